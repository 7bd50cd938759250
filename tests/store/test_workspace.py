"""The folder of a dataset: its content, and whether a dataset can be made in it."""

from dataclasses import replace
from pathlib import Path

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.dataset_spec import load_dataset_spec, shards, write_dataset_spec
from cnpgen.store.workspace import (
    Workspace,
    check_clearable,
    check_place,
    find_workspace,
    open_workspace,
    require_dataset_spec,
    started_spec,
)
from tests.examples.store import SPEC, make_shard
from tests.refusals import is_refused

OTHER = replace(SPEC, seed=8)


def test_the_content_of_a_folder_is_recognized(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    (tmp_path / "left" / "_work").mkdir(parents=True)
    write_dataset_spec(tmp_path / "begun", SPEC)
    assert find_workspace(tmp_path / "new" / "deep") == Workspace(
        tmp_path / "new" / "deep", tmp_path, "nothing"
    )
    assert find_workspace(tmp_path / "left").content == "nothing"
    assert find_workspace(tmp_path / "file" / "below").content == "a file"
    assert find_workspace(tmp_path / "mine").content == "something else"
    begun = find_workspace(tmp_path / "begun")
    assert (begun.content, begun.has_shards, begun.spec, begun.damage) == (
        "a dataset",
        False,
        SPEC,
        "",
    )


def test_a_dataset_with_a_damaged_specification_is_recognized_as_a_dataset(
    tmp_path: Path,
) -> None:
    write_dataset_spec(tmp_path, SPEC)
    make_shard(tmp_path, SPEC, shards(SPEC)[0])
    (tmp_path / "specification.json").write_bytes(b"{")
    found = find_workspace(tmp_path)
    assert (found.content, found.has_shards, found.spec) == ("a dataset", True, None)
    assert "specification.json is damaged" in found.damage
    with is_refused(DatasetError, argument="force"):
        started_spec(found, SPEC)
    assert check_clearable(found) == [tmp_path / "train"]


def test_a_dataset_of_an_older_format_is_recognized_and_can_be_replaced(
    tmp_path: Path,
) -> None:
    (tmp_path / "plan.json").write_text(
        '{"format": "cnpgen-plan", "format_version": 2}'
    )
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "shard-00000.h5").write_bytes(b"")
    workspace = find_workspace(tmp_path)
    assert (workspace.content, workspace.has_shards, workspace.spec) == (
        "a dataset",
        True,
        None,
    )
    with is_refused(DatasetError, argument="force"):
        open_workspace(tmp_path, SPEC)
    assert open_workspace(tmp_path, SPEC, force=True) == SPEC
    assert {path.name for path in tmp_path.iterdir()} - {"_work"} == {
        "specification.json"
    }


def test_opening_the_same_folder_again_returns_the_existing_specification(
    tmp_path: Path,
) -> None:
    assert open_workspace(tmp_path, SPEC) == SPEC
    before = (tmp_path / "specification.json").read_bytes()
    assert open_workspace(tmp_path, replace(SPEC, title="other")) == SPEC
    assert (tmp_path / "specification.json").read_bytes() == before


def test_a_specification_replaces_another_one_only_if_there_are_no_rows(
    tmp_path: Path,
) -> None:
    open_workspace(tmp_path, SPEC)
    assert open_workspace(tmp_path, OTHER) == OTHER
    make_shard(tmp_path, OTHER, shards(OTHER)[0])
    with is_refused(UsageError, argument="out"):
        open_workspace(tmp_path, SPEC)
    assert load_dataset_spec(tmp_path) == OTHER
    assert open_workspace(tmp_path, SPEC, force=True) == SPEC
    assert not list(tmp_path.glob("*/shard-*"))


def test_a_specification_with_several_different_settings_is_refused_and_each_is_named_once(
    tmp_path: Path,
) -> None:
    write_dataset_spec(tmp_path, SPEC)
    make_shard(tmp_path, SPEC, shards(SPEC)[0])
    other = replace(
        SPEC,
        dtype="float32",
        robot={"name": "another", "joint_names": []},
        fields=SPEC.fields[:2],
    )
    with is_refused(UsageError, argument="out"):
        open_workspace(tmp_path, other)


def test_a_dataset_started_by_another_process_after_the_first_check_is_detected(
    tmp_path: Path,
) -> None:
    check_place(find_workspace(tmp_path))
    write_dataset_spec(tmp_path, OTHER)
    make_shard(tmp_path, OTHER, shards(OTHER)[0])
    with is_refused(UsageError, argument="out"):
        open_workspace(tmp_path, SPEC)


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    for force in (False, True):
        with is_refused(UsageError, argument="out"):
            open_workspace(tmp_path, SPEC, force=force)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_specification_replaced_by_another_process_is_detected(
    tmp_path: Path,
) -> None:
    open_workspace(tmp_path, SPEC)
    require_dataset_spec(tmp_path, SPEC)
    open_workspace(tmp_path, OTHER)
    with is_refused(UsageError, argument="out"):
        require_dataset_spec(tmp_path, SPEC)
