"""The journal: whole frames count, damaged or foreign ones are as if they had never been written."""

import hashlib
import io
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.refine.journal import MAGIC, open_journal
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


@pytest.mark.parametrize("length", [0, 7, len(MAGIC), len(MAGIC) + 20])
def test_a_journal_that_was_cut_in_its_first_line_is_begun_anew(tmp_path: Path, length: int) -> None:
    path = tmp_path / "part"
    written(path, 0)
    path.write_bytes(path.read_bytes()[:length])
    journal = open_journal(path, IDENTITY)
    assert journal.finished == {}
    journal.append([0], [refined(0)])
    journal.close()
    assert list(kept(path)) == [0]


def test_the_journal_of_another_run_is_kept_unless_it_may_be_thrown_away(tmp_path: Path) -> None:
    path = tmp_path / "part"
    written(path)
    with pytest.raises(
        UsageError, match=r"part holds 6 finished plans of another run \(run one, now two\): discard=True"
    ):
        open_journal(path, '{"run": "two"}')
    assert len(kept(path)) == 6
    open_journal(path, '{"run": "two"}', discard=True).close()
    assert kept(path, '{"run": "two"}') == {}


@pytest.mark.parametrize("content", [b"precious", b"\0" * 4000])
def test_a_file_that_is_no_journal_is_not_touched(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "part"
    path.write_bytes(content)
    with pytest.raises(UsageError, match="part is not a journal of cnpgen"):
        open_journal(path, IDENTITY, discard=True)
    assert path.read_bytes() == content


@pytest.mark.skipif(sys.platform == "win32", reason="has no such locks")
def test_two_processes_do_not_share_a_journal(tmp_path: Path) -> None:
    first = open_journal(tmp_path / "part", IDENTITY)
    with pytest.raises(UsageError, match="part is in use"):
        open_journal(tmp_path / "part", IDENTITY)
    first.close()
    assert kept(tmp_path / "part") == {}


def test_a_place_where_nothing_can_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(MachineError, match=r"cannot write .*nowhere.part: .*; choose a folder that can be made"):
        open_journal(tmp_path / "nowhere" / "part", IDENTITY)


@pytest.mark.skipif(sys.platform == "win32", reason="there are no locks")
def test_a_journal_that_appears_while_it_is_opened_is_not_emptied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, begun, really = tmp_path / "part", [], os.open

    def late(name: str, flags: int, *mode: int) -> int:
        if not begun:
            begun.append(True)
            begun[0] = open_journal(path, IDENTITY)
            begun[0].append([0], [refined(0)])
        return really(name, flags, *mode)

    monkeypatch.setattr(os, "open", late)
    with pytest.raises(UsageError, match="is in use"):
        open_journal(path, IDENTITY)
    begun[0].close()
    assert sorted(kept(path)) == [0]


@pytest.mark.parametrize("frame", [b"", b"PK\x03\x04", b"no archive", "packed"], ids=["empty", "cut", "text", "packed"])
def test_a_frame_that_cnpgen_has_not_written_is_no_journal(tmp_path, frame):
    path = tmp_path / "plans.part"
    open_journal(path, "{}").close()
    if frame == "packed":
        buffer = io.BytesIO()
        np.savez_compressed(buffer, words=np.zeros(10**6, np.uint8))
        frame = buffer.getvalue()
    with path.open("ab") as file:
        file.write(len(frame).to_bytes(8, "little") + hashlib.sha256(frame).digest() + frame)
    with pytest.raises(UsageError, match=r"plans\.part is no journal that cnpgen has written"):
        open_journal(path, "{}")
