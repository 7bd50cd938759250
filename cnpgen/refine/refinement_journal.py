"""Journal of finished plans, from which an interrupted run resumes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.store.files.record_file import (
    RecordFile,
    RecordFormat,
    open_records,
    pack_arrays,
    unpack_arrays,
)


@dataclass
class Journal:
    """Finished plans of a run in a file of records."""

    # Results of earlier runs, index of the plan -> judged attempt.
    finished: dict[int, Attempt]
    file: RecordFile

    def append(self, indices: Sequence[int], results: Sequence[Attempt]) -> None:
        """Append finished plans.

        Raises:
            MachineError: The file cannot be written.
        """
        self.file.append(_pack(indices, results))


def open_journal(
    path: Path, identity: JsonMapping, *, discard: bool = False
) -> Journal:
    """Open the journal of a run with the results of earlier runs of the same identity; create it if it is missing.

    Finished plans of another run are lost only if ``discard``.

    Raises:
        DatasetError: The file is no journal, or damaged.
        UsageError: It holds another run's plans, or is in use.
        MachineError: The file cannot be opened.
    """
    file = open_records(path, JOURNAL, identity, discard=discard)
    return Journal({k: v for plans in file.records for k, v in plans.items()}, file)


def _pack(indices: Sequence[int], results: Sequence[Attempt]) -> JsonObject:
    return {
        "plans": [
            [int(index), int(result.outcome), result.iterations, str(result.reason)]
            for index, result in zip(indices, results, strict=True)
        ],
        "arrays": pack_arrays(
            {
                "path": np.stack([result.path for result in results]),
                "rate": np.stack([result.rate for result in results]),
                "cost": np.array([result.cost for result in results]),
            }
        ),
    }


def _unpack(record: Any) -> dict[int, Attempt]:
    arrays = unpack_arrays(record["arrays"])
    path, rate, cost = (arrays[name] for name in ("path", "rate", "cost"))
    return {
        index: Attempt(
            path=path[i],
            rate=rate[i],
            cost=float(cost[i]),
            outcome=Outcome(outcome),
            iterations=iterations,
            reason=reason,
        )
        for i, (index, outcome, iterations, reason) in enumerate(record["plans"])
    }


JOURNAL = RecordFormat(
    "cnpgen-journal",
    2,
    "a journal of cnpgen",
    "{discard} discards its finished plans, another output keeps them",
    "discard",
    _unpack,
)
