"""Values in degrees or millimetres are refused with a suggestion, in tasks, hits and boundary files."""

from pathlib import Path
from unittest.mock import ANY

import h5py
import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.robots.plausible_values import (
    UnitError,
    check_plausible,
    find_implausible_value,
)
from tests.examples.plans import ROBOTS
from tests.refusals import is_refused


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"hit_angle": 15.0}, r"hit_angle must be from -6.28 to 6.28 rad, got 15 rad in task 0; 15 rad is 859 deg;"
         r" did you mean 15 deg = 0.262 rad\?"),
        ({"goal_xyz": [1000.0, 100.0]}, r"goal_xyz must .* m, got 1000 m in task 0; did you mean 1000 mm = 1 m\?"),
        ({"start_q": np.rad2deg}, r"start_q .* in task 0 of joint_2; .* did you mean 39.9\d+ deg = 0.69\d rad\?"),
        ({"start_q": np.array, "start_dq": [90.0] * 6, "start_ddq": [0.0] * 6}, r"start_dq .* 90 deg/s = 1.57 rad/s\?"),
        ({"hit_speed": 2000.0}, r"hit_speed .* m/s, got 2000 m/s in task 0; did you mean 2000 mm/s = 2 m/s\?"),
    ],
)  # fmt: skip
def test_tasks_in_other_units_are_refused_with_a_suggestion(
    columns: dict[str, object], message: str
) -> None:
    recipe = "airhockey-replan" if "start_dq" in columns else "airhockey-hit"
    home = ROBOTS["airhockey"].home
    given = {
        name: each(home) if callable(each) else each for name, each in columns.items()
    }
    task = {"goal_xyz": [1.0, 0.1], "hit_angle": 0.1, **given}
    with pytest.raises(UnitError, match=message) as caught:
        cnpgen.complete(recipe, **task)
    assert caught.value.argument in columns
    assert caught.value.exit_code == 2


def test_a_table_in_degrees_ends_with_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tasks.csv").write_text(
        "goal_xyz.x,goal_xyz.y,hit_angle\n1.0,0.1,0.2\n1.0,0.1,15\n"
    )
    assert (
        main(
            [
                "complete",
                "airhockey-hit",
                str(tmp_path / "tasks.csv"),
                "-o",
                str(tmp_path / "a.h5"),
            ]
        )
        == 2
    )
    error = capsys.readouterr().err
    assert "got 15 rad in task 1" in error
    assert "did you mean 15 deg = 0.262 rad?" in error
    assert not (tmp_path / "a.h5").exists()


@pytest.fixture
def in_degrees(tmp_path: Path) -> Path:
    path, home = tmp_path / "degrees.h5", ROBOTS["airhockey"].home
    with h5py.File(path, "w") as file:
        file["start_q"], file["goal_q"] = (
            np.rad2deg(home)[None],
            np.rad2deg(home + 0.1)[None],
        )
    return path


def test_boundary_files_in_degrees_are_refused_unless_large_angles_are_allowed(
    in_degrees: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with is_refused(UnitError, argument="start_q"):
        cnpgen.load_boundary_problems(in_degrees, problem="airhockey")
    with pytest.warns(UserWarning, match=r"did you mean .* deg = "):
        plans = cnpgen.load_boundary_problems(
            in_degrees, problem="airhockey", allow_large_angles=True
        )
    np.testing.assert_allclose(
        plans.boundary.start_q[0], np.rad2deg(ROBOTS["airhockey"].home)
    )
    out = str(in_degrees.with_name("plans.h5"))
    for command in (
        ["solve", "--problem", "airhockey"],
        ["plan", "--model", "airhockey-hit"],
    ):
        assert main([command[0], str(in_degrees), *command[1:], "-o", out]) == 2
        assert "--allow-large-angles accepts such values" in capsys.readouterr().err


def test_hits_in_millimetres_are_refused() -> None:
    planner = cnpgen.Planner("airhockey-hit")
    state = (ROBOTS["airhockey"].home, np.zeros(6), np.zeros(6))
    for wrong in ({"puck": [1000.0, 100.0]}, {"target": [2400.0, 0.0]}):
        with is_refused(UnitError, argument=ANY) as caught:
            cnpgen.plan_hits(
                planner, state, **{"puck": [1.0, 0.1], "target": [2.4, 0.0], **wrong}
            )
        assert caught.value.argument in wrong


def test_valid_limits_and_moderate_violations_are_plausible() -> None:
    low, high = ROBOTS["airhockey"].position_lower, ROBOTS["airhockey"].position_upper
    for values in (low, high, low - 0.4 * (high - low)):
        assert (
            find_implausible_value(ROBOTS["airhockey"], "start_q", values[None], "rad")
            is None
        )
    check_plausible(
        ROBOTS["airhockey"],
        {"start_dq": 3 * ROBOTS["airhockey"].velocity_limit[None]},
        {"start_dq": "rad/s"},
        noun="plan",
    )
    assert (
        find_implausible_value(
            ROBOTS["airhockey"], "goal_q", np.full((1, 6), np.nan), "rad"
        )
        is None
    )
    assert (
        find_implausible_value(
            ROBOTS["airhockey"], "hit_speed_share", np.full((1, 1), 1e9), "1"
        )
        is None
    )
