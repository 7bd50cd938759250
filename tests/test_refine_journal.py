"""The journal: whole frames count, damaged or foreign ones are as if they had never been written."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import MachineError
from cnpgen.refine.journal import open_journal
from cnpgen.refine.task import Outcome, Refined

IDENTITY = '{"run": "one"}'


def refined(seed: int) -> Refined:
    random = np.random.default_rng(seed)
    path, rate = random.normal(size=(15, 6)), random.uniform(1, 2, 20)
    return Refined(path, rate, Outcome.POLISHED, "joint velocity limit" if seed % 2 else "ok", seed, float(seed))


def kept(path: Path, identity: str = IDENTITY) -> dict[int, Refined]:
    journal = open_journal(path, identity)
    journal.close()
    return journal.finished


def written(path: Path, count: int = 3) -> None:
    journal = open_journal(path, IDENTITY)
    for first in range(0, 2 * count, 2):
        journal.append([first, first + 1], [refined(first), refined(first + 1)])
    journal.close()


def test_what_was_appended_is_found_again_to_the_bit(tmp_path: Path) -> None:
    written(tmp_path / "part")
    found = kept(tmp_path / "part")
    assert sorted(found) == list(range(6))
    for plan, each in found.items():
        expected = refined(plan)
        np.testing.assert_array_equal(each.path, expected.path)
        np.testing.assert_array_equal(each.rate, expected.rate)
        assert (each.outcome, each.reason, each.iterations, each.cost) == (
            expected.outcome,
            expected.reason,
            expected.iterations,
            expected.cost,
        )


@pytest.mark.parametrize("lost", [1, 30, 500])
def test_a_frame_that_was_cut_is_dropped_and_later_ones_follow_the_whole_ones(tmp_path: Path, lost: int) -> None:
    path = tmp_path / "part"
    written(path)
    path.write_bytes(path.read_bytes()[:-lost])
    journal = open_journal(path, IDENTITY)
    assert sorted(journal.finished) == [0, 1, 2, 3]
    journal.append([4], [refined(4)])
    journal.close()
    assert sorted(kept(path)) == [0, 1, 2, 3, 4]


def test_a_flipped_bit_ends_what_counts(tmp_path: Path) -> None:
    path = tmp_path / "part"
    written(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert set(kept(path)) < set(range(6))


@pytest.mark.parametrize("content", [b"", b"\0" * 7, b"\xff" * 4000])
def test_files_that_are_no_journal_are_begun_anew(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "part"
    path.write_bytes(content)
    journal = open_journal(path, IDENTITY)
    assert journal.finished == {}
    journal.append([0], [refined(0)])
    journal.close()
    assert list(kept(path)) == [0]


def test_the_journal_of_another_run_does_not_count(tmp_path: Path) -> None:
    written(tmp_path / "part")
    assert kept(tmp_path / "part", '{"run": "two"}') == {}
    assert kept(tmp_path / "part") == {}


def test_a_place_where_nothing_can_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(MachineError, match="nowhere"):
        open_journal(tmp_path / "nowhere" / "part", IDENTITY)
