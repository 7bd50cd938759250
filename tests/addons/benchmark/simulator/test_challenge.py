"""Execution in a clone of the Air Hockey Challenge's environment; a stand-in has its interface."""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.benchmark.benchmark_options import BenchmarkOptions
from cnpgen.addons.benchmark.benchmark_report import save_benchmark_report
from cnpgen.addons.benchmark.run_suite import run_benchmark
from cnpgen.addons.benchmark.simulator.challenge import _ScalarItems, challenge_plant
from cnpgen.addons.benchmark.simulator.simulate import execute_plan, simulate_plans
from cnpgen.errors import MachineError, UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.plans import Plans, save_plans
from cnpgen.refine.refine_plans import solve_plans
from tests.refusals import is_refused

pytestmark = pytest.mark.skipif(not find_spec("mujoco"), reason="needs mujoco")
CLONE = Path(__file__).parents[3] / "examples" / "challenge"


@pytest.fixture(scope="module")
def plans() -> Plans:
    return solve_plans(
        draw_boundary_problems("airhockey-pucks", 2, seed=1), workers=1
    ).plans


@pytest.mark.slow
def test_outcomes_in_the_challenge_differ_only_by_its_controller(plans: Plans) -> None:
    in_challenge, in_mujoco = (
        simulate_plans(plans, environment=CLONE, workers=1),
        simulate_plans(plans, workers=1),
    )
    assert in_challenge.plant.name == "challenge"
    for a, b in zip(in_challenge.executed, in_mujoco.executed, strict=True):
        assert a.success
        assert b.success
        assert a.hit_time == pytest.approx(b.hit_time, abs=0.005)
        assert a.puck_speed == pytest.approx(b.puck_speed, rel=0.05)
        assert 0 < a.tracking_error < 0.02
        assert a.tracking_error != b.tracking_error
        assert a.z_error == pytest.approx(b.z_error, abs=1e-4)
        assert 0.1 < a.torque_use < 1


def test_records_are_in_the_robots_frame(plans: Plans) -> None:
    execution = execute_plan(plans[0], challenge_plant(CLONE))
    scene, reference = execution.scene, execution.reference
    assert scene.puck is not None
    np.testing.assert_allclose(execution.puck[0], scene.puck, atol=1e-12)
    np.testing.assert_allclose(execution.states[0, :6], reference.q[0], atol=1e-12)
    at_the_hit = execution.tip[reference.ticks - 1]
    assert np.linalg.norm(at_the_hit - plans.columns["goal_xyz"][0]) < 0.002


def test_violated_constraints_and_penalties_are_counted(plans: Plans) -> None:
    (executed,) = simulate_plans(plans[:1], environment=CLONE, workers=1).executed
    row = executed.to_dict()
    assert (
        3 < row["joint_vel_constr_steps"] <= np.ceil(plans.duration[0] / 0.02)
    )  # steps of 20 ms, of the plan only
    assert [row[f"{name}_constr_steps"] for name in ("joint_pos", "ee", "link")] == [
        0,
        0,
        0,
    ]
    assert row["penalty_points"] == 1.0
    (elsewhere,) = simulate_plans(plans[:1], workers=1).executed
    assert not {"joint_vel_constr_steps", "penalty_points"} & elsewhere.to_dict().keys()


@pytest.mark.slow
def test_a_benchmark_executes_in_the_challenge(tmp_path: Path) -> None:
    benchmark = run_benchmark(
        "hits-81",
        tmp_path,
        planners=["cnpgen"],
        n=1,
        workers=1,
        options=BenchmarkOptions(environment=CLONE),
    )
    assert benchmark.executions == ("challenge",)
    assert benchmark.results["cnpgen"][0]["executed"]["challenge"]["success"]
    assert (
        "executed by the challenge plant"
        in save_benchmark_report(benchmark, tmp_path / "report.html").read_text()
    )


@pytest.mark.slow
def test_the_command_line_executes_in_the_challenge_and_refuses_other_folders(
    plans: Plans, tmp_path: Path
) -> None:
    save_plans(tmp_path / "plans.h5", plans[:1])

    def run(folder: Path) -> subprocess.CompletedProcess[str]:
        command = [
            sys.executable,
            "-m",
            "cnpgen",
            "simulate",
            str(tmp_path / "plans.h5"),
            "--environment",
            str(folder),
        ]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    done = run(CLONE)
    assert done.returncode == 0, done.stderr
    assert "executed by the challenge plant" in done.stdout
    refused = run(tmp_path)
    assert refused.returncode == 2
    assert "no clone of the Air Hockey Challenge" in refused.stderr
    assert "position_control_wrapper.py" in refused.stderr


ARRAYS_AS_NUMBERS = """
class AirHockeySingle:
    def __init__(self):
        import numpy as np
        np.zeros(1)[0] = [1.0, 2.0]
"""


def clone(folder: Path, **files: str) -> Path:
    """Copy the clone and replace some modules of its environments."""
    shutil.copytree(CLONE, folder)
    for name, text in files.items():
        (folder / "air_hockey_challenge" / "environments" / f"{name}.py").write_text(
            text, encoding="utf-8"
        )
    return folder


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {"position_control_wrapper": "import mushroom_rl_that_is_missing"},
            "cannot be imported",
        ),
        (
            {"position_control_wrapper": "class PositionControlIIWA: pass"},
            "has a version that cnpgen does not support",
        ),
        (
            {"iiwas": "class AirHockeyIIWA: pass"},
            "has a version that cnpgen does not support",
        ),
        (
            {"iiwas": ARRAYS_AS_NUMBERS},
            "ValueError: setting an array element with a sequence.*installed: numpy [0-9]",
        ),
    ],
)
def test_an_unusable_clone_is_reported(
    files: dict[str, str], message: str, tmp_path: Path
) -> None:
    """Use a separate process, because modules of one name are imported once."""
    folder = clone(tmp_path / "clone", **files)
    code = f"""
from cnpgen.errors import MachineError
from cnpgen.addons.benchmark.simulator.challenge import _ScalarItems, challenge_plant
try:
    challenge_plant({str(folder)!r})
except MachineError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert re.search(message, done.stdout)


def test_an_imported_clone_is_not_confused_with_another(tmp_path: Path) -> None:
    challenge_plant(CLONE)
    with is_refused(MachineError):
        challenge_plant(clone(tmp_path / "clone"))
    challenge_plant(CLONE)


def test_other_problems_than_hits_are_refused(tmp_path: Path) -> None:
    with is_refused(UsageError):
        simulate_plans(
            draw_boundary_problems("heavy-object", 1, seed=0), environment=CLONE
        )
    with is_refused(UsageError):
        run_benchmark(
            "heavy-100",
            tmp_path,
            planners=["cnpgen"],
            n=1,
            options=BenchmarkOptions(environment=CLONE),
        )


def test_items_of_one_number_are_assigned_as_numbers() -> None:
    values = np.zeros(2).view(_ScalarItems)
    values[1] = np.array([3.0])
    values[:] = values + values
    assert values.tolist() == [0.0, 6.0]
    with is_refused(ValueError):
        values[0] = np.zeros(2)


REAL_CLONE, ITS_PYTHON = (
    Path(os.environ.get(f"CNPGEN_CHALLENGE{name}", "")) for name in ("", "_PYTHON")
)
REAL = """
import json, sys
from cnpgen.addons.benchmark.run_suite import run_benchmark
done = run_benchmark("hits-81", sys.argv[2], planners=["cnpgen", "aqp"], n=9, environment=sys.argv[1], workers=1)
print(json.dumps({name: [row["executed"]["challenge"] for row in rows] for name, rows in done.results.items()}))
"""


@pytest.mark.extended
@pytest.mark.skipif(
    not (REAL_CLONE / "air_hockey_challenge").is_dir() or not ITS_PYTHON.is_file(),
    reason="CNPGEN_CHALLENGE or CNPGEN_CHALLENGE_PYTHON is not set",
)
def test_the_real_environment_separates_planners(tmp_path: Path) -> None:
    """Run in the environment's own interpreter, which has other versions of NumPy and MuJoCo."""
    command = [
        str(ITS_PYTHON),
        "-W",
        "ignore",
        "-c",
        REAL,
        str(REAL_CLONE),
        str(tmp_path),
    ]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[4])}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    executed = json.loads(done.stdout)
    assert sum(row["success"] for row in executed["cnpgen"]) == 9
    assert sum(row["scored"] for row in executed["aqp"]) < 9
    for row in (*executed["cnpgen"], *executed["aqp"]):
        assert row["hit"]
        assert row["contact_distance_mm"] < 20
        assert (
            1 < row["plane_error_mm"] < 10
        )  # the controller of the environment tracks loosely
        assert row["hit_time_s"] > 0.1
        assert {
            row[f"{name}_constr_steps"] for name in ("joint_pos", "ee", "link")
        } == {0}
        assert row["penalty_points"] == (1.0 if row["joint_vel_constr_steps"] else 0.0)
        assert (
            "table_force_n" not in row
        )  # the environment simulates no contact of mallet and table
