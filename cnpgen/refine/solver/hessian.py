"""The Hessian of the Lagrangian of one motion: of the residuals by differences of their derivatives, phase by phase."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.solver.transcription import Linearisation, Transcription

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
STEP = 1e-5  # of central differences, relative to the largest value along the motion: errors of some 1e-9
SMALL = 1e-2  # values below this are taken for this


def lagrangian_hessian(motion: Transcription, at: Linearisation, multipliers: Array, weight: float = 1.0) -> Array:
    """Return the Hessian of ``weight * objective + multipliers . residuals``, shape (nx, nx).

    With w(x) the state of the splines at a phase and g(w) the residuals there, it is the sum over phases of
    ``(dw/dx)^T (lambda . d2g/dw2) dw/dx + (lambda . dg/dw) . d2w/dx2``. The objective's share is the positive
    semidefinite model of ``Linearisation.curvature``; w depends on x linearly but for the logarithms of the rate.

    Args:
        motion: The transcription.
        at: Where.
        multipliers: One per residual, shape (K, m); phases where all are zero cost nothing.
        weight: Multiplier of the objective.
    """
    points = np.flatnonzero(multipliers.any(axis=1))
    hessian: Array = weight * at.curvature
    if len(points) == 0:
        return hessian
    width = len(at.jacobian)
    bent = _node_hessians(motion, at, multipliers[points].T, points)
    unit = np.broadcast_to(np.eye(width)[:, :, None], (width, width, len(at.g)))
    slopes = motion.rows(replace(at, jacobian=unit), np.repeat(points, width), np.tile(np.arange(width), len(points)))
    slopes = slopes.reshape(len(points), width, motion.nx)
    inner = slopes.reshape(-1, motion.nx).T @ (bent @ slopes).reshape(-1, motion.nx)
    outer = _rate_hessian(motion, at, multipliers, points)
    return hessian + (inner + inner.T + outer + outer.T) / 2


def _node_hessians(motion: Transcription, at: Linearisation, multipliers: Array, points: Indices) -> Array:
    """Second derivatives of the residuals in w, weighted by the multipliers (m, P), at P phases: shape (P, W, W)."""
    w = motion.grid.bases.states(*motion.unpack(at.x))[:, points]
    width, count = w.shape
    step = STEP * np.maximum(np.abs(w).max(axis=1), SMALL)
    shift = np.stack([np.diag(step), -np.diag(step)], axis=1)[..., None]  # (W, sign, direction, 1)
    shifted = (w[:, None, None] + shift).reshape(width, -1)
    tops = np.repeat(motion.tops[:, None], shifted.shape[1], axis=1)
    _, jacobian = motion.stage.jacobian(shifted, tops)
    slopes = np.einsum("wmsdp,mp->swdp", jacobian.reshape(width, -1, 2, width, count), multipliers)
    return np.asarray(((slopes[0] - slopes[1]) / (2 * step[:, None])).transpose(2, 0, 1))


def _rate_hessian(motion: Transcription, at: Linearisation, multipliers: Array, points: Indices) -> Array:
    """The second term: each log r has its own curvature, the first and last two bend the boundary points, too."""
    pull = replace(at, jacobian=np.einsum("wmk,km->wk", at.jacobian, multipliers)[:, None])
    only = np.zeros(len(points), np.intp)

    def gradient(rate: Array) -> Array:
        return np.asarray(motion.rows(replace(pull, rate=rate), points, only).sum(axis=0))

    size, split = len(at.rate), motion.split
    hessian = np.zeros((motion.nx, motion.nx))
    own = np.arange(split + 2, split + size - 2)
    hessian[own, own] = gradient(at.rate)[own]
    for index in {0, 1, size - 2, size - 1}:
        factor = np.exp(STEP * np.eye(size)[index])
        hessian[:, split + index] = (gradient(at.rate * factor) - gradient(at.rate / factor)) / (2 * STEP)
    return hessian
