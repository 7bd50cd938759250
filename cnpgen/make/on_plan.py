"""Stages: starts on motions that are being executed, as a planner gives them or refined, and goals that stay theirs."""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.machine.threads import one_thread
from cnpgen.make.stage_planner import SHA256, asked, load_stage_planner
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.draw import position_field
from cnpgen.pipelines.stages.motion import onto_table, velocity_of_tip
from cnpgen.pipelines.stages.stage import Round, Stage, Work, leave
from cnpgen.plans.format import BOUNDARY
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Field
from cnpgen.trajectory.moment import states_at_times
from cnpgen.trajectory.motion import Motion

MOMENTS = 40  # on every refined plan: one takes some 20 ms, a moment on it nothing
START = ("start_q", "start_dq", "start_ddq")
GOAL = ("goal_q", "goal_dq", "goal_xyz", "hit_angle", "hit_speed", "hit_speed_max", "home_q")


@dataclass(frozen=True, kw_only=True)
class StartOnPlan(Stage):
    """Plans the draws so far and moves their starts to random moments of the motions, put back on the table exactly."""

    needs = (*BOUNDARY, "start_xyz", *GOAL[2:-1])
    renews = ("goal_q", "goal_dq")
    model: str = field("the planner: name of a shipped one, or path of a model file")
    sha256: str = field("sha256 of the model's file: from another one come other rows", pattern=SHA256)
    moved: float = field("fraction of the starts that are moved; the others stay where they are", low=0.0, high=1.0)
    refined: float = field(
        f"fraction of the moved ones that are on refined plans, up to {MOMENTS} on each", low=0.0, high=1.0, default=0.0
    )
    moments: Range = field("when, as a fraction of the motion time")

    def describe(self) -> str:
        """Say where starts go."""
        return (
            f"plan with {self.model!r} and move {100 * self.moved:.4g} % of the starts to a moment between"
            f" {self.moments.low:g} and {self.moments.high:g} of the motion time, {100 * self.refined:.4g} % of them"
            " on refined plans"
        )

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The state at the start, anywhere on the table."""
        meaning = (("rad", "positions"), ("rad/s", "velocities"), ("rad/s^2", "accelerations"))
        states = (
            context.joint_field(name, unit, f"joint {what} at the start")
            for name, (unit, what) in zip(START, meaning, strict=True)
        )
        table = context.constraint(Table)
        low, high = ([getattr(axis, end) for axis in (table.x, table.y)] for end in ("low", "high"))
        return (*states, position_field("start", [*low, table.z], [*high, table.z]))

    def writes(self, context: Context) -> tuple[str, ...]:
        """Also where the tip is and how it moves, and the goals of the plans."""
        return (*(field.name for field in self.provides(context)), "start_tip_velocity", *map(of_plan, GOAL))

    def prepare(self, context: Context) -> Work:
        """Load the planner, the refiner and the kernels."""
        height = context.constraint(Table).z
        load = context.kernels.load
        exact, tip, speed = load(onto_table, height=height), load(tip_position), load(velocity_of_tip)
        make = self._maker(context)

        def work(draws: Round, random: np.random.Generator) -> None:
            moves, refines, when = (draws.draw(random, 1)[0] for _ in range(3))
            moved = moves < self.moved
            owner, motion = make(draws, moved & (refines < self.refined))
            for name in GOAL:
                draws[of_plan(name)] = np.take(draws["start_q" if name == "home_q" else name], owner, axis=1)
            phase = self.moments.low + (self.moments.high - self.moments.low) * when
            states = states_at_times(motion, phase * motion.duration())
            found = exact(*(np.ascontiguousarray(each.T) for each in states))
            for name, values in zip(START, found, strict=True):
                draws[name] = np.where(moved, values, draws[name])
            (draws["start_xyz"],) = tip(draws["start_q"])
            (draws["start_tip_velocity"],) = speed(draws["start_q"], draws["start_dq"])

        return work

    def complete(self, context: Context, given: Collection[str]) -> Work:
        """Leave a start where it is."""
        del context, given
        return leave

    def _maker(self, context: Context) -> Callable[[Round, NDArray[np.bool_]], tuple[NDArray[np.intp], Motion]]:
        """Return what makes a motion for every draw, and says whose of the draws it is."""
        from cnpgen.refine.engine import load_solver

        planner = load_stage_planner(self.model, self.sha256, context)
        solve = load_solver(context.problem, context.robot, context.kernels)

        def make(draws: Round, refined: NDArray[np.bool_]) -> tuple[NDArray[np.intp], Motion]:
            columns = {name: np.ascontiguousarray(values.T) for name, values in draws.columns.items()}
            motion = planner.plan_batch(asked(columns, planner)).motion
            owner, some = np.arange(len(motion)), np.flatnonzero(refined)
            few = some[::MOMENTS]
            owner[some] = np.repeat(few, MOMENTS)[: len(some)]
            path, rate = motion.path.copy(), motion.rate.copy()
            with one_thread():
                better, _ = solve({name: values[few] for name, values in columns.items()}, given=motion[few])
            path[few], rate[few] = better.path, better.rate
            return owner, Motion(path[owner], rate[owner], motion.degree)

        return make


@dataclass(frozen=True, kw_only=True)
class GoalOfPlan(Stage):
    """In some cases the goal stays that of the motion which the start is on: only the way to it is planned anew."""

    needs = tuple(f"planned_{name}" for name in GOAL)
    share: float = field("fraction of the cases", low=0.0, high=1.0)

    def describe(self) -> str:
        """Say how often."""
        return f"in {100 * self.share:.4g} % of the cases take the goal of the motion that the start is on"

    def provides(self, context: Context) -> tuple[Field, ...]:
        """Nothing that is not there already."""
        del context
        return ()

    def prepare(self, context: Context) -> Work:
        """Nothing to load."""
        del context

        def work(draws: Round, random: np.random.Generator) -> None:
            same = draws.draw(random, 1)[0] < self.share
            for name in GOAL:
                draws[name] = np.where(same, draws[of_plan(name)], draws[name])

        return work

    def complete(self, context: Context, given: Collection[str]) -> Work:
        """Leave the goal, which is what tasks are about."""
        del context, given
        return leave


def of_plan(name: str) -> str:
    """Return what a column of the goal is called while it is that of the plan."""
    return f"planned_{name}"
