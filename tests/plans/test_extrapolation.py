"""Parameters outside of their ranges: refused, or allowed on request by a problem whose name and ranges say so."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import CnpgenError, DatasetError, UsageError
from cnpgen.problems.problem_record import open_problem
from cnpgen.trajectories import LoadOptions, load_trajectories
from tests.refusals import is_refused

TASK = {"goal_xyz": [[1, 0.1]], "start_xyz": [[0.65, 0]]}
MARKED = "airhockey-tables-extrapolated"


@pytest.fixture(scope="module")
def slow_hit() -> cnpgen.Plans:
    """A plan at 0.3 of the velocity limits, where the problem has 0.5 to 1."""
    values = [[0, 0, 0, 0.3]]
    problems = cnpgen.complete(
        "airhockey-tables", **TASK, parameters=values, extrapolate=True
    )
    return cnpgen.solve_plans(problems.plans, workers=1).plans


def test_the_result_is_marked_and_judged_with_its_values(
    slow_hit: cnpgen.Plans, tmp_path: Path
) -> None:
    assert slow_hit.problem.name == MARKED
    assert cnpgen.evaluate_plans(slow_hit, workers=1).valid.all()
    limit = open_problem(slow_hit.problem)[1].velocity_limit
    t = np.linspace(0, float(slow_hit.duration[0]), 500)
    share = np.abs(slow_hit.motion.at_times(t[None]).dq[0]).max(axis=0) / limit
    assert 0.2 < share.max() <= 0.3 * 1.003
    cnpgen.save_plans(tmp_path / "a.h5", slow_hit)
    assert cnpgen.load_plans(tmp_path / "a.h5").problem.name == MARKED
    with is_refused(DatasetError):
        cnpgen.load_plans(tmp_path / "a.h5", problem="airhockey-tables")


def test_without_the_option_values_outside_are_refused() -> None:
    for value in (0.3, 1.3):
        with is_refused(UsageError, argument="parameters"):
            cnpgen.complete("airhockey-tables", **TASK, parameters=[[0, 0, 0, value]])


@pytest.mark.parametrize(
    ("recipe", "values", "text"),
    [
        ("airhockey-tables", [[0, 0, 0, 1.3]], "cannot be extrapolated to 1.3"),
        ("airhockey-tables", [[0, 0.6, 0, 1]], "table_roll cannot be extrapolated"),
        ("heavy-object-loads", [[-5.0]], "payload_mass cannot be extrapolated to -5"),
    ],
)
def test_limits_of_the_robot_and_impossible_values_are_never_exceeded(
    recipe: str, values: list[list[float]], text: str
) -> None:
    ranges = cnpgen.load_problem(recipe).parameters
    rows = np.tile(values, (1, len(ranges) // len(values[0]))).astype(float)
    with pytest.raises(UsageError, match=text):
        ranges.widened(rows)


def test_files_of_other_programs_need_the_option_at_every_command(
    slow_hit: cnpgen.Plans, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file.attrs["problem"] = "airhockey-tables"
        for name, values in slow_hit.boundary.arrays().items():
            file[name] = values
        file["path_control_points"] = slow_hit.path_control_points
        file["rate_control_points"] = slow_hit.rate_control_points
    with is_refused(CnpgenError, argument="extrapolate"):
        cnpgen.load_plans(path)
    assert cnpgen.load_plans(path, extrapolate=True).problem.name == MARKED
    for words in (
        ["evaluate"],
        ["refine", "--workers", "1", "-o", str(tmp_path / "r.h5")],
    ):
        command, *options = words
        assert main([command, str(path), *options]) in {1, 2}
        error = capsys.readouterr().err
        assert "velocity_factor must be from 0.5 to 1" in error
        assert "--extrapolate allows values outside" in error
        assert main([command, str(path), *options, "--extrapolate"]) == 0
    assert (
        MARKED
        in capsys.readouterr().err + cnpgen.load_plans(tmp_path / "r.h5").problem.name
    )
    problems = cnpgen.load_boundary_problems(path, extrapolate=True)
    assert problems.problem.name == MARKED
    with is_refused(CnpgenError, argument="extrapolate"):
        cnpgen.load_boundary_problems(path)


def test_sampled_trajectories_are_read_with_the_option(
    slow_hit: cnpgen.Plans, tmp_path: Path
) -> None:
    cnpgen.export_plans(slow_hit, tmp_path / "csv", to="csv", rate=500)
    text = r"velocity_factor must be from 0\.5 to 1.*extrapolate=True allows"
    with pytest.raises(UsageError, match=text):
        load_trajectories(tmp_path / "csv", "airhockey-tables")
    with is_refused(UsageError, argument="parameters"):
        load_trajectories(
            tmp_path / "csv",
            "airhockey-tables",
            parameters={"velocity_factor": 0.9},
            options=LoadOptions(extrapolate=True),
        )
    options = LoadOptions(extrapolate=True)
    loaded = load_trajectories(tmp_path / "csv", "airhockey-tables", options=options)
    assert loaded.problem.name == MARKED
    found = cnpgen.evaluate_trajectories(loaded.problem, loaded.trajectories)
    assert found.valid.all()


def test_values_that_change_after_the_check_are_found_when_plans_are_saved(
    slow_hit: cnpgen.Plans, tmp_path: Path
) -> None:
    parameters = slow_hit.boundary.parameters
    assert parameters is not None
    changed = parameters.copy()
    boundary = dataclasses.replace(slow_hit.boundary, parameters=changed)
    plans = dataclasses.replace(slow_hit, boundary=boundary)
    changed[:, 3] = 1.3
    for door in (
        lambda: cnpgen.save_plans(tmp_path / "a.h5", plans),
        lambda: cnpgen.evaluate_plans(plans, workers=1),
        lambda: cnpgen.refine_plans(plans, workers=1),
        lambda: cnpgen.solve_plans(plans, workers=1),
    ):
        with is_refused(UsageError, argument="boundary"):
            door()
    assert not (tmp_path / "a.h5").exists()


def test_the_option_has_no_effect_without_parameters_and_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plans = cnpgen.complete("airhockey-hit", **TASK).plans
    path = tmp_path / "plans.h5"
    cnpgen.save_plans(path, plans)
    for words in (
        ["evaluate", str(path)],
        ["refine", str(path), "-o", str(tmp_path / "r.h5")],
        ["solve", str(path), "-o", str(tmp_path / "s.h5")],
    ):
        assert main([*words, "--extrapolate"]) == 2
        text = "--extrapolate has no effect: the problem 'airhockey' has no parameters"
        assert text in capsys.readouterr().err
    options = LoadOptions(extrapolate=True)
    samples = tmp_path / "a.csv"
    samples.write_text("t,q1,q2,q3,q4,q5,q6\n0,0,0,0,0,0,0\n1,0,0,0,0,0,0\n")
    with is_refused(UsageError, argument="extrapolate"):
        load_trajectories(samples, "airhockey", options=options)
