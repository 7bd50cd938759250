"""Pipeline: how the boundary conditions of a problem are drawn."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cnpgen.errors import RecipeError
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.problem import Problem
from cnpgen.schema.keys import NAME, field

MOST_STAGES = 100


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """How the boundary conditions of a problem are drawn."""

    name: str = field("name of the pipeline: lower-case letters, digits and hyphens", pattern=NAME)
    title: str = field("one line about it", default="")
    problem: Problem = field(
        "name of a shipped problem, or path of a problem file relative to this one", form="a name or a path"
    )
    stage: tuple[Stage, ...] = field("the steps, in order", form="[[stage]] tables")
    path: Path = Path()

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        if (count := len(self.stage)) > MOST_STAGES:
            yield "stage", f"there are {count:,} stages, expected at most {MOST_STAGES}"


def listed_tasks(pipeline: Pipeline) -> int | None:
    """Return how many draws there are where a stage lists them; None where none does.

    Raises:
        RecipeError: More than one stage lists them.
    """
    listed = [stage.tasks for stage in pipeline.stage if stage.tasks is not None]
    if len(listed) > 1:
        raise RecipeError([f"{pipeline.path}: {len(listed)} stages list positions, expected one at most"])
    return listed[0] if listed else None
