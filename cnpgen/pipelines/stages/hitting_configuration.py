"""The hitting configuration: the joint positions at the puck from which the mallet can move fastest along the hit.

What is maximised, and how, is said in ``hitting_newton``; what happens at joint limits, in ``hitting_limits``.
"""

from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.linalg import Scalar, Vec, symbols
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.hitting_limits import held_step, within_limits
from cnpgen.pipelines.stages.hitting_newton import MAX_STEPS, TOLERANCE, basic_joints, newton_step, objective
from cnpgen.pipelines.stages.ik import MAX_STEPS as IK_STEPS
from cnpgen.pipelines.stages.ik import TOLERANCE as IK_TOLERANCE
from cnpgen.pipelines.stages.ik import ik_step
from cnpgen.pipelines.stages.stage import Array, Round, Stage, Work
from cnpgen.schema.keys import field
from cnpgen.store.field import Field

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

REASONS = "no hitting configuration", "joint position limit at the goal"


@dataclass(frozen=True, kw_only=True)
class HittingConfiguration(Stage):
    """Joint positions of the goal with maximal manipulability along the hit, close to start, base or home."""

    near: str = field(
        "the configuration that the search starts from and stays close to", choices=("base", "start", "home")
    )

    @property
    def needs(self) -> tuple[str, ...]:
        """The hit, and the home where goals are near it."""
        return ("goal_xyz", "hit_angle", "home_q") if self.near == "home" else ("goal_xyz", "hit_angle")

    def describe(self) -> str:
        """Say near what."""
        return (
            "find the goal configuration within the joint limits from which the tip moves fastest along the hit, near"
            f" the {self.near} configuration"
        )

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The goal configuration."""
        return (context.joint_field("goal_q", "rad", "joint positions at the goal", "target"),)

    def prepare(self, context: Context) -> Work:
        """Load the kernels."""
        robot = context.robot
        if robot.n < 3 or any(joint.prismatic for joint in robot.chain.joints):
            raise RecipeError(["needs three or more planned joints, all of them revolute"])
        search = _Search(context)

        def work(draws: Round, _random: np.random.Generator) -> None:
            n = len(draws.alive)
            home = np.repeat(robot.base[:, None], n, axis=1) if self.near == "base" else draws[f"{self.near}_q"]
            direction = np.concatenate([np.cos(draws["hit_angle"]), np.sin(draws["hit_angle"])])
            draws["goal_q"], solved, value = search.solve(draws["goal_xyz"], direction, home)
            draws.reject_first(np.array([solved, value > -np.inf]), REASONS)

        return work


class _Search:
    """Two climbs from either side of home, and the better optimum within the joint limits."""

    def __init__(self, context: Context) -> None:
        load = context.kernels.load
        self._robot = context.robot
        self._first = load(ik_step, Loop(IK_TOLERANCE, IK_STEPS), vertical=False, max_step=0.4)
        self._newton = load(newton_step, Loop(TOLERANCE, MAX_STEPS))
        self._better = load(better_optimum)
        self._held = load(held_step, Loop(TOLERANCE, MAX_STEPS))
        self._value = load(objective)
        free = [j not in basic_joints(context.robot) for j in range(context.robot.n)]
        self._free = np.array(free)[:, None]

    def solve(self, position: Array, direction: Array, home: Array) -> tuple[Array, NDArray[np.bool_], Array]:
        """Find the optimum of every draw.

        Returns:
            ``(q, solved, value)``: configurations [rad], shape (n, N); whether there is an optimum at all, within the
            limits or not, shape (N,); and its value, -inf where it is beyond the limits, shape (N,).
        """
        where = position, direction, home
        one = self._climb(home, *where)
        mirrored = np.where(self._free, 2 * home - one[0], one[0])  # a second optimum has its elbow beyond home
        q, value, beyond, hope, solved = self._better(*one, *self._climb(mirrored, *where))
        self._hold(q, value[0], beyond, hope[0], *where)
        return q, solved[0] > 0, value[0]

    def _climb(self, start: Array, position: Array, direction: Array, home: Array) -> tuple[Array, Array, Array]:
        """Climb from the configuration nearest to ``start`` that is at the position: ``(q, last step, value)``."""
        q, step = self._newton(self._first(start, position)[0], position, direction, home)
        (value,) = self._value(q, direction, home)
        return q, step, value

    def _hold(self, q: Array, value: Array, beyond: Array, hope: Array, *where: Array) -> None:
        """Where an optimum beyond the limits is better than those within, solve again on the limits, in place."""
        worth = hope > value
        if not np.count_nonzero(worth):
            return
        some = np.flatnonzero(worth)
        position, direction, home = (np.take(values, some, axis=1) for values in where)
        held, found = within_limits(self._robot, self._held, np.take(beyond, some, axis=1), position, direction, home)
        (reached,) = self._value(held, direction, home)
        better = found & (reached[0] > value[some])
        q[:, some[better]], value[some[better]] = held[:, better], reached[0, better]


def better_optimum(robot: "Robot") -> Any:
    """Build ``(q1, step1, value1, q2, step2, value2) -> (q, value, beyond, hope, solved)``: what came of two climbs.

    A climb has reached an optimum where its last step was short. ``q`` is the better optimum within the joint limits
    and ``value`` the objective there; ``beyond`` and ``hope`` are those of the better one beyond the limits. The first
    is taken on a tie; a value is -inf where there is no such optimum. ``solved`` is 1 where there is any.
    """
    import casadi as ca

    widths = {"q1": robot.n, "step1": 1, "value1": 1, "q2": robot.n, "step2": 1, "value2": 1}
    columns, (q1, step1, value1, q2, step2, value2) = zip(*(symbols(*item) for item in widths.items()), strict=True)
    solved = step1[0] < TOLERANCE, step2[0] < TOLERANCE
    inside = ca.logic_and(solved[0], _within(robot, q1)), ca.logic_and(solved[1], _within(robot, q2))
    outside = ca.logic_and(solved[0], ca.logic_not(inside[0])), ca.logic_and(solved[1], ca.logic_not(inside[1]))
    found: list[Any] = []
    for one, two in (inside, outside):
        first, second = ca.if_else(one, value1[0], -np.inf), ca.if_else(two, value2[0], -np.inf)
        found.append(ca.vertcat(*[ca.if_else(second > first, b, a) for a, b in zip(q1, q2, strict=True)]))
        found.append(ca.fmax(first, second))
    return ca.Function("better_optimum", columns, [*found, ca.logic_or(*solved)])


def _within(robot: "Robot", q: Vec) -> Scalar:
    """Whether a configuration is within the joint limits."""
    import casadi as ca

    bounds = zip(q, robot.position_lower.tolist(), robot.position_upper.tolist(), strict=True)
    return reduce(ca.logic_and, (ca.logic_and(low <= x, x <= high) for x, low, high in bounds))
