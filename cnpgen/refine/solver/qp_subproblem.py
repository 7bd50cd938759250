"""Quadratic programming subproblem of one SQP step: rules that select its residuals, and its constants.

With the Cholesky factor H + rho I = L L', the step is d = L^-T y and the elastic
variable e = z / sqrt(kappa), so that the program has the identity as its Hessian:

    minimize    |y|^2 / 2 + (L^-1 f') y + z^2 / 2 + (c / sqrt(kappa)) z
    subject to  l - g <= J L^-T y + (v- - v+) z / sqrt(kappa) <= u - g

In terms of e the elastic variable costs c e + kappa e^2 / 2, with c = mu v plus a small
constant. ``step.c`` builds the program, and ``active_set.c`` solves it.
"""

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Mask

# Of the elastic variable's cost; far smaller ones triple the working-set changes.
ELASTIC_CURVATURE_ROOT = 0.1
ELASTIC_GRADIENT = 1e-3  # of the elastic variable's cost where nothing is violated
MIN_MULTIPLIER = 1e-9  # smaller multipliers belong to inactive residuals
QP_TOLERANCE = 1e-6  # primal tolerance of active_set.c
MAX_WORKING_SET_CHANGES = 3000
# Interval of grid points at which residuals are selected without being a local maximum.
THINNING = 6
# Selection distance without accelerations, which grow with the square of the rate.
MAX_SPEED_DISTANCE = 0.4


@dataclass(frozen=True)
class Step:
    """Solution of a subproblem."""

    dx: Array  # step of the variables, shape (nx,)
    remaining: float  # fraction of the violations that remains after the step
    # Multipliers of all residuals, shape (K, m); 0 for those that are not selected.
    multipliers: Array
    gain: float  # predicted reduction of the objective


@dataclass(frozen=True)
class ResidualSelection:
    """Rule that selects the residuals of a subproblem."""

    violation: float  # largest violation at the current iterate
    # Residuals are selected at local maxima within this distance of a bound.
    max_distance: float
    # Bound of the change of log r; nonsmooth residuals that it could move over a bound
    # are selected.
    max_log_rate_change: float
    missed: Mask  # residuals that are selected in any case, shape (K, m)
    # multipliers of the last step, shape (K, m), or None; residuals with one are
    # selected
    multipliers: Array | None


def local_maxima(violations: Array) -> Mask:
    """Return a mask of local maxima along the motion, their neighbors and the thinned grid, shape (K, m)."""
    # v_k >= v_(k-1) and v_k >= v_(k+1); at the ends one neighbor decides
    peak = np.zeros(violations.shape, bool, order="F")
    peak[1:-1] = (violations[1:-1] >= violations[:-2]) & (
        violations[1:-1] >= violations[2:]
    )
    peak[0] = violations[0] >= violations[1]
    peak[-1] = violations[-1] >= violations[-2]
    # Maxima move between steps: their neighbors take part, too. The thinned grid keeps
    # long flat parts from drifting over a bound unseen.
    mask = peak.copy("F")
    mask[1:] |= peak[:-1]
    mask[:-1] |= peak[1:]
    mask[::THINNING] = True
    return mask
