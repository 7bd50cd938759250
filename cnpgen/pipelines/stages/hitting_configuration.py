"""Stage: the hitting configuration, the joint positions at the puck that allow the fastest tip motion along the hit.

``hitting_newton`` defines the objective and its Newton steps. An active-set method
moves optima within joint limits.
"""

from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.errors import RecipeError
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.symbolic.linalg import Scalar, Vec, symbols
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.stages.candidate_table import hit_direction
from cnpgen.pipelines.stages.hitting_newton import (
    MAX_NEWTON_STEPS,
    NEWTON_TOLERANCE_RAD,
    basic_joints,
    held_step,
    newton_step,
    objective,
)
from cnpgen.pipelines.stages.ik import IK_TOLERANCE, MAX_IK_STEPS, ik_step
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field
from cnpgen.store.field import Fields

REASONS = "no hitting configuration", "joint position limit at the goal"


@dataclass(frozen=True, kw_only=True)
class HittingConfiguration(Stage):
    """Stage: goal configuration of maximum manipulability along the hit, close to start, base or home."""

    near: str = field(
        "initial configuration of the search, which stays close to it",
        choices=("base", "start", "home"),
    )

    @property
    def inputs(self) -> tuple[str, ...]:
        return (
            ("goal_xyz", "hit_angle", "home_q")
            if self.near == "home"
            else ("goal_xyz", "hit_angle")
        )

    def describe(self) -> str:
        return (
            "find the goal configuration within the joint limits from which the tip moves fastest along the hit, near"
            f" the {self.near} configuration"
        )

    def outputs(self, context: Context) -> Fields:
        return (
            context.joint_field(
                "goal_q", "rad", "joint positions at the goal", "target"
            ),
        )

    def prepare(self, context: Context) -> StageFunction:
        robot = context.robot
        if robot.n < 3 or any(joint.prismatic for joint in robot.chain.joints):
            raise RecipeError(
                ["needs three or more planned joints, all of them revolute"]
            )
        search = _Search(context)

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            n = len(candidates.alive)
            # Configuration to which the optimum stays close.
            home = (
                np.repeat(robot.home[:, None], n, axis=1)
                if self.near == "base"
                else candidates[f"{self.near}_q"]
            )
            direction = hit_direction(context, candidates)
            candidates["goal_q"], solved, value = search.solve(
                candidates["goal_xyz"], direction, home
            )
            candidates.reject_first(np.array([solved, value > -np.inf]), REASONS)

        return work


class _Search:
    """Two Newton searches from both sides of home.

    The better optimum within the joint limits is the result.
    """

    def __init__(self, context: Context) -> None:
        load = context.kernels.load
        self._robot = context.robot
        # From the initial guess to the position first: Newton needs a start near the
        # constraint.
        self._first = load(
            ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), vertical=False, max_step=0.4
        )
        self._newton = load(newton_step, Loop(NEWTON_TOLERANCE_RAD, MAX_NEWTON_STEPS))
        self._better = load(better_optimum)
        self._held = load(held_step, Loop(NEWTON_TOLERANCE_RAD, MAX_NEWTON_STEPS))
        self._value = load(objective)
        free = [j not in basic_joints(context.robot) for j in range(context.robot.n)]
        self._free = np.array(free)[:, None]

    def solve(
        self, position: Array, direction: Array, home: Array
    ) -> tuple[Array, Mask, Array]:
        """Find the optimum of every candidate.

        Returns:
            ``(q, solved, value)``: configurations [rad], shape (n, N); mask of the
            candidates with an optimum, within the limits or not, shape (N,); objective,
            -inf for optima outside the limits, shape (N,).
        """
        where = position, direction, home
        one = self._climb(home, *where)
        # A second optimum has its elbow on the other side.
        mirrored = np.where(self._free, 2 * home - one[0], one[0])
        q, value, outside_q, outside_value, solved = self._better(
            *one, *self._climb(mirrored, *where)
        )
        self._hold(q, value[0], outside_q, outside_value[0], *where)
        return q, solved[0] > 0, value[0]

    def _climb(
        self, start: Array, position: Array, direction: Array, home: Array
    ) -> tuple[Array, Array, Array]:
        """Maximize from the projection of ``start`` onto the position.

        Return ``(q, last step, value)``.
        """
        # The step of the last iteration shows whether it has converged.
        q, step = self._newton(
            self._first(start, position)[0], position, direction, home
        )
        (value,) = self._value(q, direction, home)
        return q, step, value

    def _hold(
        self,
        q: Array,
        value: Array,
        outside_q: Array,
        outside_value: Array,
        *where: Array,
    ) -> None:
        """Solve again on the limits, in place, if an optimum outside the limits is better than those within."""
        # An optimum outside the limits is worth another search only if it is better
        # than the best one within.
        improvable = outside_value > value
        if not np.count_nonzero(improvable):
            return
        some = np.flatnonzero(improvable)
        position, direction, home = (np.take(values, some, axis=1) for values in where)
        held, found = within_limits(
            self._robot,
            self._held,
            np.take(outside_q, some, axis=1),
            position,
            direction,
            home,
        )
        (reached,) = self._value(held, direction, home)
        better = found & (reached[0] > value[some])
        q[:, some[better]] = held[:, better]
        value[some[better]] = reached[0, better]


def better_optimum(robot: Robot) -> Any:
    """Build ``(q1, step1, value1, q2, step2, value2) -> (q, value, outside_q, outside_value, solved)`` of two searches.

    A search has converged if its last step is below the tolerance. ``q`` is the better
    optimum within the joint limits and ``value`` its objective; ``outside_q`` and
    ``outside_value`` are those of the better optimum outside. Ties go to the first
    search. A value is -inf if there is no such optimum. ``solved`` is 1 if either
    search has converged.
    """
    import casadi as ca

    widths = {
        "q1": robot.n,
        "step1": 1,
        "value1": 1,
        "q2": robot.n,
        "step2": 1,
        "value2": 1,
    }
    columns, (q1, step1, value1, q2, step2, value2) = zip(
        *(symbols(*item) for item in widths.items()), strict=True
    )
    # The iteration has converged if its last step was below the tolerance.
    solved = step1[0] < NEWTON_TOLERANCE_RAD, step2[0] < NEWTON_TOLERANCE_RAD
    inside = (
        ca.logic_and(solved[0], _within(robot, q1)),
        ca.logic_and(solved[1], _within(robot, q2)),
    )
    outside = (
        ca.logic_and(solved[0], ca.logic_not(inside[0])),
        ca.logic_and(solved[1], ca.logic_not(inside[1])),
    )
    found: list[Any] = []
    for one, two in (inside, outside):
        first = ca.if_else(one, value1[0], -np.inf)
        second = ca.if_else(two, value2[0], -np.inf)
        found.append(
            ca.vertcat(
                *[ca.if_else(second > first, b, a) for a, b in zip(q1, q2, strict=True)]
            )
        )
        found.append(ca.fmax(first, second))
    return ca.Function("better_optimum", columns, [*found, ca.logic_or(*solved)])


def _within(robot: Robot, q: Vec) -> Scalar:
    """Build a flag that is 1 for configurations within the joint limits."""
    import casadi as ca

    bounds = zip(
        q, robot.position_lower.tolist(), robot.position_upper.tolist(), strict=True
    )
    return reduce(
        ca.logic_and, (ca.logic_and(low <= x, x <= high) for x, low, high in bounds)
    )


def within_limits(
    robot: Robot, kernel: Kernel, q: Array, *parameters: Array
) -> tuple[Array, Mask]:
    """Move optima q [rad], shape (n, N), outside joint limits to nearby optima within, by an active-set method.

    Joints outside their limits are set to the limit and held. Joints that leave their
    limits after a solve for the others are held, too. Of the held joints with an inward
    gradient, the one with the largest is released. Positions, directions and homes are
    further arguments of the kernel. Return configurations and the mask of optima, shape
    (N,).
    """
    low = robot.position_lower[:, None]
    high = robot.position_upper[:, None]
    # Sign of the limit on which a joint is held, else 0.
    side = np.where(q > high, 1.0, np.where(q < low, -1.0, 0.0))
    q, left = np.clip(q, low, high), np.arange(q.shape[1])
    for _ in range(2 * robot.n):
        held = np.take(side, left, axis=1)
        state = np.concatenate([np.take(q, left, axis=1), np.zeros_like(held)])
        arguments = [np.take(values, left, axis=1) for values in parameters]
        state, step = kernel(state, *arguments, np.abs(held))
        # ``pull`` is the gradient of the Lagrangian: towards the inside it is an
        # improvement.
        moved, pull = np.split(state, 2)
        q[:, left] = np.clip(moved, low, high)
        change = _change(
            held, np.where(moved > high, 1.0, np.where(moved < low, -1.0, 0.0)), pull
        )
        side[:, left] = held + change
        # A candidate is finished when no side changes and the last step has converged.
        left = left[(change != 0).any(0) | ~(step[0] < NEWTON_TOLERANCE_RAD)]
        if len(left) == 0:
            break
    found = np.ones(q.shape[1], bool)
    found[left] = False
    return q, found


def _change(held: Array, outside: Array, pull: Array) -> Array:
    """Return the change of the held sides: the side of a new hold, minus the side of a released hold, otherwise 0."""
    # The side is the outward sign, so that an inward gradient is positive here.
    inwards = -held * pull
    released = (inwards == inwards.max(axis=0)) & (inwards > 0) & ~outside.any(axis=0)
    return np.where(released, -held, np.where(held == 0, outside, 0.0))
