"""Stage: listed positions, or positions on a grid, in order and without random sampling."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.draw import position_field
from cnpgen.pipelines.stages.stage import Array, CandidateBatch, Stage, StageFunction
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Field

Position = tuple[float, float, float]
MAX_TASKS = 100_000


@dataclass(frozen=True, kw_only=True)
class GivenPositions(Stage):
    """Stage: goal positions of a list or a grid, with listed start positions or the base configuration."""

    goal: tuple[Position, ...] = field("goal positions: x, y, z of each", unit="m", default=())
    grid: tuple[Range, ...] = field("box of goal positions instead of a list: x, y, z", unit="m", default=())
    counts: tuple[int, ...] = field("number of positions along x, y, z, ends included", low=1, default=())
    start: tuple[Position, ...] = field(
        "start positions, one for all or one per goal; default: the base configuration", unit="m", default=()
    )

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        if bool(self.goal) == bool(self.grid):
            yield "goal", "either a list of goals or a grid must be given, and not both"
        for key in ("grid", "counts"):
            if self.grid and len(getattr(self, key)) != 3:
                yield key, f"expected 3 entries, for x, y and z, got {len(getattr(self, key))}"
        if self.counts and not self.grid:
            yield "counts", "counts are for a grid, and there is none"
        if self.tasks > MAX_TASKS:
            yield "counts", f"a grid of {self.tasks:,} goals is too large, expected at most {MAX_TASKS:,}"
            return
        if len(self.start) not in {0, 1, self.tasks}:
            yield "start", f"expected one position for all, or one for each of {self.tasks}, got {len(self.start)}"

    @property
    def tasks(self) -> int:
        """Number of goals."""
        return len(self.goal) or math.prod(self.counts)

    def describe(self) -> str:
        goals = "goals in a list" if self.goal else f"goals on a grid of {' x '.join(map(str, self.counts))}"
        origin = "listed start positions" if self.start else "the base configuration"
        return f"take {self.tasks:,} {goals}, one after the other, from {origin}"

    def outputs(self, context: Context) -> tuple[Field, ...]:
        boxes = (("start", self._starts(context)), ("goal", self._goals()))
        positions = tuple(
            position_field(end, points.min(axis=0).tolist(), points.max(axis=0).tolist()) for end, points in boxes
        )
        base = context.joint_field("start_q", "rad", "joint positions at the start")
        return positions if self.start else (*positions, base)

    def prepare(self, context: Context) -> StageFunction:
        """List the positions."""
        columns = {"start_xyz": self._starts(context).T, "goal_xyz": self._goals().T}
        if not self.start:
            columns["start_q"] = context.robot.base[:, None]

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            for name, values in columns.items():
                candidates[name] = np.ascontiguousarray(np.broadcast_to(values, (len(values), candidates.size)))

        return work

    def _goals(self) -> Array:
        """Return the goal positions [m], shape (tasks, 3); in a grid, x is the outer loop."""
        if self.goal:
            return np.array(self.goal)
        axes = [np.linspace(axis.low, axis.high, count) for axis, count in zip(self.grid, self.counts, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def _starts(self, context: Context) -> Array:
        """Return the start positions [m], shape (tasks or 1, 3)."""
        if self.start:
            return np.array(self.start)
        (tip,) = context.kernels.load(tip_position)(context.robot.base[:, None])
        return np.ascontiguousarray(tip.T)
