"""Full braking: the roll-out compared with Pinocchio and HiGHS, and the stage in a pipeline."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import scipy

from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.pipelines.prepared import PreparedPipeline, random_generator
from cnpgen.pipelines.stages.reach import (
    BRAKING_STEP_S,
    LOOKAHEAD_S,
    MAX_BRAKING_STEPS,
    BrakingReach,
    braking_step,
    overshoot,
    tip_state,
)
from cnpgen.pipelines.stages.stage import CandidateBatch
from cnpgen.problems.constraints.table import Table
from cnpgen.schema.catalogue import list_recipes
from tests.conftest import (
    Arm,
    Prepare,
    needs_compiled_code,
    run_stages,
    some,
    without_stages,
)

Array = np.ndarray
BACKENDS = [pytest.param("compiled", marks=needs_compiled_code), "numpy", "casadi"]
DRAWS = 1500
EDGES = [
    (0, 1, "x", "high"),
    (0, -1, "x", "low"),
    (1, 1, "y", "high"),
    (1, -1, "y", "low"),
]


@dataclass
class Case:
    """State that may be unable to brake before an edge: axis 0 or 1, side +1 or -1."""

    q: Array
    dq: Array
    axis: int
    side: int
    edge: float


def rollout(arm: Arm, robot, table: Table, case: Case) -> float:
    """Brake fully in steps of 10 ms; return the overshoot over the edge [m], inf if the tip does not stop."""
    q, dq = case.q.copy(), case.dq.copy()
    for _ in range(MAX_BRAKING_STEPS):
        jacobian = arm.jacobian(q)[:3]
        position, velocity = np.array(arm.pose(q).translation), arm.velocity(q, dq)
        bias = arm.acceleration(q, dq, np.zeros_like(q))
        speed, overshoot_m = (
            case.side * velocity[case.axis],
            case.side * (position[case.axis] - case.edge),
        )
        if speed <= 0:
            return overshoot_m
        height = (
            -bias[2]
            - 0.5 * velocity[2] / BRAKING_STEP_S
            - 0.1 * (position[2] - table.z) / BRAKING_STEP_S**2
        )
        low = np.maximum(
            -robot.acceleration_limit, (-robot.velocity_limit - dq) / BRAKING_STEP_S
        )
        high = np.minimum(
            robot.acceleration_limit, (robot.velocity_limit - dq) / BRAKING_STEP_S
        )
        along = case.side * jacobian[case.axis]
        best = scipy.optimize.linprog(
            along,
            A_eq=jacobian[2:],
            b_eq=[height],
            bounds=list(zip(low, high, strict=True)),
            method="highs",
        )
        assert best.status == 0
        deceleration = -(along @ best.x + case.side * bias[case.axis])
        if deceleration > 0 and speed <= deceleration * BRAKING_STEP_S:
            return overshoot_m + 0.5 * speed**2 / deceleration
        q, dq = (
            q + BRAKING_STEP_S * (dq + 0.5 * BRAKING_STEP_S * best.x),
            dq + BRAKING_STEP_S * best.x,
        )
    return math.inf


@pytest.fixture(scope="module")
def fast(prepare: Prepare) -> tuple[PreparedPipeline, CandidateBatch]:
    """Moving starts and goals of a pipeline without a reach rule."""
    prepared = prepare(
        without_stages(prepare("airhockey-replan").pipeline, "BallisticReach")
    )
    return prepared, run_stages(prepared, DRAWS, seed=81)


@pytest.fixture(scope="module")
def suspects(fast: tuple[PreparedPipeline, CandidateBatch]) -> list[Case]:
    """States whose straight line of 80 ms leaves the table: starts, and goals reversed in time."""
    prepared, candidates = fast
    table, arm = prepared.context.constraint(Table), Arm(prepared.context.robot)
    cases = []
    for end, sign in (("start", 1.0), ("goal", -1.0)):
        for q, dq in zip(
            candidates[f"{end}_q"].T, sign * candidates[f"{end}_dq"].T, strict=True
        ):
            position, velocity = np.array(arm.pose(q).translation), arm.velocity(q, dq)
            for axis, side, name, bound in EDGES:
                edge = getattr(getattr(table, name), bound)
                if (
                    side * velocity[axis] > 0
                    and side * (position[axis] + LOOKAHEAD_S * velocity[axis] - edge)
                    > 0
                ):
                    cases.append(Case(q, dq, axis, side, edge))
    return cases


def kernels(prepared: PreparedPipeline, backend: str, kernels_of):
    table, library = prepared.context.constraint(Table), kernels_of(prepared, backend)
    return (
        table,
        library.load(tip_state),
        library.load(braking_step, Loop(0.5, MAX_BRAKING_STEPS), height=table.z),
    )


@pytest.mark.parametrize("backend", some(BACKENDS, 1, "slow"))
def test_braking_agrees_with_an_independent_roll_out(
    fast, suspects, kernels_of, backend
):
    prepared, _ = fast
    table, _, brake = kernels(prepared, backend, kernels_of)
    arm = Arm(prepared.context.robot)
    chosen = suspects[:: max(1, len(suspects) // 50)][:50]
    assert len(chosen) == 50
    assert len({(case.axis, case.side) for case in chosen}) >= 3
    state = np.array([[*case.q, *case.dq, -1.0] for case in chosen]).T.copy()
    normal = np.zeros((3, len(chosen)))
    for k, case in enumerate(chosen):
        normal[case.axis, k], normal[2, k] = case.side, case.side * case.edge
    final, running = brake(state, normal)
    expected = [rollout(arm, prepared.context.robot, table, case) for case in chosen]
    found = np.where(running[0] < 0.5, final[-1], np.inf)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    assert min(expected) < -0.01 < 0.01 < max(expected)


def test_states_that_skip_the_roll_out_can_brake(fast, kernels_of, fastest):
    """The stage skips the roll-out of these states, whose straight line of 80 ms ends a millimetre inside."""
    prepared, _ = fast
    candidates = run_stages(prepared, 20_000, seed=82)
    table, tip, brake = kernels(prepared, fastest, kernels_of)
    for end, sign in (("start", 1.0), ("goal", -1.0)):
        q, dq = candidates[f"{end}_q"], sign * candidates[f"{end}_dq"]
        position, velocity = tip(q, dq)
        for axis, side, name, bound in EDGES:
            edge = getattr(getattr(table, name), bound)
            speed, ahead = side * velocity[axis], side * (position[axis] - edge)
            calm = np.flatnonzero((speed > 0) & (ahead + LOOKAHEAD_S * speed <= -1e-3))
            normal = np.zeros((3, len(calm)))
            normal[axis], normal[2] = side, side * edge
            state = np.concatenate([q, dq, np.full((1, q.shape[1]), -1.0)])
            final, running = brake(np.take(state, calm, axis=1), normal)
            assert np.all(running[0] < 0.5)
            assert final[-1].max() <= -1e-3


def one(prepared: PreparedPipeline, q: Array, dq: Array) -> CandidateBatch:
    """Return a batch of one candidate that starts with dq and ends at rest."""
    candidates = CandidateBatch(1)
    for name, values in (
        ("start_q", q),
        ("start_dq", dq),
        ("goal_q", q),
        ("goal_dq", 0 * dq),
    ):
        candidates[name] = values[:, None].copy()
    BrakingReach().prepare(prepared.context)(
        candidates, random_generator(0, "train", 0)
    )
    return candidates


def test_slow_states_pass_and_fast_states_at_the_edge_are_rejected(fast):
    prepared, candidates = fast
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    at_edge = candidates["start_q"][
        :, np.argmax(candidates["start_xyz"][1])
    ]  # about a millimetre from y = 0.45
    in_center = candidates["start_q"][
        :, np.argmin(np.abs(candidates["start_xyz"] - [[0.95], [0.0], [0.16]]).sum(0))
    ]
    for q in (at_edge, in_center):
        assert len(one(prepared, q, np.zeros(6)).alive) == 1
    jacobian = arm.jacobian(at_edge)[:3]
    outwards = np.linalg.pinv(jacobian) @ [0.0, 1.0, 0.0]
    outwards *= 0.9 / np.max(np.abs(outwards) / robot.velocity_limit)
    lost = one(prepared, at_edge, outwards)
    assert lost.reasons[0] == "cannot brake at the start"
    assert len(lost.alive) == 0
    assert len(one(prepared, at_edge, -outwards).alive) == 1
    assert len(one(prepared, in_center, 0.05 * outwards).alive) == 1


def test_a_goal_is_a_start_reversed_in_time(fast):
    prepared, candidates = fast
    q, dq = candidates["start_q"], candidates["start_dq"]
    ends = []
    for start, goal in (("start", "goal"), ("goal", "start")):
        moving = CandidateBatch(q.shape[1])
        moving[f"{start}_q"], moving[f"{start}_dq"] = q, dq if start == "start" else -dq
        moving[f"{goal}_q"], moving[f"{goal}_dq"] = q, 0 * dq
        BrakingReach().prepare(prepared.context)(
            moving, random_generator(0, "train", 0)
        )
        ends.append(moving.alive)
    np.testing.assert_array_equal(*ends)
    assert 0 < q.shape[1] - len(ends[0]) < 0.2 * q.shape[1]


def test_the_margin_is_a_distance_before_the_edge(fast, kernels_of, fastest):
    prepared, candidates = fast
    table, tip, brake = kernels(prepared, fastest, kernels_of)
    excess = overshoot(
        tip, brake, table, candidates["start_q"], candidates["start_dq"], margin=0.02
    )
    for margin in (0.0, 1e-3, 0.02):
        again = CandidateBatch(candidates["start_q"].shape[1])
        for name in ("start_q", "start_dq", "goal_q"):
            again[name] = candidates[name]
        again["goal_dq"] = 0 * candidates["goal_dq"]
        BrakingReach(margin=margin).prepare(prepared.context)(
            again, random_generator(0, "train", 0)
        )
        np.testing.assert_array_equal(again.alive, np.flatnonzero(excess <= -margin))
    assert np.sum((excess > -0.02) & (excess <= 0)) > 0


def braking_variant(folder: Path, name: str) -> Path:
    """Write the shipped pipeline with braking-reach in place of its ballistic rules."""
    head, *stages = list_recipes("pipeline")[name].read_text().split("[[stage]]")
    kept = [stage for stage in stages if "ballistic-reach" not in stage]
    path = folder / f"{name}-braking.toml"
    path.write_text(
        "[[stage]]".join([head, *kept, '\nuse = "braking-reach"\nmargin = "1 mm"\n'])
    )
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", ["airhockey-hit", "airhockey-replan"])
def test_braking_reach_rejects_fewer_candidates_than_the_ballistic_rule(
    prepare: Prepare, tmp_path, name
):
    braking = (
        prepare(load_pipeline(braking_variant(tmp_path, name)), "numpy")
        .block(1, "train", 0, stop=1200)
        .sampling
    )
    ballistic = prepare(name).block(1, "train", 0, stop=1200).sampling
    lost = [
        sum(
            count
            for reason, count in sampling.rejections.items()
            if "leaves the table" in reason or "brake" in reason
        )
        for sampling in (braking, ballistic)
    ]
    assert braking.accepted == ballistic.accepted == 1200
    assert 0 < lost[0] / braking.tried < 0.5 * lost[1] / ballistic.tried
