"""Where the optimiser starts from: hits that set off gently, speeds that are bounded, plans that lead astray."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.make.boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.refine.engine import prepare, tasks_of
from cnpgen.refine.jury import Jury
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.passes import Pass
from cnpgen.refine.polish import refine_task
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver import sqp, starts
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.solver.sqp import Result
from cnpgen.refine.task import Outcome, Refined, Task
from cnpgen.trajectory.motion import Motion
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


def from_nothing(label: str) -> tuple[Refined, float, float]:
    """A plan from nothing, its duration [s], and its largest jerk in multiples of the limit."""
    plan = load(label)
    tool, jury = refiner(plan.problem.name), Jury(plan.problem, plan.robot, degree=7)
    found = refine_task(tool, jury, task(plan))
    jerk = verdict(plan, plan.boundary, found.path, found.rate).metrics.jerk
    return found, float(Motion(found.path[None], found.rate[None]).duration()[0]), jerk


def test_a_hit_that_is_found_from_a_gentle_start_has_less_jerk_and_is_as_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    found, duration, jerk = from_nothing("hit")
    monkeypatch.setattr(starts, "gentle", starts.straight)
    before, straight, harsh = from_nothing("hit")
    assert found.valid
    assert before.valid
    assert jerk < 0.8 * harsh
    assert duration < 1.002 * straight


@pytest.mark.parametrize(("label", "rises"), [("hit", True), ("replan", False), ("transport", False)])
def test_only_motions_that_set_off_from_rest_and_arrive_moving_start_gently(label: str, rises: bool) -> None:
    plan = load(label)
    given = plan.boundary, plan.robot.velocity_limit, plan.problem.trajectory
    (path, rate), (straight, constant) = starts.gentle(*given), starts.straight(*given)
    np.testing.assert_array_equal(path, straight)
    assert rate[-1] == constant[-1]
    assert (rate[0] < 0.5 * constant[0]) == rises
    assert (np.diff(rate) >= 0).all()


@pytest.mark.slow
def test_a_pass_that_is_stuck_where_breaking_limits_pays_goes_on_with_heavier_violations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tool, asked = refiner("heavy-object"), long_task()
    penalties: list[float] = []

    def stuck(descent: sqp._Descent) -> bool:
        penalties.append(descent._penalty)
        return descent._penalty < descent.cost or len(penalties) > 6

    monkeypatch.setattr(sqp._Descent, "_is_stuck", stuck)
    result = tool.minimise(asked, tool.passes.first, tool.straight(asked))
    assert result.ended
    assert result.iterations > 2
    assert penalties[0] == sqp.Settings().penalty
    assert penalties[-1] > sqp.HEAVY


def test_a_pass_does_not_give_up_since_its_start_violated_less_than_what_it_leads_to() -> None:
    problems = draw_boundary_problems("airhockey-replan", 96, seed=20266)
    plans = Planner("airhockey-replan").plan_batch(problems.boundary)
    tool = prepare(plans, RefineOptions())
    for given in (tasks_of(plans)[row] for row in (22, 37, 53)):
        x = tool.given(given)
        assert x is not None
        assert tool.minimise(given, tool.passes.given, x).violation < sqp.DEFAULT.violation_tolerance


def test_where_a_given_plan_leads_all_attempts_astray_one_is_made_from_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    plan, tool = load("transport"), refiner("heavy-object")
    minimise, given = Refiner.minimise, tool.passes.given
    wrong = plan.motion.path[0] + np.pi
    begun: list[bool] = []

    def astray(self: Refiner, asked: Task, which: Pass, x: np.ndarray, hulls: Hulls | None = None) -> Result:
        """Stay where the given plan is, until the straight line has its turn."""
        begun.append(which is self.passes.first)
        return minimise(self, asked, which, x, hulls) if any(begun) else Result(x, 0.0, 1.0, 1, True)

    def none(*_: object) -> Iterator[None]:
        yield from ()

    monkeypatch.setattr(Refiner, "minimise", astray)
    monkeypatch.setattr(Refiner, "_from_others", none)
    asked = task(plan, path=wrong, rate=plan.motion.rate[0])
    found = refine_task(tool, Jury(PROBLEMS["heavy-object"], ROBOTS["heavy-object"], degree=7), asked)
    assert given is not tool.passes.first
    assert begun[0] is False
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
def test_a_transport_that_no_start_solves_is_solved_by_going_on_from_the_best_attempt(ends: list[list[float]]) -> None:
    start, goal, rest = np.array(ends[:1]), np.array(ends[1:]), np.zeros((1, 7))
    plans = cnpgen.make_plans(
        "heavy-object",
        cnpgen.Boundary(start, rest, rest, goal, rest),
        path_control_points=np.full((1, 15, 7), np.nan),
        rate_control_points=np.ones((1, 20)),
    )
    jury = Jury(PROBLEMS["heavy-object"], ROBOTS["heavy-object"], degree=7)
    assert refine_task(refiner("heavy-object"), jury, *tasks_of(plans)).valid


@needs_robots
@pytest.mark.extended  # the kernels of a UR5 in its real shape take half a minute to compile
@pytest.mark.parametrize("seed", [0, 1])
def test_a_ur5_whose_tip_may_only_be_slow_finds_all_of_20_motions(tmp_path: Path, seed: int) -> None:
    urdf = f"{robots()}/example-robot-data/robots/ur_description/urdf/ur5_joint_limited_robot.urdf"
    assert main(["init", str(tmp_path / "ur5"), "--urdf", urdf, "--tip", "tool0"]) == 0
    with (tmp_path / "ur5" / "problem.toml").open("a", encoding="utf-8") as file:
        file.write(TIP_SPEED)
    problems = draw_boundary_problems(tmp_path / "ur5" / "pipeline.toml", 20, seed=seed)
    found = cnpgen.solve_plans(problems, workers=1)
    assert found.valid.all()
    chord = np.linalg.norm(problems.columns["goal_xyz"] - problems.columns["start_xyz"], axis=1) / 0.25
    assert np.mean(found.plans.duration / chord) < 1.12
