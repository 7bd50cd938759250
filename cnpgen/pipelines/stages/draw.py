"""Stages: draw the start and goal position of the tip, or the goal's alone."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Array, Round, Stage, Work
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class DrawPositions(Stage):
    """Start and goal position uniform in two boxes, at least ``min_distance`` apart."""

    start: tuple[Range, Range, Range] = field("box of start positions: x, y, z", unit="m")
    goal: tuple[Range, Range, Range] = field("box of goal positions: x, y, z", unit="m")
    min_distance: float = field("smallest horizontal distance between the two", unit="m", default=0.0, low=0.0)

    def describe(self) -> str:
        """Say what is drawn."""
        text = f"draw a start position in {_box(self.start)} m and a goal position in {_box(self.goal)} m"
        return f"{text}, at least {self.min_distance:g} m apart horizontally" if self.min_distance else text

    def provides(self, context: Context) -> tuple[Field, ...]:
        """Both positions."""
        del context
        return tuple(
            position_field(end, [axis.low for axis in box], [axis.high for axis in box])
            for end, box in (("start", self.start), ("goal", self.goal))
        )

    def prepare(self, context: Context) -> Work:
        """Check that the boxes can be reached and return the draw."""
        check_reach(context, (("start", self.start), ("goal", self.goal)))

        def work(draws: Round, random: np.random.Generator) -> None:
            draws["start_xyz"] = uniform(draws.draw(random, 3), self.start)
            draws["goal_xyz"] = uniform(draws.draw(random, 3), self.goal)
            apart = np.hypot(*(draws["goal_xyz"] - draws["start_xyz"])[:2])
            draws.reject(apart >= self.min_distance, "too close together")

        return work


@dataclass(frozen=True, kw_only=True)
class DrawGoal(Stage):
    """Goal position uniform in a box, at least ``min_distance`` from the start, wherever that is."""

    needs = ("start_xyz",)
    goal: tuple[Range, Range, Range] = field("box of goal positions: x, y, z", unit="m")
    min_distance: float = field("smallest horizontal distance from the start", unit="m", default=0.0, low=0.0)

    def describe(self) -> str:
        """Say what is drawn."""
        text = f"draw a goal position in {_box(self.goal)} m"
        return f"{text}, at least {self.min_distance:g} m from the start horizontally" if self.min_distance else text

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The position."""
        del context
        return (position_field("goal", [axis.low for axis in self.goal], [axis.high for axis in self.goal]),)

    def prepare(self, context: Context) -> Work:
        """Check that the box can be reached and return the draw."""
        check_reach(context, (("goal", self.goal),))

        def work(draws: Round, random: np.random.Generator) -> None:
            draws["goal_xyz"] = uniform(draws.draw(random, 3), self.goal)
            apart = np.hypot(*(draws["goal_xyz"] - draws["start_xyz"])[:2])
            draws.reject(apart >= self.min_distance, "too close together")

        return work


def check_reach(context: Context, boxes: Iterable[tuple[str, tuple[Range, ...]]]) -> None:
    """Refuse boxes of positions, each with what it is called, that the arm is too short for."""
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
    """Describe the field of the tip's position at an end, within a box [m]."""
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
