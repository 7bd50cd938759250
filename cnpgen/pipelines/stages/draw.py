"""Stages: draw the start and goal positions of the tip, or the goal position alone."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.candidate_table import in_world, in_world_box
from cnpgen.pipelines.stages.stage import Array, CandidateBatch, Stage, StageFunction
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class DrawPositions(Stage):
    """Stage: start and goal positions uniform in two boxes, with a minimum distance.

    If parameters of the problem move the table, the boxes are in the frame of the table.
    """

    start: tuple[Range, Range, Range] = field("box of start positions: x, y, z", unit="m")
    goal: tuple[Range, Range, Range] = field("box of goal positions: x, y, z", unit="m")
    min_distance: float = field(
        "minimum horizontal distance of start and goal", unit="m", default=0.0, low=0.0, plausible=10.0
    )

    def describe(self) -> str:
        text = f"draw a start position in {_box(self.start)} m and a goal position in {_box(self.goal)} m"
        return f"{text}, horizontal distance at least {self.min_distance:g} m" if self.min_distance else text

    def outputs(self, context: Context) -> tuple[Field, ...]:
        return tuple(
            position_field(end, *in_world_box(context, [axis.low for axis in box], [axis.high for axis in box]))
            for end, box in (("start", self.start), ("goal", self.goal))
        )

    def prepare(self, context: Context) -> StageFunction:
        """Check that the boxes are reachable and return the stage function."""
        check_reach(context, (("start", self.start), ("goal", self.goal)))

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["start_xyz"] = uniform(candidates.draw(random, 3), self.start)
            candidates["goal_xyz"] = uniform(candidates.draw(random, 3), self.goal)
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
        "minimum horizontal distance from the start", unit="m", default=0.0, low=0.0, plausible=10.0
    )

    def describe(self) -> str:
        text = f"draw a goal position in {_box(self.goal)} m"
        return f"{text}, at least {self.min_distance:g} m from the start horizontally" if self.min_distance else text

    def outputs(self, context: Context) -> tuple[Field, ...]:
        return (position_field("goal", [axis.low for axis in self.goal], [axis.high for axis in self.goal]),)

    def prepare(self, context: Context) -> StageFunction:
        """Check that the box is reachable and return the stage function."""
        check_reach(context, (("goal", self.goal),))

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["goal_xyz"] = uniform(candidates.draw(random, 3), self.goal)
            distance = np.hypot(*(candidates["goal_xyz"] - candidates["start_xyz"])[:2])
            candidates.reject(distance >= self.min_distance, "too close together")

        return work


def check_reach(context: Context, boxes: Iterable[tuple[str, tuple[Range, ...]]]) -> None:
    """Raise RecipeError if the arm cannot reach one of the boxes, given as (name, box)."""
    mistakes = []
    shoulder = context.robot.chain.joints[0].translation
    for name, box in boxes:
        nearest = np.clip(shoulder, [axis.low for axis in box], [axis.high for axis in box])
        distance = float(np.linalg.norm(nearest - shoulder))
        if distance > context.robot.chain.reach:
            mistakes.append(
                f"{name}: the whole box {_box(box)} m is out of reach:"
                f" {distance:.2f} m from the first joint, the arm is {context.robot.chain.reach:.2f} m long"
            )
    if mistakes:
        raise RecipeError(mistakes)


def position_field(end: str, low: Sequence[float], high: Sequence[float]) -> Field:
    """Describe the field of the tip position at an end, bounded by a box [m]."""
    text = f"{end} position of the tip"
    return Field(f"{end}_xyz", "m", text, 3, ("x", "y", "z"), "context", "world", tuple(low), tuple(high))


def uniform(numbers: Array, ranges: tuple[Range, ...]) -> Array:
    """Scale uniform numbers of shape (m, n) to m ranges."""
    low = np.array([[r.low] for r in ranges])
    high = np.array([[r.high] for r in ranges])
    scaled: Array = low + (high - low) * numbers
    return scaled


def _box(ranges: tuple[Range, ...]) -> str:
    return " x ".join(f"[{r.low:g}, {r.high:g}]" if r.low < r.high else f"{r.low:g}" for r in ranges)
