"""Stages for replanning: starts on planned or refined motions, and goals of these motions."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.arrays import Array, Indices, Mask
from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.machine.threads import one_thread
from cnpgen.pipelines.stages.boundary_motion import onto_table, velocity_of_tip
from cnpgen.pipelines.stages.draw import position_field
from cnpgen.pipelines.stages.stage import (
    CandidateBatch,
    Context,
    Stage,
    StageFunction,
    fraction,
    leave,
)
from cnpgen.plans.format import BOUNDARY, CONDITIONS
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem_record import record_problem
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Fields
from cnpgen.store.files.atomic import file_sha256
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion, states_at_times

if TYPE_CHECKING:
    from cnpgen.planner.planner import Planner


SHA256 = "^([0-9a-f]{64})?$"
STATES_PER_REFINED_PLAN = 40  # a refined plan takes about 20 ms, a state on it is cheap
START = ("start_q", "start_dq", "start_ddq")
GOAL = (
    "goal_q",
    "goal_dq",
    "goal_xyz",
    "hit_angle",
    "hit_speed",
    "hit_speed_max",
    "home_q",
)


def model_sha256(model: str) -> str:
    """Return the sha256 of the file of a model, by the name of a shipped one or the file's path."""
    from cnpgen.planner.model_file import find_model

    return file_sha256(find_model(model))


def load_stage_planner(model: str, sha256: str, context: Context) -> "Planner":
    """Load the planner of a stage, a shipped model or a model file with the digest ``sha256``.

    Raise RecipeError if the file has another sha256, or the model is for another
    problem.
    """
    from cnpgen.planner.model_file import load_model
    from cnpgen.planner.planner import Planner

    digest = model_sha256(model)
    if digest != sha256:
        raise RecipeError(
            [f"sha256: the file of model {model!r} has {digest}, expected {sha256}"]
        )
    loaded = load_model(model)
    problem = record_problem(context.problem)
    if loaded.problem.comparable_sha256 != problem.comparable_sha256:
        differs = ", ".join(problem.differences(loaded.problem)[:4])
        raise RecipeError(
            [
                f"model: {model!r} plans for another problem, they differ in {differs}; leave it out"
            ]
        )
    return Planner(loaded, backend=context.kernels.backend)


def planner_boundary(columns: Mapping[str, Array], planner: "Planner") -> Boundary:
    """Return the boundary conditions of N rows for a planner, from columns of shape (N, width).

    Goal accelerations are omitted if the planner leaves them free.
    """
    names = [
        name
        for name in CONDITIONS
        # Models that fix fewer derivatives leave the acceleration at the goal free.
        if name != "goal_ddq" or planner.model.fixed_at_goal == 3
    ]
    return Boundary(**{name: columns[name] for name in names if name in columns})


@dataclass(frozen=True, kw_only=True)
class StartOnPlan(Stage):
    """Stage: plan the candidates and move their starts to random times of the motions, projected onto the table."""

    inputs = (*BOUNDARY, "start_xyz", *GOAL[2:-1])
    replaces = ("goal_q", "goal_dq")
    model: str = field("planner: name of a shipped model, or path of a model file")
    sha256: str = field(
        "sha256 of the model file; another file gives other samples", pattern=SHA256
    )
    moved: float = fraction("fraction of the starts that are moved onto plans")
    refined: float = fraction(
        f"fraction of the moved ones that are on refined plans, up to {STATES_PER_REFINED_PLAN} on each",
        default=0.0,
    )
    times: Range = field("time on the plan as a fraction of its duration")

    def describe(self) -> str:
        return (
            f"plan with {self.model!r} and move {100 * self.moved:.4g} % of the starts to a time between"
            f" {self.times.low:g} and {self.times.high:g} of the motion time, {100 * self.refined:.4g} % of them"
            " on refined plans"
        )

    def outputs(self, context: Context) -> Fields:
        quantities = (
            ("rad", "positions"),
            ("rad/s", "velocities"),
            ("rad/s^2", "accelerations"),
        )
        states = (
            context.joint_field(name, unit, f"joint {quantity} at the start")
            for name, (unit, quantity) in zip(START, quantities, strict=True)
        )
        table = context.constraint(Table)
        low, high = (
            [getattr(axis, end) for axis in (table.x, table.y)]
            for end in ("low", "high")
        )
        return (*states, position_field("start", [*low, table.z], [*high, table.z]))

    def writes(self, context: Context) -> tuple[str, ...]:
        return (
            *(field.name for field in self.outputs(context)),
            "start_tip_velocity",
            *map(of_plan, GOAL),
        )

    def prepare(self, context: Context) -> StageFunction:
        height = context.constraint(Table).z
        load = context.kernels.load
        exact = load(onto_table, height=height)
        tip = load(tip_position)
        speed = load(velocity_of_tip)
        make = self._maker(context)

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            # All candidates draw all three numbers, so that an option does not change
            # the other draws.
            moves, refines, times = (candidates.draw(random, 1)[0] for _ in range(3))
            moved = moves < self.moved
            owner, motion = make(candidates, moved & (refines < self.refined))
            for name in GOAL:
                candidates[of_plan(name)] = np.take(
                    candidates["start_q" if name == "home_q" else name], owner, axis=1
                )
            # Uniform between low and high, as a fraction of the duration.
            phase = self.times.low + (self.times.high - self.times.low) * times
            states = states_at_times(motion, phase * motion.duration())
            # Plans meet the table within a tolerance, starts of samples exactly.
            projected = exact(*(np.ascontiguousarray(state.T) for state in states))
            for name, values in zip(START, projected, strict=True):
                candidates[name] = np.where(moved, values, candidates[name])
            (candidates["start_xyz"],) = tip(candidates["start_q"])
            (candidates["start_tip_velocity"],) = speed(
                candidates["start_q"], candidates["start_dq"]
            )

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        return leave

    def _maker(
        self, context: Context
    ) -> Callable[[CandidateBatch, Mask], tuple[Indices, Motion]]:
        """Return a function that computes a motion for every candidate and the index of its owner."""
        from cnpgen.refine.refine_engine import load_solver

        planner = load_stage_planner(self.model, self.sha256, context)
        solve = load_solver(context.problem, context.robot, context.kernels)

        def make(candidates: CandidateBatch, refined: Mask) -> tuple[Indices, Motion]:
            columns = {
                name: np.ascontiguousarray(values.T)
                for name, values in candidates.columns.items()
            }
            motion = planner.plan_batch(planner_boundary(columns, planner)).motion
            owner = np.arange(len(motion))
            some = np.flatnonzero(refined)
            # One plan of each group of candidates is refined; all of the group start on
            # it.
            few = some[::STATES_PER_REFINED_PLAN]
            owner[some] = np.repeat(few, STATES_PER_REFINED_PLAN)[: len(some)]
            path = motion.path.copy()
            rate = motion.rate.copy()
            with one_thread():
                better, _ = solve(
                    {name: values[few] for name, values in columns.items()},
                    initial_guess=motion[few],
                )
            # The motion of each candidate is then that of its owner.
            path[few] = better.path
            rate[few] = better.rate
            return owner, Motion(path[owner], rate[owner], motion.degree)

        return make


@dataclass(frozen=True, kw_only=True)
class GoalOfPlan(Stage):
    """Stage: keep the goal of the motion that contains the start, in a fraction of the cases."""

    inputs = tuple(f"planned_{name}" for name in GOAL)
    share: float = fraction(
        "fraction of the samples with the goal of the motion that they start on"
    )

    def describe(self) -> str:
        return f"in {100 * self.share:.4g} % of the cases take the goal of the motion that the start is on"

    def prepare(self, context: Context) -> StageFunction:

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            same = candidates.draw(random, 1)[0] < self.share
            for name in GOAL:
                candidates[name] = np.where(
                    same, candidates[of_plan(name)], candidates[name]
                )

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        return leave


def of_plan(name: str) -> str:
    """Return the column name of a goal column of the plan."""
    return f"planned_{name}"
