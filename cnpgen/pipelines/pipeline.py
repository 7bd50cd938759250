"""Pipeline: the stages that sample the boundary conditions of a problem."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cnpgen.errors import RecipeError
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.problems.problem import Problem
from cnpgen.schema.keys import NAME, field

MAX_STAGES = 100


@dataclass(frozen=True, kw_only=True)
class Pipeline:
    """Stages that sample the boundary conditions of a problem."""

    name: str = field("name of the pipeline: lower-case letters, digits and hyphens", pattern=NAME)
    title: str = field("title in one line", default="")
    problem: Problem = field(
        "name of a shipped problem, or path of a problem file relative to this one", form="a name or a path"
    )
    stage: tuple[Stage, ...] = field("stages, in order", form="[[stage]] tables")
    path: Path = Path()

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, mistake) pairs."""
        if (count := len(self.stage)) > MAX_STAGES:
            yield "stage", f"there are {count:,} stages, expected at most {MAX_STAGES}"


def listed_tasks(pipeline: Pipeline) -> int | None:
    """Return the number of listed tasks of a pipeline; None if no stage lists tasks.

    Raises:
        RecipeError: More than one stage lists tasks.
    """
    listed = [stage.tasks for stage in pipeline.stage if stage.tasks is not None]
    if len(listed) > 1:
        raise RecipeError([f"{pipeline.path}: {len(listed)} stages list positions, expected one at most"])
    return listed[0] if listed else None
