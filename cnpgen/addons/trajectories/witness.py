"""A smooth curve within the errors of all samples: if the independent judge accepts it, a valid motion exists.

The curve is a quintic spline with knots at the samples, one for each column of data
(positions; velocities; accelerations). Of all splines it minimizes the squared
differences from the samples plus a weight times the integral of the squared jerk
(Reinsch 1967). The normal equations are banded; all joints share a factorization. The
largest weight that keeps a joint within its errors is chosen for each joint.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.addons.trajectories.curve_family import CurveFamily
from cnpgen.addons.trajectories.interpolate import data_of, family_of_data
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array, Mask

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

DEGREE = 5
MIN_ERRORS = np.array([1e-9, 1e-7, 1e-5])  # of q, dq, ddq: agreement with exact samples
# Of the weight of the jerk, with a span as unit.
EXPONENTS = np.arange(6.0, -15.0, -1.0)
REFINED = 0.5  # of an exponent
MIN_WITNESS_SAMPLES = 4
JITTER_PARTS = 9  # times within the jitter at which a curve may meet a sample


def witness(trajectory: Trajectory, errors: SampleErrors) -> CurveFamily | None:
    """Return the smoothest curve within the errors of all samples; None if none of its weights is.

    Values of one sample belong to one time within the jitter.
    """
    if len(trajectory.t) < MIN_WITNESS_SAMPLES:
        return None
    # A sample taken d late differs by |dq| d; the largest allowed share is tried first.
    shares = (0.8, 0.0) if errors.t else (0.0,)
    for share in shares:
        fit = fitted(trajectory, errors, share)
        if fit is None:
            continue
        at = partial(derivatives_of, fit)
        if is_within(at, trajectory, errors):
            return family_of_data(trajectory.t, at(trajectory.t))
    return None


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Normal equations of the samples and of the jerk in banded form, with a span as unit of time."""

    knots: Array  # in seconds
    data: Array  # upper bands of the samples' part, shape (DEGREE + 1, N)
    jerk: Array  # upper bands of the jerk's part
    right: Array  # right-hand sides, shape (N, n)

    def solve(self, exponent: float) -> Array | None:
        """Return the coefficients for a weight of 10^exponent; None if rounding makes the equations singular."""
        from scipy.linalg import LinAlgError, solveh_banded

        try:
            return np.asarray(
                solveh_banded(self.data + 10.0**exponent * self.jerk, self.right)
            )
        except LinAlgError:
            return None


def fitted(
    trajectory: Trajectory, errors: SampleErrors, jitter_share: float
) -> "BSpline | None":
    """Return the splines of all joints with the largest weights whose differences are within the errors."""
    from scipy.interpolate import BSpline

    data = data_of(trajectory)
    t = trajectory.t
    allowed = np.maximum(errors.values, MIN_ERRORS)[: len(data)]
    # A value measured within d of its time differs by at most its rate times d.
    limits = [
        error + jitter_share * errors.t * np.abs(np.gradient(values, t, axis=0))
        for error, values in zip(allowed, data, strict=True)
    ]
    equations = _equations(t, data, allowed)
    # Columns of joints without a solution stay nan.
    chosen = np.full((len(equations.right), trajectory.q.shape[1]), np.nan)

    def keep(exponent: float, candidates: Mask) -> Mask:
        """Store the solutions of candidates within the errors, and return which these are."""
        solution = equations.solve(exponent)
        if solution is None or not np.isfinite(solution).all():
            return np.zeros_like(candidates)
        found = derivatives_of(BSpline(equations.knots, solution, DEGREE), t)
        kept = _are_close(found, data, limits, axis=0) & candidates
        chosen[:, kept] = solution[:, kept]
        return kept

    at = np.full(chosen.shape[1], np.nan)  # exponents
    # Weights fall by powers of ten: the first one within the errors is the smoothest.
    for exponent in EXPONENTS:
        at[keep(exponent, np.isnan(at))] = exponent
        if not np.isnan(at).any():
            break
    if np.isnan(at).any():
        return None
    # Half a power more is tried once; a joint that fails keeps its solution.
    for exponent in np.unique(at):
        keep(exponent + REFINED, at == exponent)
    return BSpline(equations.knots, chosen, DEGREE)


def derivatives_of(spline: "BSpline", t: Array) -> list[Array]:
    """Return positions, velocities and accelerations of a spline, shape (K, n) or (K,) each."""
    return [np.asarray(spline(t, order)) for order in range(3)]


def _equations(t: Array, data: list[Array], errors: Array) -> _NormalEquations:
    """Return the normal equations of K samples; data of shape (K, n) each."""
    from scipy.interpolate import BSpline

    h = t[-1] / (len(t) - 1)
    # With m columns, inner knots have the multiplicity m: about one coefficient for
    # each value, so that errors of exact samples can vanish.
    inner = np.repeat(t[1:-1], len(data))
    knots = np.concatenate([[t[0]] * (DEGREE + 1), inner, [t[-1]] * (DEGREE + 1)])
    scaled = knots / h
    times = t / h
    # The last sample must not lie beyond the last knot by rounding, where the basis
    # ends.
    times[-1] = scaled[-1]
    # Rows of derivatives are those of lower degree times differences of coefficients.
    rows = np.eye(1)
    total = 0.0
    right = 0.0
    difference: Any = None
    for order, values in enumerate(data):
        basis = BSpline.design_matrix(
            times, scaled[order : len(scaled) - order], DEGREE - order
        )
        rows = basis if difference is None else basis @ difference
        # Differences count in units of their errors, and those of positions have weight
        # 1.
        weight = (errors[0] / (errors[order] * h**order)) ** 2
        total = total + weight * (rows.T @ rows)
        right = right + weight * (rows.T @ (values * h**order))
        difference = _difference(scaled, order, difference)
    for order in range(len(data), 3):
        difference = _difference(scaled, order, difference)
    # Squared jerks have degree 4 in a span: three Gauss nodes integrate them exactly.
    nodes, weights = np.polynomial.legendre.leggauss(DEGREE - 2)
    spans = np.diff(times)
    points = (times[:-1, None] + spans[:, None] * (nodes + 1) / 2).ravel()
    third = BSpline.design_matrix(points, scaled[3:-3], DEGREE - 3) @ difference
    strength = (spans[:, None] * weights / 2).ravel()
    jerk = third.T @ third.multiply(strength[:, None])
    return _NormalEquations(knots, _bands(total), _bands(jerk), np.asarray(right))


def _difference(knots: Array, order: int, before: Any) -> Any:
    """Return the matrix from coefficients to those of the derivative of the next order (de Boor 1978, ch. X)."""
    from scipy.sparse import diags_array

    size = len(knots) - DEGREE - 1 - order
    inner = knots[order : len(knots) - order]
    degree = DEGREE - order
    # Coefficients of the derivative: c'_i = p (c_i+1 - c_i) / (t_i+p+1 - t_i+1), with
    # the degree p.
    scale = degree / (inner[degree + 1 : degree + size] - inner[1:size])
    matrix = diags_array(
        (-scale, scale), offsets=(0, 1), shape=(size - 1, size)
    ).tocsr()
    return matrix if before is None else matrix @ before


def _bands(matrix: Any) -> Array:
    """Return the upper bands of a symmetric sparse matrix as of ``scipy.linalg.solveh_banded``."""
    bands = np.zeros((DEGREE + 1, matrix.shape[0]))
    for offset in range(min(DEGREE + 1, matrix.shape[0])):
        bands[DEGREE - offset, offset:] = matrix.diagonal(offset)
    return bands


def is_within(
    at: Callable[[Array], list[Array]], trajectory: Trajectory, errors: SampleErrors
) -> bool:
    """Return whether a curve meets every sample within its errors at one time within the jitter.

    ``at`` returns its positions, velocities and accelerations at times [s].
    """
    t = trajectory.t
    # The relative share is for rounding in the evaluation of splines.
    allowed = np.maximum(errors.values, MIN_ERRORS) * (1 + 1e-9)
    met = np.zeros(len(t), bool)
    for offset in np.linspace(-1, 1, JITTER_PARTS if errors.t else 1):
        shift = offset * errors.t if errors.t else 0.0
        # All values of a sample must be met at one time, not each at its own.
        values = at(np.clip(t + shift, t[0], t[-1]))
        met |= _are_close(values, data_of(trajectory), allowed, axis=1)
    return bool(met.all())


def _are_close(
    values: Sequence[Array], data: Sequence[Array], limits: Iterable[Any], axis: int
) -> Mask:
    """Return whether all given data are within limits of values along an axis."""
    close = [
        (np.abs(value - given) <= limit).all(axis=axis)
        for value, given, limit in zip(values, data, limits, strict=False)
    ]
    return np.asarray(np.all(close, axis=0))
