"""How far the tip must leave a table soon after the start, or shortly before the goal.

At a time t from an end every joint is somewhere in its interval (``cnpgen.refine.proof.reachable``). The smallest
exceedance of the table's rectangle over that box, with the tip at the table's height, is found by sequential linear
programming; the multipliers at its end give a combination of the table's bounds that ``bound_projection`` proves to be
exceeded in the whole box.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.refine.proof.reachable import Departure, JointLimits, departures, joint_limits, moments
from cnpgen.refine.proof.tip_bound import Arm, bound_projection
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]
FLOOR = -0.01  # m: more room than this is not told from this
PENALTY = 10.0  # of the height, per metre of the rectangle
SLACK = 5e-5  # m, for what happens between the moments that the verdict looks at
VERGE = 1.5e-3  # m to spare up to which it is a matter of luck whether a spline of the usual size fits
CARRIED = 1e-4  # m: nothing is said of an end that is near the edge, but from where the tip is not carried further
STARTS = 3
TRIED = 3  # moments whose exceedance is to be proven, the largest first
STEPS = 15
CLOSE = 1e-7  # m, gain at which the search ends


@dataclass(frozen=True)
class TableBounds:
    """The bounds of all tables of a problem: ``normals @ tip <= limits``.

    Attributes:
        normals: Unit vectors, shape (m, 3).
        limits: Shape (m,) [m].
        height: Which rows are about the height, shape (m,).
    """

    normals: Array
    limits: Array
    height: NDArray[np.bool_]

    def exceedance(self, tip: Array) -> tuple[float, float]:
        """Return how far a tip is outside of the rectangle, at least ``FLOOR``, and how far off the height [m]."""
        excess = self.normals @ tip - self.limits
        return max(float(excess[~self.height].max()), FLOOR), max(float(excess[self.height].max()), 0.0)


def table_bounds(problem: Problem, start_tip: Array, *, tolerances: float) -> TableBounds | None:
    """Return the bounds of the problem's tables, or None where it has none.

    The height is always held within its tolerance, and a motion that starts off the table may be as far off as the
    table's ``start_off`` all along: when it must have come down depends on its phase, not on time.

    Args:
        problem: The problem.
        start_tip: Tip at the start [m], shape (3,).
        tolerances: Fraction of the tolerance by which the rectangles are larger.
    """
    tables = [each for each in problem.constraint if isinstance(each, Table)]
    if not tables:
        return None
    limits = []
    for table in tables:
        room = tolerances * table.tolerance + SLACK
        band = table.tolerance + SLACK + float(table.start_off(start_tip))
        limits += [table.x.high + room, room - table.x.low, table.y.high + room, room - table.y.low]
        limits += [table.z + band, band - table.z]
    normals = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    height = np.tile(np.arange(6) >= 4, len(tables))
    return TableBounds(np.tile(normals, (len(tables), 1)), np.array(limits), height)


@dataclass(frozen=True)
class Exceedance:
    """The smallest exceedance that was found at one moment.

    Attributes:
        time: Time from the end [s].
        value: Exceedance of the rectangle, at least ``FLOOR``, plus ``PENALTY`` times that of the height [m].
        multipliers: Of the table's bounds, shape (m,).
        box: Where the joints can be: (lower, upper), shape (n,) each.
    """

    time: float
    value: float
    multipliers: Array
    box: tuple[Array, Array]

    def weight(self, bounds: TableBounds) -> float:
        """What the multipliers make of a metre off the table: 1, or ``PENALTY`` where the height alone is missed."""
        total = float(self.multipliers.sum())
        return 1.0 if float(self.multipliers[~bounds.height].sum()) > 0.5 else max(total, 1.0)


@dataclass(frozen=True)
class Leaving:
    """The tip leaves the table, or nearly so, whatever the motion does.

    Attributes:
        end: "start" or "goal".
        time: Time from there [s].
        distance: How far off the table it is at least, or, negative, how far from its edge at most [m].
        proven: Whether that is proven, with all tolerances; else it is what local searches found, without.
    """

    end: str
    time: float
    distance: float
    proven: bool


def find_leaving(problem: Problem, robot: Robot, boundary: Boundary) -> Leaving | None:
    """Find where the tip must leave a table; where that cannot be proven, where it has less room than ``VERGE``.

    Args:
        problem: The problem.
        robot: Its robot.
        boundary: Boundary conditions of one motion.
    """
    arm, nearly = Arm(robot), None
    start_tip = arm.at(boundary.start_q[0]).position
    exact, wide = (table_bounds(problem, start_tip, tolerances=tolerances) for tolerances in (0.0, 1.0))
    if exact is None or wide is None:
        return None
    limits, wider = (joint_limits(problem, robot, tolerances=tolerances) for tolerances in (0.0, 1.0))
    times = moments(boundary, wider)
    for end, departure in departures(boundary).items():
        found = _exceedances(arm, exact, departure, limits, times)
        worst = max(found, key=lambda each: each.value, default=None)
        if worst is None or worst.value < max(-VERGE, _merit(exact, arm.at(departure.q).position) + CARRIED):
            continue
        certain = _prove(arm, wide, _exceedances(arm, wide, departure, wider, times))
        if certain is not None:
            return Leaving(end, *certain, proven=True)
        if nearly is None or worst.value > nearly.distance:
            nearly = Leaving(end, worst.time, worst.value, proven=False)
    return nearly


def _exceedances(
    arm: Arm, bounds: TableBounds, departure: Departure, limits: JointLimits, times: Array
) -> list[Exceedance]:
    """Search for the smallest exceedance at some times from an end [s]; those where no joint can be are left out."""
    boxes = [(float(time), departure.box(float(time), limits)) for time in times]
    return [_smallest(arm, bounds, time, box) for time, box in boxes if (box[0] <= box[1]).all()]


def _prove(arm: Arm, bounds: TableBounds, found: list[Exceedance]) -> tuple[float, float] | None:
    """Prove the exceedance at one of some moments: (time from the end [s], distance off the table [m]), or None."""
    worst = sorted((each for each in found if each.value > 0), key=lambda each: -each.value)
    for each in worst[:TRIED]:
        direction, limit = bounds.normals.T @ each.multipliers, float(bounds.limits @ each.multipliers)
        for share in (0.8, 0.0):
            least = bound_projection(arm, direction, *each.box, above=limit + share * each.value)
            if least is not None:
                return each.time, (least - limit) / each.weight(bounds)
    return None


def _smallest(arm: Arm, bounds: TableBounds, time: float, box: tuple[Array, Array]) -> Exceedance:
    """Search from some configurations; one without exceedance ends it."""
    best: Exceedance | None = None
    for q in _starts(*box):
        value, multipliers = _search(arm, bounds, q, box)
        if best is None or value < best.value:
            best = Exceedance(time, value, multipliers, box)
        if value <= FLOOR:
            break
    assert best is not None
    return best


def _starts(lower: Array, upper: Array) -> Iterator[Array]:
    random = np.random.default_rng(0)
    yield (lower + upper) / 2
    for _ in range(STARTS - 1):
        yield random.uniform(lower, upper)


def _search(arm: Arm, bounds: TableBounds, q: Array, box: tuple[Array, Array]) -> tuple[float, Array]:
    """Minimise from q by linear programmes on a shrinking box; return the exceedance and the multipliers there."""
    radius = float((box[1] - box[0]).max())
    value = _merit(bounds, arm.at(q).position)
    multipliers: Array = np.zeros(len(bounds.limits))
    for _ in range(STEPS):
        near = np.maximum(box[0], q - radius), np.minimum(box[1], q + radius)
        solved = _linear_step(arm, bounds, q, near)
        if solved is None:
            break
        step, model, multipliers = solved
        new = _merit(bounds, arm.at(q + step).position)
        if new < value:
            gain, q, value = value - new, q + step, new
            if gain < CLOSE:
                break
        elif value - model < CLOSE:
            break
        else:
            radius *= 0.3
    return value, multipliers


def _merit(bounds: TableBounds, tip: Array) -> float:
    outside, off = bounds.exceedance(tip)
    return outside + PENALTY * off


def _linear_step(
    arm: Arm, bounds: TableBounds, q: Array, near: tuple[Array, Array]
) -> tuple[Array, float, Array] | None:
    """Minimise the linearised exceedance: (step, exceedance predicted, multipliers), or None without a solution."""
    from scipy.optimize import linprog

    tip, n = arm.at(q), len(q)
    elastic = np.stack([~bounds.height, bounds.height], axis=1)
    rows = np.hstack([bounds.normals @ tip.jacobian, -elastic.astype(float)])
    sides = [(low - x, high - x) for low, high, x in zip(*near, q, strict=True)]
    solved = linprog(
        np.r_[np.zeros(n), 1.0, PENALTY],
        A_ub=rows,
        b_ub=bounds.limits - bounds.normals @ tip.position,
        bounds=[*sides, (FLOOR, None), (0.0, None)],
        method="highs",
    )
    if solved.status != 0:
        return None
    return np.array(solved.x[:n]), float(solved.fun), np.maximum(-np.array(solved.ineqlin.marginals), 0.0)
