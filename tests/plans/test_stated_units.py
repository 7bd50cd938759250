"""Attributes of files of other software: units, scales and misspelt names are refused, others are listed."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.make.complete import read_tasks
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.plans.plan_file import load_plans
from cnpgen.store.field import Field
from tests.refusals import is_refused

Q = np.tile([0.0, 0.1, 0.0, -0.5, 0.0, 0.7], (2, 1))
COLUMNS = {
    "start_q": Q,
    "goal_q": Q + 0.1,
    **dict.fromkeys(("start_dq", "start_ddq", "goal_dq"), 0.0 * Q),
    "path_control_points": np.tile(Q[:, None], (1, 15, 1)),
    "rate_control_points": np.ones((2, 20)),
}
TASKS = {"goal_xyz": Field("goal_xyz", "m", "goal", 3, ("x", "y", "z"))}
READERS: dict[str, tuple[dict[str, Any], Callable[[Path], Any]]] = {
    "plans": (COLUMNS, lambda path: load_plans(path, problem="airhockey")),
    "boundary": (
        {name: COLUMNS[name] for name in ("start_q", "goal_q")},
        lambda path: load_boundary_problems(path, problem="airhockey"),
    ),
    "tasks": (
        {"goal_xyz": np.ones((2, 3))},
        lambda path: read_tasks(path, TASKS, flat=False),
    ),
}


def write(path: Path, columns: dict[str, Any]) -> h5py.File:
    file = h5py.File(path, "w")
    for name, values in columns.items():
        file[name] = values
    return file


@pytest.mark.parametrize(
    ("key", "value"),
    [("unit", "deg"), ("units", "mm"), ("units", "s"), ("scale", 2.0), ("offset", 0.1)],
)
@pytest.mark.parametrize("kind", READERS)
def test_attributes_that_change_numbers_are_refused(
    tmp_path: Path, kind: str, key: str, value: Any
) -> None:
    columns, read = READERS[kind]
    name = next(iter(columns))
    with write(tmp_path / "a.h5", columns) as file:
        file[name].attrs[key] = value
    with is_refused(DatasetError):
        read(tmp_path / "a.h5")


@pytest.mark.parametrize("kind", READERS)
def test_attributes_that_state_si_units_are_accepted(tmp_path: Path, kind: str) -> None:
    columns, read = READERS[kind]
    unit = "m" if kind == "tasks" else "rad"
    with write(tmp_path / "a.h5", columns) as file:
        file[next(iter(columns))].attrs["unit"] = unit
    assert len(read(tmp_path / "a.h5")) > 0


@pytest.mark.parametrize("kind", ["plans", "boundary"])
def test_attributes_that_are_not_read_are_listed_or_refused(
    tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    columns, read = READERS[kind]
    with write(tmp_path / "a.h5", columns) as file:
        file.attrs["rate"] = 50.0
        file["start_q"].attrs["epoch"] = "1970"
    caplog.set_level("INFO", "cnpgen")
    read(tmp_path / "a.h5")
    assert "not used: attribute rate, attribute epoch of start_q" in caplog.text
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.attrs["degre"] = 5
    with is_refused(DatasetError):
        read(tmp_path / "a.h5")


def test_datasets_beside_boundary_conditions_are_listed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    columns, read = READERS["boundary"]
    write(tmp_path / "a.h5", columns | {"velocity_limits": Q}).close()
    caplog.set_level("INFO", "cnpgen")
    read(tmp_path / "a.h5")
    assert "not used: velocity_limits" in caplog.text


OWN = [f"joint_{k}" for k in range(1, 7)]


@pytest.mark.parametrize(
    ("names", "agrees"),
    [(OWN, True), (OWN[::-1], False), (OWN[:5], False), ([*OWN[:5], "claw"], False)],
)
@pytest.mark.parametrize("form", [list, ",".join, " ".join, json.dumps])
@pytest.mark.parametrize("place", ["", "start_q", "goal_q"])
@pytest.mark.parametrize("kind", ["plans", "boundary"])
def test_joints_in_another_order_are_refused(
    tmp_path: Path,
    kind: str,
    place: str,
    form: Callable[[list[str]], Any],
    names: list[str],
    agrees: bool,
    caplog: pytest.LogCaptureFixture,
) -> None:
    columns, read = READERS[kind]
    with write(tmp_path / "a.h5", columns) as file:
        item = file[place] if place else file
        item.attrs["joint_names"] = form(names)
        if place:
            item.attrs["names"] = form(names)
    caplog.set_level("INFO", "cnpgen")
    if agrees:
        assert len(read(tmp_path / "a.h5")) == 2
        assert "not used" not in caplog.text
        return
    text = f"is {', '.join(names)}, expected the problem's order, {', '.join(OWN)}"
    with pytest.raises(DatasetError, match=text):
        read(tmp_path / "a.h5")


def test_a_dataset_of_joints_in_another_order_is_refused(tmp_path: Path) -> None:
    columns, read = READERS["boundary"]
    write(tmp_path / "a.h5", columns | {"joint_names": OWN}).close()
    assert len(read(tmp_path / "a.h5")) == 2
    write(tmp_path / "b.h5", columns | {"joint_names": OWN[::-1]}).close()
    with pytest.raises(DatasetError, match="joint_names is joint_6, joint_5"):
        read(tmp_path / "b.h5")
