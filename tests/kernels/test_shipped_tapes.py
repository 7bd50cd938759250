"""Tapes and shapes that the package has as data: equal to those of the present sources, found by them only, optional."""

import json
from collections.abc import Iterator
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest

from cnpgen.kernels import library as library_module
from cnpgen.kernels import shipped_tapes
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.shape import shape
from tests.conftest import Prepare
from tests.examples.example_robots import needs_robots
from tests.kernels import make_shipped_tapes

MAKE = "make them again: python -m tests.kernels.make_shipped_tapes"


@pytest.mark.parametrize(
    "name", ["airhockey-hit", pytest.param("heavy-object", marks=pytest.mark.slow)]
)
def test_stored_tapes_are_those_of_the_sources(name: str) -> None:
    """The archive has all tapes of a dataset, with the bytes of those that its builders make."""
    with make_shipped_tapes.recorded() as tapes:
        make_shipped_tapes.load_kernels(name)
        make_shipped_tapes.load_training_kernels(name)
    assert len(tapes) > 10
    stored = make_shipped_tapes.stored_tapes()
    made = make_shipped_tapes.contents_of(tapes).values()
    missing = [
        tape.name for tape in made if make_shipped_tapes.digest_of(tape) not in stored
    ]
    assert not missing, MAKE


def test_constants_of_another_processor_are_equal_and_other_instructions_are_not() -> None:  # fmt: skip
    """Rounding makes no new tape; a changed constant or operand does."""
    tape = max(make_shipped_tapes.stored_tapes().values(), key=len)
    rounded = replace(tape, constant=tape.constant * (1 + 1e-15))
    assert not np.array_equal(rounded.constant, tape.constant)
    assert make_shipped_tapes.are_equal(rounded, tape)
    changed = replace(tape, constant=tape.constant * (1 + 1e-9))
    assert not make_shipped_tapes.are_equal(changed, tape)
    assert not make_shipped_tapes.are_equal(replace(tape, a=tape.a[::-1]), tape)
    [kept] = make_shipped_tapes.contents_of({"key": rounded}).values()
    assert kept.to_bytes() == tape.to_bytes()


@pytest.mark.slow
@needs_robots
def test_the_index_names_all_tapes_of_shipped_datasets_for_the_present_sources() -> None:  # fmt: skip
    """The index is the one that making it again gives, and the archive has what it names, nothing else."""
    with make_shipped_tapes.recorded() as tapes:
        make_shipped_tapes.load_all()
    index = json.loads((shipped_tapes.FOLDER / shipped_tapes.INDEX).read_text())
    made = make_shipped_tapes.contents_of(tapes)
    assert index == {key: make_shipped_tapes.digest_of(tape) for key, tape in made.items()}, MAKE  # fmt: skip
    with ZipFile(shipped_tapes.FOLDER / shipped_tapes.ARCHIVE) as archive:
        assert sorted(archive.namelist()) == sorted(set(index.values()))
        for name in archive.namelist():
            assert sha256(archive.read(name)).hexdigest()[:32] == name


@pytest.mark.slow
@needs_robots
def test_stored_shapes_are_those_of_the_sources(tmp_path: Path) -> None:
    """Computed again, capsules and pairs of the robots of shipped problems are those stored, up to rounding."""
    make_shipped_tapes.write_shapes(tmp_path)
    stored, made = (
        {path.name: shape_in(path) for path in folder.iterdir()}
        for folder in (shape.SHIPPED, tmp_path)
    )
    assert len(made) > 5
    assert stored.keys() == made.keys(), MAKE
    for name, (capsules, pairs) in made.items():
        np.testing.assert_allclose(stored[name][0], capsules, atol=3e-5, err_msg=MAKE)
        assert [each[:3] for each in stored[name][1]] == [each[:3] for each in pairs]
        np.testing.assert_allclose(
            [each[3:] for each in stored[name][1]], [each[3:] for each in pairs], atol=0.01
        )  # fmt: skip


def shape_in(path: Path) -> tuple[list[list[float]], list[list[Any]]]:
    """Return capsules, with their ends in order, and pairs of links: names, reason and shares of states."""
    stored = json.loads(path.read_text("utf-8").partition("\n")[2])
    capsules = [
        [*min(each["first"], each["second"]), *max(each["first"], each["second"]), each["radius"], each["overhang"]]
        for each in stored["capsules"]
    ]  # fmt: skip
    return capsules, [list(each.values()) for each in stored["pairs"]]


def test_the_first_use_of_a_shipped_robot_computes_no_capsules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is computed, also with an empty cache, and the capsules are those that the cache would keep."""
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path))
    with monkeypatch.context() as patch:
        patch.setattr(shape, "covering_capsule", lambda _: pytest.fail("it is stored"))
        held = load_robot(load_problem("heavy-object")).held_shape
    assert held is not None
    assert len(held.capsules) > 3
    assert not list(tmp_path.glob("shape-*"))


@pytest.fixture
def kernels(
    prepare: Prepare, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[KernelLibrary]:
    """A library of kernels whose package has one tape: that of the position of the tip."""
    library = prepare("airhockey-hit").context.kernels
    with make_shipped_tapes.recorded() as tapes:
        library.tape(tip_position)
    make_shipped_tapes.write(tapes, tmp_path)
    monkeypatch.setattr(shipped_tapes, "FOLDER", tmp_path)
    shipped_tapes._index.cache_clear()
    yield library
    shipped_tapes._index.cache_clear()


def builds(library: KernelLibrary, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether the tape is built by CasADi, with an empty cache."""
    built: list[object] = []

    def build(function: object, *args: object, **options: object) -> object:
        built.append(function)
        return make(function, *args, **options)

    make = library_module.tape_from_function
    with monkeypatch.context() as patch:
        patch.setattr(library_module, "tape_from_function", build)
        patch.setattr(KernelLibrary, "_cached", lambda _, name: None)
        library.tape(tip_position)
    return bool(built)


def test_a_stored_tape_is_used_by_its_sources_only(
    kernels: KernelLibrary, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A changed source gives another key, so that the tape is built."""
    assert not builds(kernels, monkeypatch)
    monkeypatch.setattr(library_module, "_source_digests", lambda _: ["changed"])
    assert builds(kernels, monkeypatch)


@pytest.mark.parametrize("name", [shipped_tapes.INDEX, shipped_tapes.ARCHIVE])
@pytest.mark.parametrize("content", [b"", b"{", b"PK damaged", None])
def test_damaged_and_missing_files_are_ignored(
    kernels: KernelLibrary,
    content: bytes | None,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without a usable file the tape is built."""
    file = shipped_tapes.FOLDER / name
    file.unlink() if content is None else file.write_bytes(content)
    assert builds(kernels, monkeypatch)
