"""Resolution of the specification of a dataset: everything that determines its bytes."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.machine.versions import versions
from cnpgen.make.make_shards import Job
from cnpgen.make.recipe import MAX_SEED, DatasetRecipe, recipe_digest, split_rows
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.problems.problem import resolved
from cnpgen.robots.scene import scene_capacity
from cnpgen.schema.arguments import check_memory, integer
from cnpgen.store.dataset_spec import DatasetSpec, default_shard_size
from cnpgen.store.workspace import Workspace

MAX_ROWS = 10**12


def dataset_folder(recipe: DatasetRecipe, out: str | Path | None) -> Path:
    """Return the folder of a dataset, by default ``NAME-vMAJOR`` in the current folder.

    A path with ".." after a missing folder is resolved, since creating that folder
    could change its target.
    """
    if out is None:
        return Path(f"{recipe.name}-v{recipe.version.split('.')[0]}")
    if not isinstance(out, str | Path) or not str(out).strip():
        raise UsageError(
            f"must name a folder, got {str(out) if isinstance(out, Path) else out!r}",
            argument="out",
        )
    folder = Path(out)
    return (
        folder.resolve()
        if ".." in folder.parts and not folder.parent.exists()
        else folder
    )


def resolve(
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
    """Resolve the job of ``make_dataset``, whose arguments these are; build its kernels but write no file.

    An unfinished dataset of the recipe in the folder determines the default backend and
    shard size, unless ``force`` deletes it.
    """
    total, root, shard_size = _check(recipe, n, seed, shard_size)
    begun = _begun(recipe, workspace, force=force)
    if begun is not None:
        # A dataset is continued as it was begun, unless the caller states otherwise.
        backend = begun.backend if backend is None else backend
        shard_size = begun.shard_size if shard_size is None else shard_size
    chosen, cache = choose_backend(backend)
    prepared = PreparedPipeline(
        recipe.pipeline, backend=chosen, cache_folder=cache, dtype=dtype
    )
    if prepared.tasks is not None:
        total = _solved_tasks(prepared, recipe, root, n)
    rows = shard_size or default_shard_size(total, prepared.block_rows)
    width = sum(max(field.width, 1) for field in prepared.fields)
    check_memory("shard_size", rows, min(rows, total) * width)
    spec = _spec(
        recipe,
        prepared,
        split_rows(recipe, total),
        begun,
        seed=root,
        rows=rows,
        dtype=dtype,
        backend=chosen,
    )
    return Job(workspace.folder, spec, recipe.pipeline, chosen, cache)


def _begun(
    recipe: DatasetRecipe, workspace: Workspace, *, force: bool
) -> DatasetSpec | None:
    """Return the specification of a dataset of the recipe that is there and stays."""
    spec = workspace.spec
    is_continued = spec is not None and spec.recipe_sha256 == recipe_digest(recipe)
    return spec if is_continued and not force else None


def _spec(
    recipe: DatasetRecipe,
    prepared: PreparedPipeline,
    splits: Mapping[str, int],
    begun: DatasetSpec | None,
    *,
    seed: int,
    rows: int,
    dtype: str,
    backend: str,
) -> DatasetSpec:
    """Return the specification of a dataset that continues a begun one, if there is one."""
    obstacles = recipe.pipeline.problem.obstacle
    previous = (
        begun.previous_splits if begun is not None and begun.splits == splits else ()
    )
    return DatasetSpec(
        name=recipe.name,
        version=recipe.version,
        title=recipe.title,
        license=recipe.license,
        recipe_sha256=recipe_digest(recipe),
        recipe=resolved(recipe),
        seed=seed,
        splits=splits,
        shard_size=rows,
        block_rows=prepared.block_rows,
        dtype=dtype,
        backend=backend,
        fields=prepared.fields,
        robot=_robot_record(prepared),
        versions=versions(),
        # An extended dataset keeps its earlier versions, which determine the limits of
        # its shards.
        previous_splits=previous,
        scene_obstacles=scene_capacity(obstacles) if prepared.families else 0,
        scene_families=prepared.families,
    )


def _check(
    recipe: DatasetRecipe, n: int | None, seed: int | None, shard_size: int | None
) -> tuple[int, int, int | None]:
    """Return rows, seed and shard size.

    Raise UsageError for values that only recipes built in Python can have.
    """
    for split, rows in recipe.splits.items():
        integer(f"the rows of split {split!r}", rows, least=1)
    if not recipe.splits:
        raise UsageError(
            f"{recipe.name} has no splits: expected rows of at least one, such as {{'train': 1000}}"
        )
    total = integer(
        "n", sum(recipe.splits.values()) if n is None else n, least=1, most=MAX_ROWS
    )
    root = integer(
        "seed", recipe.seed if seed is None else seed, least=0, most=MAX_SEED
    )
    return (
        total,
        root,
        None if shard_size is None else integer("shard_size", shard_size, least=1),
    )


def _solved_tasks(
    prepared: PreparedPipeline, recipe: DatasetRecipe, seed: int, n: int | None
) -> int:
    """Return the number of rows of a dataset of listed tasks, at most one per solved task.

    Raise UsageError if more rows are requested, no task is solved, or the recipe has
    several splits.
    """
    if len(recipe.splits) > 1:
        splits = ", ".join(recipe.splits)
        raise UsageError(
            f"{recipe.name} lists its tasks: they would be the same in its splits {splits}, expected one"
        )
    tasks = prepared.complete_listed_tasks(seed)
    requested = sum(recipe.splits.values()) if n is None else n
    # Only tasks that a stage completed become rows.
    rows = len(tasks.alive)
    if not rows or (n is not None and n > rows):
        counts = zip(
            tasks.reasons,
            np.bincount(tasks.outcome, minlength=1 + len(tasks.reasons))[1:],
            strict=True,
        )
        why = (
            ", ".join(f"{count} {reason}" for reason, count in counts if count)
            or "it lists no more"
        )
        raise UsageError(
            f"{recipe.name} has {rows} rows, of {prepared.tasks} tasks ({why}): got n = {requested}"
        )
    return min(rows, requested)


def _robot_record(prepared: PreparedPipeline) -> JsonObject:
    robot = prepared.context.robot
    limits = {
        name: [float(x) for x in getattr(robot, name)]
        for name in (
            "position_lower",
            "position_upper",
            "velocity_limit",
            "acceleration_limit",
            "torque_limit",
        )
    }
    return {
        "name": robot.urdf.stem,
        "urdf_sha256": hashlib.sha256(robot.urdf_text.encode()).hexdigest(),
        "urdf": robot.urdf_text,
        "tip": robot.tip,
        "joint_names": list(robot.joint_names),
        "limits": limits,
    }
