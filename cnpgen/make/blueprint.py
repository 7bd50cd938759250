"""Drawing up the blueprint of a dataset: everything that determines its bytes, resolved; nothing is made."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.errors import UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.machine.versions import versions
from cnpgen.make.recipe import MAX_SEED, DatasetRecipe, recipe_digest, split_rows
from cnpgen.make.shards import Job
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.problems.problem import resolved
from cnpgen.schema.arguments import integer
from cnpgen.store.blueprint import Blueprint, default_shard_size
from cnpgen.store.workspace import Workspace

MAX_ROWS = 10**12


def dataset_folder(recipe: DatasetRecipe, out: str | Path | None) -> Path:
    """Return the folder of a dataset: what was asked for, else ``NAME-vMAJOR`` in the current folder.

    A path with ".." behind a folder that is not there yet is resolved: it would be another one once that is made.

    Raises:
        UsageError: It has no name.
    """
    if out is None:
        return Path(f"{recipe.name}-v{recipe.version.split('.')[0]}")
    if not isinstance(out, str | Path) or not str(out).strip():
        raise UsageError(f"out must name a folder, got {str(out) if isinstance(out, Path) else out!r}")
    folder = Path(out)
    return folder.resolve() if ".." in folder.parts and not folder.parent.exists() else folder


def draw_up(
    recipe: DatasetRecipe,
    workspace: Workspace,
    *,
    n: int | None = None,
    seed: int | None = None,
    shard_size: int | None = None,
    dtype: str = "float64",
    backend: str | None = None,
    force: bool = False,
) -> Job:
    """Resolve what ``make_dataset`` would make, building its kernels but writing nothing of the dataset.

    Args:
        recipe: The recipe.
        workspace: Its folder. If the recipe was begun there, backend and shard size that are not given are those with
            which it was.
        n: Rows over all splits; default the recipe's.
        seed: Root seed; default the recipe's.
        shard_size: Rows per shard.
        dtype: What rows are stored as.
        backend: What computes them; default the fastest that works.
        force: Whether what was begun in the folder will be deleted.

    Raises:
        RecipeError: The recipe has mistakes.
        UsageError: An argument makes no sense.
        MachineError: No working backend.
    """
    total, root, shard_size = _check(recipe, n, seed, shard_size)
    digest, begun = recipe_digest(recipe), workspace.blueprint
    if begun is not None and (begun.recipe_sha256 != digest or force):
        begun = None  # another dataset, or one that goes
    if begun is not None:
        backend = begun.backend if backend is None else backend
        shard_size = begun.shard_size if shard_size is None else shard_size
    chosen, cache_folder = choose_backend(backend)
    prepared = PreparedPipeline(recipe.pipeline, backend=chosen, cache_folder=cache_folder, dtype=dtype)
    if prepared.tasks is not None:
        total = _answered(prepared, recipe, root, n)
    splits = split_rows(recipe, total)
    blueprint = Blueprint(
        name=recipe.name,
        version=recipe.version,
        title=recipe.title,
        license=recipe.license,
        recipe_sha256=digest,
        recipe=resolved(recipe),
        seed=root,
        splits=splits,
        shard_size=shard_size or default_shard_size(total, prepared.block_rows),
        block_rows=prepared.block_rows,
        dtype=dtype,
        backend=chosen,
        fields=prepared.fields,
        robot=_robot_record(prepared),
        versions=versions(),
        earlier=begun.earlier if begun is not None and begun.splits == splits else (),
    )
    return Job(workspace.folder, blueprint, recipe.pipeline, chosen, cache_folder)


def _check(
    recipe: DatasetRecipe, n: int | None, seed: int | None, shard_size: int | None
) -> tuple[int, int, int | None]:
    """Return rows, seed and shard size; refuse what no file of a recipe can say, but a recipe made in Python."""
    for split, rows in recipe.splits.items():
        integer(f"the rows of split {split!r}", rows, least=1)
    if not recipe.splits:
        raise UsageError(f"{recipe.name} has no splits: expected rows of at least one, such as {{'train': 1000}}")
    total = integer("n", sum(recipe.splits.values()) if n is None else n, least=1, most=MAX_ROWS)
    root = integer("seed", recipe.seed if seed is None else seed, least=0, most=MAX_SEED)
    return total, root, None if shard_size is None else integer("shard_size", shard_size, least=1)


def _answered(prepared: PreparedPipeline, recipe: DatasetRecipe, seed: int, n: int | None) -> int:
    """Return how many rows a dataset of listed tasks has: one for each that has an answer, or as many as are wanted.

    Raises:
        UsageError: More are wanted, or none has an answer, or there are splits to share them.
    """
    if len(recipe.splits) > 1:
        splits = ", ".join(recipe.splits)
        raise UsageError(f"{recipe.name} lists its tasks: they would be the same in its splits {splits}, expected one")
    found, wanted = prepared.answers(seed), sum(recipe.splits.values()) if n is None else n
    rows = len(found.alive)
    if not rows or (n is not None and n > rows):
        counts = zip(found.reasons, np.bincount(found.fate, minlength=1 + len(found.reasons))[1:], strict=True)
        why = ", ".join(f"{count} {reason}" for reason, count in counts if count) or "it lists no more"
        raise UsageError(f"{recipe.name} has {rows} rows, of {prepared.tasks} tasks ({why}): got n = {wanted}")
    return min(rows, wanted)


def _robot_record(prepared: PreparedPipeline) -> dict[str, Any]:
    robot = prepared.context.robot
    limits = {
        name: [float(x) for x in getattr(robot, name)]
        for name in ("position_lower", "position_upper", "velocity_limit", "acceleration_limit", "torque_limit")
    }
    return {
        "name": robot.urdf.stem,
        "urdf_sha256": hashlib.sha256(robot.urdf_text.encode()).hexdigest(),
        "urdf": robot.urdf_text,
        "tip": robot.tip,
        "joint_names": list(robot.joint_names),
        "limits": limits,
    }
