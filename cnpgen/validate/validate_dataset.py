"""Validation of a dataset: its files, every row with Pinocchio and Coal, and regenerated random blocks."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError, MachineError, UsageError, counted
from cnpgen.judges.rows.row_report import RowReport
from cnpgen.kernels.library import Backend, choose_backend
from cnpgen.machine.engine import Engine
from cnpgen.machine.versions import versions
from cnpgen.make.make_shards import Job, blocks_of, prepare, shard_columns
from cnpgen.make.recipe import DatasetRecipe, recipe_digest, resolved_digest, restored
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer
from cnpgen.store.check import REPLACE_HINT, Finding, check_dataset
from cnpgen.store.dataset_spec import (
    GENERATOR_REVISION,
    DatasetSpec,
    ShardTask,
    load_dataset_spec,
    shards,
)
from cnpgen.store.dataset_summary import (
    load_stats_document,
    stats_document,
    summarize_dataset,
)
from cnpgen.store.files.documents import plain
from cnpgen.store.intact import RERUN_HINT
from cnpgen.store.layout import SPECIFICATION, STATS
from cnpgen.store.paths import require_dataset
from cnpgen.store.reader import StoredDataset
from cnpgen.store.scene_table import SCENE_ID
from cnpgen.store.shard_record import is_committed
from cnpgen.validate.validate_rows import DeepCheck, check_rows

# In SI units; accepted difference of rows made on another machine or backend.

MAX_REGENERATION_ERROR = 1e-9
# In SI units; accepted difference of rows stored as float32.
MAX_REGENERATION_ERROR_FLOAT32 = 1e-5


@dataclass(frozen=True)
class Regeneration:
    """Numbers of regenerated, of all and of bitwise identical blocks, and the differences above the tolerance."""

    made: int = 0
    blocks: int = 0
    identical: int = 0
    findings: tuple[Finding, ...] = ()


def regenerate_blocks(
    folder: Path, spec: DatasetSpec, tasks: list[ShardTask], count: int
) -> Regeneration:
    """Regenerate ``count`` random blocks of some shards, or all, and compare them with the stored rows."""
    size = spec.block_rows
    blocks = [(task, block) for task in tasks for block in blocks_of(task, size)]
    backend, cache_folder = backend_of(folder, spec)
    # Without the manifest, which may be damaged.
    dataset = StoredDataset(folder, spec, None)
    # Other blocks at each call: repeated checks cover more of the dataset.
    chosen = np.random.default_rng().permutation(len(blocks))[:count]
    identical = 0
    findings = []
    with restored(spec) as recipe:
        prepared = prepare(Job(folder, spec, recipe.pipeline, backend, cache_folder))
        if prepared.block_rows != size:
            raise UsageError(
                f"the blocks of {folder} have {size} rows, those of this version {prepared.block_rows}"
            )
        for task, block in (blocks[index] for index in chosen):
            # A block may overlap several shards: only its part in this one is compared.
            start = max(block * size, task.first_row)
            stop = min((block + 1) * size, task.first_row + task.rows)
            part = ShardTask(task.split, task.index, start, stop - start)
            again, _, scenes = next(shard_columns(prepared, spec, [part]))
            stored = dataset.read(task.split, start=start, stop=stop)
            if scenes is not None:
                table = dataset.read_scenes(task.split, start=start, stop=stop)
                stored |= dict(
                    table[table.rows_of(np.unique(stored[SCENE_ID]))].arrays()
                )
                again |= dict(scenes.arrays())
            same, problem = _compare(stored, again)
            identical += same
            if problem:
                text = f"block {block} made again from the seed: {problem}{_explanation(spec, recipe)}"
                findings.append(Finding(task.file, text))
    return Regeneration(len(chosen), len(blocks), identical, tuple(findings))


def backend_of(folder: Path, spec: DatasetSpec) -> tuple[Backend, Path]:
    """Return the backend of a dataset, which has to work on this machine, and its cache folder."""
    try:
        return choose_backend(spec.backend)
    except MachineError as error:
        raise MachineError(
            f"{folder} was made by the {spec.backend} backend, which does not work here ({error}): its blocks"
            " cannot be made again; all checks but {regenerate} work without it",
            remedies={"regenerate": None},
        ) from error


def _compare(stored: JsonObject, again: JsonObject) -> tuple[bool, str]:
    """Return whether the values are bitwise identical, and the first difference above the tolerance."""
    same = all(np.array_equal(stored[name], values) for name, values in again.items())
    for name, values in again.items():
        if stored[name].shape != values.shape:
            return (
                False,
                f"{name} has the shape {stored[name].shape}, not {values.shape}",
            )
        difference = np.abs(stored[name].astype(float) - values.astype(float))
        float_tolerance = (
            MAX_REGENERATION_ERROR_FLOAT32
            if values.dtype == np.float32
            else MAX_REGENERATION_ERROR
        )
        if not (
            # Indices and identifiers must be equal.
            difference <= (0.0 if values.dtype.kind == "i" else float_tolerance)
        ).all():
            return same, f"{name} differs by {difference.max():.3g}"
    return same, ""


def _explanation(spec: DatasetSpec, recipe: DatasetRecipe) -> str:
    """Name the libraries and plug-ins that have changed since the dataset was made."""
    now = versions()
    changed = [
        f"{name} {old} -> {now.get(name)}"
        for name, old in spec.versions.items()
        if now.get(name) != old
    ]
    if spec.revision != GENERATOR_REVISION:
        changed.append(
            f"revision of the generator {spec.revision} -> {GENERATOR_REVISION}"
        )
    if recipe_digest(recipe) != spec.recipe_sha256:
        # The recipe is that of the dataset, so only code can differ.
        changed.append("the code of its plug-ins has changed")
    return f" (made with other versions: {', '.join(changed)})" if changed else ""


@dataclass(frozen=True)
class ValidationReport:
    """Result of a validation.

    Attributes:
        folder: Folder of the dataset.
        rows: Number of rows of the existing shards.
        findings: Problems and notes, by file.
        deep: Report of the recomputation of every row with Pinocchio and Coal; None
            without a deep check.
        plans: Numbers of judged and of valid plans; None without a deep check or
            without plans.
        wanted: Number of blocks that were requested to be regenerated.
        blocks: Number of blocks of the dataset.
        regenerated: Number of regenerated blocks.
        identical: Number of regenerated blocks that are bitwise identical.
    """

    folder: Path
    rows: int
    findings: tuple[Finding, ...]
    deep: RowReport | None = None
    plans: tuple[int, int] | None = None
    wanted: int = 0
    blocks: int = 0
    regenerated: int = 0
    identical: int = 0

    @property
    def ok(self) -> bool:
        """Whether there are no findings except for notes."""
        return all(finding.note for finding in self.findings)

    def to_dict(self) -> JsonObject:
        """Return the report for JSON."""
        return {
            "folder": str(self.folder),
            "ok": self.ok,
            "rows": self.rows,
            "findings": [asdict(finding) for finding in self.findings],
            "deep": self.deep.to_dict() if self.deep else None,
            "plans": dict(zip(("judged", "valid"), self.plans, strict=True))
            if self.plans
            else None,
            "blocks": self.blocks,
            "regenerated": self.regenerated,
            "identical": self.identical,
        }

    def summary(self) -> str:
        """Return a summary in a few lines."""
        n_problems = sum(not finding.note for finding in self.findings)
        findings = counted(n_problems, "finding") if n_problems else "no findings"
        lines = [f"{self.folder}: {counted(self.rows, 'row')}, {findings}"]
        if self.deep:
            failed = f"{len(self.deep.failed_rows):,} out"
            lines.append(
                f"  recomputed with Pinocchio and Coal: {counted(self.deep.rows, 'row')}, {failed}"
            )
            lines += [
                f"    {check.name:<22} worst {check.worst:9.2e} of {check.tolerance:9.2e} {check.unit:<8}"
                f" {counted(check.n_failed, 'row')} out"
                for check in self.deep.checks
            ]
        if self.plans:
            lines.append(
                f"  judged at all times: {counted(self.plans[0], 'plan')}, {self.plans[1]:,} valid"
            )
        if self.wanted:
            requested = (
                f" ({self.wanted:,} were requested)"
                if self.wanted > self.blocks
                else ""
            )
            text = f"{self.regenerated:,} of {counted(self.blocks, 'block')}{requested}"
            lines.append(
                f"  made again: {text}, {self.identical:,} identical to the bit"
            )
        hints = dict.fromkeys(
            finding.hint
            for finding in self.findings
            if finding.hint and not finding.note
        )
        return "\n".join([*lines, *(f"  hint: {text}" for text in hints)])


@checked_arguments
def validate_dataset(
    folder: str | Path,
    *,
    deep: bool = False,
    regenerate: int = 0,
    workers: int | None = None,
    engine: str | None = None,
    address: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> ValidationReport:
    """Validate a dataset.

    Checksums, counts, schema and provenance are always checked; every row and some
    regenerated blocks optionally.

    Args:
        folder: Folder of the dataset.
        deep: Whether to recompute kinematics, limits, torques, manifold and collisions
            of every row with Pinocchio and Coal.
        regenerate: Number of random blocks to regenerate and compare.
        workers: Number of processes for the deep check; by default one per available
            core.
        engine: Engine of the processes, as in ``make_dataset``.
        address: Address of the engine, as in ``make_dataset``.
        progress: Called with the number of rows of every recomputed shard.

    Raises:
        UsageError: The folder does not exist or contains no dataset, or an argument is
            invalid.
        RecipeError: The recipe in the specification does not fit this version of
            cnpgen.
        PluginError: The recipe needs packages that are not installed.
        MachineError: A file cannot be read, or blocks are to be regenerated and the
            backend of the dataset does not work on this machine.
    """
    regenerate = integer("regenerate", regenerate, least=0)
    where = Engine(engine, address, workers)
    folder = require_dataset(folder)
    findings = check_dataset(folder)
    try:
        spec = load_dataset_spec(folder)
    except DatasetError:
        return ValidationReport(folder, 0, tuple(findings))
    _check_recomputable(folder, spec, deep=deep, regenerate=regenerate > 0)
    existing = [task for task in shards(spec) if is_committed(folder, spec, task)]
    undamaged = _undamaged(existing, findings)
    findings += check_recipe(spec)
    checked, again = DeepCheck(), Regeneration()
    if deep:
        findings += check_statistics(folder, spec)
        checked = check_rows(folder, spec, undamaged, where, progress)
    if regenerate:
        again = regenerate_blocks(folder, spec, undamaged, regenerate)
    return ValidationReport(
        folder,
        sum(task.rows for task in existing),
        (*findings, *checked.findings, *again.findings),
        deep=checked.rows,
        plans=(checked.judged, checked.valid) if checked.judged else None,
        wanted=regenerate,
        blocks=again.blocks,
        regenerated=again.made,
        identical=again.identical,
    )


def _check_recomputable(
    folder: Path, spec: DatasetSpec, *, deep: bool, regenerate: bool
) -> None:
    """Report missing packages and backends, and a recipe that cannot be restored, before the expensive checks."""
    if regenerate:
        backend_of(folder, spec)
    if deep or regenerate:
        with restored(spec):
            pass


def _undamaged(existing: list[ShardTask], findings: list[Finding]) -> list[ShardTask]:
    """Return the shards without findings. A damaged one is a finding already; HDF5 may hang on it."""
    damaged = {finding.file for finding in findings if not finding.note}
    return [task for task in existing if task.file not in damaged]


def check_recipe(spec: DatasetSpec) -> list[Finding]:
    """Check that the recipe in a specification has the recorded sha256."""
    try:
        digest = resolved_digest(
            spec.recipe["pipeline"], str(spec.robot["urdf"]).encode()
        )
    except (KeyError, TypeError, AttributeError):
        return [Finding(SPECIFICATION, "its recipe cannot be read", hint=REPLACE_HINT)]
    text = f"its recipe has the sha256 {digest}, not the recorded {spec.recipe_sha256}"
    return (
        []
        if digest == spec.recipe_sha256
        else [Finding(SPECIFICATION, text, hint=REPLACE_HINT)]
    )


def check_statistics(folder: Path, spec: DatasetSpec) -> list[Finding]:
    """Check that ``stats.json`` is the summary of the records of all shards.

    These must exist.
    """
    try:
        document = load_stats_document(folder)
        expected = plain(stats_document(summarize_dataset(folder, spec)))
    except DatasetError:
        # Missing or damaged files are findings already.
        return []
    different = [key for key in expected if document.get(key) != expected[key]]
    text = f"is not the summary of the records of the shards: {', '.join(different)} differ"
    hint = f"delete {STATS} and {RERUN_HINT}: it writes the file again"
    return [Finding(STATS, text, hint=hint)] if different else []
