"""The hitting configuration: the joint positions at the puck from which the mallet can move fastest along the hit.

What is maximised, and how, is said in ``hitting_newton``; what happens at joint limits, in ``hitting_limits``.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
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
            draws.reject(solved, "no hitting configuration")
            draws.reject(np.isfinite(value[solved]), "joint position limit at the goal")

        return work


class _Search:
    """Two climbs from either side of home, and the better optimum within the joint limits."""

    def __init__(self, context: Context) -> None:
        load = context.kernels.load
        self._robot = context.robot
        self._first = load(ik_step, Loop(IK_TOLERANCE, IK_STEPS), vertical=False, max_step=0.4)
        self._newton = load(newton_step, Loop(TOLERANCE, MAX_STEPS))
        self._held = load(held_step, Loop(TOLERANCE, MAX_STEPS))
        self._value = load(objective)
        basic = basic_joints(context.robot)
        self._free = [j for j in range(context.robot.n) if j not in basic]

    def solve(self, position: Array, direction: Array, home: Array) -> tuple[Array, NDArray[np.bool_], Array]:
        """Find the optimum of every draw.

        Returns:
            ``(q, solved, value)``: configurations [rad], shape (n, N); whether there is an optimum at all, within the
            limits or not, shape (N,); and its value, -inf where it is beyond the limits, shape (N,).
        """
        where = position, direction, home
        one = self._climb(self._first(home, position)[0], *where)
        mirrored = one.q.copy()  # a second optimum, where there is one, has the elbow on the other side of home
        mirrored[self._free] = 2 * home[self._free] - mirrored[self._free]
        two = self._climb(self._first(mirrored, position)[0], *where)
        q, value = _better(one.q, one.inside, two.q, two.inside)
        self._hold(q, value, *_better(one.q, one.outside, two.q, two.outside), *where)
        return q, one.solved | two.solved, value

    def _climb(self, start: Array, position: Array, direction: Array, home: Array) -> "_Optima":
        q, step = self._newton(start, position, direction, home)
        (value,) = self._value(q, direction, home)
        low, high = self._robot.position_lower[:, None], self._robot.position_upper[:, None]
        within = np.asarray(((low <= q) & (q <= high)).all(axis=0))
        return _Optima(q, step[0] < TOLERANCE, within, value[0])

    def _hold(self, q: Array, value: Array, beyond: Array, hope: Array, *where: Array) -> None:
        """Where an optimum beyond the limits is better than those within, solve again on the limits, in place."""
        some = np.flatnonzero(hope > value)
        if len(some) == 0:
            return
        position, direction, home = (np.take(values, some, axis=1) for values in where)
        held, found = within_limits(self._robot, self._held, np.take(beyond, some, axis=1), position, direction, home)
        (better,) = self._value(held, direction, home)
        better = np.where(found, better[0], -np.inf)
        q[:, some], value[some] = _better(q[:, some], value[some], held, better)


@dataclass(frozen=True)
class _Optima:
    """What a climb reached.

    Attributes:
        q: Configurations [rad], shape (n, N).
        solved: Whether they are optima, shape (N,).
        within: Whether they are within the joint limits, shape (N,).
        value: The objective there, shape (N,).
    """

    q: Array
    solved: NDArray[np.bool_]
    within: NDArray[np.bool_]
    value: Array

    @property
    def inside(self) -> Array:
        """The value of optima within the limits, else -inf."""
        return np.where(self.solved & self.within, self.value, -np.inf)

    @property
    def outside(self) -> Array:
        """The value of optima beyond the limits, else -inf."""
        return np.where(self.solved & ~self.within, self.value, -np.inf)


def _better(one: Array, value: Array, other: Array, second: Array) -> tuple[Array, Array]:
    """Take the better one of two configurations of every draw; the first one on a tie."""
    return np.where(second > value, other, one), np.maximum(value, second)
