"""Problem, Pipeline and DatasetRecipe: the three nouns that users write as TOML files."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from cnpgen.errors import UsageError
from cnpgen.pipelines.stage import Stage
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.robots.spec import HeldObject, LimitSpec, Obstacle, RobotSpec
from cnpgen.schema import registry
from cnpgen.schema.keys import NAME, field, to_dict
from cnpgen.trajectory.spec import TrajectorySpec

SPLIT_NAME = "^[a-z][a-z0-9_]*$"
VERSION = r"^(0|[1-9][0-9]*)\.(0|[1-9][0-9]*)\.(0|[1-9][0-9]*)$"


@dataclass(frozen=True, kw_only=True)
class Objective:
    """What a good motion is: the integral over time of ``1 + centrifugal |kappa| v^2`` (paper, Appendix B, eta)."""

    centrifugal: float = field(
        "weight of the centrifugal acceleration |kappa| v^2 of the tip beside the time",
        unit="s^2/m",
        default=0.0,
        low=0.0,
    )


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What a valid motion is.

    Attributes:
        path: The problem file; the URDF is looked up beside it.
        digest: sha256 of the problem file and its URDF.
    """

    name: str = field("name of the problem: lower-case letters, digits and hyphens", pattern=NAME)
    title: str = field("one line about it", default="")
    robot: RobotSpec = field("the robot")
    limits: LimitSpec = field("its planning limits")
    object: HeldObject | None = field("what it holds", default=None)
    obstacle: tuple[Obstacle, ...] = field("the boxes of the world", default=(), form="[[obstacle]] tables")
    constraint: tuple[Constraint, ...] = field("the constraint manifold", default=(), form="[[constraint]] tables")
    trajectory: TrajectorySpec = field("parameterisation of motions", default=TrajectorySpec())
    objective: Objective = field("what a good motion is", default=Objective())
    path: Path = Path()
    digest: str = ""

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        depth = max((item.depth for item in self.constraint if isinstance(item, ObjectContact)), default=0.0)
        if self.object is not None and min(self.object.size) <= 2 * depth:
            yield (
                "object",
                f"is {min(self.object.size):g} m thin, where contacts {depth:g} m deep are legal (object-contact):"
                " expected more than twice the depth",
            )

    @property
    def urdf_path(self) -> Path:
        """The URDF file."""
        return self.path.parent / self.robot.urdf


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
    digest: str = ""


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe:
    """How many rows of which pipeline, from which seed, split how.

    Attributes:
        splits: Split name -> rows; the first split takes what rounding leaves when the sizes are scaled by ``--n``.
    """

    name: str = field("name of the dataset: lower-case letters, digits and hyphens", pattern=NAME)
    version: str = field("version of the dataset, MAJOR.MINOR.PATCH", default="1.0.0", pattern=VERSION)
    title: str = field("one line about it", default="")
    pipeline: Pipeline = field(
        "name of a shipped pipeline, or path of a pipeline file relative to this one", form="a name or a path"
    )
    seed: int = field("root seed", default=0, low=0, high=2**63 - 1)
    splits: dict[str, int] = field("rows per split", low=1, pattern=SPLIT_NAME)
    license: str = field("licence of the rows", default="CC-BY-4.0")
    path: Path = Path()
    digest: str = ""


def split_rows(recipe: DatasetRecipe, n: int) -> dict[str, int]:
    """Scale the splits of a recipe to ``n`` rows in total.

    Every split gets its proportional share rounded down; the few rows that are left go one by one to the split that has
    the most rows in the recipe per row it would then have, the first one on a tie. This is D'Hondt's rule: no split
    shrinks when ``n`` grows, so a longer run of a recipe extends a shorter one. (Giving all of the rest to the first
    split would not do: of 80 + 10 + 10, n = 9 would give it 9 rows and n = 10 only 8.)

    Args:
        recipe: The recipe.
        n: Rows of all splits together, at least 1.

    Returns:
        Split name -> rows, in the recipe's order, without splits that would be empty; the recipe's own numbers if ``n``
        is their sum.

    Raises:
        UsageError: ``n`` is less than 1.
    """
    if n < 1:
        raise UsageError(f"the number of rows must be at least 1, got {n}")
    total = sum(recipe.splits.values())
    rows = {name: n * share // total for name, share in recipe.splits.items()}
    for _ in range(n - sum(rows.values())):
        rows[max(rows, key=lambda name: Fraction(recipe.splits[name], rows[name] + 1))] += 1
    return {name: count for name, count in rows.items() if count > 0}


def resolved(recipe: Problem | Pipeline | DatasetRecipe) -> dict[str, Any]:
    """Return a recipe with everything it refers to and every default as plain dicts and lists, in SI units."""
    return to_dict(recipe, label=_use)


def recipe_digest(recipe: Pipeline | DatasetRecipe) -> str:
    """Hash all that decides which rows a seed gives.

    That is the resolved pipeline and problem, the code of plug-ins and the content of the URDF: not titles, comments,
    paths, the seed or the splits. Writing "5 mm" for 0.005 or a default explicitly does not change it; another name, or
    what is read only where motions are planned (trajectory, objective), does, although the rows stay the same.

    Returns:
        sha256, as 64 hexadecimal digits.
    """
    pipeline = recipe.pipeline if isinstance(recipe, DatasetRecipe) else recipe
    return resolved_digest(resolved(pipeline), pipeline.problem.urdf_path.read_bytes())


def resolved_digest(pipeline: Mapping[str, Any], urdf: bytes) -> str:
    """Hash a pipeline that was resolved, here or, as plans of datasets keep it, elsewhere; see ``recipe_digest``.

    Args:
        pipeline: What ``resolved`` made of it.
        urdf: Content of the robot's URDF file.
    """
    problem = {key: value for key, value in pipeline["problem"].items() if key != "title"}
    problem["robot"] = {key: value for key, value in problem["robot"].items() if key != "urdf"}
    content = {key: value for key, value in pipeline.items() if key != "title"}
    content |= {"problem": problem, "urdf_sha256": hashlib.sha256(urdf).hexdigest()}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _use(obj: object) -> dict[str, str]:
    """Label a stage or a constraint with the name of its kind and, for a plug-in, its package and code."""
    for group, base in registry.BASES.items():
        if isinstance(obj, base):
            source = registry.source_digest(type(obj))
            package = registry.package_of(group, type(obj))
            about = {"package": package, "source": source}
            return {"use": registry.name_of(group, type(obj)), **{key: text for key, text in about.items() if text}}
    return {}


def problem_identity(problem: Problem) -> str:
    """Digest of what kernels are built from: the problem as it is, wherever it came from, and its URDF."""
    content = resolved(problem)
    del content["title"], content["robot"]["urdf"]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode() + problem.urdf_path.read_bytes()).hexdigest()
