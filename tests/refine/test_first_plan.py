"""Time limits of the search: the first plan that the verdict accepts, and better ones until the limit."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import BSpline

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.refine import first_plan
from cnpgen.refine.first_plan import fast_rate
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.strategy import PlanChecker
from cnpgen.robots.obstacle import Obstacle
from cnpgen.scenes import SceneProblem, solve_scenes
from cnpgen.trajectory.spline import clamped_knots
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from tests.examples.narrow import BESIDE_WALL
from tests.examples.shaped_robot import SELF, write_problem
from tests.make.test_solve_scenes import LIMITS, SCENES
from tests.refusals import is_refused

FIRST = RefineOptions(time_limit=0)


@pytest.fixture
def crane(tmp_path: Path) -> Path:
    return write_problem(tmp_path, obstacles="", more=SELF + LIMITS)


def splines(control: np.ndarray, degree: int) -> list[BSpline]:
    """A spline and its first two derivatives, by SciPy."""
    spline = BSpline(clamped_knots(len(control), degree), control, degree)
    return [spline.derivative(order) if order else spline for order in range(3)]


@pytest.mark.parametrize("seed", range(5))
def test_rates_in_closed_form_reach_the_limits_and_do_not_exceed_them(
    seed: int,
) -> None:
    """Velocities and accelerations on 20,000 phases, by the chain rule with splines of SciPy."""
    random, spec = np.random.default_rng(seed), TrajectorySpec()
    path = np.cumsum(random.normal(size=(spec.path_control_points, 3)), axis=0)
    # From rest to rest: three equal control points at each end.
    path[:3], path[-3:] = path[0], path[-1]
    velocity, acceleration = random.uniform(1, 3, 3), random.uniform(5, 20, 3)
    control = fast_rate(path, velocity, acceleration, spec)
    assert control.shape == (spec.rate_control_points,)
    assert control.min() > 0
    s = np.linspace(0, 1, 20_001)
    (_, slope, curvature) = (each(s) for each in splines(path, spec.degree))
    rate, change = (each(s)[:, None] for each in splines(control, spec.degree)[:2])
    speed = np.abs(slope * rate) / velocity
    strength = np.abs(curvature * rate**2 + slope * rate * change) / acceleration
    reached = max(speed.max(), np.sqrt(strength.max()))
    # The factor is measured on 300 phases.
    assert 1 - 1e-9 <= reached < 1.02


def test_first_plans_are_valid_and_equal_in_every_run(crane: Path) -> None:
    solved = [solve_scenes(crane, SCENES, options=FIRST, workers=1) for _ in range(2)]
    usual = solve_scenes(crane, SCENES, workers=1)
    assert solved[0].valid.all()
    assert all(v.valid for v in cnpgen.evaluate_plans(solved[0].plans, workers=1).verdicts)  # fmt: skip
    assert [result.iterations for result in solved[0].results] == [0, 0, 0]
    for one, other in zip(*(each.results for each in solved), strict=True):
        np.testing.assert_array_equal(one.path, other.path)
        np.testing.assert_array_equal(one.rate, other.rate)
    # Not better than the search without a limit, and not absurdly worse.
    ratio = solved[0].plans.duration / usual.plans.duration
    assert (ratio > 1).all()
    assert (ratio < 5).all()


def test_one_tree_decides_which_of_many_goals_is_reached_first(crane: Path) -> None:
    """A wall is between the start and the eleven nearest of twelve goal states; the plan is that of its goal alone."""
    wall = Obstacle(name="wall", position=(0.55, 0.0, 0.4), size=(0.9, 0.06, 0.8))
    start, behind = BESIDE_WALL
    shifts = np.linspace([0.0, 0.0, 0.0, -0.4], [0.0, 0.1, -0.1, 0.4], 11)
    goals = np.array([*(behind + shifts), start - np.array([1.65, 0.0, 0.0, 0.0])])
    scene = SceneProblem(name="wall", obstacles=(wall,), start_q=start, goal_q=goals)
    solved = solve_scenes(crane, [scene], options=FIRST, workers=1)
    assert solved.valid.all()
    np.testing.assert_array_equal(solved.plans.boundary.goal_q, goals[-1:])
    assert cnpgen.evaluate_plans(solved.plans, workers=1).verdicts[0].valid
    for wanted in (goals[-1:], goals[5:6]):
        alone = solve_scenes(crane, [replace(scene, goal_q=wanted)], options=FIRST, workers=1)  # fmt: skip
        equal = np.array_equal(
            alone.plans.path_control_points, solved.plans.path_control_points
        )
        assert equal == np.array_equal(wanted, goals[-1:])
        assert alone.valid.all()


def test_a_long_limit_returns_the_plan_of_the_whole_search(crane: Path) -> None:
    usual = solve_scenes(crane, SCENES[:1], workers=1)
    long = solve_scenes(crane, SCENES[:1], options=RefineOptions(time_limit=1000), workers=1)  # fmt: skip
    # Closest points on hulls depend on earlier searches of the task in the last digits.
    np.testing.assert_allclose(
        long.plans.path_control_points, usual.plans.path_control_points, atol=1e-8
    )


def test_the_search_ends_with_the_first_valid_attempt_after_the_limit(
    crane: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a clock that the first judged attempt moves past the limit, one more attempt is judged at most."""
    clock, judge = [0.0], PlanChecker.strict_verdict

    def slow(self: PlanChecker, *arguments: object) -> object:
        clock[0] += 1.0
        return judge(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(PlanChecker, "strict_verdict", slow)
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    found = solve_scenes(crane, SCENES[:1], options=RefineOptions(time_limit=0.5), workers=1)  # fmt: skip
    assert found.valid.all()
    assert found.results[0].iterations == 0
    clock[0] = 0.0
    monkeypatch.setattr(first_plan, "_first_valid", lambda *_: None)
    found = solve_scenes(crane, SCENES[:1], options=RefineOptions(time_limit=0.5), workers=1)  # fmt: skip
    assert found.valid.all()
    assert found.results[0].iterations > 0


def test_an_end_in_collision_is_not_solved_with_its_reason(crane: Path) -> None:
    post = replace(SCENES[0].obstacles[0], position=(0.5, -0.6, 0.25))
    scene = SceneProblem(name="hit", obstacles=(post,), start_q=SCENES[0].start_q, goal_q=SCENES[0].goal_q)  # fmt: skip
    usual = solve_scenes(crane, [scene], workers=1)
    first = solve_scenes(crane, [scene], options=FIRST, workers=1)
    assert not usual.valid.any()
    assert first.results[0].reason == usual.results[0].reason


def test_the_first_goal_that_is_reached_ends_the_search(crane: Path) -> None:
    goals = np.add(SCENES[0].goal_q, [[0.3, 0, 0, 0], [0, 0, 0, 0]])
    scene = replace(SCENES[0], goal_q=goals)
    for options in (RefineOptions(), FIRST):
        found = solve_scenes(crane, [scene], options=options, workers=1)
        assert found.valid.all()
        assert np.abs(found.plans.boundary.goal_q[0] - goals).max(axis=1).min() < 1e-9


def test_motions_with_moving_goals_end_with_the_first_valid_attempt() -> None:
    problems = cnpgen.draw_boundary_problems("airhockey-hit", 2, seed=3)
    refinement = cnpgen.solve_plans(problems, options=FIRST, workers=1)
    assert refinement.valid.all()


def test_the_command_and_its_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plans.h5"
    command = ["solve", "airhockey-hit", "--n", "1", "--workers", "1", "-o", str(out)]
    assert main([*command, "--time-limit", "0"]) == 0
    assert cnpgen.evaluate_plans(cnpgen.load_plans(out), workers=1).valid.all()
    assert main([*command, "--time-limit", "-1"]) == 2
    assert main([*command, "--time-limit", "0", "--deadline", "9ms", "--force"]) == 2
    assert "choose one" in capsys.readouterr().err
    with is_refused(UsageError, argument="time_limit"):
        RefineOptions(time_limit=-1.0)
