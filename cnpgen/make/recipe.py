"""DatasetRecipe: how many rows of which pipeline, from which seed, split how."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from cnpgen.errors import UsageError
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.problems.problem import resolved, without_labels
from cnpgen.schema.keys import NAME, field

SPLIT_NAME = "^[a-z][a-z0-9_]{0,99}$"
MAX_SEED = 2**63 - 1
VERSION = r"^(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8})\.(0|[1-9][0-9]{0,8})$"


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe:
    """How many rows of which pipeline, from which seed, split how.

    Attributes:
        splits: Split name -> rows; the first split takes what rounding leaves when the sizes are scaled by ``n``.
    """

    name: str = field("name of the dataset: lower-case letters, digits and hyphens", pattern=NAME)
    version: str = field("version of the dataset, MAJOR.MINOR.PATCH", default="1.0.0", pattern=VERSION)
    title: str = field("one line about it", default="")
    pipeline: Pipeline = field(
        "name of a shipped pipeline, or path of a pipeline file relative to this one", form="a name or a path"
    )
    seed: int = field("root seed", default=0, low=0, high=MAX_SEED)
    splits: dict[str, int] = field("rows per split", low=1, pattern=SPLIT_NAME)
    license: str = field("licence of the rows", default="CC-BY-4.0")
    path: Path = Path()


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


def recipe_digest(recipe: Pipeline | DatasetRecipe) -> str:
    """Hash all that decides which rows a seed gives.

    That is the resolved pipeline and problem, the code of plug-ins and the content of the URDF: not titles, comments,
    paths, the seed or the splits. Writing "5 mm" for 0.005 or a default explicitly does not change it; another name, or
    what is read only where motions are planned (trajectory, objective), does, although the rows stay the same.

    Returns:
        sha256, as 64 hexadecimal digits.
    """
    pipeline = recipe.pipeline if isinstance(recipe, DatasetRecipe) else recipe
    return resolved_digest(resolved(pipeline), pipeline.problem.urdf_text.encode())


def resolved_digest(pipeline: Mapping[str, Any], urdf: bytes) -> str:
    """Hash a pipeline that was resolved, here or, as blueprints of datasets keep it, elsewhere; see ``recipe_digest``.

    Args:
        pipeline: What ``resolved`` made of it.
        urdf: Content of the robot's URDF file.
    """
    content = {key: value for key, value in pipeline.items() if key != "title"}
    content |= {"problem": without_labels(pipeline["problem"]), "urdf_sha256": hashlib.sha256(urdf).hexdigest()}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()
