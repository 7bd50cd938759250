"""Planning datasets: everything that determines their bytes, resolved; nothing is made."""

import hashlib
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.kernels.library import choose_backend
from cnpgen.machine.versions import versions
from cnpgen.make.load import as_dataset_recipe
from cnpgen.make.recipe import DatasetRecipe, recipe_digest, split_rows
from cnpgen.make.shards import Job
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.problems.problem import resolved
from cnpgen.schema.arguments import integer
from cnpgen.store.blueprint import Blueprint, default_shard_size, load_blueprint

MAX_ROWS = 10**12
MAX_SEED = 2**63 - 1
DTYPES = ("float64", "float32")


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
    recipe: str | Path | DatasetRecipe,
    out: str | Path | None = None,
    *,
    n: int | None = None,
    seed: int | None = None,
    shard_size: int | None = None,
    dtype: str = "float64",
    backend: str | None = None,
    resume: bool = False,
) -> Job:
    """Resolve what ``make_dataset`` would make, building its kernels but writing nothing of the dataset.

    With ``resume``, backend and shard size that are not given are those with which the recipe was begun in the folder.

    Raises:
        RecipeError: The recipe has mistakes.
        UsageError: An argument makes no sense.
        MachineError: No working backend.
    """
    loaded = as_dataset_recipe(recipe)
    _check(loaded, dtype)
    total = integer("n", sum(loaded.splits.values()) if n is None else n, least=1, most=MAX_ROWS)
    root = integer("seed", loaded.seed if seed is None else seed, least=0, most=MAX_SEED)
    folder = dataset_folder(loaded, out)
    begun = _begun(folder, loaded) if resume else None
    if begun is not None:
        backend = begun.backend if backend is None else backend
        shard_size = begun.shard_size if shard_size is None else shard_size
    chosen, cache_folder = choose_backend(backend)
    prepared = PreparedPipeline(loaded.pipeline, backend=chosen, cache_folder=cache_folder, dtype=dtype)
    blueprint = Blueprint(
        name=loaded.name,
        version=loaded.version,
        title=loaded.title,
        license=loaded.license,
        recipe_sha256=recipe_digest(loaded),
        recipe=resolved(loaded),
        seed=root,
        splits=split_rows(loaded, total),
        shard_size=_shard_size(shard_size, total, prepared.block_rows),
        block_rows=prepared.block_rows,
        dtype=dtype,
        backend=chosen,
        fields=prepared.fields,
        robot=_robot_record(prepared),
        versions=versions(),
    )
    return Job(folder, blueprint, loaded.pipeline, chosen, cache_folder)


def _check(recipe: DatasetRecipe, dtype: str) -> None:
    """Refuse what no file of a recipe can say, but a recipe that was made in Python."""
    for split, rows in recipe.splits.items():
        integer(f"the rows of split {split!r}", rows, least=1)
    if not recipe.splits:
        raise UsageError(f"{recipe.name} has no splits: expected rows of at least one, such as {{'train': 1000}}")
    if dtype not in DTYPES:
        raise UsageError(f"dtype must be {' or '.join(map(repr, DTYPES))}, got {dtype!r}")


def _shard_size(wanted: int | None, rows: int, block_rows: int) -> int:
    """Return the rows per shard."""
    return default_shard_size(rows, block_rows) if wanted is None else integer("shard_size", wanted, least=1)


def _begun(folder: Path, recipe: DatasetRecipe) -> Blueprint | None:
    """Return the plan in a folder if it is one of the recipe; what else is there is not decided here."""
    try:
        found = load_blueprint(folder)
    except DatasetError:
        return None
    return found if found.recipe_sha256 == recipe_digest(recipe) else None


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
