"""Proof that the tip must leave a table soon after the start, or shortly before the goal.

At a time t from an end every joint is within an interval
(``cnpgen.refine.proof.reachable_positions``). Sequential linear programming minimizes
the violation of the table's rectangle over that box, with the tip at the table's
height. The multipliers at the minimum combine the table's bounds to one direction,
along which ``bound_projection`` proves the violation for the whole box.
"""

from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.refine.proof.reachable_positions import (
    EndState,
    JointLimits,
    end_states,
    joint_limits,
    sample_times,
)
from cnpgen.refine.proof.tip_bound import ArmKinematics, bound_projection
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.boundary import Boundary

MIN_VIOLATION_M = -0.01  # larger distances from the edge count as this one
HEIGHT_WEIGHT = 10.0  # of a violation of the height, relative to the rectangle
TIP_MARGIN_M = 5e-5  # for motion between the times of the verdict
# From the edge, up to which splines of the usual size may be too coarse.
VERGE_DISTANCE_M = 1.5e-3
# Further out than the end itself; an end at rest near the edge is not on the verge.
MIN_DRIFT_M = 1e-4
LOCAL_SEARCHES = 3  # from different configurations
MAX_PROOFS = 3  # of times with a violation, the largest first
MAX_LP_STEPS = 15
MIN_GAIN_M = 1e-7  # at which a local search ends


@dataclass(frozen=True)
class TableBounds:
    """Bounds of all tables of a problem: ``normals @ tip <= limits``."""

    normals: Array  # unit vectors, shape (m, 3)
    limits: Array  # limits [m], shape (m,)
    height: Mask  # mask of the rows of the height, shape (m,)

    def violation(self, tip: Array) -> float:
        """Return the violation by a tip [m].

        It is that of the rectangle, at least ``MIN_VIOLATION_M``, plus
        ``HEIGHT_WEIGHT`` times that of the height.
        """
        violation = self.normals @ tip - self.limits
        rectangle = violation[~self.height].max()
        height = violation[self.height].max()
        return max(float(rectangle), MIN_VIOLATION_M) + HEIGHT_WEIGHT * max(
            float(height), 0.0
        )


def table_bounds(
    problem: Problem, start_tip: Array, *, tolerances: float
) -> TableBounds | None:
    """Return the bounds of the problem's tables, or None if it has none or they differ from sample to sample.

    The rectangles are enlarged by a fraction of the tolerance; the height is bounded by
    its tolerance. A motion with a tip [m], shape (3,), that starts off the table may be
    off by the table's ``start_off`` at any time, since the time-varying bound depends
    on its phase.
    """
    tables = [
        constraint for constraint in problem.constraint if isinstance(constraint, Table)
    ]
    if (
        not tables
        or problem.parameters.tilts_table
        or problem.parameters.changes_rectangle
    ):
        return None
    limits = []
    for table in tables:
        margin = tolerances * table.tolerance + TIP_MARGIN_M
        band = table.tolerance + TIP_MARGIN_M + float(table.start_off(start_tip))
        limits += [
            table.x.high + margin,
            margin - table.x.low,
            table.y.high + margin,
            margin - table.y.low,
        ]
        limits += [table.z + band, band - table.z]
    # Rows: +x, -x, +y, -y, +z, -z.
    normals = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    height = np.tile(np.arange(6) >= 4, len(tables))
    return TableBounds(np.tile(normals, (len(tables), 1)), np.array(limits), height)


@dataclass(frozen=True)
class TableViolation:
    """Smallest violation found at one time."""

    time: float  # time from the end [s]
    value: float  # see ``TableBounds.violation``
    multipliers: Array  # multipliers of the table's bounds, shape (m,)
    # Reachable joint positions: (lower, upper), shape (n,) each.
    box: tuple[Array, Array]

    def weight(self, bounds: TableBounds) -> float:
        """Return the weight of one metre off the table: 1, or ``HEIGHT_WEIGHT`` if only the height is violated."""
        total = float(self.multipliers.sum())
        return (
            1.0
            if float(self.multipliers[~bounds.height].sum()) > 0.5
            else max(total, 1.0)
        )


@dataclass(frozen=True)
class TableExit:
    """Instant at which the tip leaves the table, or nearly so, in every motion."""

    end: str  # "start" or "goal"
    time: float  # time from that end [s]
    # Smallest distance off the table, or, negative, largest distance from its edge [m].
    distance: float
    # Whether it is proven with all tolerances; otherwise a local search without
    # tolerances found it.
    proven: bool


def find_table_exit(
    problem: Problem, robot: Robot, boundary: Boundary
) -> TableExit | None:
    """Find a proven exit of one motion from a table, or one within ``VERGE_DISTANCE_M`` of the edge, or None."""
    arm = ArmKinematics(robot)
    nearly = None
    start_tip = arm.at(boundary.start_q[0]).position
    exact, wide = (
        table_bounds(problem, start_tip, tolerances=tolerances)
        for tolerances in (0.0, 1.0)
    )
    if exact is None or wide is None:
        return None
    limits, relaxed = (
        joint_limits(problem, robot, tolerances=tolerances) for tolerances in (0.0, 1.0)
    )
    times = sample_times(boundary, relaxed)
    for end, state in end_states(boundary).items():
        worst = max(
            _violations(arm, exact, state, limits, times),
            key=lambda item: item.value,
            default=None,
        )
        # The drift is measured from the end itself, which may be near the edge.
        at_end = exact.violation(arm.at(state.q).position)
        if worst is None or worst.value < max(-VERGE_DISTANCE_M, at_end + MIN_DRIFT_M):
            continue
        # A proof must hold for all that the verdict accepts, hence the relaxed bounds
        # and limits.
        proof = _prove(arm, wide, _violations(arm, wide, state, relaxed, times))
        if proof is not None:
            return TableExit(end, *proof, proven=True)
        if nearly is None or worst.value > nearly.distance:
            nearly = TableExit(end, worst.time, worst.value, proven=False)
    return nearly


def _violations(
    arm: ArmKinematics,
    bounds: TableBounds,
    state: EndState,
    limits: JointLimits,
    times: Array,
) -> list[TableViolation]:
    """Search for the smallest violation at some times from an end [s], except where no position is reachable."""
    boxes = [(float(time), state.box(float(time), limits)) for time in times]
    return [
        _smallest(arm, bounds, time, box)
        for time, box in boxes
        if (box[0] <= box[1]).all()
    ]


def _prove(
    arm: ArmKinematics, bounds: TableBounds, violations: list[TableViolation]
) -> tuple[float, float] | None:
    """Prove a violation at one time: (time from the end [s], distance off the table [m]), or None."""
    positive = sorted(
        (item for item in violations if item.value > 0), key=lambda item: -item.value
    )
    for item in positive[:MAX_PROOFS]:
        # Multipliers m >= 0 combine the bounds. If (normals^T m) . tip > limits . m for
        # all reachable tips, not all bounds hold.
        direction = bounds.normals.T @ item.multipliers
        limit = float(bounds.limits @ item.multipliers)
        # A proof of most of the distance is tried first, then one of any violation.
        for fraction in (0.8, 0.0):
            bound = bound_projection(
                arm, direction, *item.box, above=limit + fraction * item.value
            )
            if bound is not None:
                return item.time, (bound - limit) / item.weight(bounds)
    return None


def _smallest(
    arm: ArmKinematics, bounds: TableBounds, time: float, box: tuple[Array, Array]
) -> TableViolation:
    """Search from several configurations; stop at one without violation."""
    random = np.random.default_rng(0)
    violations = list[TableViolation]()
    center = (box[0] + box[1]) / 2
    for q in (center, *(random.uniform(*box) for _ in range(LOCAL_SEARCHES - 1))):
        violations.append(TableViolation(time, *_search(arm, bounds, q, box), box))
        if violations[-1].value <= MIN_VIOLATION_M:
            break
    return min(violations, key=lambda item: item.value)


def _search(
    arm: ArmKinematics, bounds: TableBounds, q: Array, box: tuple[Array, Array]
) -> tuple[float, Array]:
    """Minimize from q by linear programs on a shrinking box.

    Return the violation and the multipliers.
    """
    radius = float((box[1] - box[0]).max())
    value = bounds.violation(arm.at(q).position)
    multipliers: Array = np.zeros(len(bounds.limits))
    for _ in range(MAX_LP_STEPS):
        region = np.maximum(box[0], q - radius), np.minimum(box[1], q + radius)
        solution = _linear_step(arm, bounds, q, region)
        if solution is None:
            break
        step, predicted, multipliers = solution
        new = bounds.violation(arm.at(q + step).position)
        # A step is accepted if the violation decreases; otherwise the region of the
        # linearization shrinks.
        if new < value:
            gain = value - new
            q = q + step
            value = new
            if gain < MIN_GAIN_M:
                break
        elif value - predicted < MIN_GAIN_M:
            break
        else:
            radius *= 0.3
    return value, multipliers


def _linear_step(
    arm: ArmKinematics, bounds: TableBounds, q: Array, region: tuple[Array, Array]
) -> tuple[Array, float, Array] | None:
    """Minimize the linearized violation: (step, predicted violation, multipliers), or None without a solution."""
    from scipy.optimize import linprog

    tip = arm.at(q)
    n = len(q)
    # One elastic variable for the rectangle and one for the height; their weighted sum
    # is minimized.
    elastic = np.stack([~bounds.height, bounds.height], axis=1)
    rows = np.hstack([bounds.normals @ tip.jacobian, -elastic.astype(float)])
    sides = [(low - x, high - x) for low, high, x in zip(*region, q, strict=True)]
    solved = linprog(
        np.r_[np.zeros(n), 1.0, HEIGHT_WEIGHT],
        A_ub=rows,
        b_ub=bounds.limits - bounds.normals @ tip.position,
        bounds=[*sides, (MIN_VIOLATION_M, None), (0.0, None)],
        method="highs",
    )
    if solved.status != 0:
        return None
    return (
        np.array(solved.x[:n]),
        float(solved.fun),
        np.maximum(-np.array(solved.ineqlin.marginals), 0.0),
    )
