"""Results on disk: a file per planner and repetition, with a line of JSON for every finished problem.

Further lines of a problem add the execution of its plan on one plant.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.benchmark.benchmark_planner import PLANNERS, Setting
from cnpgen.addons.benchmark.hypothesis_tests import FIGURES
from cnpgen.addons.benchmark.suite import Suite
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError, UsageError
from cnpgen.machine.versions import __version__, installed_version
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.problem import resolved
from cnpgen.schema import addons
from cnpgen.store.files.atomic import check_writable
from cnpgen.store.files.document_structure import (
    ANY_KEY,
    ANYTHING,
    FINITE,
    TEXT,
    WHOLE,
    Nullable,
    Structure,
    check_structure,
)
from cnpgen.store.files.documents import canonical_sha256, plain
from cnpgen.store.files.record_file import RecordFile, RecordFormat, open_records
from cnpgen.store.paths import require_file

_POINTS = [Nullable(FINITE)]
_PLAN = {
    "degree": WHOLE,
    "path_control_points": [_POINTS],
    "rate_control_points": _POINTS,
}
_REQUIRED = {"t": _POINTS, "q": [_POINTS]}
_SAMPLES = {**_REQUIRED, "dq": [_POINTS], "ddq": [_POINTS]}
_PLANNED = {
    "ending": TEXT,
    "planning_s": FINITE,
    "planning_cpu_s": FINITE,
    "error": TEXT,
}
_VERDICT = {
    "valid": ANYTHING,
    "paper": {"valid": ANYTHING, "finished": ANYTHING},
    "metrics": {ANY_KEY: Nullable(FINITE)},
    "value_over_bound": {ANY_KEY: FINITE},
}


@dataclass
class Results:
    """Results of one planner: the file, and problem -> its row, see ``cnpgen docs benchmark``."""

    file: RecordFile
    rows: dict[int, JsonObject]

    def append(self, row: JsonObject) -> None:
        """Append a line to the file and to the rows."""
        # Equal to the row that a later run reads.
        _merge(self.rows, json.loads(json.dumps(row, allow_nan=False)))
        self.file.append(row)

    def missing(self, count: int) -> Iterator[int]:
        """Yield those of the first ``count`` problems without planning result."""
        return (
            index for index in range(count) if "ending" not in self.rows.get(index, {})
        )

    def unexecuted(self, plant: str, count: int) -> Iterator[int]:
        """Yield the problems whose plans a plant has not executed."""
        for index in range(count):
            row = self.rows.get(index, {})
            if row.get("answer") is not None and plant not in row.get("executed", {}):
                yield index


def open_results(
    path: Path,
    identity: JsonObject,
    *,
    overwrite: bool = False,
    discard: bool = False,
) -> Results:
    """Open the results of a planner with the rows of earlier runs.

    Results of another run, by its identity, are refused or overwritten; those of this
    run may be discarded.

    Raises:
        UsageError: The file belongs to another run, or is in use.
        DatasetError: The file is damaged, or has another format.
        MachineError: The file cannot be read or written.
    """
    if path.exists():
        require_file(path, "the results of a planner")
    file = open_records(path, RESULTS, identity, discard=overwrite)
    if discard:
        file.clear()
    return Results(file, _merged(file.records))


def _merged(records: Sequence[JsonObject]) -> dict[int, JsonObject]:
    """Return problem -> its row."""
    rows: dict[int, JsonObject] = {}
    for row in records:
        _merge(rows, row)
    return rows


def _merge(rows: dict[int, JsonObject], row: JsonObject) -> None:
    known = rows.setdefault(row["problem"], {})
    # Executions of several plants add up; other keys of a row are replaced.
    executed = {**known.get("executed", {}), **row.get("executed", {})}
    known |= row
    if executed:
        known["executed"] = executed


def _checked_row(row: Any) -> JsonObject:
    """Return a row of results; raise ``ValueError`` if a line is none.

    Files are untrusted input.
    """
    check_structure(row, {"problem": WHOLE})
    if row.keys() & {"ending", "answer"}:
        check_structure(row, {**_PLANNED, "answer": Nullable({ANY_KEY: ANYTHING})})
        if (answer := row["answer"]) is not None:
            structure = (
                _PLAN
                if "degree" in answer
                else {**_REQUIRED, **_present(_SAMPLES, answer)}
            )
            check_structure(answer, structure)
            check_structure(row, {"verdict": _VERDICT})
            for name in structure.keys() - {"degree"}:
                # Rows of equal length.
                np.array(answer[name], float)
    if "executed" in row:
        check_structure(row, {"executed": {ANY_KEY: {ANY_KEY: ANYTHING}}})
        for executed in row["executed"].values():
            check_structure(
                executed, _present(dict.fromkeys(FIGURES, Nullable(FINITE)), executed)
            )
    return dict(row)


RESULTS = RecordFormat(
    "cnpgen-benchmark",
    2,
    "a file of results of cnpgen",
    "{force} discards its results, another folder keeps them",
    "force",
    _checked_row,
    checked=False,
)


def _present(
    structures: dict[str, Structure], table: JsonObject
) -> dict[str, Structure]:
    return {name: structure for name, structure in structures.items() if name in table}


def answer_to_dict(answer: Plans | Trajectory) -> JsonObject:
    """Write an answer for JSON; numbers read back as the same float64."""
    if isinstance(answer, Plans):
        return {
            "degree": answer.degree,
            "path_control_points": _rows(answer.path_control_points[0]),
            "rate_control_points": _rows(answer.rate_control_points[0]),
        }
    return {
        name: _rows(values)
        for name in _SAMPLES
        if (values := getattr(answer, name)) is not None
    }


def answer_from_dict(problem: Plans, content: JsonObject) -> Plans | Trajectory:
    """Read an answer for one boundary problem.

    Raise UsageError if a shape or the number of joints is wrong.
    """
    known = (
        _PLAN.keys() - {"degree"}
        if "degree" in content
        else _SAMPLES.keys() & content.keys()
    )
    numbers = {name: np.array(content[name], float) for name in known}
    if "degree" not in content:
        trajectory = Trajectory(**numbers)
        if (joints := trajectory.q.shape[1]) != (
            wanted := problem.boundary.start_q.shape[1]
        ):
            raise UsageError(f"the problem has {wanted} joints, its answer {joints}")
        return trajectory
    return make_plans(
        problem.problem,
        problem.boundary,
        path_control_points=numbers["path_control_points"][None],
        rate_control_points=numbers["rate_control_points"][None],
        degree=content["degree"],
        columns=problem.columns,
        sample_id=problem.sample_id,
        # As in the problem.
        allow_large_angles=True,
    )


def _rows(values: Any) -> list[Any]:
    """Convert an array to lists; nonfinite values become None, which is read as nan."""
    array = np.asarray(values, float)
    rows: list[Any] = np.where(np.isfinite(array), array.astype(object), None).tolist()  # type: ignore[call-overload]
    return rows


class ResultsFolder:
    """Folder for the results of planners on one suite with one time limit and seed; created if missing.

    Raises:
        UsageError: The path is a file.
        MachineError: The folder cannot be created.
    """

    def __init__(self, path: Path, suite: Suite, setting: Setting) -> None:
        if path.exists() and not path.is_dir():
            raise UsageError(
                f"{path} is a file, expected a folder for the results",
                concerns="folder",
            )
        check_writable(path)
        path.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._shared = {
            "suite": suite.name,
            "suite_version": suite.version,
            # Parameters of planners are part of each file, not of the suite's identity.
            "suite_sha256": canonical_sha256(
                plain(resolved(replace(suite, planners=None)))
            ),
            "cnpgen": __version__,
            "time_limit_s": setting.time_limit,
            "seed": setting.seed,
        }

    def _results(
        self,
    ) -> Iterator[tuple[Path, JsonObject, dict[int, JsonObject] | None]]:
        """Yield path, head and rows of every file.

        None for those of another suite, version or time limit.
        """
        shared = RESULTS.head(self._shared)
        for path in sorted(self.path.glob("*.jsonl")):
            require_file(path, "the results of a planner")
            head = None
            with suppress(DatasetError):
                head, records = RESULTS.read(path)
            if head is not None:
                is_own = head.items() >= shared.items()
                rows = _merged(RESULTS.unpacked(path, records)) if is_own else None
                yield path, head, rows

    def planners(self, *, delete_others: bool) -> set[str]:
        """Return the planners with results.

        Delete results of another run, or raise UsageError.
        """
        names = set()
        for path, head, results in self._results():
            if results is not None:
                names.add(str(head["planner"]))
            elif delete_others:
                path.unlink()
            else:
                known = {name: head.get(name) for name in RESULTS.head(self._shared)}
                RESULTS.require(path, known, self._shared)
        return names

    def open(
        self,
        planner: str,
        repetition: int,
        parameters: JsonObject,
        *,
        overwrite: bool,
        discard: bool,
    ) -> Results:
        """Open the results of a planner and a repetition; see ``open_results``."""
        packages = [
            entry.distribution
            for entry in addons.installed(PLANNERS)
            if entry.name == planner
        ]
        identity = {
            **self._shared,
            "planner": planner,
            "planner_version": next(
                filter(None, map(installed_version, packages)),
                __version__,
            ),
            "parameters": parameters,
            "repetition": repetition,
        }
        name = (
            f"{planner}.jsonl"
            if repetition == 0
            else f"{planner}.repetition-{repetition}.jsonl"
        )
        return open_results(
            self.path / name, identity, overwrite=overwrite, discard=discard
        )

    def rows(self, first: Sequence[str]) -> dict[str, list[JsonObject]]:
        """Return planner -> rows of all results, the given planners first."""
        parts: dict[str, dict[int, dict[int, JsonObject]]] = {
            name: {} for name in first
        }
        for _, head, rows in self._results():
            if rows is not None:
                parts.setdefault(head["planner"], {})[head["repetition"]] = rows
        return {
            name: [
                {**row, "repetition": repetition}
                for repetition, rows in sorted(repetitions.items())
                for _, row in sorted(rows.items())
                if "ending" in row
            ]
            for name, repetitions in parts.items()
        }
