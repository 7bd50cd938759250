"""Initial guesses: rising rates of hits, bounded speeds, and input plans from which no attempt succeeds."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.refine import attempts, initial_guesses
from cnpgen.refine.grid_levels import GridLevel
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_engine import prepare, tasks_of
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver import sqp
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.solver.sqp import Result
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Attempt, Outcome, RefinementTask
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.example_robots import folder as robots
from tests.examples.example_robots import needs_robots
from tests.examples.plans import PROBLEMS, ROBOTS, load
from tests.examples.refiner import refiner, task, verdict
from tests.refine.test_long_motions import long_task

TIP_SPEED = """
[[constraint]]
use = "tip-speed"
limit = "0.25 m/s"
tolerance = "0.5 cm/s"
"""


def solve(label: str) -> tuple[Attempt, float, float]:
    """Solve without input plan; return the plan, its duration [s] and its largest jerk in multiples of the limit."""
    plan = load(label)
    tool, checker = (
        refiner(plan.problem.name),
        PlanChecker(plan.problem, plan.robot, degree=7),
    )
    found = refine_task(tool, checker, task(plan))
    jerk = verdict(plan, plan.boundary, found.path, found.rate).metrics.jerk
    return found, float(Motion(found.path[None], found.rate[None]).duration()[0]), jerk


def test_a_hit_from_a_rising_line_has_less_jerk_and_is_as_fast(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found, duration, jerk = solve("hit")
    monkeypatch.setattr(initial_guesses, "rising_line", initial_guesses.straight_line)
    before, straight, harsh = solve("hit")
    assert found.valid
    assert before.valid
    assert jerk < 0.8 * harsh
    assert duration < 1.002 * straight


@pytest.mark.parametrize(
    ("label", "rises"), [("hit", True), ("replan", False), ("transport", False)]
)
def test_only_motions_from_rest_that_arrive_moving_start_with_a_rising_rate(
    label: str, rises: bool
) -> None:
    plan = load(label)
    arguments = plan.boundary, plan.robot.velocity_limit, plan.problem.trajectory
    (path, rate), (straight, constant) = (
        initial_guesses.rising_line(*arguments),
        initial_guesses.straight_line(*arguments),
    )
    np.testing.assert_array_equal(path, straight)
    assert rate[-1] == constant[-1]
    assert (rate[0] < 0.5 * constant[0]) == rises
    assert (np.diff(rate) >= 0).all()


@pytest.mark.slow
def test_a_stalled_level_continues_with_a_higher_penalty_where_violations_are_profitable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tool, problem = refiner("heavy-object"), long_task()
    penalties: list[float] = []

    def stuck(iterate: sqp._Iterate) -> bool:
        penalties.append(iterate._penalty)
        return iterate._penalty < iterate.cost or len(penalties) > 6

    monkeypatch.setattr(sqp._Iterate, "_is_stuck", stuck)
    result = tool.run_level(problem, tool.levels.coarse, tool.line_guess(problem))
    assert result.converged
    assert result.iterations > 2
    assert penalties[0] == sqp.Settings().penalty
    assert penalties[-1] > sqp.PENALTY_FACTOR


def test_a_level_does_not_stall_if_its_initial_guess_violated_less_than_later_iterates() -> (
    None
):
    problems = draw_boundary_problems("airhockey-replan", 96, seed=20266)
    plans = Planner("airhockey-replan").plan_batch(problems.boundary)
    tool = prepare(plans, RefineOptions())
    for problem in (tasks_of(plans)[row] for row in (22, 37, 53)):
        x = tool.input_variables(problem)
        assert x is not None
        assert (
            tool.run_level(problem, tool.levels.warm, x).violation
            < sqp.DEFAULT_SETTINGS.violation_tolerance
        )


def test_if_all_attempts_from_an_input_plan_fail_the_straight_line_is_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan, tool = load("transport"), refiner("heavy-object")
    run_level = Refiner.run_level
    wrong = plan.motion.path[0] + np.pi
    is_coarse: list[bool] = []

    def misleading(
        self: Refiner,
        problem: RefinementTask,
        level: GridLevel,
        x: np.ndarray,
        hulls: Hulls | None = None,
    ) -> Result:
        """Return the initial guess until the straight line is tried."""
        is_coarse.append(level is self.levels.coarse)
        return (
            run_level(self, problem, level, x, hulls)
            if any(is_coarse)
            else Result(x, 0.0, 1.0, 1, True)
        )

    def none(*_: object) -> Iterator[None]:
        yield from ()

    monkeypatch.setattr(Refiner, "run_level", misleading)
    monkeypatch.setattr(attempts, "_from_other_guesses", none)
    problem = task(plan, path=wrong, rate=plan.motion.rate[0])
    found = refine_task(
        tool,
        PlanChecker(PROBLEMS["heavy-object"], ROBOTS["heavy-object"], degree=7),
        problem,
    )
    assert tool.levels.warm is not tool.levels.coarse
    assert is_coarse[0] is False
    assert found.valid
    assert found.outcome is Outcome.RESTARTED


@pytest.mark.parametrize(
    "ends",
    [
        [
            [0.0186, 1.4355, -1.05, -1.2516, -0.8038, 0.7892, -2.4982],
            [-0.1777, 1.892, 1.647, -1.4845, -0.5815, 0.1759, 0.2585],
        ],
        pytest.param(
            [
                [-0.6113, 1.1158, -0.1419, -0.6555, -1.3717, 1.9079, -2.9349],
                [-0.7075, 1.1233, 1.3434, -1.91, 0.8258, 0.6802, -0.5628],
            ],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_transport_that_no_guess_solves_is_solved_from_the_best_attempt(
    ends: list[list[float]],
) -> None:
    start, goal, rest = np.array(ends[:1]), np.array(ends[1:]), np.zeros((1, 7))
    plans = cnpgen.make_plans(
        "heavy-object",
        cnpgen.Boundary(start, rest, rest, goal, rest),
        path_control_points=np.full((1, 15, 7), np.nan),
        rate_control_points=np.ones((1, 20)),
    )
    checker = PlanChecker(PROBLEMS["heavy-object"], ROBOTS["heavy-object"], degree=7)
    assert refine_task(refiner("heavy-object"), checker, *tasks_of(plans)).valid


@needs_robots
@pytest.mark.extended  # the kernels of a UR5 in its real shape take half a minute to compile
@pytest.mark.parametrize("seed", [0, 1])
def test_a_ur5_with_a_slow_tip_solves_all_of_20_problems(
    tmp_path: Path, seed: int
) -> None:
    urdf = f"{robots()}/example-robot-data/robots/ur_description/urdf/ur5_joint_limited_robot.urdf"
    assert main(["init", str(tmp_path / "ur5"), "--urdf", urdf, "--tip", "tool0"]) == 0
    with (tmp_path / "ur5" / "problem.toml").open("a", encoding="utf-8") as file:
        file.write(TIP_SPEED)
    problems = draw_boundary_problems(tmp_path / "ur5" / "pipeline.toml", 20, seed=seed)
    found = cnpgen.solve_plans(problems, workers=1)
    assert found.valid.all()
    chord = (
        np.linalg.norm(
            problems.columns["goal_xyz"] - problems.columns["start_xyz"], axis=1
        )
        / 0.25
    )
    assert np.mean(found.plans.duration / chord) < 1.12
