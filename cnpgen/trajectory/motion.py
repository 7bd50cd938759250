"""N motions of one robot: positions and their derivatives in time, duration, time as a function of phase."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.recipes import TrajectorySpec
from cnpgen.trajectory.spline import basis, gauss_rule

Array = NDArray[np.float64]


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
        if s.ndim == 2:
            parts = [Motion(self.path[[i]], self.rate[[i]], self.degree).at(s[i]) for i in range(len(self))]
            return States(*(np.concatenate([getattr(part, name) for part in parts]) for name in States.__annotations__))
        p = [basis(s, self.path.shape[1], self.degree, order) @ self.path for order in range(4)]
        r, r1, r2 = (self.rate @ basis(s, self.rate.shape[1], self.degree, order).T for order in range(3))
        a, b, c = r[..., None], r1[..., None], r2[..., None]
        return States(
            q=p[0],
            dq=p[1] * a,
            ddq=p[2] * a**2 + p[1] * b * a,
            jerk=p[3] * a**3 + 3 * p[2] * b * a**2 + p[1] * (c * a + b**2) * a,
            rate=r,
        )

    def duration(self) -> Array:
        """Duration ``T = integral of 1 / r`` [s], shape (N,); inf or negative where r is not positive."""
        s, weights = gauss_rule(self.rate.shape[1], self.degree)
        with np.errstate(divide="ignore"):
            inverse: Array = 1.0 / (self.rate @ basis(s, self.rate.shape[1], self.degree).T)
        return inverse @ weights

    def time_at(self, s: Array) -> Array:
        """Time at phases s, ``t(s) = integral of 1 / r from 0 to s`` [s].

        Args:
            s: Ascending phases, shape (K,), s[0] >= 0.

        Returns:
            Shape (N, K).
        """
        edges = np.unique(np.concatenate([np.linspace(0, 1, 4 * (self.rate.shape[1] - self.degree) + 1), [0.0], s]))
        nodes, weights = np.polynomial.legendre.leggauss(6)
        width = np.diff(edges)
        points = edges[:-1, None] + width[:, None] * (nodes + 1) / 2
        rate = self.rate @ basis(points.ravel(), self.rate.shape[1], self.degree).T
        pieces = (1.0 / rate).reshape(len(self), len(width), len(nodes)) @ (weights / 2) * width
        total = np.concatenate([np.zeros((len(self), 1)), np.cumsum(pieces, axis=1)], axis=1)
        return np.asarray(total[:, np.searchsorted(edges, s)])

    def phase_at(self, t: Array) -> Array:
        """Phase at times t: the inverse of ``time_at``, by interpolation and Newton's method.

        Args:
            t: Times in [0, T] [s], shape (N, K); clipped to the motion.

        Returns:
            Shape (N, K).
        """
        grid = np.linspace(0, 1, 513)
        known = self.time_at(grid)
        s = np.array([np.interp(times, row, grid) for times, row in zip(t, known, strict=True)])
        for _ in range(3):
            for i in range(len(self)):
                one = Motion(self.path[[i]], self.rate[[i]], self.degree)
                order = np.argsort(s[i], kind="stable")
                now, rate = np.empty_like(s[i]), one.at(s[i]).rate[0]
                now[order] = one.time_at(s[i][order])[0]
                s[i] = np.clip(s[i] + (np.clip(t[i], 0, known[i, -1]) - now) * rate, 0.0, 1.0)
        return s

    def slower(self, factor: Array) -> "Motion":
        """Slow the motions down uniformly: the path stays, the rate is divided by ``factor`` (shape (N,), at least 1).

        Exact for motions from rest to rest: their boundary velocities and accelerations stay zero.
        """
        return Motion(self.path, self.rate / factor[:, None], self.degree)
