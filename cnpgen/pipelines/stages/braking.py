"""Stage: can the arm brake before the edge of the table? A roll-out of full braking from both ends.

Forwards in time from the start, backwards from the goal.

Each step of 10 ms takes the accelerations that slow the tip down most along the edge's normal, within the
acceleration and velocity limits and on the manifold: a linear programme with one equality (a continuous knapsack).
Reversed in time, the goal is a start.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.symbolic.kinematics import bias_acceleration, forward_kinematics, tip_velocity
from cnpgen.kernels.symbolic.linalg import Scalar, Vec, add, dot, scale, symbols
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Array, Round, Stage, Work
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.keys import field
from cnpgen.store.field import Field

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

STEP = 0.01  # s
MAX_STEPS = 60
SUSPECT = 0.08  # s: ends whose straight line stays over the table this long can brake (none failed above 46.4 ms)

SIDES = np.array([[1.0], [-1.0], [1.0], [-1.0]])  # of the edges: high and low x, high and low y


@dataclass(frozen=True, kw_only=True)
class BrakingReach(Stage):
    """Full braking keeps the tip over the table, at the start and, reversed in time, at the goal."""

    needs = ("start_q", "start_dq", "goal_q", "goal_dq")
    margin: float = field("how far before the edge full braking must end", unit="m", default=1e-3, low=0.0)

    def describe(self) -> str:
        """Say what is kept."""
        return (
            f"require that full braking ends at least {1e3 * self.margin:g} mm before every edge of the table, from"
            " the start forwards and from the goal backwards in time (loses about 0.15 % of the solvable problems,"
            " where the ballistic rule loses 13.7 %)"
        )

    def provides(self, context: Context) -> tuple[Field, ...]:
        """Nothing."""
        del context
        return ()

    def prepare(self, context: Context) -> Work:
        """Load the kernels."""
        table = context.constraint(Table)
        tip = context.kernels.load(tip_state)
        brake = context.kernels.load(braking_step, Loop(0.5, MAX_STEPS), height=table.z)

        def work(draws: Round, _random: np.random.Generator) -> None:
            q = np.concatenate([draws["start_q"], draws["goal_q"]], axis=1)
            dq = np.concatenate([draws["start_dq"], -draws["goal_dq"]], axis=1)
            excess = overshoot(tip, brake, table, q, dq, margin=self.margin).reshape(2, -1)
            draws.reject_first(excess <= -self.margin, ["cannot brake at the start", "cannot brake at the goal"])

        return work


def overshoot(
    tip: Kernel, brake: Kernel, table: Table, q: Array, dq: Array, *, margin: float = 0.0
) -> NDArray[np.float64]:
    """How far full braking carries the tip beyond the worst edge of the table.

    Args:
        tip: Kernel of ``tip_state``.
        brake: Kernel of ``braking_step``, iterated.
        table: The table.
        q: Joint positions [rad], shape (joints, n).
        dq: Joint velocities [rad/s], reversed for the goal, shape (joints, n).
        margin: Distance from the edges that matters [m].

    Returns:
        Distance beyond the edge [m], shape (n,); -inf where a straight line stays this far inside for 80 ms.
    """
    position, velocity = (np.repeat(each[:2], 2, axis=0) for each in tip(q, dq))  # for both edges across x and across y
    edges = np.array([table.x.high, table.x.low, table.y.high, table.y.low])[:, None]
    ahead = SIDES * (position + SUSPECT * velocity - edges)
    suspects = (ahead > -margin) & (SIDES * velocity > 0)
    worst = np.full(q.shape[1], -np.inf)
    if not np.count_nonzero(suspects):  # nearly always of single tasks; a fifth of the time of any()
        return worst
    for which in np.flatnonzero(suspects.any(axis=1)):
        suspect, side, edge = np.flatnonzero(suspects[which]), SIDES[which, 0], edges[which, 0]
        normal = np.zeros((3, len(suspect)))
        normal[which // 2], normal[2] = side, side * edge
        state = np.concatenate([np.take(q, suspect, 1), np.take(dq, suspect, 1), np.full((1, len(suspect)), -1.0)])
        final, running = brake(state, normal)
        worst[suspect] = np.maximum(worst[suspect], np.where(running[0] < 0.5, final[-1], np.inf))
    return worst


def tip_state(robot: "Robot") -> Any:
    """Build ``(q, dq) -> (tip position, tip velocity)``."""
    import casadi as ca

    (q_sx, q), (dq_sx, dq) = symbols("q", robot.n), symbols("dq", robot.n)
    kin = forward_kinematics(robot.chain, q)
    return ca.Function("tip_state", [q_sx, dq_sx], [ca.vertcat(*kin.tip), ca.vertcat(*tip_velocity(kin, dq))])


def braking_step(robot: "Robot", *, height: float) -> Any:
    """Build one step of braking: ``((q, dq, overshoot), (nx, ny, edge)) -> (next state, still running)``.

    ``still running`` is 1 until the tip stops moving along the normal within the step; ``overshoot`` is then how far
    beyond ``n . p = edge`` it is [m].

    Args:
        robot: The robot.
        height: Height that the roll-out is drawn back to [m].
    """
    import casadi as ca

    n = robot.n
    (state_sx, state), (edge_sx, edge) = symbols("state", 2 * n + 1), symbols("edge", 3)
    q, dq = state[:n], state[n : 2 * n]
    kin = forward_kinematics(robot.chain, q)
    velocity, bias = tip_velocity(kin, dq), bias_acceleration(kin, dq)
    along = [edge[0] * column[0] + edge[1] * column[1] for column in kin.jacobian]
    row = [column[2] for column in kin.jacobian]
    target = -bias[2] - 0.5 * velocity[2] / STEP - 0.1 * (kin.tip[2] - height) / STEP**2
    low, high = _acceleration_box(robot, dq)
    ddq = _knapsack([-x for x in along], row, target, low, high)
    speed = edge[0] * velocity[0] + edge[1] * velocity[1]
    slowing = -(dot(along, ddq) + edge[0] * bias[0] + edge[1] * bias[1])
    stops = ca.logic_or(speed <= 0, ca.logic_and(slowing > 0, speed <= slowing * STEP))
    now = edge[0] * kin.tip[0] + edge[1] * kin.tip[1] - edge[2]
    end = now + ca.if_else(speed > 0, 0.5 * speed * speed / ca.fmax(slowing, 1e-9), 0.0)
    following_q = add(q, scale(add(dq, scale(ddq, 0.5 * STEP)), STEP))
    following = [*following_q, *add(dq, scale(ddq, STEP)), ca.if_else(stops, end, -1.0)]
    return ca.Function("braking", [state_sx, edge_sx], [ca.vertcat(*following), ca.if_else(stops, 0.0, 1.0)])


def _acceleration_box(robot: "Robot", dq: Vec) -> tuple[Vec, Vec]:
    """Accelerations that keep the velocity within its limits over the step."""
    import casadi as ca

    low, high = [], []
    for rate, most, fastest in zip(dq, robot.acceleration_limit, robot.velocity_limit, strict=True):
        low.append(ca.fmax(-float(most), (-float(fastest) - rate) / STEP))
        high.append(ca.fmin(float(most), (float(fastest) - rate) / STEP))
    return low, high


def _knapsack(c: Vec, a: Vec, target: Scalar, low: Vec, high: Vec) -> Vec:
    """Maximise ``c . x`` subject to ``a . x = target`` and ``low <= x <= high``.

    All but one x sit on a bound, chosen by the sign of ``c - lambda a`` with lambda = c_i / a_i for the one in
    between: of the n candidates the one that violates its own bounds least is the optimum (by nothing, where there is
    one).
    """
    import casadi as ca

    n = len(c)
    best: Scalar = ca.SX(1e300)
    x: Vec = [ca.SX(0)] * n
    for i in range(n):
        ratio = c[i] / a[i]
        others = [ca.if_else(c[j] - ratio * a[j] > 0, high[j], low[j]) for j in range(n)]
        rest: Scalar = target
        for j in range(n):
            if j != i:
                rest = rest - a[j] * others[j]
        between = rest / a[i]
        miss = ca.fmax(ca.fmax(low[i] - between, between - high[i]), 0)
        others[i] = ca.fmin(ca.fmax(between, low[i]), high[i])
        better = miss < best
        best = ca.if_else(better, miss, best)
        x = [ca.if_else(better, new, old) for new, old in zip(others, x, strict=True)]
    return x
