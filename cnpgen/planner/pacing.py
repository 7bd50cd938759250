"""Pacing: rates behind the network are made as large as limits allow, and smaller where limits are broken.

The path stays, and so do the two control points of the rate at either end, which the boundary conditions hang on. On a
path that is given, what a problem bounds is ``g = rest + linear r + square r^2 + mixed r r'`` with coefficients that
depend on the phase alone: velocities, accelerations and torques are, as in time-optimal path parameterisation
(Bobrow, Dubowsky and Gibson, 1985). So it is a quadratic of any one control point of the rate, or of a factor of them
all, and how far that may go before the first bound is met follows in closed form. Control points go half of that way,
one after the other and twice; what is then left, all of them go together.
"""

import ctypes
from ctypes import c_double, c_long, c_void_p
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.compiled import address_of
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.preparation import lanes
from cnpgen.planner.speeds import BLOCK, Speeds, load_speeds
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

SOURCE = Path(__file__).with_name("pace.c")
FIXED = 2  # control points of the rate at either end
SWEEPS, SHARE = 2, 0.5
MOST, LEAST = 0.5, -0.3  # of itself: no control point is changed more at once
ROUNDED = 1e-9  # of a limit: what a boundary condition may be beyond it


class _Pacing(ctypes.Structure):
    """``pacing`` of pace.c."""

    _fields_ = (
        *((name, c_long) for name in ("count", "phases", "rows", "points", "first", "last", "sweeps")),
        *((name, c_void_p) for name in ("rest", "linear", "square", "mixed", "lower", "upper")),
        *((name, c_void_p) for name in ("basis", "slope", "span")),
        *((name, c_double) for name in ("share", "most", "least")),
        *((name, c_void_p) for name in ("rate", "scratch")),
    )


@dataclass(frozen=True)
class Pacing(Speeds):
    """Fits rates of one problem's motions to its limits; made by ``make_pacing``.

    Attributes:
        library: That of pace.c; None where kernels are not compiled.
    """

    library: ctypes.CDLL | None

    def paced(self, motion: Motion, tops: Array) -> Motion:
        """Return N motions along the same paths, between the same ends, whose rates meet the limits.

        One whose worst value is then further out than before stays as it was: what is bounded of it is no such
        quadratic.

        Args:
            motion: N motions, with the problem's numbers of control points.
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).
        """
        blocks = [slice(first, first + BLOCK) for first in range(0, len(motion), BLOCK)]
        found = [self._paced(motion[block], tops[block]) for block in blocks]
        rate = np.concatenate(found) if found else motion.rate
        return Motion(motion.path, rate, motion.degree)

    def _paced(self, motion: Motion, tops: Array) -> Array:
        path = [lanes((each @ motion.path).reshape(-1, motion.path.shape[2])) for each in self.path]
        heights = np.repeat(tops.T, self.path.shape[1], axis=1)
        coefficients = self._coefficients(path, heights)
        rate = np.array(motion.rate, order="C")
        if self.library is None:
            pace(rate, coefficients, self._bounds, self.rate)
        else:
            self._pace_compiled(rate, coefficients)
        worst_before, worst = (self._worst(path, each, heights) for each in (motion.rate, rate))
        better = worst <= np.maximum(worst_before, self._slack)
        return np.where(better[:, None], rate, motion.rate)

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds, eased by what rounding takes."""
        return self.lower - ROUNDED * np.abs(self.lower), self.upper + ROUNDED * np.abs(self.upper)

    @cached_property
    def _slack(self) -> float:
        """What is no excess [SI units of the largest bound]."""
        bounds = np.abs(np.concatenate([self.lower, self.upper]))
        return 10 * ROUNDED * float(bounds[np.isfinite(bounds)].max(initial=0.0))

    @cached_property
    def _span(self) -> NDArray[np.int64]:
        """First phase at which a control point of the rate counts, and that behind the last, shape (R, 2)."""
        counts = (self.rate != 0).any(axis=0)
        return np.stack([counts.argmax(axis=0), len(counts) - counts[::-1].argmax(axis=0)], axis=1).astype(np.int64)

    @cached_property
    def _tables(self) -> tuple[Array, Array]:
        """Basis of r and r' as pace.c takes them, shape (R, K) each."""
        return np.ascontiguousarray(self.rate[0].T), np.ascontiguousarray(self.rate[1].T)

    def _coefficients(self, path: list[Array], heights: Array) -> list[Array]:
        """Return rest, linear, square and mixed of every row at every phase of N motions, shape (m, N K) each."""
        p, p1, p2 = path
        states = ((0 * p1, 0 * p2), (p1, p2), (2 * p1, 4 * p2), (p1, p2 + p1))  # r, r' = 0, 0; 1, 0; 2, 0; 1, 1
        rest, one, two, rising = (self.residuals(p, *state, heights)[0] for state in states)
        rising -= one
        one -= rest
        two -= rest
        two *= 0.5
        two -= one
        one -= two
        return [rest, one, two, rising]

    def _worst(self, path: list[Array], rate: Array, heights: Array) -> Array:
        """By how much the worst value of every motion is out, shape (N,)."""
        rates = [(rate @ each.T).reshape(1, -1) for each in self.rate]
        (found,) = self.excess(np.concatenate([*path, *rates, heights]))
        return np.asarray(found.reshape(len(rate), -1).max(axis=1))

    def _pace_compiled(self, rate: Array, coefficients: list[Array]) -> None:
        assert self.library is not None
        count, points = rate.shape
        phases, rows = self.rate.shape[1], len(self.lower)
        scratch, kept = np.empty(5 * phases), [np.ascontiguousarray(each) for each in coefficients]
        arrays = [*kept, *self._bounds, *self._tables, self._span]
        numbers = (count, phases, rows, points, FIXED, points - FIXED, SWEEPS)
        where = [address_of(each) for each in arrays]
        self.library.pace(
            ctypes.byref(_Pacing(*numbers, *where, SHARE, MOST, LEAST, address_of(rate), address_of(scratch)))
        )


def make_pacing(problem: Problem, robot: "Robot", kernels: KernelLibrary) -> Pacing:
    """Prepare the pacing of one problem.

    Args:
        problem: The problem.
        robot: Its robot.
        kernels: Where kernels are loaded from.

    Raises:
        UsageError: The problem bounds the jerk, which is no quadratic of the rate.
    """
    if problem.path_orders > 3:
        raise UsageError(f"plans of {problem.name!r} cannot be paced: its jerk is bounded")
    library = kernels.load_source(SOURCE)
    if library is not None:
        library.pace.argtypes, library.pace.restype = (c_void_p,), None
    return Pacing(**vars(load_speeds(problem, robot, kernels)), library=library)


def pace(rate: Array, coefficients: list[Array], bounds: tuple[Array, Array], table: Array) -> None:
    """Change the rates of N motions as pace.c does.

    Args:
        rate: Control points of the rate, shape (N, R), changed in place.
        coefficients: Rest, linear, square and mixed, shape (m, N K) each.
        bounds: Lower and upper, shape (m,) each.
        table: Basis of r and r', shape (2, K, R).
    """
    shaped = [each.reshape(len(each), len(rate), -1) for each in coefficients]
    movable = slice(FIXED, rate.shape[1] - FIXED)
    for point in [*range(rate.shape[1])[movable]] * SWEEPS:
        along = rate[:, point, None] * table[:, None, :, point]
        x = advance(shaped, bounds, rate @ table.swapaxes(1, 2), along)
        rate[:, point] *= 1 + np.where(x > 0, SHARE * x, x)
    along = rate[:, movable] @ table[:, :, movable].swapaxes(1, 2)
    rate[:, movable] *= 1 + advance(shaped, bounds, rate @ table.swapaxes(1, 2), along)[:, None]


def advance(coefficients: list[Array], bounds: tuple[Array, Array], rates: Array, along: Array) -> Array:
    """Say how far rates may go in a direction before a bound is met, or have to go back where one is broken.

    Args:
        coefficients: Rest, linear, square and mixed, shape (m, N, K) each.
        bounds: Lower and upper, shape (m,) each.
        rates: r and r', shape (2, N, K).
        along: The direction, likewise.

    Returns:
        Multiples of it, shape (N,).
    """
    (rest, linear, square, mixed), (r, r1), (b, b1) = coefficients, rates, along
    value = rest + (linear + square * r + mixed * r1) * r
    first = (linear + 2 * square * r + mixed * r1) * b + mixed * r * b1
    second = (square * b + mixed * b1) * b
    low, high = (each[:, None, None] for each in bounds)
    room = np.stack([high - value, value - low])
    first, second = np.stack([first, -first]), np.stack([second, -second])
    broken, moved = room < 0, (first != 0) | (second != 0)
    way = smallest(np.abs(room), first, np.where(broken, -second, second))
    forwards = np.where(broken, np.inf, way).min(axis=(0, 1, 3))
    back = np.where(broken & np.isfinite(way), way, 0.0).max(axis=(0, 1, 3))
    out = (broken & moved).any(axis=(0, 1, 3))
    found: Array = np.where(out, np.maximum(-back, LEAST), np.minimum(forwards, MOST))
    return found


def smallest(room: Array, linear: Array, square: Array) -> Array:
    """Smallest x > 0 with ``square x^2 + linear x = room``, elementwise; infinite where there is none."""
    with np.errstate(all="ignore"):
        below = linear + np.sqrt(linear**2 + 4 * square * room)
        found: Array = np.where(below > 0, 2 * room / below, np.inf)
    return found
