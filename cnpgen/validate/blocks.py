"""Regeneration of blocks of a dataset from its seed, for a comparison with the stored rows."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels.library import Backend, choose_backend
from cnpgen.machine.versions import versions
from cnpgen.make.make_shards import Job, blocks_of, prepare, shard_columns
from cnpgen.make.recipe import DatasetRecipe, recipe_digest
from cnpgen.make.recipe_file import restored
from cnpgen.store.check import Finding
from cnpgen.store.dataset_spec import GENERATOR_REVISION, DatasetSpec, ShardTask
from cnpgen.store.reader import StoredDataset
from cnpgen.store.scene_table import SCENE_ID

MAX_REGENERATION_ERROR = 1e-9  # in SI units; accepted difference of rows made on another machine or backend
MAX_REGENERATION_ERROR_FLOAT32 = 1e-5  # in SI units; accepted difference of rows stored as float32


@dataclass(frozen=True)
class Regeneration:
    """Numbers of regenerated, of all and of bitwise identical blocks, and the differences above the tolerance."""

    made: int = 0
    blocks: int = 0
    identical: int = 0
    findings: tuple[Finding, ...] = ()


def regenerate_blocks(folder: Path, spec: DatasetSpec, tasks: list[ShardTask], count: int) -> Regeneration:
    """Regenerate ``count`` random blocks of some shards, or all, and compare them with the stored rows.

    Raises:
        MachineError: The backend of the dataset does not work on this machine.
        UsageError: The block size of this version differs.
    """
    size = spec.block_rows
    blocks = [(task, block) for task in tasks for block in blocks_of(task, size)]
    backend, cache_folder = backend_of(folder, spec)
    dataset = StoredDataset(folder, spec, None)  # without the manifest, which may be damaged
    chosen = np.random.default_rng().permutation(len(blocks))[:count]
    identical, findings = 0, []
    with restored(spec) as recipe:
        prepared = prepare(Job(folder, spec, recipe.pipeline, backend, cache_folder))
        if prepared.block_rows != size:
            raise UsageError(f"the blocks of {folder} have {size} rows, those of this version {prepared.block_rows}")
        for task, block in (blocks[index] for index in chosen):
            start = max(block * size, task.first_row)
            stop = min((block + 1) * size, task.first_row + task.rows)
            part = ShardTask(task.split, task.index, start, stop - start)
            again, _, scenes = next(shard_columns(prepared, spec, [part]))
            stored = dataset.read(task.split, start=start, stop=stop)
            if scenes is not None:
                table = dataset.read_scenes(task.split, start=start, stop=stop)
                stored |= dict(table[table.rows_of(np.unique(stored[SCENE_ID]))].arrays())
                again |= dict(scenes.arrays())
            same, problem = _compare(stored, again)
            identical += same
            if problem:
                text = f"block {block} made again from the seed: {problem}{_explanation(spec, recipe)}"
                findings.append(Finding(task.file, text))
    return Regeneration(len(chosen), len(blocks), identical, tuple(findings))


def backend_of(folder: Path, spec: DatasetSpec) -> tuple[Backend, Path]:
    """Return the backend of a dataset and its cache folder.

    Raises:
        MachineError: The backend does not work on this machine.
    """
    try:
        return choose_backend(spec.backend)
    except MachineError as error:
        raise MachineError(
            f"{folder} was made by the {spec.backend} backend, which does not work here ({error}): its blocks"
            " cannot be made again; all checks but {regenerate} work without it",
            remedies={"regenerate": None},
        ) from error


def _compare(stored: dict[str, Any], again: dict[str, Any]) -> tuple[bool, str]:
    """Return whether the values are bitwise identical, and the first difference above the tolerance."""
    same = all(np.array_equal(stored[name], values) for name, values in again.items())
    for name, values in again.items():
        if stored[name].shape != values.shape:
            return False, f"{name} has the shape {stored[name].shape}, not {values.shape}"
        difference = np.abs(stored[name].astype(float) - values.astype(float))
        float_tolerance = MAX_REGENERATION_ERROR_FLOAT32 if values.dtype == np.float32 else MAX_REGENERATION_ERROR
        if not (difference <= (0.0 if values.dtype.kind == "i" else float_tolerance)).all():
            return same, f"{name} differs by {difference.max():.3g}"
    return same, ""


def _explanation(spec: DatasetSpec, recipe: DatasetRecipe) -> str:
    """Name the libraries and plug-ins that have changed since the dataset was made."""
    now = versions()
    changed = [f"{name} {old} -> {now.get(name)}" for name, old in spec.versions.items() if now.get(name) != old]
    if spec.revision != GENERATOR_REVISION:
        changed.append(f"revision of the generator {spec.revision} -> {GENERATOR_REVISION}")
    if recipe_digest(recipe) != spec.recipe_sha256:  # the recipe is that of the dataset, so only code can differ
        changed.append("the code of its plug-ins has changed")
    return f" (made with other versions: {', '.join(changed)})" if changed else ""
