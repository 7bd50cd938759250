"""Record of benchmark runs: date, machine, versions and seed of every run that wrote results into a folder."""

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError
from cnpgen.machine.versions import installed_version, processor_entry, versions
from cnpgen.store.files.atomic import read_file, write_file
from cnpgen.store.files.document_structure import check_structure, structure_of
from cnpgen.store.files.documents import parse_json

RUNS_FILE = "runs.json"
MAX_RUNS_BYTES = 10_000_000
# Beside those of ``versions``.
LIBRARIES = (
    "scipy",
    "daqp",
    "mujoco",
    "ompl",
    "toppra",
    "ruckig",
    "sscbirrt",
    "drake",
)


@dataclass(frozen=True)
class RunRecord:
    """Date, machine, versions and seed of a run.

    Attributes:
        date: Start of the run, ISO 8601, UTC.
        processor: Name of the processor.
        cores: Number of its cores.
        seed: Seed of random planners.
        planners: Names of the planners.
        versions: Versions of Python, cnpgen and libraries.
    """

    date: str
    processor: str
    cores: int
    seed: int
    planners: tuple[str, ...]
    versions: dict[str, str]

    def __str__(self) -> str:
        libraries = ", ".join(
            f"{name} {number}" for name, number in self.versions.items()
        )
        return f"{self.date}: {self.processor}, {self.cores} cores; seed {self.seed}; {libraries}"


_STRUCTURE = structure_of(RunRecord)


def describe_run(seed: int, planners: Sequence[str]) -> RunRecord:
    """Describe a run of these planners that begins now."""
    libraries = {
        name: number for name in LIBRARIES if (number := installed_version(name))
    }
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return RunRecord(
        date,
        _processor(),
        os.cpu_count() or 1,
        seed,
        tuple(planners),
        {**versions(), **libraries},
    )


def load_runs(folder: Path) -> tuple[RunRecord, ...]:
    """Load the records of earlier runs in a folder.

    Raise DatasetError if the file is damaged.
    """
    path = folder / RUNS_FILE
    if not path.exists():
        return ()
    try:
        documents = parse_json(read_file(path, max_bytes=MAX_RUNS_BYTES).decode())
        check_structure(documents, [_STRUCTURE])
    except ValueError as error:
        raise DatasetError(f"{path} is damaged: {error}; delete it") from error
    known = ({name: document[name] for name in _STRUCTURE} for document in documents)
    return tuple(
        RunRecord(**{**values, "planners": tuple(values["planners"])})
        for values in known
    )


def add_run(folder: Path, seed: int, planners: Sequence[str]) -> tuple[RunRecord, ...]:
    """Record a run that begins now, and return the records of all runs; errors as of ``load_runs``."""
    runs = (*load_runs(folder), describe_run(seed, planners))
    documents: list[JsonObject] = [asdict(run) for run in runs]
    write_file(folder / RUNS_FILE, json.dumps(documents, indent=1) + "\n")
    return runs


def _processor() -> str:
    return processor_entry("model name").strip() or platform.machine()
