"""Results on disk: a file per planner and repetition, with a line of JSON for every finished problem.

Further lines of a problem add the execution of its plan on one plant. An incomplete
last line is ignored.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
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
from cnpgen.store.files.atomic import check_writable, machine_errors, write_file
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
from cnpgen.store.files.documents import canonical_sha256, parse_json, plain
from cnpgen.store.files.journal import append_line
from cnpgen.store.paths import require_file

RESULTS_FORMAT = "cnpgen-benchmark"
RESULTS_VERSION = 2
_FORMAT = {"format": RESULTS_FORMAT, "format_version": RESULTS_VERSION}
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

    path: Path
    rows: dict[int, JsonObject] = field(default_factory=dict)

    def append(self, row: JsonObject) -> None:
        """Append a line to the file and to the rows."""
        text = json.dumps(row, allow_nan=False)
        # Equal to the row that a later run reads.
        self._merge(json.loads(text))
        append_line(self.path, text)

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

    def _merge(self, row: JsonObject) -> None:
        known = self.rows.setdefault(row["problem"], {})
        # Executions of several plants add up; other keys of a row are replaced.
        executed = {**known.get("executed", {}), **row.get("executed", {})}
        known |= row
        if executed:
            known["executed"] = executed


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
        UsageError: The file belongs to another run.
        DatasetError: The file is damaged.
        MachineError: The file cannot be read or written.
    """
    head = json.dumps({**_FORMAT, **identity})
    lines: list[str] = []
    if path.exists():
        require_file(path, "the results of a planner")
        lines = _complete_lines(path)
        if lines and lines[0] != head and not overwrite:
            raise UsageError(
                f"{path} holds results of another run ({_differences(lines[0], head)});"
                " {force} overwrites them, another folder keeps them",
                remedies={"force": True},
            )
        lines = lines[1:] if lines and lines[0] == head and not discard else []
    results = _read_rows(path, lines)
    # The file is rewritten without an incomplete last line.
    write_file(path, "".join(f"{line}\n" for line in (head, *lines)).encode())
    return results


def _differences(line: str, head: str) -> str:
    """Name the keys in which two heads differ."""
    one = json.loads(line)
    other = json.loads(head)
    if not isinstance(one, dict):
        return "it has no head"
    # A digest says nothing to a reader; the other keys name the difference.
    keys = [
        key for key in other if one.get(key) != other[key] and key != "suite_sha256"
    ]
    return f"other {', '.join(keys) or 'problems'}".replace("_", " ")


def _read_rows(path: Path, lines: list[str]) -> Results:
    results = Results(path)
    for number, line in enumerate(lines, start=2):
        row = json.loads(line)
        try:
            _check_row(row)
        except ValueError as error:
            raise DatasetError(
                f"{path} is damaged: line {number}: {error}; delete that line"
            ) from error
        results._merge(row)
    return results


def _check_row(row: Any) -> None:
    """Raise ``ValueError`` if a line is not a row of results.

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


def _present(
    structures: dict[str, Structure], table: JsonObject
) -> dict[str, Structure]:
    return {name: structure for name, structure in structures.items() if name in table}


def _complete_lines(path: Path) -> list[str]:
    """Return the lines of a file up to the first line that is not JSON."""
    complete = []
    with machine_errors("read", path):
        lines = path.read_bytes().decode("utf-8", "replace").splitlines()
    for line in lines:
        try:
            parse_json(line)
        except ValueError:
            break
        complete.append(line)
    return complete


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

    def _results(self) -> Iterator[tuple[Path, JsonObject, Results | None]]:
        """Yield path, head and results of every file.

        None for results of another suite, version or time limit.
        """
        for path in sorted(self.path.glob("*.jsonl")):
            require_file(path, "the results of a planner")
            lines = _complete_lines(path)
            head = json.loads(lines[0]) if lines else None
            if isinstance(head, dict) and head.get("format") == RESULTS_FORMAT:
                is_own = all(
                    head.get(key) == value
                    for key, value in {**_FORMAT, **self._shared}.items()
                )
                yield path, head, _read_rows(path, lines[1:]) if is_own else None

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
                raise UsageError(
                    f"{path} holds results of another run (suite, version, time limit or seed differ);"
                    " {force} deletes them, another folder keeps them",
                    remedies={"force": True},
                )
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
        parts: dict[str, dict[int, Results]] = {name: {} for name in first}
        for _, head, results in self._results():
            if results is not None:
                parts.setdefault(head["planner"], {})[head["repetition"]] = results
        return {
            name: [
                {**row, "repetition": repetition}
                for repetition, results in sorted(repetitions.items())
                for _, row in sorted(results.rows.items())
                if "ending" in row
            ]
            for name, repetitions in parts.items()
        }
