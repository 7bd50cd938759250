"""Objectives: terms against Pinocchio and SciPy, gradients against finite differences, their text, and plug-ins."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy
from numpy_transcription import evaluate, regularized_values

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import RecipeError, UsageError
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.plans.plans import Plans
from cnpgen.problems.objectives import (
    Centrifugal,
    Effort,
    Jerk,
    ObjectiveTerm,
    PathLength,
    TipReference,
    read_objective,
)
from cnpgen.problems.problem import Objective
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem, with_objective
from cnpgen.refine.objective_values import objective_values
from cnpgen.schema import registry
from cnpgen.training.settings import TrainingSettings
from tests.conftest import some
from tests.examples.installed import installed_kind
from tests.examples.losses import PROBLEM_OF, batch
from tests.examples.plans import PROBLEMS, load
from tests.examples.refiner import transcription_of
from tests.refusals import is_refused

CURVE = ((0.5, -0.2, 0.2), (0.8, 0.0, 0.3), (0.9, 0.3, 0.1))
TERMS: dict[str, ObjectiveTerm] = {
    "centrifugal": Centrifugal(weight=0.02),
    "effort": Effort(weight=2.0),
    "jerk": Jerk(weight=0.1),
    "path-length": PathLength(weight=0.5),
    "tip-reference": TipReference(weight=30.0, points=CURVE),
}
SUM = "weighted sum"


def terms_of(name: str) -> tuple[ObjectiveTerm, ...]:
    return tuple(TERMS.values()) if name == SUM else (TERMS[name],)


@pytest.mark.parametrize("name", some([*TERMS, SUM], 3, "slow"))
@pytest.mark.parametrize("label", ["hit"])
def test_the_training_gradient_of_an_objective_agrees_with_central_differences(
    label, name
):
    problem = replace(
        PROBLEMS[PROBLEM_OF[label]], objective=Objective(term=terms_of(name))
    )
    of = PlanLoss(problem, dtype="float64", backend="numpy", nodes=16)
    given, random = batch(label, 3, by=0.3, seed=1), np.random.default_rng(3)
    weights = np.zeros(len(of.budgets))

    def total(sign: float) -> np.ndarray:
        path, rate = (
            part + sign * 1e-6 * step
            for part, step in zip((given.path, given.rate), direction, strict=True)
        )
        value = of(
            path,
            rate,
            weights=weights,
            obstacle_poses=given.obstacle_poses,
            gradient=False,
        )
        return np.asarray(value.total)

    value = of(
        given.path, given.rate, weights=weights, obstacle_poses=given.obstacle_poses
    )
    for _ in range(3):
        direction = (
            random.normal(size=given.path.shape),
            random.normal(size=given.rate.shape),
        )
        expected = (total(1) - total(-1)) / 2e-6
        along = np.einsum("kcn,kcn->k", value.path_gradient, direction[0])
        along += np.einsum("kr,kr->k", value.rate_gradient, direction[1])
        np.testing.assert_allclose(
            along, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max()
        )


@pytest.mark.parametrize("name", some([*TERMS, SUM], 3, "slow"))
def test_the_refiners_gradient_of_an_objective_agrees_with_central_differences(name):
    plan = load("hit")
    motion, plain = (
        transcription_of(plan, 24, terms_of(name)),
        transcription_of(plan, 24, ()),
    )
    random = np.random.default_rng(0)
    x = motion.pack(plan.motion.path[0], plan.motion.rate[0]) + 0.02 * random.normal(
        size=motion.nx
    )
    at = evaluate(motion, x)
    assert at.cost - evaluate(plain, x).cost > 1e-4
    for variable in random.choice(motion.nx, 12, replace=False):
        up, down = (
            regularized_values(motion, x + sign * 1e-6 * np.eye(motion.nx)[variable])[0]
            for sign in (1, -1)
        )
        assert at.gradient[variable] == pytest.approx(
            (up - down) / 2e-6, abs=1e-7 * (1 + np.abs(at.gradient).max())
        )
    assert np.linalg.eigvalsh(at.curvature).min() > -1e-9 * np.abs(at.curvature).max()


def test_values_of_objectives_are_those_of_pinocchio_and_scipy():
    """Integrate with SciPy's splines and Pinocchio's torques and tip positions on 4,001 phases."""
    plan = load("hit")
    problem = replace(plan.problem, objective=Objective(term=tuple(TERMS.values())))
    path, rate = plan.motion.path[0], plan.motion.rate[0]
    plans = _plans(plan, problem)
    values = objective_values(plans)
    assert list(values) == ["time", *TERMS]
    s = np.linspace(0, 1, 4001)
    p, r = (_spline(points) for points in (path, rate))
    derivatives = [p(s, order) for order in range(4)]
    r0, r1, r2 = (r(s, order)[:, None] for order in range(3))
    dq, ddq = derivatives[1] * r0, derivatives[2] * r0**2 + derivatives[1] * r0 * r1
    jerk = (
        derivatives[3] * r0**3
        + 3 * derivatives[2] * r1 * r0**2
        + derivatives[1] * (r2 * r0 + r1**2) * r0
    )
    robot = plan.robot
    data, frame = robot.model.createData(), robot.tip_frame
    tips, torques = np.empty((len(s), 3)), np.empty_like(dq)
    for i, q in enumerate(derivatives[0]):
        torques[i] = pin.rnea(robot.model, data, q, dq[i], ddq[i])
        pin.forwardKinematics(robot.model, data, q)
        tips[i] = pin.updateFramePlacement(robot.model, data, frame).translation
    distance = np.min(
        [_segment_distance(tips, a, b) for a, b in pairwise(CURVE)], axis=0
    )
    expected = {
        "time": np.trapezoid(1 / r0[:, 0], s),
        "effort": np.trapezoid(
            ((torques / robot.torque_limit) ** 2).sum(1) / r0[:, 0], s
        ),
        "jerk": np.trapezoid(((jerk / robot.jerk_limit) ** 2).sum(1) / r0[:, 0], s),
        "path-length": np.linalg.norm(np.diff(tips, axis=0), axis=1).sum(),
        "tip-reference": np.trapezoid(distance**2 / r0[:, 0], s),
    }
    for name, value in expected.items():
        tolerance = (
            1e-2 if name == "path-length" else 3e-3
        )  # its norm is smoothed below 0.01 m/s
        assert values[name][0] == pytest.approx(value, rel=tolerance), name


def test_objectives_are_read_from_text():
    assert read_objective("time") is None
    assert read_objective("") is None
    assert read_objective("effort") == (Effort(weight=1.0),)
    assert read_objective(" time=2, effort=1,jerk = 0.5") == (
        Effort(weight=0.5),
        Jerk(weight=0.25),
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "efort",
            "objective 'efort' does not exist: expected one of time, .*did you mean 'effort'",
        ),
        (
            "effort=-1",
            "the weight of 'effort' must be a number that is not negative, got '-1'",
        ),
        (
            "effort=much",
            "the weight of 'effort' must be a number that is not negative, got 'much'",
        ),
        ("time=0,effort=1", "the weight of time must be above 0"),
        (
            "tip-reference",
            r"tip-reference: points: missing key.*write the term as \[\[objective.term\]\]",
        ),
    ],
)
def test_invalid_objectives_are_refused(text, message):
    with pytest.raises(UsageError, match=message):
        read_objective(text)
    with pytest.raises(UsageError, match=message):
        TrainingSettings(objective=text)
    with pytest.raises(UsageError, match=message):
        cnpgen.RefineOptions(objective=text)


def test_terms_of_a_problem_file_are_read_and_recorded(tmp_path: Path):
    problem = load_problem(
        _problem_file(tmp_path, '[[objective.term]]\nuse = "effort"\nweight = 0.5\n')
    )
    assert problem.objective.terms == (Centrifugal(weight=0.01), Effort(weight=0.5))
    with record_problem(problem).restored() as restored:
        assert restored.objective == problem.objective
    with is_refused(RecipeError):
        load_problem(
            _problem_file(
                tmp_path,
                '[[objective.term]]\nuse = "tip-reference"\npoints = [[1, 0, 0]]\n',
            )
        )


def test_another_objective_changes_the_record_but_not_the_problem_of_plans():
    record = record_problem(PROBLEMS["airhockey"])
    other = with_objective(record, "time=2, effort=1")
    assert with_objective(record, "time") is record
    assert other.comparable_sha256 == record.comparable_sha256
    with other.restored() as problem:
        assert problem.objective.terms == (Effort(weight=0.5),)


@pytest.mark.slow
def test_a_plan_refined_for_effort_uses_less_of_it_and_more_time():
    problems = cnpgen.draw_boundary_problems("heavy-object", 4, seed=5)
    drafts = cnpgen.Planner("heavy-object").plan_batch(
        problems.boundary, columns=problems.columns
    )
    fast, saving = (
        cnpgen.refine_plans(
            drafts, options=cnpgen.RefineOptions(objective=text), workers=1
        )
        for text in ("time", "effort=2")
    )
    assert fast.valid.all()
    assert saving.valid.all()
    values = [objective_values(found.plans, "effort") for found in (fast, saving)]
    assert values[1]["effort"].mean() < values[0]["effort"].mean()
    assert values[1]["time"].mean() > values[0]["time"].mean()


def test_an_installed_objective_is_used_by_loss_and_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "speedy.py").write_text(
        "from dataclasses import dataclass\n"
        "from cnpgen.plugins import ObjectiveTerm\n"
        "@dataclass(frozen=True, kw_only=True)\n"
        "class JointSpeed(ObjectiveTerm):\n"
        '    "Squares of the joint velocities."\n'
        "    unit = 'rad^2/s'\n"
        "    def residuals(self, state):\n"
        "        return state.dq\n"
    )
    with installed_kind(
        tmp_path, "speedy", "speedy:JointSpeed", monkeypatch, group=registry.OBJECTIVES
    ):
        plan = load("hit")
        (term,) = read_objective("speedy=0.5")
        plans = _plans(plan, replace(plan.problem, objective=Objective(term=(term,))))
        s = np.linspace(0, 1, 4001)
        dq = (
            _spline(plan.motion.path[0])(s, 1)
            * _spline(plan.motion.rate[0])(s)[:, None]
        )
        expected = np.trapezoid((dq**2).sum(1) / _spline(plan.motion.rate[0])(s), s)
        assert objective_values(plans)["speedy"][0] == pytest.approx(expected, rel=3e-3)
        of = PlanLoss(plans.problem, dtype="float64", backend="numpy", nodes=200)
        value = of(
            plan.motion.path,
            plan.motion.rate,
            weights=np.zeros(len(of.budgets)),
            obstacle_poses=plan.scene.poses,
        )
        assert value.total[0] == pytest.approx(
            plans.duration[0] + 0.5 * expected, rel=1e-3
        )


def test_objectives_are_listed(capsys: pytest.CaptureFixture[str]):
    assert main(["list", "objectives"]) == 0
    out = capsys.readouterr().out
    for name in TERMS:
        assert name in out


def _plans(plan, problem) -> Plans:
    record = record_problem(problem)
    return Plans(
        problem=record,
        boundary=plan.boundary,
        path_control_points=plan.motion.path,
        rate_control_points=plan.motion.rate,
        degree=7,
        sample_id=np.arange(1),
        status=np.zeros(1, np.uint8),
        columns={"start_xyz": plan.start_xyz, "goal_xyz": plan.goal_xyz},
    )


def _spline(points: np.ndarray) -> "scipy.interpolate.BSpline":
    count = len(points)
    return scipy.interpolate.BSpline(
        np.r_[np.zeros(8), np.linspace(0, 1, count - 6)[1:-1], np.ones(8)], points, 7
    )


def _segment_distance(
    tips: np.ndarray, a: tuple[float, ...], b: tuple[float, ...]
) -> np.ndarray:
    first, along = np.array(a), np.array(b) - np.array(a)
    fraction = np.clip((tips - first) @ along / (along @ along), 0, 1)
    return np.linalg.norm(tips - first - fraction[:, None] * along, axis=1)


def _problem_file(folder: Path, text: str) -> Path:
    shipped = PROBLEMS["airhockey"].path
    (folder / "iiwa14_striker.urdf").write_bytes(
        (shipped.parent / "iiwa14_striker.urdf").read_bytes()
    )
    file = folder / "problem.toml"
    file.write_text(shipped.read_text() + "\n" + text)
    return file
