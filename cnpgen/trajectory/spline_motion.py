"""N motions of one robot: positions and their time derivatives, duration, time as a function of phase."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.schema.arguments import numbers
from cnpgen.trajectory.boundary import MotionIndexError
from cnpgen.trajectory.spline import (
    basis,
    clamped_knots,
    derivatives_of_each,
    edges_around,
    extrema,
    graded_edges,
    horner,
    power_coefficients,
    select_spans,
)
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

MAX_BLOCK_VALUES = 16_384  # per temporary array, to fit into the cache
# On [0, 1].
_NODES, _WEIGHTS = (np.polynomial.legendre.leggauss(8) + np.array([[1.0], [0.0]])) / 2
_NODES_AND_END = np.append(_NODES, 1.0)[:, None, None]


@dataclass(frozen=True)
class States:
    """Samples of N motions at K phases each; every array has shape (N, K, n).

    Attributes:
        q: Joint positions [rad].
        dq: Joint velocities [rad/s].
        ddq: Joint accelerations [rad/s^2].
        jerk: Joint jerks [rad/s^3].
        rate: r = ds/dt [1/s], shape (N, K).
    """

    q: Array
    dq: Array
    ddq: Array
    jerk: Array
    rate: Array

    def __repr__(self) -> str:
        return f"<States of shape {np.shape(self.q)}>"


@dataclass(frozen=True)
class Motion:
    """N motions ``q(t) = p(s(t))`` with ``ds/dt = r(s)``.

    Attributes:
        path: Control points of p [rad], shape (N, C, n).
        rate: Control points of r [1/s], shape (N, R).
        degree: Degree of both splines.

    Raises:
        UsageError: The shapes do not fit together.
    """

    path: Array
    rate: Array
    degree: int = 7

    def __post_init__(self) -> None:
        try:
            arrays = np.asarray(self.path), np.asarray(self.rate)
        except ValueError as error:
            # Rows of different lengths.
            raise UsageError(
                f"control points must be arrays: {error}", concerns="path"
            ) from error
        for name, array in zip(("path", "rate"), arrays, strict=True):
            if array.dtype.kind not in "fiu":
                raise UsageError("must be an array of numbers", argument=name)
        path, rate = (array.shape for array in arrays)
        if len(path) != 3 or len(rate) != 2 or path[0] != rate[0]:
            raise UsageError(
                f"control points must have shapes (N, C, n) and (N, R), got {path} and {rate}",
                concerns="path",
            )
        if not isinstance(self.degree, int | np.integer):
            raise UsageError(
                f"must be an integer, got {self.degree!r:.100}", argument="degree"
            )
        if min(path[1], rate[1]) <= self.degree:
            raise UsageError(
                f"splines of degree {self.degree} need at least {self.degree + 1} control points",
                concerns="degree",
            )

    def __repr__(self) -> str:
        return f"<Motion of degree {self.degree}: path {np.shape(self.path)}, rate {np.shape(self.rate)}>"

    def __len__(self) -> int:
        return len(self.path)

    def __getitem__(self, index: int | slice | list[int] | NDArray[Any]) -> Motion:
        index = [int(index)] if isinstance(index, int | np.integer) else index
        try:
            return Motion(self.path[index], self.rate[index], self.degree)
        except (IndexError, TypeError, ValueError, UsageError) as error:
            text = (
                f"motions are selected by a number, numbers, a mask or a slice: {error}"
            )
            raise MotionIndexError(text, concerns="index") from error

    @property
    def spec(self) -> TrajectorySpec:
        """Degree and numbers of control points."""
        return TrajectorySpec(
            degree=self.degree,
            path_control_points=self.path.shape[1],
            rate_control_points=self.rate.shape[1],
        )

    def at(self, s: Array) -> States:
        """Evaluate the motions at phases s; see ``time_derivatives``.

        Args:
            s: Phases in [0, 1], shape (K,), the same for all motions, or (N, K).

        Raises:
            UsageError: s has another shape.
        """
        s = self._checked("s", s)
        blocks = self._blocks(s.shape[1]) if s.ndim == 2 else []
        if len(blocks) > 1:
            parts = [vars(self[block].at(s[block])) for block in blocks]
            return States(
                **{
                    name: np.concatenate([part[name] for part in parts])
                    for name in parts[0]
                }
            )
        # invalid inputs give nan
        with np.errstate(over="ignore", invalid="ignore"):
            if s.ndim == 1:
                p = [
                    basis(s, self.path.shape[1], self.degree, i) @ self.path
                    for i in range(4)
                ]
                r = [
                    (
                        basis(s, self.rate.shape[1], self.degree, i)
                        @ self.rate[..., None]
                    )[..., 0]
                    for i in range(3)
                ]
            else:
                path, rate = (
                    select_spans(power_coefficients(control, self.degree), s)
                    for control in (self.path, self.rate)
                )
                p = [horner(*path, i) for i in range(4)]
                r = [horner(*rate, i) for i in range(3)]
            q, dq, ddq, jerk = time_derivatives(p, [values[..., None] for values in r])
            return States(q, dq, ddq, jerk, rate=r[0])

    def runs_forward(self) -> NDArray[np.bool_]:
        """Return whether r > 0 over the whole motion, not only at samples, shape (N,); False where r is not finite."""
        forward: NDArray[np.bool_] = np.asarray(np.isfinite(self.rate).all(axis=1))
        # Convex hull property: r lies between its control points.
        unproven = forward & (self.rate <= 0).any(axis=1)
        for i in np.flatnonzero(unproven):
            forward[i] = extrema(self.rate[i], self.degree)[1].min() > 0
        return forward

    def duration(self) -> Array:
        """Compute the duration ``T = integral of 1 / r`` [s], shape (N,).

        It is inf where r is not positive, and nan where r is not finite.
        """
        total = np.empty(len(self))
        for rows, edges, table in self._cells():
            total[rows] = self[rows]._times_at(edges, table)[:, -1]
        total[~self.runs_forward()] = np.inf
        total[~np.isfinite(self.rate).all(axis=1)] = np.nan
        return total

    def duration_bound(self) -> Array:
        """Return a fast upper bound of the duration [s], shape (N,), for positive control points of r.

        1 / r is convex in r, so it is at most the mean of 1 / r_j with the weights of
        the basis at a phase (Jensen).
        """
        points = self.rate.shape[1]
        degree = self.degree
        knots = clamped_knots(points, degree)
        # The integral of a basis function is (t_{j+D+1} - t_j) / (D + 1), its weight in
        # the bound.
        return np.asarray(
            (1 / self.rate) @ ((knots[degree + 1 :] - knots[:points]) / (degree + 1))
        )

    def time_at(self, s: Array) -> Array:
        """Compute the time at phases s, ``t(s) = integral of 1 / r from 0 to s`` [s].

        Args:
            s: Phases in [0, 1], shape (K,), the same for all motions, or (N, K).

        Returns:
            Times [s], shape (N, K); undefined where r is not positive.

        Raises:
            UsageError: s has another shape.
        """
        s = np.clip(self._checked("s", s), 0.0, 1.0)
        if s.ndim == 2:
            return np.array(
                [self[[i]].time_at(s[i])[0] for i in range(len(self))]
            ).reshape(s.shape)
        times = np.empty((len(self), len(s)))
        for rows, coarse, _ in self._cells():
            # Cells end at the phases too, so that their times are sums of whole cells.
            edges = np.union1d(coarse, s)
            table = _kept_nodes(edges.tobytes(), self.rate.shape[1], self.degree)
            times[rows] = self[rows]._times_at(edges, table)[
                :, np.searchsorted(edges, s)
            ]
        return times

    def _times_at(self, edges: Array, table: Array) -> Array:
        """Compute the time at edges of cells, shape (N, edges), from the basis at their Gauss nodes, (R, cells x 8)."""
        width = np.diff(edges)
        times = np.zeros((len(self), len(edges)))
        for block in self._blocks(table.shape[1]):
            # Invalid inputs give invalid results.
            with np.errstate(all="ignore"):
                # One product per motion: same bits in any batch.
                inverse = 1.0 / (self.rate[block, None] @ table)
                cells = (
                    inverse.reshape(-1, len(width), len(_WEIGHTS)) @ _WEIGHTS * width
                )
                np.cumsum(cells, axis=1, out=times[block, 1:])
        return times

    def phase_at(self, t: Array) -> Array:
        """Compute the phase at times t: the inverse of ``time_at``, by Newton's method in the cells of its quadrature.

        Args:
            t: Times in [0, T] [s], shape (K,), the same for all motions, or (N, K);
                clipped to the motion.

        Returns:
            Phases, shape (N, K), exactly 0 and 1 at the ends; undefined where r is not
            positive.

        Raises:
            UsageError: t has another shape.
        """
        t = self._checked("t", t)
        t = np.repeat(t[None], len(self), axis=0) if t.ndim == 1 else t
        blocks = self._blocks(len(_NODES) * t.shape[1])
        if len(blocks) > 1:
            return np.concatenate([self[block].phase_at(t[block]) for block in blocks])
        phases = np.empty(t.shape)
        for rows, edges, table in self._cells():
            phases[rows] = self[rows]._phases_at(t[rows], edges, table)
        return phases

    def _phases_at(self, t: Array, edges: Array, table: Array) -> Array:
        """Compute the phases at times t, shape (N, K), with a quadrature over cells between the edges."""
        known = self._times_at(edges, table)
        with np.errstate(all="ignore"):
            t = np.clip(t, 0.0, known[:, -1:])
            index = [
                np.searchsorted(row, times, side="right")
                for row, times in zip(known, t, strict=True)
            ]
            cell = np.clip(
                np.array(index, np.intp).reshape(t.shape) - 1, 0, len(edges) - 2
            )
            # Start from linear interpolation within the cell; left is the time still to
            # go.
            low = edges[cell]
            width = np.diff(edges)[cell]
            rate, offset = select_spans(
                power_coefficients(self.rate, self.degree), low + width / 2
            )
            offset = offset - width / 2
            left = t - np.take_along_axis(known, cell, axis=1)
            ahead = width * left / np.take_along_axis(np.diff(known), cell, axis=1)
            done = np.zeros(t.shape, bool)
            # Three or four are enough if r is positive.
            for _ in range(30):
                values = horner(rate, offset + ahead * _NODES_AND_END)
                # Node by node: same bits in any batch.
                taken = ahead * sum(_WEIGHTS[:, None, None] / values[:-1])
                # Newton step on t(s) = t with dt/ds = 1 / r, kept within the cell.
                new = np.minimum(
                    np.maximum(ahead + (left - taken) * values[-1], 0.0), width
                )
                ahead, done = (
                    np.where(done, ahead, new),
                    done | ~(np.abs(new - ahead) > 1e-15),
                )
                if done.all():
                    break
        # Exactly 1 at the end, whatever the rounding of the sum.
        return np.where(t >= known[:, -1:], 1.0, low + ahead)

    def at_times(self, t: Array) -> States:
        """Evaluate the motions at times t [s], shape (K,) or (N, K), clipped to the motion; see ``at``."""
        return self.at(self.phase_at(t))

    def time_scaled(self, factor: Array | float) -> Motion:
        """Scale time uniformly: keep the path and divide the rate by a factor.

        Exact for motions from rest to rest: their boundary velocities and accelerations
            stay zero.

        Args:
            factor: Scale of the durations, at least 1: one per motion, shape (N,), or
                one for all.
        """
        factors = numbers("factor", factor).reshape(-1, 1)
        if len(factors) not in {1, len(self)} or not (factors > 0).all():
            got = f"got {factor!s:.100}"
            raise UsageError(
                f"must be one positive number or one for each of {len(self)} motions, {got}",
                argument="factor",
            )
        return Motion(self.path, self.rate / factors, self.degree)

    def _checked(self, name: str, values: ArrayLike) -> Array:
        """Return phases or times as an array of shape (K,) or (N, K)."""
        array = numbers(name, values)
        if array.ndim not in {1, 2} or (array.ndim == 2 and len(array) != len(self)):
            raise UsageError(
                f"must have shape (K,) or ({len(self)}, K), got {array.shape}",
                argument=name,
            )
        return array

    def _cells(self) -> Iterator[tuple[slice | list[int], Array, Array]]:
        """Yield groups of motions, the edges of the quadrature cells of ``t(s)`` for them, and ``_nodes`` of the edges.

        All motions share the edges, except those whose r has control points that are
            not positive: it may nearly be 0.
        """
        points = self.rate.shape[1]
        degree = self.degree
        shared = _shared_cells(points, degree)
        # Nodes near a zero of r need cells that shrink towards it.
        near_zero = np.isfinite(self.rate).all(axis=1) & (self.rate <= 0).any(axis=1)
        if not near_zero.any():
            yield slice(None), *shared
            return
        yield np.flatnonzero(~near_zero).tolist(), *shared
        for i in np.flatnonzero(near_zero).tolist():
            s, r = extrema(self.rate[i], degree)
            edges = edges_around(s, points, degree)
            yield (
                [i],
                *((edges, _nodes(edges, points, degree)) if r.min() > 0 else shared),
            )

    def _blocks(self, columns: int) -> list[slice]:
        """Split the motions into blocks whose arrays of shape (block, columns) fit into the cache."""
        size = max(MAX_BLOCK_VALUES // max(columns, 1), 1)
        return [slice(first, first + size) for first in range(0, len(self), size)]


def scaled_to_duration(
    rate: Array, duration: Array | float, spec: TrajectorySpec
) -> Array:
    """Scale rate control points [1/s], shape (N, R), to a duration [s], one number or shape (N,)."""
    path = np.zeros((len(rate), spec.path_control_points, 1))
    return rate * (Motion(path, rate, spec.degree).duration() / duration)[:, None]


@cache
def _shared_cells(points: int, degree: int) -> tuple[Array, Array]:
    """Return the edges of the cells of motions with positive rate control points, and ``_nodes`` of them."""
    edges = graded_edges(points, degree)
    return edges, _nodes(edges, points, degree)


@lru_cache(maxsize=16)
def _kept_nodes(edges: bytes, points: int, degree: int) -> Array:
    """Return ``_nodes`` of edges, kept for calls with equal phases."""
    return _nodes(np.frombuffer(edges), points, degree)


def _nodes(edges: Array, points: int, degree: int) -> Array:
    """Return the basis of r at the Gauss nodes of the cells between the edges, shape (R, cells x 8)."""
    nodes = edges[:-1, None] + np.diff(edges)[:, None] * _NODES
    return basis(nodes.ravel(), points, degree).T


def time_derivatives(p: Sequence[Array], r: Sequence[Array]) -> list[Array]:
    """Convert derivatives of the path and the rate by phase to positions and their derivatives by time.

    ``dq = p' r``, ``ddq = (p'' r + p' r') r`` and ``jerk = ((p''' r + 3 p'' r') r + p'
    (r'' r + r'^2)) r``. The jerk is returned if the path has three derivatives; the
    rate has one less. Their shapes broadcast to those of the path.
    """
    states = [p[0], p[1] * r[0], (p[2] * r[0] + p[1] * r[1]) * r[0]]
    if len(p) > 3:
        states.append(
            ((p[3] * r[0] + 3 * p[2] * r[1]) * r[0] + p[1] * (r[2] * r[0] + r[1] ** 2))
            * r[0]
        )
    return states


def states_at_times(motion: Motion, t: Array) -> tuple[Array, Array, Array]:
    """Evaluate each of N motions at one time [s], shape (N,), faster than ``Motion.at_times``, for online replanning.

    The result are positions [rad], velocities [rad/s] and accelerations [rad/s^2],
    shape (N, n) each.
    """
    s = motion.phase_at(t[:, None])[:, 0]
    p = derivatives_of_each(motion.path, motion.degree, s)
    r = derivatives_of_each(motion.rate[..., None], motion.degree, s)
    q, dq, ddq = time_derivatives(list(p), list(r))
    return q, dq, ddq
