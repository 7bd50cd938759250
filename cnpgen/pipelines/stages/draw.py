"""Stages: draw or list start and goal positions of the tip, and draw the parameters of the problem."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.documents import NamedErrors
from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.pipelines.stages.candidate_table import in_world, in_world_box
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Field, Fields

MAX_TASKS = 100_000


@dataclass(frozen=True, kw_only=True)
class DrawPositions(Stage):
    """Stage: start and goal positions uniform in two boxes, with a minimum distance.

    If parameters of the problem move the table, the boxes are in the frame of the
    table.
    """

    start: tuple[Range, Range, Range] = field(
        "box of start positions: x, y, z", unit="m"
    )
    goal: tuple[Range, Range, Range] = field("box of goal positions: x, y, z", unit="m")
    min_distance: float = field(
        "minimum horizontal distance of start and goal",
        unit="m",
        default=0.0,
        low=0.0,
        plausible=10.0,
    )

    def describe(self) -> str:
        text = f"draw a start position in {_box(self.start)} m and a goal position in {_box(self.goal)} m"
        return (
            f"{text}, horizontal distance at least {self.min_distance:g} m"
            if self.min_distance
            else text
        )

    def outputs(self, context: Context) -> Fields:
        return tuple(
            position_field(
                end,
                *in_world_box(
                    context, [axis.low for axis in box], [axis.high for axis in box]
                ),
            )
            for end, box in (("start", self.start), ("goal", self.goal))
        )

    def prepare(self, context: Context) -> StageFunction:
        check_reach(context, (("start", self.start), ("goal", self.goal)))

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["start_xyz"] = uniform(candidates.draw(random, 3), self.start)
            candidates["goal_xyz"] = uniform(candidates.draw(random, 3), self.goal)
            # Measured in the frame of the table, before positions move to the world.
            distance = np.hypot(*(candidates["goal_xyz"] - candidates["start_xyz"])[:2])
            for end in ("start_xyz", "goal_xyz"):
                candidates[end] = in_world(context, candidates, candidates[end])
            candidates.reject(distance >= self.min_distance, "too close together")

        return work


@dataclass(frozen=True, kw_only=True)
class DrawGoal(Stage):
    """Stage: goal position uniform in a box, with a minimum distance from the start."""

    inputs = ("start_xyz",)
    goal: tuple[Range, Range, Range] = field("box of goal positions: x, y, z", unit="m")
    min_distance: float = field(
        "minimum horizontal distance from the start",
        unit="m",
        default=0.0,
        low=0.0,
        plausible=10.0,
    )

    def describe(self) -> str:
        text = f"draw a goal position in {_box(self.goal)} m"
        return (
            f"{text}, at least {self.min_distance:g} m from the start horizontally"
            if self.min_distance
            else text
        )

    def outputs(self, context: Context) -> Fields:
        return (
            position_field(
                "goal",
                [axis.low for axis in self.goal],
                [axis.high for axis in self.goal],
            ),
        )

    def prepare(self, context: Context) -> StageFunction:
        check_reach(context, (("goal", self.goal),))

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["goal_xyz"] = uniform(candidates.draw(random, 3), self.goal)
            distance = np.hypot(*(candidates["goal_xyz"] - candidates["start_xyz"])[:2])
            candidates.reject(distance >= self.min_distance, "too close together")

        return work


def check_reach(
    context: Context, boxes: Iterable[tuple[str, tuple[Range, ...]]]
) -> None:
    """Raise RecipeError if the arm cannot reach one of the boxes, given as (name, box)."""
    errors = []
    shoulder = context.robot.chain.joints[0].translation
    for name, box in boxes:
        # The closest point of the box to the shoulder is out of reach: so is the whole
        # box.
        nearest = np.clip(
            shoulder, [axis.low for axis in box], [axis.high for axis in box]
        )
        distance = float(np.linalg.norm(nearest - shoulder))
        if distance > context.robot.chain.reach:
            errors.append(
                f"{name}: the whole box {_box(box)} m is out of reach:"
                f" {distance:.2f} m from the first joint, the arm is {context.robot.chain.reach:.2f} m long"
            )
    if errors:
        raise RecipeError(errors)


def position_field(end: str, low: Sequence[float], high: Sequence[float]) -> Field:
    """Describe the field of the tip position at an end, bounded by a box [m]."""
    return Field(
        f"{end}_xyz",
        "m",
        f"{end} position of the tip",
        3,
        ("x", "y", "z"),
        "context",
        "world",
        tuple(low),
        tuple(high),
    )


def uniform(numbers: Array, ranges: tuple[Range, ...]) -> Array:
    """Scale uniform numbers of shape (m, n) to m ranges."""
    low = np.array([[r.low] for r in ranges])
    high = np.array([[r.high] for r in ranges])
    # low + (high - low) u with u in [0, 1)
    scaled: Array = low + (high - low) * numbers
    return scaled


def _box(ranges: tuple[Range, ...]) -> str:
    return " x ".join(
        f"[{r.low:g}, {r.high:g}]" if r.low < r.high else f"{r.low:g}" for r in ranges
    )


@dataclass(frozen=True, kw_only=True)
class GivenPositions(Stage):
    """Stage: goal positions of a list or a grid, with listed start positions or the base configuration."""

    goal: tuple[Vector3, ...] = field(
        "goal positions: x, y, z of each", unit="m", default=()
    )
    grid: tuple[Range, ...] = field(
        "box of goal positions instead of a list: x, y, z", unit="m", default=()
    )
    counts: tuple[int, ...] = field(
        "number of positions along x, y, z, ends included", low=1, default=()
    )
    start: tuple[Vector3, ...] = field(
        "start positions, one for all or one per goal; default: the base configuration",
        unit="m",
        default=(),
    )

    def validate(self) -> NamedErrors:
        if bool(self.goal) == bool(self.grid):
            yield "goal", "either a list of goals or a grid must be given, and not both"
        for key in ("grid", "counts"):
            if self.grid and len(getattr(self, key)) != 3:
                yield (
                    key,
                    f"expected 3 entries, for x, y and z, got {len(getattr(self, key))}",
                )
        if self.counts and not self.grid:
            yield "counts", "counts are for a grid, and there is none"
        if self.tasks > MAX_TASKS:
            yield (
                "counts",
                f"a grid of {self.tasks:,} goals is too large, expected at most {MAX_TASKS:,}",
            )
            return
        # One start holds for all goals.
        if len(self.start) not in {0, 1, self.tasks}:
            yield (
                "start",
                f"expected one position for all, or one for each of {self.tasks}, got {len(self.start)}",
            )

    @property
    def tasks(self) -> int:
        """Number of goals."""
        return len(self.goal) or math.prod(self.counts)

    def describe(self) -> str:
        goals = (
            "goals in a list"
            if self.goal
            else f"goals on a grid of {' x '.join(map(str, self.counts))}"
        )
        origin = "listed start positions" if self.start else "the base configuration"
        return f"take {self.tasks:,} {goals}, one after the other, from {origin}"

    def outputs(self, context: Context) -> Fields:
        boxes = (("start", self._starts(context)), ("goal", self._goals()))
        positions = tuple(
            position_field(
                end, points.min(axis=0).tolist(), points.max(axis=0).tolist()
            )
            for end, points in boxes
        )
        base = context.joint_field("start_q", "rad", "joint positions at the start")
        return positions if self.start else (*positions, base)

    def prepare(self, context: Context) -> StageFunction:
        columns = {"start_xyz": self._starts(context).T, "goal_xyz": self._goals().T}
        if not self.start:
            columns["start_q"] = context.robot.home[:, None]

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            for name, values in columns.items():
                candidates[name] = np.ascontiguousarray(
                    np.broadcast_to(values, (len(values), candidates.size))
                )

        return work

    def _goals(self) -> Array:
        """Return the goal positions [m], shape (tasks, 3).

        In a grid, x is the outer loop.
        """
        if self.goal:
            return np.array(self.goal)
        axes = [
            np.linspace(axis.low, axis.high, count)
            for axis, count in zip(self.grid, self.counts, strict=True)
        ]
        # z changes fastest, then y, then x.
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def _starts(self, context: Context) -> Array:
        """Return the start positions [m], shape (tasks or 1, 3)."""
        if self.start:
            return np.array(self.start)
        (tip,) = context.kernels.load(tip_position)(context.robot.home[:, None])
        return np.ascontiguousarray(tip.T)


@dataclass(frozen=True, kw_only=True)
class DrawParameters(Stage):
    """Stage: parameters of the problem, uniform in the ranges of its ``[parameters]``."""

    def describe(self) -> str:
        return "draw the parameters of the problem uniformly in their ranges"

    def outputs(self, context: Context) -> Fields:
        ranges = context.problem.parameters
        if not ranges:
            raise RecipeError(
                [
                    f"needs [parameters], which the problem {context.problem.path} does not have"
                ]
            )
        low, high = (
            tuple(getattr(span, end) for span in ranges.ranges)
            for end in ("low", "high")
        )
        return (
            Field(
                "parameters",
                ranges.units,
                "parameters of the problem",
                len(ranges),
                ranges.names,
                valid_min=low,
                valid_max=high,
            ),
        )

    def prepare(self, context: Context) -> StageFunction:
        ranges = context.problem.parameters.ranges

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["parameters"] = uniform(
                candidates.draw(random, len(ranges)), ranges
            )

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Keep the parameters of the tasks; they are nominal if none are given."""
        if "parameters" in given:
            return super().complete(context, given)
        nominal = context.robot.nominal_parameters[:, None]

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            candidates["parameters"] = np.repeat(nominal, len(candidates.alive), axis=1)

        return work
