"""Sampled trajectories of problems with parameters: values in files and on the command line."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans import Plans
from cnpgen.plans.export import export_plans
from cnpgen.trajectories import import_trajectories, load_trajectories
from tests.conftest import some
from tests.refusals import assert_said, is_refused

TABLES = "airhockey-tables"


@cache
def plans() -> Plans:
    """Return four valid plans, each on a table and with limits of its own."""
    found = Planner(TABLES).plan_batch(
        draw_boundary_problems(TABLES, 8, seed=11).boundary
    )
    return found[np.flatnonzero(cnpgen.evaluate_plans(found, workers=1).valid)[:4]]


@pytest.mark.parametrize("to", some(["csv", "npz", "parquet", "lerobot"]))
def test_exports_have_the_parameters_of_every_plan(to: str, tmp_path: Path) -> None:
    if to in {"parquet", "lerobot"}:
        pytest.importorskip("pyarrow")
    out = tmp_path / (
        "plans.npz" if to == "npz" else "plans.parquet" if to == "parquet" else "plans"
    )
    export_plans(plans(), out, to=to, rate=500)
    loaded = load_trajectories(out, TABLES)
    found = np.array([trajectory.parameters for trajectory in loaded.trajectories])
    np.testing.assert_allclose(
        found, plans().boundary.parameters, rtol=0 if to != "lerobot" else 1e-6
    )
    assert not set(loaded.ignored) & set(plans().problem.parameters.names)
    if to != "lerobot":  # has no accelerations
        assert cnpgen.evaluate_trajectories(TABLES, loaded.trajectories).valid.all()
        others = [
            replace(trajectory, parameters=parameters)
            for trajectory, parameters in zip(
                loaded.trajectories, plans().boundary.parameters[::-1], strict=True
            )
        ]
        assert not cnpgen.evaluate_trajectories(TABLES, others).valid.any()


def test_margins_are_relative_to_the_limits_of_the_sample(tmp_path: Path) -> None:
    export_plans(plans(), tmp_path, to="csv", rate=500)
    evaluation = cnpgen.evaluate_trajectories(
        TABLES, load_trajectories(tmp_path, TABLES).trajectories
    )
    for verdict, expected in zip(
        evaluation.verdicts,
        cnpgen.evaluate_plans(plans(), workers=1).verdicts,
        strict=True,
    ):
        for name, entry in verdict.conditions.items():
            assert entry.margin.severity == pytest.approx(
                expected.margins[name].severity, rel=0.02, abs=0.05
            ), name


def test_the_command_line_states_values_that_a_file_lacks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export_plans(plans()[:1], tmp_path, to="joint-trajectory", rate=500)
    words = ["evaluate", str(tmp_path), "--problem", TABLES, "--json"]
    assert main(words) == 2
    text = capsys.readouterr().err
    assert "has no values of table_height, table_roll, table_pitch" in text
    assert "columns of these names, or --parameters" in text
    names, values = (
        plans().problem.parameters.names,
        plans().boundary.parameters[0].tolist(),
    )
    assert (
        main([*words, "--parameters", ",".join(map("{}={!r}".format, names, values))])
        == 0
    )
    assert json.loads(capsys.readouterr().out)["valid"] == 1
    for value, error in (
        ("payload=1", "expected NAME=VALUE with one of table_height"),
        ("payload_mass=6kg", "'payload_mass' is not a parameter of 'airhockey-tables'"),
        ("table_height=2deg", "table_height: expected a length [m]"),
        (
            "table_height=9,table_roll=0,table_pitch=0,velocity_factor=1",
            "table_height must be from",
        ),
    ):
        assert main([*words, "--parameters", value]) == 2
        assert error in capsys.readouterr().err, value
    export_plans(plans()[:1], tmp_path / "hits", to="csv", rate=500)
    assert (
        main(
            [
                "evaluate",
                str(tmp_path / "hits"),
                "--problem",
                "airhockey",
                "--parameters",
                "table_height=0",
            ]
        )
        == 2
    )
    assert_said(capsys.readouterr().err)


def test_a_column_of_a_parameter_has_one_value(tmp_path: Path) -> None:
    export_plans(plans()[:1], tmp_path, to="csv", rate=100)
    file = tmp_path / "plan_00000.csv"
    lines = file.read_text().splitlines()
    lines[-1] = ",".join([*lines[-1].split(",")[:-4], "0", "0", "0", "0.5"])
    file.write_text("\n".join(lines))
    with is_refused(UsageError, argument="path"):
        load_trajectories(file, TABLES)


def test_imported_plans_keep_the_parameters(tmp_path: Path) -> None:
    export_plans(plans(), tmp_path, to="csv", rate=500)
    imported = import_trajectories(
        TABLES, load_trajectories(tmp_path, TABLES).trajectories
    )
    np.testing.assert_array_equal(
        imported.plans.boundary.parameters, plans().boundary.parameters
    )
    assert imported.snapped.max() < 1e-5
