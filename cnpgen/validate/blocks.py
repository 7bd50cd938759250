"""Blocks of a dataset made again from its seed, to compare them with what is stored."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels.library import Backend, choose_backend
from cnpgen.machine.versions import versions
from cnpgen.make.load import restored
from cnpgen.make.recipe import DatasetRecipe, recipe_digest
from cnpgen.make.shards import Job, blocks_of, prepare, shard_columns
from cnpgen.store.blueprint import REVISION, Blueprint, ShardTask
from cnpgen.store.check import Finding
from cnpgen.store.reader import StoredDataset

PORTABLE = 1e-9  # what the rows of another machine or backend may differ by when they are made again, in SI units
PORTABLE_FLOAT32 = 1e-5  # likewise, where rows are stored as float32


@dataclass(frozen=True)
class Regeneration:
    """Blocks that were made again.

    Attributes:
        made: How many.
        blocks: How many there are to choose from.
        identical: How many came out with the same bits.
        findings: What differs by more than arithmetic.
    """

    made: int = 0
    blocks: int = 0
    identical: int = 0
    findings: tuple[Finding, ...] = ()


def make_again(folder: Path, blueprint: Blueprint, tasks: list[ShardTask], count: int) -> Regeneration:
    """Make random blocks again.

    Args:
        folder: The dataset.
        blueprint: Its blueprint.
        tasks: The shards whose blocks may be chosen.
        count: How many blocks to choose; all of them if there are fewer.

    Raises:
        MachineError: The backend that made the dataset does not work here.
        UsageError: The blocks of this version have another size.
    """
    size = blueprint.block_rows
    pieces = [(task, block) for task in tasks for block in blocks_of(task, size)]
    backend, cache_folder = backend_of(folder, blueprint)
    dataset = StoredDataset(folder, blueprint, None)  # whatever became of the manifest
    chosen = np.random.default_rng().permutation(len(pieces))[:count]
    identical, findings = 0, []
    with restored(blueprint) as recipe:
        prepared = prepare(Job(folder, blueprint, recipe.pipeline, backend, cache_folder))
        if prepared.block_rows != size:
            raise UsageError(f"the blocks of {folder} have {size} rows, those of this version {prepared.block_rows}")
        for task, block in (pieces[index] for index in chosen):
            start = max(block * size, task.first_row)
            stop = min((block + 1) * size, task.first_row + task.rows)
            again, _ = next(
                shard_columns(prepared, blueprint, [ShardTask(task.split, task.index, start, stop - start)])
            )
            same, problem = _compare(dataset.read(task.split, start=start, stop=stop), again)
            identical += same
            if problem:
                text = f"block {block} made again from the seed: {problem}{_explanation(blueprint, recipe)}"
                findings.append(Finding(task.file, text))
    return Regeneration(len(chosen), len(pieces), identical, tuple(findings))


def backend_of(folder: Path, blueprint: Blueprint) -> tuple[Backend, Path]:
    """Return the backend that made a dataset, and its cache folder.

    Raises:
        MachineError: It does not work here.
    """
    try:
        return choose_backend(blueprint.backend)
    except MachineError as error:
        raise MachineError(
            f"{folder} was made by the {blueprint.backend} backend, which does not work here ({error}): its blocks"
            " cannot be made again; all checks but regenerate= work without it"
        ) from error


def _compare(stored: dict[str, Any], again: dict[str, Any]) -> tuple[bool, str]:
    """Return whether all bits are the same, and what differs by more than arithmetic on another machine can explain."""
    same = all(np.array_equal(stored[name], values) for name, values in again.items())
    for name, values in again.items():
        allowed = {"f": PORTABLE, "i": 0}[values.dtype.kind] if values.dtype != np.float32 else PORTABLE_FLOAT32
        off = np.abs(stored[name].astype(float) - values.astype(float))
        if not (off <= allowed).all():
            return same, f"{name} differs by {off.max():.3g}"
    return same, ""


def _explanation(blueprint: Blueprint, recipe: DatasetRecipe) -> str:
    """Name the libraries and plug-ins that are not those that made the dataset."""
    now = versions()
    other = [f"{name} {was} -> {now.get(name)}" for name, was in blueprint.versions.items() if now.get(name) != was]
    if blueprint.revision != REVISION:
        other.append(f"revision of the generator {blueprint.revision} -> {REVISION}")
    if recipe_digest(recipe) != blueprint.recipe_sha256:  # its own recipe: only code can differ
        other.append("the code of its plug-ins has changed")
    return f" (made with other versions: {', '.join(other)})" if other else ""
