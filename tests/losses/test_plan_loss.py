"""The loss: values against Pinocchio, Coal and SciPy, backends, margins, time-varying bounds, and refused arguments."""

import copy
import pickle
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import CnpgenError
from cnpgen.losses.margins import Margins
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.losses.quadrature import quadrature
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.problem import Problem
from cnpgen.schema.keys import field
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import needs_compiled_code, some
from tests.examples.jerk_limits import jerk_limited
from tests.examples.losses import (
    PROBLEM_OF,
    Batch,
    batch,
    huber,
    loss,
    states,
    step_losses,
)
from tests.examples.plans import PROBLEMS
from tests.refusals import is_refused

PROBLEM_NAMES = ("airhockey", "heavy-object")
LABEL_OF = {"airhockey": "hit", "heavy-object": "transport"}


def slightly_invalid(label: str, count: int = 3) -> Batch:
    """Return plans that violate every constraint and have no robot segment inside an obstacle."""
    given = batch(label, count, by=0.02 if label == "transport" else 0.1, raised=0.03)
    return replace(given, rate=given.rate * 1.5)


@pytest.mark.parametrize("label", some(["hit", "replan", "transport"], 2, "slow"))
@pytest.mark.parametrize(
    ("rule", "shift"),
    some([("cosine", 0.3), ("cosine", 0.0), ("gauss", 0.0)], 1, "slow"),
)
def test_terms_agree_with_the_quadrature_of_pinocchio_and_coal(label, rule, shift):
    of, given = loss(PROBLEM_OF[label], rule=rule, nodes=24), slightly_invalid(label)
    found = given.evaluated(of, shift=shift).terms
    s, weights = quadrature(rule, 24, shift)
    for k in range(len(found)):
        at = states(given.path[k], given.rate[k], s)
        expected = (weights / at.rate) @ step_losses(
            given.problem, at, given.obstacle_poses[k]
        )
        # object-contact is a bound if the object is tilted; puck-contact has a form for training
        exact = np.array(
            [name not in {"object-contact", "puck-contact"} for name in of.terms]
        )
        np.testing.assert_allclose(
            found[k][exact], expected[exact], rtol=1e-9, atol=1e-14
        )


def test_the_term_of_a_nearly_upright_object_in_a_pedestal_agrees_with_coal():
    of, upright = (
        loss("heavy-object", nodes=24),
        batch("transport", 1, by=0.0, raised=-0.02),
    )
    given = replace(
        upright, obstacle_poses=upright.obstacle_poses + 0.03
    )  # 1 cm into the object at both ends
    s, weights = quadrature("cosine", 24)
    at = states(given.path[0], given.rate[0], s)
    expected = (weights / at.rate) @ step_losses(
        given.problem, at, given.obstacle_poses[0]
    )
    term = of.terms.index("object-contact")
    assert expected[term] > 1e-6
    assert given.evaluated(of).terms[0, term] == pytest.approx(
        expected[term], rel=0.02
    )  # upright to a milliradian


@pytest.mark.parametrize("name", PROBLEM_NAMES)
def test_every_term_is_positive_in_the_plans_of_the_comparison(name):
    terms = slightly_invalid(LABEL_OF[name]).evaluated(loss(name)).terms
    silent = {loss(name).terms[k] for k in np.flatnonzero((terms == 0).all(axis=0))}
    assert silent <= {
        "joint-position",
        "object-clearance",
    }  # compared in the next test and in test_object_clearance


def test_the_term_of_joint_positions_outside_their_limits_is_the_published_one():
    of, given = loss("airhockey", nodes=16), batch("hit", 2, by=1.5)
    s, weights = quadrature("cosine", 16)
    for k, found in enumerate(
        given.evaluated(of).terms[:, of.terms.index("joint-position")]
    ):
        at, robot = states(given.path[k], given.rate[k], s), of._robot
        violation = np.maximum(robot.position_lower - at.q, 0) + np.maximum(
            at.q - robot.position_upper, 0
        )
        assert found == pytest.approx(
            (weights / at.rate) @ huber(violation).sum(axis=1), rel=1e-10
        )
        assert found > 0


@pytest.mark.parametrize("rule", ["cosine", "gauss"])
def test_the_term_of_jerks_outside_their_limits_agrees_with_scipy_splines(rule):
    """Compare with finite differences of accelerations."""
    problem, robot = jerk_limited("airhockey")
    of, given = (
        PlanLoss(problem, dtype="float64", backend="numpy", rule=rule, nodes=16),
        slightly_invalid("hit"),
    )
    assert of.terms[-1] == "joint-jerk"
    value, plain = (
        given.evaluated(of),
        given.evaluated(loss("airhockey", rule=rule, nodes=16)),
    )
    np.testing.assert_allclose(value.terms[:, :-1], plain.terms, rtol=1e-10)
    s, weights = quadrature(rule, 16)
    for k, found in enumerate(value.terms[:, -1]):
        at, h = states(given.path[k], given.rate[k], s), 1e-7
        after, before = (
            states(given.path[k], given.rate[k], s + step).ddq for step in (h, -h)
        )
        jerk = (after - before) / (2 * h) * at.rate[:, None]
        violation = np.maximum(np.abs(jerk) - robot.jerk_limit, 0)
        assert found == pytest.approx(
            (weights / at.rate) @ huber(violation).sum(axis=1), rel=1e-5
        )
        assert found > 0


@pytest.mark.parametrize("name", PROBLEM_NAMES)
def test_the_total_is_the_task_loss_and_the_weighted_terms(name):
    of, given = loss(name), batch(LABEL_OF[name], 3)
    weights = np.random.default_rng(0).uniform(0, 10, len(of.terms) - 1)
    value = given.evaluated(of, weights=weights)
    np.testing.assert_allclose(
        value.total, value.terms[:, 0] + value.terms[:, 1:] @ weights, rtol=1e-13
    )
    assert of.terms[0] == "time"
    assert len(of.terms) == value.terms.shape[1] == 1 + len(PROBLEMS[name].constraint)
    assert of.budgets.shape == of.weights0.shape == weights.shape


def test_budgets_and_first_weights_come_from_the_problem_file():
    of, constraints = loss("airhockey"), PROBLEMS["airhockey"].constraint
    assert of.terms[1:] == (
        "joint-position",
        "joint-velocity",
        "joint-acceleration",
        "joint-torque",
        "table",
        "puck-contact",
    )
    assert of.budgets.tolist() == [constraint.budget for constraint in constraints]
    assert of.weights0.tolist() == [constraint.weight for constraint in constraints]


@pytest.mark.parametrize("name", some(PROBLEM_NAMES, 1, "slow"))
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_without_a_compiler_the_loss_is_the_same_up_to_rounding(name, dtype):
    given = batch(LABEL_OF[name], 5)
    reference = given.evaluated(loss(name, dtype=dtype))
    value = given.evaluated(loss(name, dtype=dtype, backend="numpy"))
    tolerance = 1e-10 if dtype == "float64" else 2e-4
    for field_name in ("total", "terms", "path_gradient", "rate_gradient"):
        found, expected = getattr(value, field_name), getattr(reference, field_name)
        assert found.dtype == expected.dtype == dtype
        np.testing.assert_allclose(
            found, expected, rtol=tolerance, atol=tolerance * np.abs(expected).max()
        )


@pytest.mark.parametrize("n", [0, 1, 2, 15, 16, 17, 127, 128, 129, 300])
def test_the_loss_of_a_plan_does_not_depend_on_its_batch(n):
    of, few = loss("airhockey", dtype="float32"), batch("hit", 7)
    rows = np.arange(n) % 7
    value, alone = few[rows].evaluated(of), few.evaluated(of)
    assert value.path_gradient.shape == (n, 15, 6)
    assert value.rate_gradient.shape == (n, 20)
    np.testing.assert_allclose(value.terms, alone.terms[rows], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(
        value.path_gradient, alone.path_gradient[rows], rtol=1e-4, atol=1e-3
    )


def test_arrays_of_any_layout_and_type_are_accepted():
    of, given = loss("airhockey"), batch("hit", 20)
    expected = given.evaluated(of)
    lanes_last = np.ascontiguousarray(given.path.transpose(1, 2, 0)).transpose(2, 0, 1)
    for path in (
        lanes_last,
        np.asfortranarray(given.path),
        given.path.tolist(),
        given.path[::-1][::-1],
    ):
        np.testing.assert_allclose(
            replace(given, path=path).evaluated(of).total, expected.total, rtol=1e-13
        )


@pytest.mark.slow
def test_without_a_gradient_the_terms_are_the_same_and_the_gradients_are_empty():
    of, given = loss("heavy-object"), batch("transport", 3)
    value = given.evaluated(of, gradient=False)
    np.testing.assert_allclose(value.terms, given.evaluated(of).terms, rtol=1e-12)
    assert value.path_gradient.shape == (0, 15, 7)
    assert value.rate_gradient.shape == (0, 20)


# --- invalid plans ----------------------------------------------------------------------------------------------------

GARBAGE = {
    "path is nan": ("path", (4, 2), np.nan),
    "path is infinite": ("path", (0, 0), -np.inf),
    "path overflows float32": ("path", (3, 1), 1e300),
    "rate is nan": ("rate", (19,), np.nan),
    "rate is zero": ("rate", (5,), 0.0),
    "rate is negative": ("rate", (0,), -1.0),
    "height is nan": ("obstacle_poses", (0,), np.nan),
}


@pytest.mark.parametrize("what", GARBAGE)
@pytest.mark.parametrize(
    "backend", [pytest.param("compiled", marks=needs_compiled_code), "numpy"]
)
def test_an_invalid_plan_has_a_loss_of_nan_and_does_not_affect_others(what, backend):
    of, given = (
        loss("heavy-object", dtype="float32", backend=backend),
        batch("transport", 5),
    )
    expected = given.evaluated(of)
    name, index, value = GARBAGE[what]
    array = getattr(given, name).copy()
    array[(2, *index)] = value
    found = replace(given, **{name: array}).evaluated(of)
    others = np.arange(5) != 2
    for part in ("total", "terms", "path_gradient", "rate_gradient"):
        assert np.isnan(getattr(found, part)[2]).all()
        np.testing.assert_array_equal(
            getattr(found, part)[others], getattr(expected, part)[others]
        )


def test_a_negative_rate_control_point_is_invalid_even_if_the_rate_is_positive():
    of, given = loss("airhockey"), batch("hit", 2)
    given.rate[1, 9] = -0.01
    assert Motion(given.path, given.rate, 7).runs_forward().all()
    assert np.isnan(given.evaluated(of).total).tolist() == [False, True]


def test_losses_of_distant_control_points_are_large_and_finite():
    of, given = loss("airhockey", dtype="float32"), batch("hit", 2)
    value = replace(given, path=given.path * 1e3).evaluated(of)
    assert np.isfinite(value.total).all()
    assert (value.total > 1e3).all()


MISTAKES = {
    "path must have shape (N, 15, 6), got (3, 15, 7)": {"path": np.zeros((3, 15, 7))},
    "path must have shape (N, 15, 6), got (15, 6)": {"path": np.zeros((15, 6))},
    "rate must have shape (3, 20), got (2, 20)": {"rate": np.ones((2, 20))},
    "rate must be an array of numbers, got str": {"rate": "fast"},
    "obstacle_poses must have shape (3, 4), got (3, 2)": {
        "obstacle_poses": np.zeros((3, 2))
    },
    "start_tip must have shape (3, 3), got (3,)": {"start_tip": np.zeros(3)},
    "rate must be an array of numbers, got ndarray: complex128 is no real type": {
        "rate": np.ones((3, 20)) * 1j
    },
    "weights must be an array of numbers, got str": {"weights": "abc"},
    "weights must have shape (6,) for joint-position": {"weights": np.ones(7)},
    "the weight of 'joint-torque' must be a number that is not negative, got -1.0": {
        "weights": [1, 1, 1, -1, 1, 1]
    },
    "the weight of 'table' must be a number that is not negative, got nan": {
        "weights": [1, 1, 1, 1, np.nan, 1]
    },
    "the shift of the quadrature nodes must be in [0, 1), got 1.5": {"shift": 1.5},
    "shift must be a finite number, got None": {"shift": None},
    "gradient must be True or False, got 'no'": {"gradient": "no"},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_invalid_arguments_are_refused(message):
    given = batch("hit", 3)
    arguments = {
        "path": given.path,
        "rate": given.rate,
        "weights": np.ones(6),
        "obstacle_poses": given.obstacle_poses,
        **MISTAKES[message],
    }
    with pytest.raises(CnpgenError) as error:
        loss("airhockey")(**arguments)
    assert str(error.value).startswith(message)


def test_missing_obstacle_poses_are_an_error():
    given = batch("transport", 1)
    with is_refused(CnpgenError, argument="obstacle_poses"):
        loss("heavy-object")(given.path, given.rate, weights=np.ones(7))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dtype": "float16"}, "dtype must be one of float64, float32, got 'float16'"),
        (
            {"form": "sined"},
            r"form must be one of signed, paper, got 'sined' \(did you mean 'signed'",
        ),
        ({"rule": "uniform"}, "between uniform nodes the ends of r hide violations"),
        ({"nodes": 0}, "nodes must be an integer from 1 on, got 0"),
        ({"nodes": 64.5}, "nodes must be an integer from 1 on, got 64.5"),
        ({"nodes": "64"}, "nodes must be an integer from 1 on, got '64'"),
        ({"rule": 3}, "rule must be a text, got 3"),
        (
            {"margins": {"table": 1e-3}},
            "margins must be a Margins or None, got {'table': 0.001}",
        ),
        ({"backend": "cuda"}, "backend 'cuda' does not exist"),
        (
            {"margins": Margins({"joint-velocty": 0.9})},
            r"no such term.*did you mean 'joint-velocity'",
        ),
        (
            {"margins": Margins({"joint-velocity": 98.5})},
            "above 0 and at most 1, got 98.5",
        ),
        (
            {"margins": Margins({}, {"table": np.inf})},
            "an inset must be a finite number, got inf",
        ),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(CnpgenError, match=message):
        PlanLoss(PROBLEMS["airhockey"], **options)


def test_a_problem_may_be_given_by_name_and_other_types_are_refused():
    assert PlanLoss("airhockey").terms == loss("airhockey").terms
    with is_refused(CnpgenError, argument="problem"):
        PlanLoss("airhokey")
    with is_refused(CnpgenError, argument="problem"):
        PlanLoss(None)


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda of: pickle.loads(pickle.dumps(of))]
)
def test_a_used_loss_can_be_copied_and_pickled(copied):
    of, given = PlanLoss("airhockey", nodes=8), batch("hit", 2)
    tips = np.array([[0.65, 0.0, 0.19]] * 2)
    expected = [
        given.evaluated(of, start_tip=tips, gradient=gradient)
        for gradient in (True, False)
    ]
    again = copied(of)
    for gradient, value in zip((True, False), expected, strict=True):
        np.testing.assert_array_equal(
            given.evaluated(again, start_tip=tips, gradient=gradient).terms, value.terms
        )


# --- margins, time-varying bounds, other constraints ------------------------------------------------------------------


def test_margins_have_the_effect_of_the_same_limits_in_the_problem_file():
    problem, given = PROBLEMS["airhockey"], slightly_invalid("hit")
    tighter = replace(
        problem,
        limits=replace(problem.limits, velocity_scale=0.8 * 0.9, acceleration_cap=18.0),
        constraint=tuple(
            replace(
                each,
                x=replace(each.x, low=0.62, high=1.98),
                y=replace(each.y, low=-0.43, high=0.43),
            )
            if hasattr(each, "x")
            else each
            for each in problem.constraint
        ),
    )
    margins = Margins(
        {"joint-velocity": 0.9, "joint-acceleration": 0.9}, {"table": 0.02}
    )
    found = given.evaluated(PlanLoss(problem, dtype="float64", margins=margins))
    expected = given.evaluated(PlanLoss(tighter, dtype="float64", backend="numpy"))
    np.testing.assert_allclose(found.terms, expected.terms, rtol=1e-9)
    np.testing.assert_allclose(
        found.path_gradient, expected.path_gradient, rtol=1e-7, atol=1e-6
    )
    assert (
        found.terms[:, [2, 3, 5]]
        > given.evaluated(loss("airhockey")).terms[:, [2, 3, 5]]
    ).all()


@pytest.mark.parametrize(
    ("start", "allowed"),
    [(0.163, 0.003), (0.19, 0.005)],
    ids=["in the band", "outside the band"],
)
def test_a_motion_that_starts_off_the_table_has_the_time_varying_bound(
    start: float, allowed: float
):
    of, given = loss("airhockey", nodes=32), batch("hit", 2, by=0.1)
    table, column = PROBLEMS["airhockey"].constraint[-2], -2
    tips = np.array([[0.65, 0.0, start], [0.65, 0.0, 0.16]])
    found = given.evaluated(of, start_tip=tips).terms
    at_once = given.evaluated(of).terms
    np.testing.assert_allclose(found[1], at_once[1], rtol=1e-13)
    s, weights = quadrature("cosine", 32)
    at = states(given.path[0], given.rate[0], s)
    band = allowed * np.clip((0.3 - s) / 0.2, 0, 1)
    height = np.array([_tip(of, q)[2] for q in at.q])
    saved = huber(height - table.z) - huber(
        np.maximum(np.abs(height - table.z) - band, 0)
    )
    assert at_once[0, column] - found[0, column] == pytest.approx(
        (weights / at.rate) @ saved, rel=1e-9
    )
    others = np.arange(len(of.terms)) != len(of.terms) + column
    np.testing.assert_allclose(found[0, others], at_once[0, others], rtol=1e-13)


def _tip(of: PlanLoss, q: np.ndarray) -> np.ndarray:
    import pinocchio as pin

    model = of._robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.array(data.oMf[model.getFrameId(of._robot.tip)].translation)


@dataclass(frozen=True, kw_only=True)
class KeepOut(Constraint):
    """A plug-in constraint without training attributes: the tip stays outside a circle."""

    reason = "in the circle"
    radius: float = field("radius", unit="m", low=0.0)
    tolerance: float = field(
        "how deep a motion may enter and still be called valid", unit="m", low=0.0
    )

    def symbolic(self, state: Any) -> tuple[Condition, ...]:
        return self._outside(state.kinematics.tip)

    def measured(self, world: Any) -> tuple[Condition, ...]:
        return self._outside(world.tip_position)

    def _outside(self, tip: Any) -> tuple[Condition, ...]:
        distance = ((tip[0] - 0.9) ** 2 + tip[1] ** 2) ** 0.5
        return (
            Condition(
                "circle",
                "m",
                [distance],
                np.array([self.radius]),
                np.array([np.inf]),
                "position",
            ),
        )


def plugged_in(radius: float, monkeypatch: pytest.MonkeyPatch) -> Problem:
    from cnpgen.schema import registry

    original = registry.name_of
    monkeypatch.setattr(
        registry,
        "name_of",
        lambda group, kind: "keep-out" if kind is KeepOut else original(group, kind),
    )
    problem = PROBLEMS["airhockey"]
    two = (
        KeepOut(radius=radius, tolerance=1e-3, budget=1e-4, weight=2.0),
        KeepOut(radius=0.1, tolerance=1e-3),
    )
    return replace(problem, constraint=(*problem.constraint[:2], *two))


def test_a_constraint_without_training_attributes_is_a_term_with_a_gradient(
    monkeypatch,
):
    of, given = (
        PlanLoss(
            plugged_in(0.5, monkeypatch), dtype="float64", nodes=24, backend="numpy"
        ),
        batch("hit", 2),
    )
    assert of.terms == (
        "time",
        "joint-position",
        "joint-velocity",
        "keep-out",
        "keep-out-2",
    )
    assert (of.budgets[2], of.weights0[2]) == (1e-4, 2.0)
    weights = np.array([0.0, 0.0, 5.0, 0.0])
    value = of(given.path, given.rate, weights=weights)
    s, quadrature_weights = quadrature("cosine", 24)
    at = states(given.path[0], given.rate[0], s)
    tips = np.array([_tip(of, q) for q in at.q])
    inside = np.maximum(0.5 - np.hypot(tips[:, 0] - 0.9, tips[:, 1]), 0)
    assert value.terms[0, 3] == pytest.approx(
        (quadrature_weights / at.rate) @ huber(inside), rel=1e-9
    )
    direction = np.random.default_rng(1).normal(size=given.path.shape)
    ends = [
        of(
            given.path + h * direction, given.rate, weights=weights, gradient=False
        ).total
        for h in (1e-6, -1e-6)
    ]
    expected = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(
        np.einsum("kcn,kcn->k", value.path_gradient, direction), expected, rtol=1e-6
    )


def test_weights_may_be_given_by_name_with_the_problem_s_weights_for_others():
    of, some = loss("airhockey"), batch("hit", 3)
    given = some.path, some.rate
    poses = some.obstacle_poses
    by_name = dict(zip(of.terms[1:], of.weights0.tolist(), strict=True)) | {
        "table": 3.0
    }
    ordered_weights = [by_name[name] for name in of.terms[1:]]
    for weights in ({"table": 3.0}, {"table": np.float32(3)}, by_name):
        found, expected = (
            of(*given, weights=w, obstacle_poses=poses)
            for w in (weights, ordered_weights)
        )
        np.testing.assert_array_equal(found.total, expected.total)
    assert of.checked_weights({}).tolist() == of.checked_weights(of.weights0).tolist()


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (
            {"tabel": 3.0},
            "there is no constraint 'tabel' .did you mean 'table'.., expected some of joint-pos",
        ),
        ({"time": 3.0}, "there is no constraint 'time'"),
        (
            {"table": "much"},
            "the weight of 'table' must be a finite number, got 'much'",
        ),
        (
            {"table": -1.0},
            "the weight of 'table' must be a number that is not negative, got -1.0",
        ),
    ],
)
def test_invalid_weights_by_name_are_refused(weights, message):
    with pytest.raises(CnpgenError, match=message):
        loss("airhockey").checked_weights(weights)


def test_threads_change_no_result():
    given, arguments = batch("hit", 70), {"nodes": 8, "dtype": "float64"}
    one, two = (
        given.evaluated(PlanLoss("airhockey", threads=threads, **arguments))
        for threads in (1, 2)
    )
    for name, values in vars(one).items():
        assert np.array_equal(values, getattr(two, name))
    with is_refused(CnpgenError, argument="threads"):
        PlanLoss("airhockey", threads=0)


@pytest.mark.parametrize("form", ["signed", "paper"])
def test_a_problem_without_its_obstacles_has_no_loss_of_distances(form):
    problem = PROBLEMS["heavy-object"].with_obstacles(())
    loss, spec = (
        PlanLoss(problem, form=form, backend="numpy", nodes=4),
        problem.trajectory,
    )
    path = np.zeros((1, spec.path_control_points, 7))
    value = loss(path, np.ones((1, spec.rate_control_points)), weights=loss.weights0)
    terms = dict(zip(loss.terms, value.terms[0].tolist(), strict=True))
    assert terms["robot-clearance"] == terms["object-contact"] == 0
