"""Pacing: rates behind the network are made as large as limits allow, and smaller where limits are broken.

The path stays, and so do the two control points of the rate at either end, which the boundary conditions hang on. On a
path that is given, what a problem bounds is ``g = rest + square r^2 + mixed r r'`` with coefficients that depend on the
phase alone: squares of velocities, accelerations and torques are, as in time-optimal path parameterisation (Bobrow,
Dubowsky and Gibson, 1985). So it is a quadratic of any one control point of the rate, or of a factor of them all, and
how far that may go before the first bound is met follows in closed form. Every second control point goes a part of that
way, one after the other, then those between a larger one of theirs; what is then left, all of them go together.
"""

import ctypes
from ctypes import c_double, c_long, c_void_p
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.compiled import address_of, aligned
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.planner.expressions import coefficient_bounds, speed_bounds, speed_coefficients
from cnpgen.planner.speeds import BLOCK, Speeds, load_speeds
from cnpgen.problems.problem import Problem
from cnpgen.trajectory.motion import Motion

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]

SOURCE = Path(__file__).with_name("pace.c")
INTERVALS = 79  # between phases, of which there are as many as fill vectors of any machine
FIXED = 2  # control points of the rate at either end
SHARES = 0.65, 0.9  # of the way to the first bound: of every second control point, then of those between
MOST, LEAST = 1.0, -0.3  # of itself: no control point is changed more at once
ROUNDED = 1e-9  # of a limit: what a boundary condition may be beyond it
VECTOR = 8  # numbers, at most


class _Pacing(ctypes.Structure):
    """``pacing`` of pace.c."""

    _fields_ = (
        *((name, c_long) for name in ("joints", "tops", "path_points", "points")),
        *((name, c_long) for name in ("phases", "rows", "first", "last", "moves")),
        *((name, c_void_p) for name in ("path", "rate", "lower", "upper", "path_span", "span", "order", "shares")),
        *((name, c_void_p) for name in ("coefficients", "excess")),
        *((name, c_double) for name in ("most", "least", "slack")),
    )


@dataclass(frozen=True)
class Pacing(Speeds):
    """Fits rates of one problem's motions to its limits; made by ``make_pacing``.

    Attributes:
        coefficients: Kernel of ``expressions.speed_coefficients``.
        lower: Lower bounds of its rows, shape (m,).
        upper: Upper bounds, shape (m,).
        joints: Number of joints.
        library: That of pace.c; None where kernels are not compiled.
    """

    coefficients: Kernel
    lower: Array
    upper: Array
    joints: int
    library: ctypes.CDLL | None

    def paced(self, motion: Motion, tops: Array) -> Motion:
        """Return N motions along the same paths, between the same ends, whose rates meet the limits.

        One whose worst value is then further out than before stays as it was: what is bounded of it is no such
        quadratic. For the same reason one may become slower than it had to.

        Args:
            motion: N motions, with the problem's numbers of control points.
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).
        """
        rate = np.array(motion.rate, np.float64, order="C")
        if self.library is not None:
            self._pace_compiled(motion.path, tops, rate)
        else:
            for block in (slice(first, first + BLOCK) for first in range(0, len(motion), BLOCK)):
                rate[block] = self._paced(motion[block], tops[block])
        return Motion(motion.path, rate, motion.degree)

    def _paced(self, motion: Motion, tops: Array) -> Array:
        rate, column = motion.rate.copy(), self.column(motion, tops)
        pace(rate, self.coefficients(column), self._bounds, self.rate)
        paced = self.column(Motion(motion.path, rate, motion.degree), tops)
        before, worst = (self.excess(each)[0].reshape(len(motion), -1).max(axis=1) for each in (column, paced))
        better = worst <= np.maximum(before, self._slack)
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
    def _prepared(self) -> tuple[_Pacing, list[NDArray[Any]]]:
        """What pace.c knows of the problem, and the arrays that it looks into."""
        lower, upper, order, shares = *self._bounds, *moves_of(self.rate.shape[2])
        tables, spans = [[of(self.path), of(self.rate)] for of in (by_point, span_of)]
        arrays = [*tables, lower, upper, *spans, order, shares]
        (phases, path_points), points = self.path.shape[1:], self.rate.shape[2]
        counts = self.joints, self.coefficients.tape.inputs[0] - 3 * self.joints - 2, path_points, points
        moves = phases, len(lower), FIXED, points - FIXED, len(order)
        where = *map(address_of, arrays), self.coefficients.address, self.excess.address
        return _Pacing(*counts, *moves, *where, MOST, LEAST, self._slack), arrays

    def _pace_compiled(self, path: Array, tops: Array, rate: Array) -> None:
        assert self.library is not None
        rows, phases = self.coefficients.tape.inputs[0] + 3 * len(self.lower) + 3, self.path.shape[1]
        memory = np.empty(VECTOR + rows * phases + VECTOR * len(self.lower) + rate.shape[1])
        given = [np.ascontiguousarray(each, np.float64) if each.size else None for each in (path, tops)]
        where = (None if each is None else address_of(each) for each in (*given, rate, memory))
        self.library.pace(ctypes.byref(self._prepared[0]), len(rate), *where)


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
    library, speeds = kernels.load_source(SOURCE), load_speeds(problem, kernels, INTERVALS)
    if library is not None:
        library.pace.argtypes, library.pace.restype = (c_void_p, c_long, *[c_void_p] * 4), None
    rows = kernels.load(speed_coefficients), *coefficient_bounds(speed_bounds(robot, problem))
    return Pacing(speeds.excess, speeds.path, speeds.rate, *rows, joints=robot.n, library=library)


def span_of(table: Array) -> NDArray[np.int64]:
    """First phase at which a control point counts, and that behind the last, as whole vectors.

    Args:
        table: Basis of a spline and its derivatives, shape (orders, K, points).

    Returns:
        Shape (points, 2).
    """
    counts = (table != 0).any(axis=0)
    first, last = counts.argmax(axis=0), len(counts) - counts[::-1].argmax(axis=0)
    return np.stack([first - first % VECTOR, last + -last % VECTOR], axis=1).astype(np.int64)


def by_point(table: Array) -> Array:
    """Lay out a basis as pace.c takes it, shape (orders, points, K), from where a vector may begin."""
    found = aligned(table.size)
    found.reshape(table.swapaxes(1, 2).shape)[:] = table.swapaxes(1, 2)
    return found


def moves_of(points: int) -> tuple[NDArray[np.int64], Array]:
    """In which order control points of the rate move, and which share of their ways they go."""
    movable = np.arange(FIXED, points - FIXED)
    first, then = movable[1::2], movable[::2]
    return np.concatenate([first, then]), np.repeat(SHARES, [len(first), len(then)])


def pace(rate: Array, coefficients: list[Array], bounds: tuple[Array, Array], table: Array) -> None:
    """Change the rates of N motions as pace.c does.

    Args:
        rate: Control points of the rate, shape (N, R), changed in place.
        coefficients: Rest, square and mixed, shape (m, N K) each.
        bounds: Lower and upper, shape (m,) each.
        table: Basis of r and r', shape (2, K, R).
    """
    shaped = [each.reshape(len(each), len(rate), -1) for each in coefficients]
    movable = slice(FIXED, rate.shape[1] - FIXED)
    for point, share in zip(*moves_of(rate.shape[1]), strict=True):
        along = rate[:, point, None] * table[:, None, :, point]
        x = advance(shaped, bounds, rate @ table.swapaxes(1, 2), along)
        rate[:, point] *= 1 + np.where(x > 0, share * x, x)
    along = rate[:, movable] @ table[:, :, movable].swapaxes(1, 2)
    rate[:, movable] *= 1 + advance(shaped, bounds, rate @ table.swapaxes(1, 2), along)[:, None]


def advance(coefficients: list[Array], bounds: tuple[Array, Array], rates: Array, along: Array) -> Array:
    """Say how far rates may go in a direction before a bound is met, or have to go back where one is broken.

    Args:
        coefficients: Rest, square and mixed, shape (m, N, K) each.
        bounds: Lower and upper, shape (m,) each.
        rates: r and r', shape (2, N, K).
        along: The direction, likewise.

    Returns:
        Multiples of it, shape (N,).
    """
    (rest, square, mixed), (r, r1), (b, b1) = coefficients, rates, along
    value = rest + (square * r + mixed * r1) * r
    first = (2 * square * r + mixed * r1) * b + mixed * r * b1
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
