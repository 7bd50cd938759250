"""Derivatives of the refiner's transcription in NumPy: the reference of ``step.c``, and the input of other solvers."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Indices
from cnpgen.refine.solver.grid import Bases
from cnpgen.refine.solver.residuals import CostTerm
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.trajectory.boundary import boundary_derivatives


@dataclass(frozen=True)
class Linearization:
    """Objective and residuals at one x, with their derivatives."""

    x: Array  # variables, shape (nx,)
    cost: float  # objective [s]
    gradient: Array  # gradient of the objective, shape (nx,)
    curvature: Array  # positive semidefinite model of its Hessian, shape (nx, nx)
    g: Array  # residuals, shape (K, m)
    jacobian: Array  # d(residuals)/d(w), shape (width of w, m, K)
    rate: Array  # rate control points, shape (R,)


def regularized_values(motion: Transcription, x: Array) -> tuple[float, Array]:
    """Evaluate the regularized objective and residuals (K, m), without derivatives."""
    cost, g = motion.measured(x)
    return cost + motion.regularization(x), g


def evaluate(motion: Transcription, x: Array) -> Linearization:
    """Evaluate objective and residuals with their derivatives."""
    w, path, rate = motion.states(x)
    g, jacobian = motion.kernels.jacobian(w, motion.poses_along)
    log = x[motion.split :]
    # dr/d(log R_j) = B_j R_j at the nodes of the time integral
    log_rate_derivative = motion.grid.time_basis * rate
    inverse = 1.0 / (motion.grid.time_basis @ rate)
    cost = float(inverse @ motion.grid.time_weights) + motion.regularization(x)
    gradient = np.zeros(motion.nx)
    # dT/d(log R) = -sum of weight r^-2 dr/d(log R)
    gradient[motion.split :] = (
        -((motion.grid.time_weights * inverse**2) @ log_rate_derivative)
        + motion.smoothing @ log
    )
    curvature = np.zeros((motion.nx, motion.nx))
    # H = half' half: a square root, so that one product of matrices builds it
    half = (
        log_rate_derivative
        * np.sqrt(2 * motion.grid.time_weights * inverse**3)[:, None]
    )
    curvature[motion.split :, motion.split :] = half.T @ half + motion.smoothing
    if motion.kernels.cost_term is not None:
        cost += _add_cost_term(motion, path, rate, gradient, curvature)
    return Linearization(
        x, cost, gradient, curvature, g.T, jacobian.reshape(len(w), *g.shape), rate
    )


def residual_gradients(
    motion: Transcription, at: Linearization, k: Indices, residual: Indices
) -> Array:
    """Return the gradients of residuals with indices (m,) at grid points k, (m,), in the variables: (m, nx)."""
    return _chain(motion, at.jacobian[:, residual, k].T, k, at.rate, motion.grid.bases)


def linearization_errors(
    motion: Transcription, at: Linearization, step: float
) -> Array:
    """Bound the change of residuals by derivatives of r if no log r changes by more than ``step``: (K, m)."""
    # |r^(i) after - before| <= sum_j |B_j^(i)| R_j step, to first order in the step
    orders = len(motion.grid.bases.path)
    errors = np.zeros(at.g.shape)
    for order in range(1, orders - 1):
        change = np.abs(motion.grid.bases.rate[order]) @ at.rate * step
        errors += np.abs(at.jacobian[orders * motion.n + order]).T * change[:, None]
    return errors


def _cost_residuals(
    motion: Transcription, path: Array, rate: Array
) -> tuple[Array, Array, Array]:
    """Return the cost term's residuals (m, Q), their Jacobian (4 n + 3, m, Q) and quadrature weights (Q,)."""
    assert motion.kernels.cost_residuals is not None
    w = motion.grid.cost_bases.states(path, rate)
    e, jacobian = motion.kernels.cost_residuals(w)
    # dt = ds / r: quadrature weights of the phase become those of time.
    weights = motion.grid.cost_weights / w[4 * motion.n]
    return e, jacobian.reshape(len(w), *e.shape), weights


def _add_cost_term(
    motion: Transcription, path: Array, rate: Array, gradient: Array, curvature: Array
) -> float:
    """Add the cost term's gradient and its Gauss-Newton Hessian.

    Return its value.
    """
    assert motion.kernels.cost_term is not None
    bases = motion.grid.cost_bases
    e, jacobian, weights = _cost_residuals(motion, path, rate)
    counts = motion.kernels.cost_counts
    rho = motion.kernels.cost_term.rate(e, counts)
    rho_derivative = cost_weights(motion.kernels.cost_term, e, counts)
    m, points = e.shape
    k = np.repeat(np.arange(points), m)
    residual = np.tile(np.arange(m), points)
    rows = _chain(motion, jacobian[:, residual, k].T, k, rate, bases)
    row_weights = (weights * rho_derivative)[residual, k]
    gradient += (row_weights * e[residual, k]) @ rows
    half = rows * np.sqrt(row_weights)[:, None]
    # The weights depend on r, too: d(1 / r) = -dr / r^2 with dr = B R d(log R).
    gradient[motion.split :] -= (
        (weights * rho / (bases.rate[0] @ rate)) @ bases.rate[0] * rate
    )
    # A product of one matrix takes half the time.
    curvature += half.T @ half
    return float(weights @ rho)


def _chain(
    motion: Transcription, state_gradients: Array, k: Indices, rate: Array, bases: Bases
) -> Array:
    """Convert gradients in w at nodes k, shape (m, width of w), to gradients in the variables, (m, nx)."""
    n = motion.n
    m = len(k)
    orders = len(bases.path)
    # dg/dC = sum over orders of B^(i) dg/dp^(i), for all control points, also those
    # that the boundary conditions determine
    control = bases.path_at[k] @ state_gradients[:, : orders * n].reshape(m, orders, n)
    out = np.empty((m, motion.nx))
    out[:, : motion.split] = control[:, 3 : (motion.interior + 3)].reshape(
        m, motion.split
    )
    out[:, motion.split :] = (
        state_gradients[:, None, orders * n :] @ bases.rate_at[k]
    )[:, 0] * rate
    # Boundary control points depend on the first and last rates: chain rule through them.
    for item in boundary_derivatives(motion.boundary, rate[None], motion.spec):
        out[:, motion.split + item.variable] += control[:, item.point] @ (
            item.derivative[0] * rate[item.variable]
        )
    return out


def cost_weights(term: CostTerm, e: Array, counts: Iterable[int]) -> Array:
    """Return the weights of the residuals e, shape (m, K), in the gradient of rho: ``weights * e``, shape (m, K).

    The diagonal matrix of the weights bounds the Hessian of rho from above.
    """
    weights = np.empty(e.shape)
    first = 0
    for count, smoothing, weight in term.groups(counts).tolist():
        part = slice(first, first := first + int(count))
        size = np.sqrt(np.sum(e[part] * e[part], axis=0) + smoothing**2)
        # d rho = weights e . de
        weights[part] = weight / size if smoothing > 0 else 2.0 * weight
    return weights
