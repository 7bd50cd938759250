"""Plans imported from samples: they follow the samples, meet the constraints at their ends, and can be refined."""

import re
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.trajectories import import_trajectories as import_module
from cnpgen.addons.trajectories.import_trajectories import StateSnapper
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans import Plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.exporter import sample_plan
from cnpgen.trajectories import Trajectory, import_trajectories, largest_error
from tests.examples.plan_files import plans_of
from tests.examples.plans import PROBLEMS, ROBOTS, load
from tests.refusals import assert_said, is_refused


def positions(plans: Plans, rate: float, noise: float = 0.0) -> Trajectory:
    plan = sample_plan(plans.motion, rate)
    return Trajectory(
        plan.t, plan.q + noise * np.random.default_rng(0).uniform(-1, 1, plan.q.shape)
    )


@pytest.mark.parametrize(("rate", "noise"), [(100, 0.0), (30, 0.0), (100, 1e-3)])
@pytest.mark.parametrize("label", ["hit", "transport"])
def test_imported_positions_are_valid_after_refining(
    label: str, rate: float, noise: float
) -> None:
    original = plans_of(load(label))
    trajectory = positions(original, rate, noise)
    imported = import_trajectories(original.problem, [trajectory], noise=noise)
    assert imported.deviation[0] == pytest.approx(
        largest_error(imported.plans.motion, trajectory.t, trajectory.q)
    )
    assert imported.deviation[0] < 2e-3 + 2 * noise
    assert imported.snapped[0] <= max(1e-3, 3 * noise)
    assert (
        np.abs(imported.plans.boundary.start_q - original.boundary.start_q).max()
        < 1e-3 + 3 * noise
    )
    refined = cnpgen.refine_plans(imported.plans, workers=1).plans
    verdict = cnpgen.evaluate_plans(refined, workers=1).verdicts[0]
    assert verdict.valid, verdict


def test_given_derivatives_are_the_boundary_conditions() -> None:
    original = plans_of(load("replan"))
    plan = sample_plan(original.motion, 500)
    imported = import_trajectories(
        original.problem, [Trajectory(plan.t, plan.q, plan.dq, plan.ddq)]
    )
    for name in ("start_q", "start_dq", "goal_q", "goal_dq"):
        found, expected = (
            getattr(imported.plans.boundary, name),
            getattr(original.boundary, name),
        )
        assert np.allclose(found, expected, atol=1e-5), name
    assert np.allclose(
        imported.plans.boundary.start_ddq, original.boundary.start_ddq, atol=1e-2
    )


def test_a_motion_at_rest_at_its_ends() -> None:
    original = plans_of(load("hit"))
    imported = import_trajectories(
        original.problem, [positions(original, 100)], at_rest=True
    )
    boundary = imported.plans.boundary
    assert not any(
        part.any() for part in (boundary.start_dq, boundary.start_ddq, boundary.goal_dq)
    )
    known = original.boundary.goal_dq
    boundary = import_trajectories(
        original.problem, [positions(original, 100)], at_rest="start"
    ).plans.boundary
    assert not any(part.any() for part in (boundary.start_dq, boundary.start_ddq))
    assert np.abs(boundary.goal_dq - known).max() < 0.1 < np.abs(known).max()
    boundary = import_trajectories(
        original.problem, [positions(original, 100)], at_rest="goal"
    ).plans.boundary
    assert not boundary.goal_dq.any()


def test_a_state_is_moved_onto_the_manifold_and_into_the_limits() -> None:
    plan = load("hit")
    problem, robot = PROBLEMS["airhockey"], ROBOTS["airhockey"]
    snapper, n = StateSnapper(problem, robot), robot.n
    q = plan.boundary.goal_q[0] + 1e-3 * np.array([1, -1, 1, 1, -1, 1])
    dq = np.append(1.1 * robot.velocity_limit[0], 0.2 * np.ones(n - 1))
    q, dq, _ = snapper((q, dq, 3.0 * np.ones(n)), "goal")
    model = cnpgen.RobotModel(problem)
    jacobian = model.jacobian(q[None])[0]
    assert abs(model.forward_kinematics(q[None])[0][0, 2] - 0.16) < 1e-8
    assert abs(jacobian[2] @ dq) < 1e-7
    assert (np.abs(dq) <= robot.velocity_limit).all()
    assert np.abs(q - plan.boundary.goal_q[0]).max() < 3e-3


def test_estimated_accelerations_outside_the_limits_do_not_prevent_the_import() -> None:
    original = plans_of(load("hit"))
    trajectory = positions(original, 100)
    jolted = trajectory.q + 2e-3 * np.exp(-trajectory.t / 0.02)[:, None] * np.array(
        [1, -1, 1, -1, 1, -1]
    )
    imported = import_trajectories(
        original.problem, [Trajectory(trajectory.t, jolted)], noise=2e-3
    )
    limit = ROBOTS["airhockey"].acceleration_limit
    assert imported.snapped[0] <= 6e-3
    assert (np.abs(imported.plans.boundary.start_ddq) <= limit * (1 + 1e-9)).all()


def test_samples_far_from_the_manifold_keep_their_ends() -> None:
    original = plans_of(load("hit"))
    trajectory = positions(original, 100)
    lifted = Trajectory(trajectory.t, trajectory.q + np.eye(6)[1] * -0.2)
    imported = import_trajectories(original.problem, [lifted])
    assert np.isnan(imported.snapped[0])
    assert np.allclose(imported.plans.boundary.start_q[0], lifted.q[0])


def test_the_number_of_control_points_grows_with_the_detail_of_the_samples() -> None:
    t = np.linspace(0, 4, 400)
    base = np.array(PROBLEMS["airhockey"].robot.base)
    smooth = Trajectory(t, base + 0.1 * (1 - np.cos(np.pi * t / 4))[:, None])
    detailed = Trajectory(t, base + 0.1 * (1 - np.cos(5 * np.pi * t / 2))[:, None])
    points = [
        import_trajectories("airhockey", [each]).plans.path_control_points.shape[1]
        for each in (smooth, detailed)
    ]
    assert points[0] == 15 < points[1]


def scan(strokes: int) -> Trajectory:
    """A scan of 20 s at rest at both ends."""
    t = np.arange(2001) / 100
    q = np.tile([-0.3, 0.6975, 0, -0.5049, 0, 1.9286], (len(t), 1))
    q[:, 0] += 0.25 * (1 - np.cos(2 * np.pi * t * strokes / 20))
    return Trajectory(t, q)


@pytest.mark.slow
def test_a_long_scan_gets_as_many_control_points_as_it_needs() -> None:
    imported = import_trajectories("airhockey", [scan(20)], at_rest=True)
    assert imported.meets_samples.all()
    assert imported.deviation[0] <= imported.max_deviation == 2e-3
    assert imported.plans.path_control_points.shape[1] > 39


def test_a_path_that_no_number_of_control_points_meets_is_named_with_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(import_module, "MAX_CONTROL_POINTS", 24)
    trajectory, file = scan(20), tmp_path / "scan.csv"
    rows = np.column_stack([trajectory.t, trajectory.q])
    names = ",".join(["t", *(f"q{k}" for k in range(1, 7))])
    np.savetxt(file, rows, delimiter=",", header=names, comments="")
    out = str(tmp_path / "scan.h5")
    words = ["import", str(file), "--problem", "airhockey", "--at-rest", "-o", out]
    assert main([*words, "--stay-within", "2deg"]) == 1
    text = capsys.readouterr().err
    assert re.search(r"plan 0: 0\.\d+ rad from its samples, more than 0\.002 rad", text)
    assert "refined" not in text


def test_no_trajectories_and_other_numbers_of_joints_are_refused() -> None:
    with is_refused(UsageError, argument="trajectories"):
        import_trajectories("airhockey", [])
    with is_refused(UsageError, argument="trajectories"):
        import_trajectories(
            "airhockey", [Trajectory(np.array([0.0, 1.0]), np.zeros((2, 2)))]
        )


def test_the_command_writes_a_plan_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export_plans(
        plans_of(load("hit"), load("hit")), tmp_path / "out", to="csv", rate=200
    )
    out = tmp_path / "plans.h5"
    words = ["import", str(tmp_path / "out"), "--problem", "airhockey", "-o", str(out)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert captured.out.strip() == str(out)
    assert "imported 2 plans with 15 control points" in captured.err
    plans = cnpgen.load_plans(out)
    assert plans.source == "imported from out"
    assert main(words) == 2
    assert_said(capsys.readouterr().err)
    assert main([*words, "--force"]) == 0


@pytest.mark.slow
def test_refining_stays_within_a_distance_of_the_imported_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check a motion whose first joint turns away and back: without the bound, the refiner leaves its path."""
    original = plans_of(load("hit"))
    turned = original.path_control_points.copy()
    turned[:, 6:9, 0] += (
        0.1  # joint 1 turns about the vertical, so that the tip stays on the table
    )
    slow = cnpgen.make_plans(
        original.problem,
        original.boundary,
        path_control_points=turned,
        rate_control_points=original.rate_control_points,
    )
    export_plans(slow, tmp_path / "slow", to="csv", rate=200)
    words = [
        "import",
        str(tmp_path / "slow"),
        "--problem",
        "airhockey",
        "-o",
        str(tmp_path / "plans.h5"),
    ]
    assert main([*words, "--stay-within", "1deg"]) == 0
    assert (
        "1 of 1 valid, at most 0.017 rad from the imported samples"
        in capsys.readouterr().err
    )
    near = cnpgen.load_plans(tmp_path / "plans.h5")
    assert cnpgen.evaluate_plans(near, workers=1).valid.all()
    imported = import_trajectories(original.problem, [positions(slow, 200)])
    free = cnpgen.refine_plans(imported.plans, workers=1)
    assert free.valid.all()
    assert free.deviation.max() > np.deg2rad(1)
