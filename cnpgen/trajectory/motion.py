"""N motions of one robot: positions and their derivatives in time, duration, time as a function of phase."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.recipes import TrajectorySpec
from cnpgen.trajectory.spline import basis, graded_edges, horner, lowest, pick, pieces

Array = NDArray[np.float64]
BLOCK = 16_384  # numbers
_NODES, _WEIGHTS = (np.polynomial.legendre.leggauss(8) + np.array([[1.0], [0.0]])) / 2  # on [0, 1]


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


@dataclass(frozen=True)
class Motion:
    """N motions ``q(t) = p(s(t))`` with ``ds/dt = r(s)``.

    Attributes:
        path: Control points of p [rad], shape (N, C, n).
        rate: Control points of r [1/s], shape (N, R).
        degree: Degree of both splines.
    """

    path: Array
    rate: Array
    degree: int = 7

    def __len__(self) -> int:
        return len(self.path)

    def __getitem__(self, index: slice | list[int] | NDArray[Any]) -> "Motion":
        return Motion(self.path[index], self.rate[index], self.degree)

    @property
    def spec(self) -> TrajectorySpec:
        """Degree and numbers of control points."""
        return TrajectorySpec(
            degree=self.degree, path_control_points=self.path.shape[1], rate_control_points=self.rate.shape[1]
        )

    def at(self, s: Array) -> States:
        """Evaluate the motions at phases s.

        ``dq = p' r``, ``ddq = p'' r^2 + p' r' r`` and ``jerk = p''' r^3 + 3 p'' r' r^2 + p' (r'' r + r'^2) r``.

        Args:
            s: Phases in [0, 1], shape (K,), the same for all motions, or (N, K).
        """
        blocks = self._blocks(s.shape[1]) if s.ndim == 2 else []
        if len(blocks) > 1:
            parts = [vars(self[block].at(s[block])) for block in blocks]
            return States(**{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})
        with np.errstate(over="ignore", invalid="ignore"):  # garbage in, nan out
            if s.ndim == 1:
                p = [basis(s, self.path.shape[1], self.degree, i) @ self.path for i in range(4)]
                r = [(basis(s, self.rate.shape[1], self.degree, i) @ self.rate[..., None])[..., 0] for i in range(3)]
            else:
                path, rate = (pick(pieces(control, self.degree), s) for control in (self.path, self.rate))
                p, r = [horner(*path, i) for i in range(4)], [horner(*rate, i) for i in range(3)]
            return _states(p, r)

    def runs_forward(self) -> NDArray[np.bool_]:
        """Whether r > 0 from start to goal, between any samples, too; False where r is not finite. Shape (N,)."""
        forward: NDArray[np.bool_] = np.asarray(np.isfinite(self.rate).all(axis=1))
        in_doubt = forward & (self.rate <= 0).any(axis=1)  # a B-spline is between its control points
        for i in np.flatnonzero(in_doubt):
            forward[i] = lowest(self.rate[i], self.degree) > 0
        return forward

    def duration(self) -> Array:
        """Duration ``T = integral of 1 / r`` [s], shape (N,); inf where r is not positive, nan where not finite."""
        total = self.time_at(np.ones(1))[:, 0]
        total[~self.runs_forward()] = np.inf
        total[~np.isfinite(self.rate).all(axis=1)] = np.nan
        return total

    def time_at(self, s: Array) -> Array:
        """Time at phases s, ``t(s) = integral of 1 / r from 0 to s`` [s].

        Args:
            s: Ascending phases, shape (K,), s[0] >= 0.

        Returns:
            Shape (N, K); without meaning where r is not positive.
        """
        edges = np.union1d(graded_edges(self.rate.shape[1], self.degree), s)
        width = np.diff(edges)
        points = edges[:-1, None] + width[:, None] * _NODES
        table, found = basis(points.ravel(), self.rate.shape[1], self.degree).T, np.searchsorted(edges, s)
        times = np.empty((len(self), len(s)))
        for block in self._blocks(points.size):
            with np.errstate(all="ignore"):  # garbage in, garbage out
                inverse = 1.0 / (self.rate[block, None] @ table)  # one product per motion: the same bits in any batch
                total = np.cumsum(inverse.reshape(-1, *points.shape) @ _WEIGHTS * width, axis=1)
            times[block] = np.pad(total, [(0, 0), (1, 0)])[:, found]
        return times

    def phase_at(self, t: Array) -> Array:
        """Phase at times t: the inverse of ``time_at``, by Newton's method within the cells of its quadrature.

        Args:
            t: Times in [0, T] [s], shape (N, K); clipped to the motion.

        Returns:
            Shape (N, K), exactly 0 and 1 at the ends; without meaning where r is not positive.
        """
        blocks = self._blocks(t.shape[1])
        if len(blocks) > 1:
            return np.concatenate([self[block].phase_at(t[block]) for block in blocks])
        edges = graded_edges(self.rate.shape[1], self.degree)
        known = self.time_at(edges)
        with np.errstate(all="ignore"):
            t = np.clip(t, 0.0, known[:, -1:])
            found = [np.searchsorted(row, times, side="right") for row, times in zip(known, t, strict=True)]
            cell = np.clip(np.array(found, np.intp).reshape(t.shape) - 1, 0, len(edges) - 2)
            low, width = edges[cell], np.diff(edges)[cell]
            rate, offset = pick(pieces(self.rate, self.degree), low + width / 2)
            offset = offset - width / 2
            left = t - np.take_along_axis(known, cell, axis=1)
            ahead = width * left / np.take_along_axis(np.diff(known), cell, axis=1)
            done = np.zeros(t.shape, bool)
            for _ in range(30):  # three or four, unless r is not positive
                nodes = (weight / horner(rate, offset + ahead * x) for x, weight in zip(_NODES, _WEIGHTS, strict=True))
                new = np.clip(ahead + (left - ahead * sum(nodes)) * horner(rate, offset + ahead), 0.0, width)
                ahead, done = np.where(done, ahead, new), done | ~(np.abs(new - ahead) > 1e-15)
                if done.all():
                    break
        return np.where(t >= known[:, -1:], 1.0, low + ahead)

    def slower(self, factor: Array) -> "Motion":
        """Slow the motions down uniformly: the path stays, the rate is divided by ``factor`` (shape (N,), at least 1).

        Exact for motions from rest to rest: their boundary velocities and accelerations stay zero.
        """
        return Motion(self.path, self.rate / factor[:, None], self.degree)

    def _blocks(self, columns: int) -> list[slice]:
        """Split the motions so that arrays of shape (block, columns) stay in the cache."""
        size = max(BLOCK // max(columns, 1), 1)
        return [slice(first, first + size) for first in range(0, len(self), size)]


def _states(p: list[Array], r: list[Array]) -> States:
    """Apply the chain rule to the derivatives of p in s, shape (N, K, n) each, and of r, shape (N, K)."""
    r0, r1, r2 = (x[..., None] for x in r)
    return States(
        q=p[0],
        dq=p[1] * r0,
        ddq=p[2] * r0**2 + p[1] * r1 * r0,
        jerk=p[3] * r0**3 + 3 * p[2] * r1 * r0**2 + p[1] * (r2 * r0 + r1**2) * r0,
        rate=r[0],
    )
