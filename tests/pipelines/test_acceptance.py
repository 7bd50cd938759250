"""Acceptance check: valid rows pass, and rows with one wrong value are rejected under the violated constraint."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from cnpgen.pipelines.acceptance import acceptance, unmet
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.problems.constraints.constraint import Condition
from cnpgen.robots.solid import place_obstacles
from cnpgen.world.path import PathWorld
from tests.conftest import SHIPPED, Prepare, needs_compiled_code, run_stages, some

BACKENDS = [pytest.param("compiled", marks=needs_compiled_code), "numpy"]
NO_NUMBERS = [
    *(
        pytest.param("compiled", value, marks=needs_compiled_code)
        for value in (np.nan, np.inf, -np.inf)
    ),
    *(("numpy", value) for value in (np.nan, np.inf, -np.inf)),
]
STATES = [
    f"{end}_{what}" for end in ("start", "goal") for what in ("q", "dq", "ddq", "xyz")
]


def judged(
    prepared: PreparedPipeline, candidates: CandidateBatch, **changes: np.ndarray
) -> CandidateBatch:
    """Copy the remaining candidates, change some columns and run the acceptance check."""
    again = CandidateBatch(len(candidates.alive))
    for name, values in candidates.columns.items():
        again[name] = changes.get(name, values).copy()
    acceptance(prepared.context, set(candidates.columns))(
        again, random_generator(0, "train", 0)
    )
    return again


def sampling(candidates: CandidateBatch) -> set[str]:
    return {candidates.reasons[k - 1] for k in set(candidates.outcome.tolist()) if k}


def clear_of_object(prepared: PreparedPipeline, q: np.ndarray) -> np.ndarray:
    """Return whether the held object keeps 1 mm from the links, which only the acceptance checks."""
    problem = prepared.context.problem
    world = PathWorld(prepared.context.robot, problem.obstacle, problem.object_size)
    world.set_path(q.copy(), 0 * q, 0 * q, place_obstacles(problem.obstacle))
    return world.pairs("held object").clear_states(1e-3)


def with_margins(
    prepared: PreparedPipeline, candidates: CandidateBatch
) -> CandidateBatch:
    """Keep candidates with a margin to every limit, so that one small change violates one constraint."""
    robot = prepared.context.robot
    for end in ("start", "goal"):
        margin = np.minimum(
            candidates[f"{end}_q"].T - robot.position_lower,
            robot.position_upper - candidates[f"{end}_q"].T,
        )
        candidates.reject(margin.min(1) > 1e-3, "on a joint limit")
        if f"{end}_clearance" in candidates.columns:
            candidates.reject(
                candidates[f"{end}_clearance"][0] > 7e-3, "close to a pedestal"
            )
        if prepared.context.problem.object is not None:
            candidates.reject(
                clear_of_object(prepared, candidates[f"{end}_q"]),
                "object in collision with the robot",
            )
    return candidates


@pytest.fixture(scope="module")
def batches(prepare: Prepare) -> dict[str, tuple[PreparedPipeline, CandidateBatch]]:
    return {
        name: (
            prepare(name),
            with_margins(prepare(name), run_stages(prepare(name), 250, seed=111)),
        )
        for name in SHIPPED
    }


@pytest.mark.parametrize("backend", some(BACKENDS, 1, "slow"))
@pytest.mark.parametrize("name", SHIPPED)
def test_candidates_of_the_stages_are_accepted(
    prepare: Prepare, batches, name, backend
):
    _, candidates = batches[name]
    again = judged(prepare(name, backend), candidates)
    assert len(again.alive) == again.size > 40
    reasons = [
        each.boundary_reason or each.reason
        for each in prepare(name).context.problem.constraint
    ]
    extra = ["hit not along its direction"] if name.startswith("airhockey") else []
    assert again.reasons == [*reasons, "tip not at its position", *extra]


# pipeline, column, row of the column, added value, reason
WRONG = [
    ("airhockey-replan", "start_q", 1, 1e-5, "off the table"),
    ("airhockey-replan", "goal_q", 3, 1e-5, "off the table"),
    ("airhockey-replan", "start_q", 0, 1e-6, "vertical or misplaced"),
    ("airhockey-replan", "start_q", 0, 10.0, "joint position limit"),
    ("airhockey-replan", "goal_q", 5, -10.0, "joint position limit"),
    ("airhockey-replan", "start_dq", 2, 5.0, "joint velocity limit"),
    ("airhockey-replan", "goal_dq", 2, -5.0, "joint velocity limit"),
    ("airhockey-replan", "start_dq", 1, 1e-8, "off the table"),
    ("airhockey-replan", "start_ddq", 0, 50.0, "joint acceleration limit"),
    ("airhockey-replan", "start_ddq", 1, 1e-7, "off the table"),
    ("airhockey-replan", "start_xyz", 0, 1e-7, "tip not at its position"),
    ("airhockey-replan", "goal_xyz", 1, -1e-7, "tip not at its position"),
    ("airhockey-replan", "hit_angle", 0, 1e-6, "hit not along its direction"),
    ("airhockey-replan", "hit_speed", 0, 1e-7, "hit not along its direction"),
    ("airhockey-replan", "hit_speed", 0, -1e-7, "hit not along its direction"),
    ("airhockey-hit", "start_dq", 1, 1e-8, "off the table"),
    ("airhockey-hit", "hit_angle", 0, -1e-6, "hit not along its direction"),
    ("heavy-object", "start_q", 5, 1e-6, "not vertical"),
    ("heavy-object", "goal_q", 5, -1e-6, "not vertical"),
    ("heavy-object", "start_q", 0, 1e-6, "tip not at its position"),
    ("heavy-object", "goal_dq", 6, 10.0, "joint velocity limit"),
    ("heavy-object", "start_ddq", 0, 1000.0, "joint acceleration limit"),
    ("heavy-object", "start_xyz", 2, 0.02, "robot in collision"),
    ("heavy-object", "start_xyz", 2, 0.005, "object in collision"),
    ("heavy-object", "goal_xyz", 2, 0.005, "object in collision"),
    ("heavy-object", "goal_xyz", 2, 0.0005, "tip not at its position"),
]


@pytest.mark.parametrize(("name", "column", "row", "amount", "reason"), WRONG)
def test_one_wrong_value_is_rejected_under_its_constraint(
    batches, name, column, row, amount, reason
):
    prepared, candidates = batches[name]
    changed = candidates[column].copy()
    changed[row] += amount
    again = judged(prepared, candidates, **{column: changed})
    assert len(again.alive) == 0
    expected = (
        {"off the table", "tip not at its position"}
        if reason == "vertical or misplaced"
        else {reason}
    )
    assert (
        sampling(again) <= expected | {"joint torque limit"}
        if column == "start_ddq"
        else sampling(again) <= expected
    )


@pytest.mark.parametrize(("backend", "value"), NO_NUMBERS)
@pytest.mark.parametrize("name", some(SHIPPED, 1, "slow"))
def test_a_non_finite_value_in_any_column_is_rejected(
    prepare: Prepare, batches, name, backend, value
):
    _, candidates = batches[name]
    columns = [
        column
        for column in [*STATES, "hit_angle", "hit_speed"]
        if column in candidates.columns
    ]
    places = [
        (column, row) for column in columns for row in range(len(candidates[column]))
    ]
    assert len(places) <= len(candidates.alive)
    changes = {column: candidates[column].copy() for column in columns}
    for draw, (column, row) in enumerate(places):
        changes[column][row, draw] = value
    again = judged(prepare(name, backend), candidates, **changes)
    accepted = [places[draw] for draw in again.alive.tolist() if draw < len(places)]
    assert accepted == []
    assert len(again.alive) == again.size - len(places)


@pytest.mark.parametrize(
    ("lower", "upper"), [(-np.inf, 1.0), (-1.0, np.inf), (-1.0, 1.0)]
)
def test_nan_violates_a_one_sided_bound(lower, upper):
    x = ca.SX.sym("x")
    condition = Condition(
        "x", "m", [x], np.array([lower]), np.array([upper]), "position"
    )
    count = ca.Function("unmet", [x], [unmet(condition, np.array([1e-6]))])
    assert [float(count(value)) for value in (0.0, 1 + 9e-7, -1 - 9e-7)] == [
        0.0,
        0.0,
        0.0,
    ]
    assert float(count(np.nan)) > 0
    assert [float(count(value)) > 0 for value in (1.6, -1.6)] == [
        bool(upper < 1.6),
        bool(lower > -1.6),
    ]


@pytest.mark.slow
def test_torques_outside_their_limits_are_rejected(prepare: Prepare, batches):
    for name in ("airhockey-replan", "heavy-object"):
        prepared, candidates = batches[name]
        limits = replace(prepared.context.problem.limits, torque_scale=0.01)
        weak = prepare(
            replace(
                prepared.pipeline,
                problem=replace(prepared.context.problem, limits=limits),
            ),
            "numpy",
        )
        again = judged(weak, candidates)
        assert len(again.alive) < 0.1 * again.size
        assert sampling(again) == {"joint torque limit"}


def test_reasons_have_the_order_of_the_problem_s_constraints(batches):
    """A row that violates two constraints is counted once, under the first."""
    prepared, candidates = batches["airhockey-replan"]
    q, dq = candidates["start_q"] + 10.0, candidates["start_dq"] + 10.0
    assert sampling(judged(prepared, candidates, start_q=q, start_dq=dq)) == {
        "joint position limit"
    }
    assert sampling(judged(prepared, candidates, start_dq=dq)) == {
        "joint velocity limit"
    }


@pytest.mark.parametrize("name", some(SHIPPED, 1, "slow"))
def test_float32_rows_are_checked_as_stored(prepare: Prepare, name):
    block = prepare(name, dtype="float32").block(5, "train", 0, stop=300)
    for field, values in block.columns.items():
        if field not in ("attempts", "sample_id"):
            np.testing.assert_array_equal(
                values, values.astype(np.float32).astype(np.float64)
            )
    robot = prepare(name).context.robot
    for end in ("start", "goal"):
        assert np.all(
            np.abs(block.columns[f"{end}_dq"]) <= robot.velocity_limit[:, None]
        )
        assert np.all(block.columns[f"{end}_q"] <= robot.position_upper[:, None])
