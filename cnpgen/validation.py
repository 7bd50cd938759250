"""Proving a dataset: its files, every row by Pinocchio and Coal, and random blocks made again."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.consistency import check_recipe, check_statistics
from cnpgen.errors import CnpgenError, DatasetError, MachineError, UsageError
from cnpgen.kernels.library import Backend, choose_backend
from cnpgen.library import restore_dataset_recipe
from cnpgen.make_shard import blocks_of, shard_columns, versions
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.recipes import DatasetRecipe, recipe_digest
from cnpgen.robots.robot import load_robot
from cnpgen.shard_checks import check_numbers
from cnpgen.store.check import DELETE, Finding, check_dataset
from cnpgen.store.layout import PLAN
from cnpgen.store.plan import DatasetPlan, ShardTask, load_plan, shards
from cnpgen.store.reader import StoredDataset
from cnpgen.store.record import is_committed, load_record
from cnpgen.store.shard import read_shard
from cnpgen.store.workspace import is_dataset
from cnpgen.verify.report import RowReport, merge
from cnpgen.verify.rows import verify_rows
from cnpgen.wording import counted
from cnpgen.workers import share_out, worker_count

PORTABLE = 1e-9  # what the rows of another machine or backend may differ by when they are made again, in SI units
PORTABLE_FLOAT32 = 1e-5  # likewise, where rows are stored as float32
_ODD = np.random.default_rng(0).integers(0, 2**63, 64, dtype=np.uint64) * np.uint64(2) + np.uint64(1)


@dataclass(frozen=True)
class ValidationReport:
    """What validation found.

    Attributes:
        folder: The dataset.
        rows: Rows of the shards that are there.
        findings: What is wrong, file by file.
        deep: What Pinocchio and Coal say of every row, or None if they were not asked.
        regenerated: How many blocks were made again.
        identical: How many of them came out with the same bits.
    """

    folder: Path
    rows: int
    findings: tuple[Finding, ...]
    deep: RowReport | None = None
    regenerated: int = 0
    identical: int = 0

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong; notes are not."""
        return all(finding.note for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        return {
            "folder": str(self.folder),
            "ok": self.ok,
            "rows": self.rows,
            "findings": [
                {"file": item.file, "problem": item.problem, "note": item.note, "advice": item.advice}
                for item in self.findings
            ],
            "deep": self.deep.to_dict() if self.deep else None,
            "regenerated": self.regenerated,
            "identical": self.identical,
        }

    def summary(self) -> str:
        """Say in a few lines what was checked and what came out."""
        wrong = sum(not finding.note for finding in self.findings)
        lines = [f"{self.folder}: {counted(self.rows, 'row')}, {counted(wrong, 'finding') if wrong else 'no findings'}"]
        if self.deep:
            lines.append(
                f"  recomputed with Pinocchio and Coal: {counted(self.deep.rows, 'row')}, {len(self.deep.out):,} out"
            )
            lines += [
                f"    {check.name:<22} worst {check.worst:9.2e} of {check.allowed:9.2e} {check.unit:<8}"
                f" {check.rows_out} rows out"
                for check in self.deep.checks
            ]
        if self.regenerated:
            lines.append(f"  made again: {counted(self.regenerated, 'block')}, {self.identical} identical to the bit")
        advice = dict.fromkeys(finding.advice for finding in self.findings if finding.advice and not finding.note)
        return "\n".join([*lines, *(f"  what to do: {text}" for text in advice)])


def validate_dataset(
    folder: str | Path,
    *,
    deep: bool = False,
    regenerate: int = 0,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> ValidationReport:
    """Check a dataset.

    Checksums, counts, schema and provenance always; optionally every row and a few blocks from the seed.

    Args:
        folder: The dataset.
        deep: Whether to recompute every row's kinematics, limits, torques, manifold and collisions with Pinocchio and
            Coal.
        regenerate: How many random blocks to make again and compare.
        workers: Processes for the deep check; default one per available core.
        progress: Called with the rows of every shard that was recomputed.

    Raises:
        UsageError: There is no folder, or an argument makes no sense.
        DatasetError: It holds no dataset.
        RecipeError: The recipe in the plan does not fit this version of cnpgen.
        PluginError: It needs packages that are not installed, for what was asked for.
        MachineError: The disk fails, or the backend that made the dataset does not work here and blocks are to be
            made again.
    """
    folder = Path(folder)
    if not folder.is_dir():
        what = "a file" if folder.exists() else "not there"
        raise UsageError(f"{folder} is {what}, expected the folder of a dataset")
    if not is_dataset(folder):
        raise DatasetError(f"{folder} is not a dataset of cnpgen: it has no {PLAN}")
    if regenerate < 0:
        raise UsageError(f"regenerate must not be negative, got {regenerate}")
    findings = list(check_dataset(folder))
    try:
        plan = load_plan(folder)
    except DatasetError:
        return ValidationReport(folder, 0, tuple(findings))
    if regenerate:
        _backend(folder, plan)
    if deep or regenerate:
        with restored(plan):  # what is missing on this machine is said before anything takes long
            pass
    wrong = {finding.file for finding in findings if not finding.note}
    present = [task for task in shards(plan) if is_committed(folder, task, plan.fingerprint)]
    whole = [task for task in present if task.file not in wrong]
    report, made, identical = None, 0, 0
    findings += check_recipe(plan)
    if deep:
        findings += check_statistics(folder, plan)
        report, found = _deep(folder, plan, whole, worker_count(workers, len(whole)), progress)
        findings += found
    if regenerate:
        made, identical, found = _regenerate(folder, plan, whole, regenerate)
        findings += found
    return ValidationReport(folder, sum(task.rows for task in present), tuple(findings), report, made, identical)


def _deep(
    folder: Path, plan: DatasetPlan, tasks: list[ShardTask], workers: int, progress: Callable[[int], None] | None
) -> tuple[RowReport | None, list[Finding]]:
    """Recompute every row, shard by shard."""
    reports, findings, keys = [], [], [np.empty(0, np.uint64)]
    with closing(share_out(partial(_verify_shard, folder, plan), tasks, workers, ordered=True)) as results:
        for task, result in zip(tasks, results, strict=True):
            findings += [Finding(task.file, problem, advice=DELETE) for problem in result.problems]
            if result.report is not None:
                reports.append(result.report)
            keys.append(result.keys)
            if progress is not None:
                progress(task.rows)
    every = np.concatenate(keys)
    twice = len(every) - len(np.unique(every))
    if twice:
        findings.append(Finding("(all splits)", f"{twice} rows stand in the dataset more than once"))
    return merge(reports) if reports else None, findings


@dataclass(frozen=True)
class _ShardCheck:
    """What the deep check found in one shard.

    Attributes:
        report: What Pinocchio and Coal say, or None if the shard cannot be read.
        problems: What is wrong with it.
        keys: A hash of the boundary states of every row, shape (rows,).
    """

    report: RowReport | None
    problems: list[str]
    keys: NDArray[np.uint64]


def _verify_shard(folder: Path, plan: DatasetPlan, task: ShardTask) -> _ShardCheck:
    """Verify one shard; a shard that cannot be read is a finding, not an exception."""
    try:
        columns = read_shard(folder / task.file)
        record = load_record(folder, task)
    except CnpgenError as error:
        return _ShardCheck(None, [str(error)], np.empty(0, np.uint64))
    with restored(plan) as recipe:
        problem = recipe.pipeline.problem
        report = verify_rows(problem, load_robot(problem), columns, dtype=plan.dtype)
    problems = check_numbers(plan, task, columns, record)
    problems += [
        f"{check.name}: {check.rows_out} rows out, worst {check.worst:.3g} {check.unit}"
        f" (allowed {check.allowed:.3g}) in row {task.first_row + check.worst_row}"
        for check in report.failed
    ]
    ends = [columns[name] for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq") if name in columns]
    bits = np.ascontiguousarray(np.concatenate(ends, axis=1), np.float64).view(np.uint64)
    keys = (bits * np.resize(_ODD, bits.shape[1])).sum(axis=1, dtype=np.uint64)
    return _ShardCheck(report, problems, keys)


def _regenerate(folder: Path, plan: DatasetPlan, tasks: list[ShardTask], count: int) -> tuple[int, int, list[Finding]]:
    """Make random blocks again; return how many, how many of them are the same to the bit, and what differs."""
    size = plan.block_rows
    pieces = [(task, block) for task in tasks for block in blocks_of(task, size)]
    backend, cache_folder = _backend(folder, plan)
    dataset = StoredDataset(folder, plan, None)  # whatever became of the manifest
    chosen = np.random.default_rng().permutation(len(pieces))[:count]
    identical, findings = 0, []
    with restored(plan) as recipe:
        prepared = PreparedPipeline(recipe.pipeline, backend=backend, cache_folder=cache_folder, dtype=plan.dtype)
        if prepared.block_rows != size:
            raise UsageError(f"the blocks of {folder} have {size} rows, those of this version {prepared.block_rows}")
        for task, block in (pieces[index] for index in chosen):
            start = max(block * size, task.first_row)
            stop = min((block + 1) * size, task.first_row + task.rows)
            again, _ = next(shard_columns(prepared, plan, [ShardTask(task.split, task.index, start, stop - start)]))
            same, problem = _compare(dataset.read(task.split, start=start, stop=stop), again)
            identical += same
            if problem:
                text = f"block {block} made again from the seed: {problem}{_explanation(plan, recipe)}"
                findings.append(Finding(task.file, text))
    return len(chosen), identical, findings


def _backend(folder: Path, plan: DatasetPlan) -> tuple[Backend, Path]:
    """Return the backend that made a dataset, and its cache."""
    try:
        return choose_backend(plan.backend)
    except MachineError as error:
        raise MachineError(
            f"{folder} was made by the {plan.backend} backend, which does not work here ({error}): its blocks cannot"
            " be made again; 'cnpgen validate' and 'cnpgen validate --deep' work without it"
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


def _explanation(plan: DatasetPlan, recipe: DatasetRecipe) -> str:
    """Name the libraries and plug-ins that are not those that made the dataset."""
    now = versions()
    other = [f"{name} {was} -> {now.get(name)}" for name, was in plan.versions.items() if now.get(name) != was]
    if recipe_digest(recipe) != plan.recipe_sha256:  # the plan's own recipe, so that only code can be different
        other.append("the code of its plug-ins has changed")
    return f" (made with other versions: {', '.join(other)})" if other else ""


@contextmanager
def restored(plan: DatasetPlan) -> Iterator[DatasetRecipe]:
    """Rebuild the recipe from a plan, its URDF in a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="cnpgen-") as folder:
        yield restore_dataset_recipe(dict(plan.recipe), str(plan.robot["urdf"]), Path(folder))
