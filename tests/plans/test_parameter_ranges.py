"""Parameters outside of their ranges are refused wherever plans get them."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, UsageError
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.trajectory.boundary import Boundary
from tests.refusals import is_refused

OUTSIDE = "velocity_factor must be from 0.5 to 1, got 1.3 in row 0"


def plans_with(parameters: list[float]) -> Plans:
    rest = np.array([[-0.3, 0.6975, 0, -0.5049, 0, 1.9286]])
    zero = np.zeros_like(rest)
    return make_plans(
        "airhockey-tables",
        Boundary(rest, zero, zero, rest, zero, parameters=np.array([parameters])),
        path_control_points=np.repeat(rest[:, None], 15, axis=1),
        rate_control_points=np.ones((1, 20)),
    )


def test_completed_tasks_name_the_parameter_and_its_range() -> None:
    with pytest.raises(UsageError, match=f"{OUTSIDE}; extrapolate=True"):
        cnpgen.complete(
            "airhockey-tables",
            goal_xyz=[[1, 0.1]],
            start_xyz=[[0.65, 0]],
            parameters=[[0, 0, 0, 1.3]],
        )


def test_a_negative_mass_is_refused_before_a_stage_computes_with_it() -> None:
    with is_refused(UsageError, argument="parameters"):
        cnpgen.complete(
            "heavy-object-loads", goal_xyz=[[0.5, 0.2, 0.4]], parameters=[[-5.0]]
        )


def test_a_table_of_tasks_is_refused_with_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "tasks.csv"
    names = ("table_height", "table_roll", "table_pitch", "velocity_factor")
    head = ["goal_xyz.x", "goal_xyz.y", *(f"parameters.{name}" for name in names)]
    table.write_text(",".join(head) + "\n1,0.1,0,0,0,1.3\n")
    out = str(tmp_path / "problems.h5")
    assert main(["complete", "airhockey-tables", str(table), "-o", out]) == 1
    text = capsys.readouterr().err
    assert str(table) in text
    assert OUTSIDE in text


def test_plans_with_values_outside_cannot_be_made_changed_or_joined() -> None:
    with pytest.raises(UsageError, match=OUTSIDE):
        plans_with([0, 0, 0, 1.3])
    plans = plans_with([0, 0, 0, 1.0])
    outside = replace(plans.boundary, parameters=np.array([[0, 0, 0, 1.3]]))
    with pytest.raises(UsageError, match=OUTSIDE):
        replace(plans, boundary=outside)


def test_values_at_the_ends_of_a_range_are_inside() -> None:
    for factor in (0.5, 1.0, 1.0 + 1e-13):
        assert len(plans_with([0, 0, 0, factor])) == 1


def test_a_value_that_is_not_a_number_is_left_to_the_verdict() -> None:
    (verdict,) = cnpgen.evaluate_plans(
        plans_with([0, 0, 0, np.nan]), workers=1
    ).verdicts
    assert not verdict.valid


@pytest.mark.parametrize("command", ["evaluate", "refine"])
def test_a_file_with_values_outside_is_refused_by_every_command(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "plans.h5"
    cnpgen.save_plans(tmp_path / "inside.h5", plans_with([0, 0, 0, 1.0]))
    with h5py.File(tmp_path / "inside.h5") as inside, h5py.File(file, "w") as other:
        for name, values in inside.items():
            other[name] = values[()]  # a file of other software, without a checksum
        other["parameters"][0, 3] = 1.3
        other.attrs["problem"] = "airhockey-tables"
    with pytest.raises(DatasetError, match=OUTSIDE):
        cnpgen.load_plans(file)
    more = ["-o", str(tmp_path / "out.h5")] if command == "refine" else []
    assert main([command, str(file), *more]) == 1
    assert OUTSIDE in capsys.readouterr().err
