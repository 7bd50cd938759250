"""The folder of a dataset as it is found: what is there, what may be made in it, and who it is given to."""

from dataclasses import replace
from pathlib import Path

import pytest

from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.blueprint import load_blueprint, shards, write_blueprint
from cnpgen.store.workspace import (
    Workspace,
    begun_blueprint,
    check_clearable,
    check_place,
    find_workspace,
    open_workspace,
    require_blueprint,
)
from tests.examples.store import BLUEPRINT, make_shard

OTHER = replace(BLUEPRINT, seed=8)


def test_what_is_in_a_folder_is_found_out(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    (tmp_path / "left" / "_work").mkdir(parents=True)
    write_blueprint(tmp_path / "begun", BLUEPRINT)
    assert find_workspace(tmp_path / "new" / "deep") == Workspace(tmp_path / "new" / "deep", tmp_path, "nothing")
    assert find_workspace(tmp_path / "left").holds == "nothing"
    assert find_workspace(tmp_path / "file" / "below").holds == "a file"
    assert find_workspace(tmp_path / "mine").holds == "something else"
    begun = find_workspace(tmp_path / "begun")
    assert (begun.holds, begun.rows, begun.blueprint, begun.damage) == ("a dataset", False, BLUEPRINT, "")


def test_a_dataset_whose_blueprint_is_damaged_is_a_dataset_still(tmp_path: Path) -> None:
    write_blueprint(tmp_path, BLUEPRINT)
    make_shard(tmp_path, BLUEPRINT, shards(BLUEPRINT)[0])
    (tmp_path / "plan.json").write_bytes(b"{")
    found = find_workspace(tmp_path)
    assert (found.holds, found.rows, found.blueprint) == ("a dataset", True, None)
    assert "plan.json is damaged" in found.damage
    with pytest.raises(DatasetError, match=r"damaged.*force=True replaces"):
        begun_blueprint(found, BLUEPRINT)
    assert check_clearable(found) == [tmp_path / "train"]


def test_opening_the_same_folder_again_changes_nothing_and_gives_what_is_there(tmp_path: Path) -> None:
    assert open_workspace(tmp_path, BLUEPRINT) == BLUEPRINT
    before = (tmp_path / "plan.json").read_bytes()
    assert open_workspace(tmp_path, replace(BLUEPRINT, title="other")) == BLUEPRINT
    assert (tmp_path / "plan.json").read_bytes() == before


def test_another_blueprint_takes_a_folder_without_rows_only(tmp_path: Path) -> None:
    open_workspace(tmp_path, BLUEPRINT)
    assert open_workspace(tmp_path, OTHER) == OTHER
    make_shard(tmp_path, OTHER, shards(OTHER)[0])
    with pytest.raises(UsageError, match=r"holds another dataset \(seed 8 instead of \d+\); choose another out="):
        open_workspace(tmp_path, BLUEPRINT)
    assert load_blueprint(tmp_path) == OTHER
    assert open_workspace(tmp_path, BLUEPRINT, force=True) == BLUEPRINT
    assert not list(tmp_path.glob("*/shard-*"))


def test_a_blueprint_that_differs_in_several_settings_is_refused_with_each_of_them_once(tmp_path: Path) -> None:
    write_blueprint(tmp_path, BLUEPRINT)
    make_shard(tmp_path, BLUEPRINT, shards(BLUEPRINT)[0])
    other = replace(
        BLUEPRINT, dtype="float32", robot={"name": "another", "joint_names": []}, fields=BLUEPRINT.fields[:2]
    )
    with pytest.raises(UsageError, match=r"\(dtype float64 instead of float32; another robot; another fields\)"):
        open_workspace(tmp_path, other)


def test_a_dataset_begun_by_another_process_after_the_first_look_is_noticed(tmp_path: Path) -> None:
    check_place(find_workspace(tmp_path))
    write_blueprint(tmp_path, OTHER)
    make_shard(tmp_path, OTHER, shards(OTHER)[0])
    with pytest.raises(UsageError, match="holds another dataset"):
        open_workspace(tmp_path, BLUEPRINT)


def test_a_folder_with_other_things_is_not_turned_into_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    for force in (False, True):
        with pytest.raises(UsageError, match="not empty and not a dataset of cnpgen"):
            open_workspace(tmp_path, BLUEPRINT, force=force)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_folder_that_was_given_to_another_dataset_is_noticed(tmp_path: Path) -> None:
    open_workspace(tmp_path, BLUEPRINT)
    require_blueprint(tmp_path, BLUEPRINT)
    open_workspace(tmp_path, OTHER)
    with pytest.raises(UsageError, match="was given to another dataset"):
        require_blueprint(tmp_path, BLUEPRINT)
