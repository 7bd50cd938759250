"""The journal of finished plans: complete records count, damaged ones and those of other runs do not."""

import base64
import io
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from cnpgen.documents import JsonMapping
from cnpgen.errors import DatasetError, MachineError, UsageError
from cnpgen.refine.refinement_journal import JOURNAL, open_journal
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.store.files.record_file import open_records
from tests.refusals import is_refused

IDENTITY = {"run": "one"}


def random_attempt(seed: int) -> Attempt:
    random = np.random.default_rng(seed)
    path, rate = random.normal(size=(15, 6)), random.uniform(1, 2, 20)
    return Attempt(
        path=path,
        rate=rate,
        cost=float(seed),
        outcome=Outcome.SOLVED_FINE,
        iterations=seed,
        reason="joint velocity limit" if seed % 2 else "ok",
    )


def finished_plans(path: Path, identity: JsonMapping = IDENTITY) -> dict[int, Attempt]:
    journal = open_journal(path, identity)
    journal.file.close()
    return journal.finished


def write_journal(path: Path, count: int = 3) -> None:
    journal = open_journal(path, IDENTITY)
    for first in range(0, 2 * count, 2):
        journal.append(
            [first, first + 1], [random_attempt(first), random_attempt(first + 1)]
        )
    journal.file.close()


def test_appended_results_are_read_bit_by_bit(tmp_path: Path) -> None:
    write_journal(tmp_path / "part")
    found = finished_plans(tmp_path / "part")
    assert sorted(found) == list(range(6))
    for plan, result in found.items():
        expected = random_attempt(plan)
        np.testing.assert_array_equal(result.path, expected.path)
        np.testing.assert_array_equal(result.rate, expected.rate)
        assert (result.outcome, result.reason, result.iterations, result.cost) == (
            expected.outcome,
            expected.reason,
            expected.iterations,
            expected.cost,
        )


@pytest.mark.parametrize("lost", [1, 30, 500])
def test_an_incomplete_record_is_removed_and_later_ones_follow_the_complete_ones(
    tmp_path: Path, lost: int
) -> None:
    path = tmp_path / "part"
    write_journal(path)
    path.write_bytes(path.read_bytes()[:-lost])
    journal = open_journal(path, IDENTITY)
    assert sorted(journal.finished) == [0, 1, 2, 3]
    journal.append([4], [random_attempt(4)])
    journal.file.close()
    assert sorted(finished_plans(path)) == [0, 1, 2, 3, 4]


def test_records_from_a_flipped_bit_on_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "part"
    write_journal(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert set(finished_plans(path)) < set(range(6))


def test_the_journal_of_another_run_is_kept_without_discard(tmp_path: Path) -> None:
    path = tmp_path / "part"
    write_journal(path)
    with is_refused(UsageError, argument="discard"):
        open_journal(path, {"run": "two"})
    assert len(finished_plans(path)) == 6
    open_journal(path, {"run": "two"}, discard=True).file.close()
    assert finished_plans(path, {"run": "two"}) == {}


def test_a_folder_without_write_access_is_named(tmp_path: Path) -> None:
    with is_refused(MachineError):
        open_journal(tmp_path / "nowhere" / "part", IDENTITY)


@pytest.mark.skipif(sys.platform == "win32", reason="there are no locks")
def test_a_journal_that_another_process_creates_meanwhile_is_not_truncated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, begun, really = tmp_path / "part", [], os.open

    def late(name: str, flags: int, *mode: int) -> int:
        if not begun:
            begun.append(True)
            begun[0] = open_journal(path, IDENTITY)
            begun[0].append([0], [random_attempt(0)])
        return really(name, flags, *mode)

    monkeypatch.setattr(os, "open", late)
    with is_refused(UsageError):
        open_journal(path, IDENTITY)
    begun[0].file.close()
    assert sorted(finished_plans(path)) == [0]


@pytest.mark.parametrize("kind", ["text", "no table", "no archive", "compressed"])
def test_a_record_that_cnpgen_has_not_written_is_refused(tmp_path, kind):
    path = tmp_path / "plans.part"
    file = open_records(path, JOURNAL, IDENTITY)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, words=np.zeros(10**6, np.uint8))
    compressed = base64.b64encode(buffer.getvalue()).decode()
    records = {
        "text": "",
        "no table": [5],
        "no archive": {"arrays": "UEsDBA=="},
        "compressed": {"arrays": compressed, "plans": []},
    }
    file.append(records[kind])
    file.close()
    with is_refused(DatasetError):
        open_journal(path, IDENTITY)
