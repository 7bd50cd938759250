"""Check of the ends: the same after other motions, once per task, and only where an attempt was rejected."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.proof.end_check import EndCheck
from cnpgen.refine.strategy import RefinementSearch
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from tests.examples.plans import Plan, load
from tests.examples.refiner import refine
from tests.examples.shaped_robot import write_problem

LABELS = ("hit", "replan", "transport")


def texts(check: EndCheck, plan: Plan, boundary: Boundary) -> list[str]:
    return [text for _, text in check.violations(boundary, plan.scene)]


@pytest.mark.parametrize("label", LABELS)
def test_a_check_that_was_used_before_finds_the_same_as_a_new_one(label: str) -> None:
    plan, random = load(label), np.random.default_rng(5)
    kept = EndCheck(plan.problem, plan.robot)
    found = 0
    for size in (0.0, 0.3, 0.0, 1.0, 3.0):
        q = plan.boundary.start_q + size * random.normal(
            size=plan.boundary.start_q.shape
        )
        boundary = replace(plan.boundary, start_q=q)
        expected = texts(EndCheck(plan.problem, plan.robot), plan, boundary)
        assert texts(kept, plan, boundary) == expected
        # a caller may stop at the first violation
        assert [
            text for text, _ in zip(texts(kept, plan, boundary), "1", strict=False)
        ] == expected[:1]
        found += len(expected)
        assert size > 0 or not expected
    assert found


@pytest.mark.parametrize("label", LABELS)
def test_a_task_whose_first_attempt_is_accepted_does_not_measure_its_ends(
    label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("the ends were measured")

    monkeypatch.setattr(EndCheck, "violations", fail)
    assert refine(load(label)).valid


@pytest.mark.parametrize("label", LABELS)
def test_invalid_ends_cost_one_attempt_and_one_check(
    label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = load(label)
    faster = 1.02 * plan.robot.velocity_limit[None]
    judged, measured = list[Attempt](), list[str]()
    add, violations = RefinementSearch.add, EndCheck.violations
    monkeypatch.setattr(
        RefinementSearch,
        "add",
        lambda search, attempt: judged.append(attempt) or add(search, attempt),
    )
    monkeypatch.setattr(
        EndCheck,
        "violations",
        lambda check, *ends: measured.append("") or violations(check, *ends),
    )
    found = refine(plan, replace(plan.boundary, start_dq=faster))
    assert (found.outcome, found.reason) == (Outcome.UNSOLVED, "joint velocity limit")
    assert (len(judged), len(measured)) == (1, 1)


def test_a_held_object_in_collision_at_an_end_is_named_with_end_and_link() -> None:
    plan, (lower, upper) = load("transport"), limits("transport")
    check, random = EndCheck(plan.problem, plan.robot), np.random.default_rng(2)
    for _ in range(200):
        boundary = replace(plan.boundary, goal_q=random.uniform(lower, upper)[None])
        found = {
            constraint.reason: text
            for constraint, text in check.violations(boundary, plan.scene)
        }
        text = found.get("object in collision with the robot")
        if text is not None:
            assert text.startswith("at the goal object clearance of ")
            assert " m, expected " in text
            return
    pytest.fail("no random goal brings object and robot together")


def limits(label: str) -> tuple[np.ndarray, np.ndarray]:
    robot = load(label).robot
    return robot.position_lower, robot.position_upper


def test_a_scene_without_obstacles_has_ends_without_distances(tmp_path) -> None:
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    empty, zero = problem.with_obstacles(()), np.zeros((1, robot.n))
    boundary = Boundary(robot.home[None], zero, zero, robot.home[None], zero)
    scene = Scene((), np.empty((1, 0)))
    assert not list(EndCheck(empty, robot).violations(boundary, scene))
