"""DatasetRecipe: pipeline, seed and rows per split of a dataset."""

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
    """Pipeline, seed and rows per split of a dataset.

    Attributes:
        splits: Split name -> rows; see ``split_rows`` for scaling to ``n`` rows.
    """

    name: str = field("name of the dataset: lower-case letters, digits and hyphens", pattern=NAME)
    version: str = field("version of the dataset, MAJOR.MINOR.PATCH", default="1.0.0", pattern=VERSION)
    title: str = field("title in one line", default="")
    pipeline: Pipeline = field(
        "name of a shipped pipeline, or path of a pipeline file relative to this one", form="a name or a path"
    )
    seed: int = field("root seed", default=0, low=0, high=MAX_SEED)
    splits: dict[str, int] = field("samples per split", low=1, pattern=SPLIT_NAME)
    license: str = field(
        "license of the samples, an SPDX identifier such as CC-BY-4.0; publishing needs one", default=""
    )
    creator: str = field("authors of the dataset, for its card", default="")
    citation: str = field("how to cite the dataset, such as BibTeX, for its card", default="")
    path: Path = Path()


def split_rows(recipe: DatasetRecipe, n: int) -> dict[str, int]:
    """Scale the splits of a recipe to ``n`` rows in total.

    Every split gets its proportional share rounded down. Each remaining row goes to the split with the most recipe rows
    per row after the addition, the first one on a tie. This is D'Hondt's rule: no split shrinks when ``n`` grows, so a
    longer run of a recipe extends a shorter one. (Adding the remainder to the first split violates this: of
    80 + 10 + 10, it would get 9 rows for n = 9 but 8 for n = 10.)

    Args:
        recipe: Recipe to scale.
        n: Number of rows over all splits, at least 1.

    Returns:
        Split name -> rows, in the recipe's order, without empty splits; the recipe's own rows if ``n`` is their sum.

    Raises:
        UsageError: ``n`` is less than 1.
    """
    if n < 1:
        raise UsageError(f"must be at least 1, got {n}", argument="n")
    total = sum(recipe.splits.values())
    rows = {name: n * share // total for name, share in recipe.splits.items()}
    for _ in range(n - sum(rows.values())):
        rows[max(rows, key=lambda name: Fraction(recipe.splits[name], rows[name] + 1))] += 1
    return {name: count for name, count in rows.items() if count > 0}


def recipe_digest(recipe: Pipeline | DatasetRecipe) -> str:
    """Hash everything that determines the rows of a seed, as 64 hexadecimal digits (sha256).

    The hash covers the resolved pipeline and problem, the code of plug-ins and the content of the URDF. It does not
    cover titles, comments, paths, the seed or the splits. Writing "5 mm" for 0.005, or a default explicitly, does not
    change it. Another name, trajectory or objective changes it, although the rows stay the same.
    """
    pipeline = recipe.pipeline if isinstance(recipe, DatasetRecipe) else recipe
    return resolved_digest(resolved(pipeline), pipeline.problem.urdf_text.encode())


def resolved_digest(pipeline: Mapping[str, Any], urdf: bytes) -> str:
    """Hash the result of ``resolved`` for a pipeline, for example from the specification of a dataset, and its URDF.

    See ``recipe_digest``.
    """
    content = {key: value for key, value in pipeline.items() if key != "title"}
    content |= {"problem": without_labels(pipeline["problem"]), "urdf_sha256": hashlib.sha256(urdf).hexdigest()}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()
