"""An arm of which joints slide and others turn: every number of a joint has its own unit, wherever it is shown."""

import csv
from pathlib import Path

import h5py
import numpy as np
import pytest

import cnpgen
from cnpgen.addons.manual.describe import describe_problem, recipe_to_dict, with_units
from cnpgen.judges.plans.judge import judge
from cnpgen.kernels.library import problem_kernels
from cnpgen.loader.dataset import make_frame
from cnpgen.pipelines.stages.stage import Context
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.refine.initial_guesses import straight_line
from cnpgen.robots.plausible_values import UnitError
from cnpgen.store.field import Field
from cnpgen.trajectory.boundary import Boundary
from tests.problems.test_constraints import gantry_problem
from tests.refusals import is_refused

JOINTS = ["slide_x", "slide_y", "slide_z", "turn", "lean"]


@pytest.fixture(scope="module")
def gantry(tmp_path_factory: pytest.TempPathFactory) -> Problem:
    return gantry_problem(tmp_path_factory.mktemp("gantry"))


@pytest.fixture(scope="module")
def plans(gantry: Problem) -> Plans:
    """A motion along x that is faster than its joint may be, and begins with another velocity than it should."""
    robot, rest, goal = (
        load_robot(gantry),
        np.zeros((1, 5)),
        np.array([[0.8, 0.0, 0.0, 0.1, 0.0]]),
    )
    path, rate = straight_line(
        Boundary(rest, rest, rest, goal, rest), robot.velocity_limit, gantry.trajectory
    )
    control = np.concatenate(
        [np.repeat(rest, 3, axis=0), path, np.repeat(goal, 2, axis=0)]
    )
    asked = Boundary(rest, np.array([[0.0, 0.1, 0.0, 0.0, 0.0]]), rest, goal, rest)
    return make_plans(
        gantry,
        asked,
        path_control_points=control[None],
        rate_control_points=3 * rate[None],
    )


def test_limits_are_shown_with_the_unit_of_each_joint(gantry: Problem) -> None:
    lines = [line.split() for line in describe_problem(gantry).splitlines()]
    sliding, turning = (
        next(line for line in lines if line[:1] == [name])
        for name in ("slide_y", "lean")
    )
    assert " ".join(sliding[1:]) == "-1 to 1 m 1 m/s 10 m/s^2 200 N 0 m"
    assert " ".join(turning[1:]) == "-1 to 1 rad 1 rad/s 10 rad/s^2 200 N m 0 rad"
    limits = recipe_to_dict(gantry)["limits"]
    assert limits["torque_limit"]["unit"] == "N, N, N, N m, N m"


def test_joints_of_one_kind_have_one_unit_above_them() -> None:
    assert with_units("m/s", ["1", "2"]) == ("[m/s]", "1", "2")
    assert with_units("m/s, rad/s", ["1", "2"]) == ("", "1 m/s", "2 rad/s")


def test_a_verdict_speaks_of_a_joint_in_its_unit(gantry: Problem, plans: Plans) -> None:
    ends = plans.scene, plans.columns["goal_xyz"]
    found = judge(gantry, load_robot(gantry), plans.motion, plans.boundary, *ends)[
        0
    ].margins
    units = {
        name: (found[f"joint {name}"].part, found[f"joint {name}"].unit)
        for name in ("velocity", "acceleration")
    }
    assert units == {
        "velocity": ("slide_x", "m/s"),
        "acceleration": ("slide_x", "m/s^2"),
    }
    assert (found["boundary velocity"].part, found["boundary velocity"].unit) == (
        "slide_y",
        "m/s",
    )


def test_fields_of_datasets_have_the_unit_of_every_column(
    gantry: Problem, tmp_path: Path
) -> None:
    robot = load_robot(gantry)
    context = Context(gantry, robot, problem_kernels(gantry, robot, "numpy", tmp_path))
    field = context.joint_field("start_dq", "rad/s", "joint velocities at the start")
    assert field.unit == "m/s, m/s, m/s, rad/s, rad/s"
    assert field.units == ("m/s",) * 3 + ("rad/s",) * 2


def test_frames_of_pandas_know_the_unit_of_every_column() -> None:
    pytest.importorskip("pandas")
    field = Field(
        "start_dq", "m/s, m/s, m/s, rad/s, rad/s", "joint velocities", 5, tuple(JOINTS)
    )
    frame = make_frame({"start_dq": np.zeros((2, 5))}, [field], library="pandas")
    assert frame.attrs["units"]["start_dq.slide_z"] == "m/s"
    assert frame.attrs["units"]["start_dq.turn"] == "rad/s"


def test_files_of_plans_and_tables_have_the_units_of_their_joints(
    plans: Plans, tmp_path: Path
) -> None:
    cnpgen.save_plans(tmp_path / "plans.h5", plans)
    with h5py.File(tmp_path / "plans.h5") as file:
        assert file["start_q"].attrs["units"].decode() == "m, m, m, rad, rad"
        assert (
            file["path_control_points"].attrs["units"].decode() == "m, m, m, rad, rad"
        )
    cnpgen.export_plans(plans, tmp_path / "tables", to="csv", rate=100)
    with (tmp_path / "tables" / "plan_00000.csv").open(newline="") as file:
        head = next(csv.reader(file))
    assert head[1:6] == [
        f"q {name} [{'rad' if name in {'turn', 'lean'} else 'm'}]" for name in JOINTS
    ]
    assert head[11:13] == ["ddq slide_x [m/s^2]", "ddq slide_y [m/s^2]"]


def test_a_position_far_outside_the_limits_of_a_sliding_joint_is_perhaps_in_millimetres(
    gantry: Problem,
) -> None:
    rest, goal = np.zeros((1, 5)), np.array([[0.0, 800.0, 0.0, 0.0, 0.0]])
    with is_refused(UnitError, argument="boundary"):
        make_plans(
            gantry,
            Boundary(rest, rest, rest, goal, rest),
            path_control_points=np.zeros((1, 15, 5)),
            rate_control_points=np.ones((1, 20)),
        )
