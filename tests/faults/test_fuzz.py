"""A small run of ``python -m tests.faults``: changed files of every kind give results or CnpgenErrors."""

from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

import pytest

from cnpgen.problems import problem
from cnpgen.robots.shape import inline
from tests.faults import mutations, scene_subjects, subjects
from tests.faults.fuzz import Outcome, fuzz
from tests.faults.good_files import make_good_files
from tests.faults.subjects import SUBJECTS, read_quietly

INPUTS_PER_KIND = 12  # some seconds in total
UNCHANGED_PER_KIND = 12  # draws of a file of the kind and of the functions that read it


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    return fuzz(INPUTS_PER_KIND * len(SUBJECTS), seed=2026)


def test_every_input_gives_a_result_or_a_cnpgen_error(outcome: Outcome) -> None:
    assert outcome.findings == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", SUBJECTS)
def test_files_of_every_kind_are_read_or_refused(outcome: Outcome, kind: str) -> None:
    assert outcome.read[kind] + outcome.refused[kind] == INPUTS_PER_KIND
    assert outcome.refused[kind]


def test_an_input_is_a_function_of_seed_and_index() -> None:
    first, again = (
        fuzz(6, seed=3, first=5, kinds=("recipe", "journal")) for _ in range(2)
    )
    assert (first.read, first.refused) == (again.read, again.refused)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    make_good_files(folder)
    return folder


def identity(content: Any, *_: Any, **__: Any) -> Any:
    """Return the content of a file as it is."""
    return content


@pytest.fixture
def unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the code of all mutations, to which the subjects hold references, by the identity."""
    functions = [mutations.change_bytes, mutations.change_text, mutations.change_json]
    functions += [mutations.change_urdf, mutations.changed_number]
    for function in functions:
        monkeypatch.setattr(function, "__code__", identity.__code__)
    for name in ("_change_values", "_changed_content"):
        monkeypatch.setattr(subjects, name, identity)
    monkeypatch.setattr(scene_subjects, "change_text_file", identity)


@pytest.mark.usefixtures("unchanged")
@pytest.mark.parametrize("kind", SUBJECTS)
def test_files_of_every_kind_are_read_unchanged(
    good: Path, tmp_path: Path, kind: str
) -> None:
    for index in range(UNCHANGED_PER_KIND):
        folder, draw = tmp_path / str(index), Random(f"{kind} {index}")
        folder.mkdir()
        SUBJECTS[kind].change(good, folder, draw)
        read_quietly(SUBJECTS[kind], folder, draw)


def test_changed_meshes_and_srdf_files_reach_their_readers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: Counter[str] = Counter()

    def counted(read: Any) -> Any:
        def reading(*arguments: Any, **keywords: Any) -> Any:
            calls[read.__name__] += 1
            return read(*arguments, **keywords)

        return reading

    monkeypatch.setattr(inline, "read_mesh", counted(inline.read_mesh))
    srdf = problem.with_disabled_pairs
    monkeypatch.setattr(problem, "with_disabled_pairs", counted(srdf))
    meshes = fuzz(30, seed=4, kinds=("mesh",))
    assert calls["read_mesh"] >= 30
    assert calls["with_disabled_pairs"] == meshes.read["mesh"] > 0
    pairs = fuzz(30, seed=4, kinds=("srdf",))
    assert calls["with_disabled_pairs"] == meshes.read["mesh"] + 30
    assert min(meshes.refused["mesh"], pairs.read["srdf"], pairs.refused["srdf"]) > 0
    assert meshes.findings + pairs.findings == []


def test_a_robot_of_which_every_element_is_removed_can_be_changed_further():
    robot = "<robot><link/></robot>"
    texts = [mutations.change_urdf(robot, Random(seed)) for seed in range(100)]
    assert any("link" not in text for text in texts)
