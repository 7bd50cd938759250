"""Proving a dataset: its files, every row by Pinocchio and Coal, and random blocks made again."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, counted
from cnpgen.judges.rows.report import RowReport
from cnpgen.machine.engine import Engine
from cnpgen.make.load import restored
from cnpgen.schema.arguments import integer
from cnpgen.store.blueprint import Blueprint, load_blueprint, shards
from cnpgen.store.check import Finding, check_dataset
from cnpgen.store.layout import PLAN
from cnpgen.store.paths import require_folder
from cnpgen.store.record import is_committed
from cnpgen.store.workspace import is_dataset
from cnpgen.validate.blocks import Regeneration, backend_of, make_again
from cnpgen.validate.documents import check_recipe, check_statistics
from cnpgen.validate.rows import DeepCheck, check_rows


@dataclass(frozen=True)
class ValidationReport:
    """What validation found.

    Attributes:
        folder: The dataset.
        rows: Rows of the shards that are there.
        findings: What is wrong, file by file.
        deep: What Pinocchio and Coal say of every row, or None if they were not asked.
        plans: Plans that were judged, and how many of them are valid; None unless the deep check met some.
        wanted: How many blocks were to be made again.
        blocks: How many there are to choose from.
        regenerated: How many were made again.
        identical: How many of them came out with the same bits.
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
            "plans": dict(zip(("judged", "valid"), self.plans, strict=True)) if self.plans else None,
            "blocks": self.blocks,
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
                f" {counted(check.rows_out, 'row')} out"
                for check in self.deep.checks
            ]
        if self.plans:
            lines.append(f"  judged at every moment: {counted(self.plans[0], 'plan')}, {self.plans[1]:,} valid")
        if self.wanted:
            lines.append(f"  made again: {self._blocks_text()}, {self.identical:,} identical to the bit")
        advice = dict.fromkeys(finding.advice for finding in self.findings if finding.advice and not finding.note)
        return "\n".join([*lines, *(f"  what to do: {text}" for text in advice)])

    def _blocks_text(self) -> str:
        """Say how many blocks were made again, of how many."""
        text = f"{self.regenerated:,} of {counted(self.blocks, 'block')}"
        return f"{text} ({self.wanted:,} were asked for)" if self.wanted > self.blocks else text


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
    """Check a dataset.

    Checksums, counts, schema and provenance always; optionally every row and a few blocks from the seed.

    Args:
        folder: The dataset.
        deep: Whether to recompute every row's kinematics, limits, torques, manifold and collisions with Pinocchio and
            Coal.
        regenerate: How many random blocks to make again and compare.
        workers: Processes for the deep check; default one per available core.
        engine: Where they run, as of ``make_dataset``.
        address: Likewise.
        progress: Called with the rows of every shard that was recomputed.

    Raises:
        UsageError: There is no folder, or an argument makes no sense.
        DatasetError: It holds no dataset.
        RecipeError: The recipe in the blueprint does not fit this version of cnpgen.
        PluginError: It needs packages that are not installed, for what was asked for.
        MachineError: The disk fails, or the backend that made the dataset does not work here and blocks are to be
            made again.
    """
    folder, regenerate = Path(folder), integer("regenerate", regenerate, least=0)
    where = Engine(engine, address, workers)
    require_folder(folder)
    if not is_dataset(folder):
        raise DatasetError(f"{folder} is not a dataset of cnpgen: it has no {PLAN}")
    findings = check_dataset(folder)
    try:
        blueprint = load_blueprint(folder)
    except DatasetError:
        return ValidationReport(folder, 0, tuple(findings))
    _require_means(folder, blueprint, deep=deep, regenerate=regenerate)
    present = [task for task in shards(blueprint) if is_committed(folder, blueprint, task)]
    wrong = {finding.file for finding in findings if not finding.note}
    whole = [task for task in present if task.file not in wrong]
    findings += check_recipe(blueprint) + (check_statistics(folder, blueprint) if deep else [])
    checked = check_rows(folder, blueprint, whole, where, progress) if deep else DeepCheck()
    again = make_again(folder, blueprint, whole, regenerate) if regenerate else Regeneration()
    return ValidationReport(
        folder,
        sum(task.rows for task in present),
        (*findings, *checked.findings, *again.findings),
        deep=checked.rows,
        plans=(checked.judged, checked.valid) if checked.judged else None,
        wanted=regenerate,
        blocks=again.blocks,
        regenerated=again.made,
        identical=again.identical,
    )


def _require_means(folder: Path, blueprint: Blueprint, *, deep: bool, regenerate: int) -> None:
    """Say what is missing on this machine before anything takes long."""
    if regenerate:
        backend_of(folder, blueprint)
    if deep or regenerate:
        with restored(blueprint):
            pass
