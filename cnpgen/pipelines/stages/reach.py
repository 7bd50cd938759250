"""Stages: rules of reachability, by which the tip stays over the table.

The paper's ballistic rule checks straight lines along the tip velocity. Full braking is
a roll-out forwards in time from the start and backwards from the goal. Each step of 10
ms uses the accelerations that decelerate the tip most along the normal of the table
edge. They satisfy the acceleration and velocity limits and the manifold: a linear
program with one equality (a continuous knapsack).
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.symbolic.kinematics import (
    bias_acceleration,
    forward_kinematics,
    tip_velocity,
)
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    dot,
    scale,
    subtract,
    symbols,
)
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.stages.candidate_table import on_table, table_corners
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.problems.constraints.table import Table
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field

BRAKING_STEP_S = 0.01
MAX_BRAKING_STEPS = 60
# Ends whose straight line stays over the table for this time can brake (no failure was
# observed above 46.4 ms).
LOOKAHEAD_S = 0.08
# Outward signs of the edges: high and low x, high and low y.
EDGE_SIDES = np.array([[1.0], [-1.0], [1.0], [-1.0]])


@dataclass(frozen=True, kw_only=True)
class BallisticReach(Stage):
    """Stage: the tip at constant velocity, ``p + v t``, stays over the table after the start and around the goal."""

    start_time: float = field(
        "time ahead of the start", unit="s", default=0.0, low=0.0, plausible=5.0
    )
    goal_time: float = field(
        "time ahead of the goal and before it",
        unit="s",
        default=0.0,
        low=0.0,
        plausible=5.0,
    )

    @property
    def inputs(self) -> tuple[str, ...]:
        start = ("start_xyz", "start_tip_velocity") if self.start_time else ()
        return start + (
            ("goal_xyz", "hit_angle", "hit_speed") if self.goal_time else ()
        )

    def describe(self) -> str:
        rules = []
        if self.start_time:
            rules.append(
                f"the start's position + velocity x {1e3 * self.start_time:g} ms"
            )
        if self.goal_time:
            rules.append(
                f"the goal's position +- hit velocity x {1e3 * self.goal_time:g} ms"
            )
        return (
            "require over the table: "
            + " and ".join(rules)
            + " (fast; braking-reach rejects far fewer problems)"
        )

    def prepare(self, context: Context) -> StageFunction:
        return self._require(context, "leaves the table")

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Load the kernel; unlike candidates, tasks may also start or end off the table."""
        return self._require(context, "is off the table, or leaves it")

    def _require(self, context: Context, reason: str) -> StageFunction:
        table = context.constraint(Table)
        varies = context.problem.parameters.changes_rectangle
        sides = [[side.low, side.high] for side in (table.x, table.y)]
        over = context.kernels.load(over_table, sides=None if varies else sides)

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            corners = (
                [np.concatenate(table_corners(context, candidates))] if varies else []
            )
            if self.start_time:
                displacement = self.start_time * candidates["start_tip_velocity"][:2]
                ahead, _ = over(candidates["start_xyz"][:2], displacement, *corners)
                candidates.reject(ahead[0] > 0, f"the start {reason}")
            if self.goal_time:
                goal = on_table(context, candidates, candidates["goal_xyz"])[:2]
                angle = candidates["hit_angle"]
                speed = candidates["hit_speed"]
                velocity = np.concatenate(
                    [speed * np.cos(angle), speed * np.sin(angle)]
                )
                _, both = over(goal, self.goal_time * velocity, *corners)
                candidates.reject(both[0] > 0, f"the hit {reason}")

        return work


def over_table(*, sides: list[list[float]] | None) -> Any:
    """Build ``(p, d) -> (ahead, both)``: whether p + d is over the table, and whether p + d and p - d both are.

    The sides are the bounds of the table along x and y [m]; without them, both corners
    are a third argument.
    """
    import casadi as ca

    p_sx, p = symbols("p", 2)
    d_sx, d = symbols("d", 2)
    corners_sx, corners = symbols("corners", 4)
    given = [p_sx, d_sx] if sides else [p_sx, d_sx, corners_sx]
    spans: Any = sides or list(zip(corners[:2], corners[2:], strict=True))

    # A closed rectangle: a tip on the edge is over the table.
    def is_over(position: Vec) -> Scalar:
        inside = [
            ca.logic_and(low <= at, at <= high)
            for at, (low, high) in zip(position, spans, strict=True)
        ]
        return ca.logic_and(*inside)

    ahead = is_over(add(p, d))
    behind = is_over(subtract(p, d))
    return ca.Function("over_table", given, [ahead, ca.logic_and(ahead, behind)])


@dataclass(frozen=True, kw_only=True)
class BrakingReach(Stage):
    """Stage: full braking keeps the tip over the table, from the start and, reversed in time, from the goal."""

    inputs = ("start_q", "start_dq", "goal_q", "goal_dq")
    margin: float = field(
        "distance before the edge at which full braking must end",
        unit="m",
        default=1e-3,
        low=0.0,
        plausible=1.0,
    )

    def describe(self) -> str:
        return (
            f"require that full braking ends at least {1e3 * self.margin:g} mm before every edge of the table, from"
            " the start forwards and from the goal backwards in time (loses about 0.15 % of the solvable problems,"
            " where the ballistic rule loses 13.7 %)"
        )

    def prepare(self, context: Context) -> StageFunction:
        table = context.constraint(Table)
        tip = context.kernels.load(tip_state)
        brake = context.kernels.load(
            braking_step, Loop(0.5, MAX_BRAKING_STEPS), height=table.z
        )

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            # Reversed in time, a goal is a start with the velocity -dq.
            q = np.concatenate([candidates["start_q"], candidates["goal_q"]], axis=1)
            dq = np.concatenate(
                [candidates["start_dq"], -candidates["goal_dq"]], axis=1
            )
            excess = overshoot(tip, brake, table, q, dq, margin=self.margin).reshape(
                2, -1
            )
            candidates.reject_first(
                excess <= -self.margin,
                ["cannot brake at the start", "cannot brake at the goal"],
            )

        return work


def overshoot(
    tip: Kernel,
    brake: Kernel,
    table: Table,
    q: Array,
    dq: Array,
    *,
    margin: float = 0.0,
) -> Array:
    """Return the overshoot of full braking over the worst edge of the table [m], shape (n,), by both kernels.

    It is -inf if a straight line stays inside by the margin [m] for 80 ms. The states
    (q, dq) [rad, rad/s] have shape (joints, n) each; those of goals are reversed.
    """
    # For both edges across x and across y.
    position, velocity = (np.repeat(values[:2], 2, axis=0) for values in tip(q, dq))
    edges = np.array([table.x.high, table.x.low, table.y.high, table.y.low])[:, None]
    # Only an edge that the tip approaches and may reach within the time is rolled out.
    ahead = EDGE_SIDES * (position + LOOKAHEAD_S * velocity - edges)
    suspects = (ahead > -margin) & (EDGE_SIDES * velocity > 0)
    worst = np.full(q.shape[1], -np.inf)
    if not np.count_nonzero(suspects):
        # The usual case of single tasks; a fifth of the time of any().
        return worst
    for which in np.flatnonzero(suspects.any(axis=1)):
        suspect = np.flatnonzero(suspects[which])
        side = EDGE_SIDES[which, 0]
        edge = edges[which, 0]
        normal = np.zeros((3, len(suspect)))
        normal[which // 2] = side
        normal[2] = side * edge
        unknown = np.full((1, len(suspect)), -1.0)
        states = np.take(q, suspect, 1), np.take(dq, suspect, 1), unknown
        final, running = brake(np.concatenate(states), normal)
        # A roll-out that never stops leaves the table.
        worst[suspect] = np.maximum(
            worst[suspect], np.where(running[0] < 0.5, final[-1], np.inf)
        )
    return worst


def tip_state(robot: Robot) -> Any:
    """Build ``(q, dq) -> (tip position, tip velocity)``."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    dq_sx, dq = symbols("dq", robot.n)
    kin = forward_kinematics(robot.chain, q)
    return ca.Function(
        "tip_state",
        [q_sx, dq_sx],
        [ca.vertcat(*kin.tip), ca.vertcat(*tip_velocity(kin, dq))],
    )


def braking_step(robot: Robot, *, height: float) -> Any:
    """Build one step of braking: ``((q, dq, overshoot), (nx, ny, edge)) -> (next state, still running)``.

    ``still running`` is 1 until the tip stops along the normal within the step.
    ``overshoot`` is then its distance outside ``n . p = edge`` [m]. The roll-out is
    stabilized to a height [m].
    """
    import casadi as ca

    n = robot.n
    state_sx, state = symbols("state", 2 * n + 1)
    edge_sx, edge = symbols("edge", 3)
    q, dq = state[:n], state[n : 2 * n]
    kin = forward_kinematics(robot.chain, q)
    velocity = tip_velocity(kin, dq)
    bias = bias_acceleration(kin, dq)
    # Velocity and vertical row: n . J and J_z.
    along = [edge[0] * column[0] + edge[1] * column[1] for column in kin.jacobian]
    row = [column[2] for column in kin.jacobian]
    # On the manifold z'' = J_z ddq + dJ_z dq = 0; a stable feedback of vertical speed
    # and height error removes the rounding of earlier steps:
    #   z'' = -z' / (2 T) - (z - height) / (10 T^2).
    feedback = 0.5 * velocity[2] / BRAKING_STEP_S
    target = -bias[2] - feedback - 0.1 * (kin.tip[2] - height) / BRAKING_STEP_S**2
    low, high = _acceleration_box(robot, dq)
    # The largest deceleration along the normal: maximize -n . J ddq.
    ddq = _knapsack([-x for x in along], row, target, low, high)
    speed = edge[0] * velocity[0] + edge[1] * velocity[1]
    deceleration = -(dot(along, ddq) + edge[0] * bias[0] + edge[1] * bias[1])
    stops, distance = _stop(speed, deceleration)
    end = edge[0] * kin.tip[0] + edge[1] * kin.tip[1] - edge[2] + distance
    # Constant acceleration over the step: q + T dq + T^2 ddq / 2.
    mean_rate = add(dq, scale(ddq, 0.5 * BRAKING_STEP_S))
    following = [
        *add(q, scale(mean_rate, BRAKING_STEP_S)),
        *add(dq, scale(ddq, BRAKING_STEP_S)),
        ca.if_else(stops, end, -1.0),
    ]
    return ca.Function(
        "braking",
        [state_sx, edge_sx],
        [ca.vertcat(*following), ca.if_else(stops, 0.0, 1.0)],
    )


def _stop(speed: Scalar, deceleration: Scalar) -> tuple[Scalar, Scalar]:
    """Build whether a speed [m/s] ends within a step, and its stopping distance [m]."""
    import casadi as ca

    # Within the step the tip stops if v <= a T; a tip that moves away has stopped
    # already.
    in_time = ca.logic_and(deceleration > 0, speed <= deceleration * BRAKING_STEP_S)
    # Stopping distance v^2 / (2 a).
    distance = 0.5 * speed * speed / ca.fmax(deceleration, 1e-9)
    return ca.logic_or(speed <= 0, in_time), ca.if_else(speed > 0, distance, 0.0)


def _acceleration_box(robot: Robot, dq: Vec) -> tuple[Vec, Vec]:
    """Return bounds of the accelerations that keep the velocity within its limits over the step."""
    import casadi as ca

    low = []
    high = []
    for rate, most, fastest in zip(
        dq, robot.acceleration_limit, robot.velocity_limit, strict=True
    ):
        # Both limits hold at the end of the step: |dq + T ddq| <= limit.
        low.append(ca.fmax(-float(most), (-float(fastest) - rate) / BRAKING_STEP_S))
        high.append(ca.fmin(float(most), (float(fastest) - rate) / BRAKING_STEP_S))
    return low, high


def _knapsack(c: Vec, a: Vec, target: Scalar, low: Vec, high: Vec) -> Vec:
    """Maximize ``c . x`` subject to ``a . x = target`` and ``low <= x <= high``.

    All but one x are on a bound, chosen by the sign of ``c - lambda a`` with lambda =
    c_i / a_i of the remaining x_i. Of these n solutions, the one with the smallest
    bound violation is the optimum; it is 0 if the problem is feasible.
    """
    import casadi as ca

    n = len(c)
    best: Scalar = ca.SX(1e300)
    x: Vec = [ca.SX(0)] * n
    for i in range(n):
        # With lambda = c_i / a_i, x_i is the only variable with zero reduced cost; the
        # others are at the bound that improves the objective.
        ratio = c[i] / a[i]
        others = [
            ca.if_else(c[j] - ratio * a[j] > 0, high[j], low[j]) for j in range(n)
        ]
        rest: Scalar = target
        for j in range(n):
            if j != i:
                rest = rest - a[j] * others[j]
        # The equation determines x_i.
        between = rest / a[i]
        miss = ca.fmax(ca.fmax(low[i] - between, between - high[i]), 0)
        others[i] = ca.fmin(ca.fmax(between, low[i]), high[i])
        better = miss < best
        best = ca.if_else(better, miss, best)
        x = [ca.if_else(better, new, old) for new, old in zip(others, x, strict=True)]
    return x
