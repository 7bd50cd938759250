"""A planner's results on disk: a line of JSON for every problem, written as it is finished.

A second line of a problem adds to the first: what came of executing its plan on one plant. What was cut off by an
interruption is as if it had never been written.
"""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.benchmark.planner import Answer
from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.store.files.atomic import machine_error, write_file

FORMAT = "cnpgen-benchmark"
FORMAT_VERSION = 1


@dataclass
class Results:
    """Results of one planner.

    Attributes:
        path: The file.
        rows: Problem -> what is known of it: the fields of ``docs/benchmark.md``.
    """

    path: Path
    rows: dict[int, dict[str, Any]] = field(default_factory=dict)

    def append(self, row: dict[str, Any]) -> None:
        """Write a line down, and take it in.

        Raises:
            MachineError: The disk is full, or otherwise unwilling.
        """
        text = json.dumps(row, allow_nan=False)
        self._take(json.loads(text))  # the same as what a later run reads
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(f"{text}\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise machine_error("write", self.path, error) from error

    def missing(self, count: int) -> Iterator[int]:
        """Yield the problems of the first ``count`` that are still to be planned."""
        return (index for index in range(count) if "ending" not in self.rows.get(index, {}))

    def unexecuted(self, plant: str, count: int) -> Iterator[int]:
        """Yield the problems whose plans are still to be executed on a plant."""
        for index in range(count):
            row = self.rows[index]
            if row.get("answer") is not None and plant not in row.get("executed", {}):
                yield index

    def _take(self, row: dict[str, Any]) -> None:
        known = self.rows.setdefault(row["problem"], {})
        executed = {**known.get("executed", {}), **row.get("executed", {})}
        known |= row
        if executed:
            known["executed"] = executed


def open_results(path: Path, identity: dict[str, Any], *, discard: bool = False) -> Results:
    """Open the results of a planner, with what earlier runs have finished.

    Args:
        path: The file.
        identity: What distinguishes a run; results of another one are not mixed in.
        discard: Whether results of another run may be thrown away.

    Raises:
        UsageError: The file is of another run.
        MachineError: It cannot be read or written.
    """
    head = json.dumps({"format": FORMAT, "format_version": FORMAT_VERSION, **identity})
    results = Results(path)
    lines: list[str] = []
    if path.exists():
        lines = _whole_lines(path)
        if lines and lines[0] != head and not discard:
            raise UsageError(
                f"{path} holds results of another run (suite, version or time limit differ): force=True throws them"
                " away, another folder keeps them"
            )
        lines = lines[1:] if lines and lines[0] == head else []
    write_file(path, "".join(f"{line}\n" for line in (head, *lines)).encode())
    for line in lines:
        results._take(json.loads(line))
    return results


def _whole_lines(path: Path) -> list[str]:
    """Return the lines of a file up to the first that is no JSON."""
    found = []
    try:
        lines = path.read_bytes().decode("utf-8", "replace").splitlines()
    except OSError as error:
        raise machine_error("read", path, error) from error
    for line in lines:
        try:
            json.loads(line)
        except ValueError:
            break
        found.append(line)
    return found


def answer_to_dict(answer: Answer) -> dict[str, Any] | None:
    """Write an answer for JSON; numbers read back as the same float64."""
    if isinstance(answer, Plans):
        return {
            "degree": answer.degree,
            "path_control_points": _rows(answer.path_control_points[0]),
            "rate_control_points": _rows(answer.rate_control_points[0]),
        }
    if answer is None:
        return None
    return {name: _rows(values) for name, values in vars(answer).items() if isinstance(values, np.ndarray)}


def answer_from_dict(problem: Plans, content: dict[str, Any]) -> Plans | Trajectory:
    """Read an answer for one boundary problem back."""
    numbers = {name: np.array(values, float) for name, values in content.items() if name != "degree"}
    if "degree" not in content:
        return Trajectory(**numbers)
    return make_plans(
        problem.problem,
        problem.boundary,
        path_control_points=numbers["path_control_points"][None],
        rate_control_points=numbers["rate_control_points"][None],
        degree=content["degree"],
        columns=problem.columns,
        sample_id=problem.sample_id,
    )


def _rows(values: Any) -> list[Any]:
    """Turn an array into lists; what is not finite becomes None, and nan when it is read."""
    array = np.asarray(values, float)
    found: list[Any] = np.where(np.isfinite(array), array.astype(object), None).tolist()  # type: ignore[call-overload]
    return found
