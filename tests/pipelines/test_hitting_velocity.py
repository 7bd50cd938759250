"""The fastest hit, a linear program, compared with HiGHS and its dual, including degenerate arms."""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy

from cnpgen.pipelines.stages.hitting_velocity import HittingVelocity, hitting_velocity
from cnpgen.pipelines.stages.stage import CandidateBatch
from tests.conftest import Arm, Prepare, needs_compiled_code, run_stages, some

Array = np.ndarray
HALF = np.sqrt(0.5)
AXES = [
    np.array(d)
    for d in (
        (1.0, 0.0),
        (-1.0, 0.0),
        (0.0, 1.0),
        (0.0, -1.0),
        (HALF, HALF),
        (HALF, -HALF),
    )
]
BACKENDS = [pytest.param("compiled", marks=needs_compiled_code), "numpy", "casadi"]


def any_direction(random: np.random.Generator, count: int) -> list[Array]:
    return [
        np.array([np.cos(angle), np.sin(angle)])
        for angle in random.uniform(-np.pi, np.pi, count)
    ]


def states(kind: str, robot) -> list[tuple[Array, Array]]:
    """Pairs (q, d) of a kind."""
    random = np.random.default_rng(51)
    poses = [
        random.uniform(robot.position_lower, robot.position_upper) for _ in range(60)
    ]
    if kind == "base":
        exact = np.where(np.arange(6) % 2 == 0, 0.0, robot.home)
        return [
            (q, d)
            for q in (robot.home, exact)
            for d in AXES + any_direction(random, 20)
        ]
    if kind == "anywhere":
        return [(q, d) for q in poses for d in AXES[:3] + any_direction(random, 3)]
    if (
        kind == "in a vertical plane"
    ):  # q1 = q3 = q5 = 0: the joints' axes are parallel in pairs
        flat = [np.where(np.arange(6) % 2 == 0, 0.0, q) for q in poses]
        return [(q, d) for q in flat for d in AXES + any_direction(random, 2)]
    zeros = [
        [2, 4],
        [0, 2],
        [2],
        [4],
        [0],
        [1],
        [3],
        [5],
        [2, 3],
        [3, 4],
    ]  # kind == "some joints at zero"
    straight = [
        np.where(np.isin(np.arange(6), zeros[k % len(zeros)]), 0.0, q)
        for k, q in enumerate(poses)
    ]
    turned = [
        np.where(np.arange(6) == k % 6, (-1) ** k * np.pi / 2, q)
        for k, q in enumerate(poses)
    ]
    return [
        (q, d) for q in straight + turned for d in AXES[:4] + any_direction(random, 1)
    ]


KINDS = ["base", "anywhere", "in a vertical plane", "some joints at zero"]


@dataclass
class Program:
    """max a . v with B v = 0 and |v_i| <= L_i, for one state, from Pinocchio's Jacobian."""

    a: Array
    b: Array
    limit: Array

    def highs(self) -> float:
        bounds = list(zip(-self.limit, self.limit, strict=True))
        return -float(
            scipy.optimize.linprog(
                -self.a, A_eq=self.b, b_eq=[0, 0], bounds=bounds, method="highs"
            ).fun
        )


def programs(robot, cases: list[tuple[Array, Array]]) -> list[Program]:
    arm = Arm(robot)
    made = []
    for q, d in cases:
        x, y, z = arm.jacobian(q)[:3]
        made.append(
            Program(
                d[0] * x + d[1] * y,
                np.array([d[0] * y - d[1] * x, z]),
                robot.velocity_limit,
            )
        )
    return made


def solve(
    prepared, backend: str, cases: list[tuple[Array, Array]], kernels_of
) -> tuple[Array, Array]:
    kernel = kernels_of(prepared, backend).load(hitting_velocity, min_speed=0.0)
    q, d = (np.array(column).T.copy() for column in zip(*cases, strict=True))
    velocity, speed, _ = kernel(q, d)
    return velocity.T, speed[0]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("kind", some(KINDS, 1, "slow"))
def test_velocities_agree_with_the_optimum_of_highs(
    prepare: Prepare, kernels_of, kind, backend
):
    prepared = prepare("airhockey-hit")
    cases = states(kind, prepared.context.robot)
    if backend != "compiled":
        cases = cases[::4]
    velocities, speeds = solve(prepared, backend, cases, kernels_of)
    problems = programs(prepared.context.robot, cases)
    for case, program, v, speed in zip(
        cases, problems, velocities, speeds, strict=True
    ):
        best = program.highs()
        assert speed == pytest.approx(best, rel=1e-9, abs=1e-12), case
        assert program.a @ v == pytest.approx(best, rel=1e-9, abs=1e-12), case
        assert np.all(np.abs(v) <= program.limit * (1 + 1e-15)), case
        assert np.abs(program.b @ v).max() < 1e-12, case


def test_there_are_more_than_500_states_and_many_are_degenerate(prepare: Prepare):
    robot = prepare("airhockey-hit").context.robot
    assert sum(len(states(kind, robot)) for kind in KINDS) > 1000
    for program in programs(robot, states("in a vertical plane", robot)):
        x, z = program.b
        odd = np.array([x[j] * z[k] - x[k] * z[j] for j, k in ((0, 2), (0, 4), (2, 4))])
        assert np.abs(odd).max() < 1e-12  # three columns of the equations are parallel


@pytest.mark.parametrize(
    "offset", some([1e-13, 1e-11, 1e-9, 1e-7, 1e-5, 1e-3], 1, "slow")
)
def test_almost_degenerate_states_are_optimal_by_duality(
    prepare: Prepare, kernels_of, fastest, offset
):
    """HiGHS' own tolerance is too coarse here: what a feasible v reaches and no v can exceed is the optimum.

    ``speed`` is the value of the dual, an upper bound. Across the hit the tip is as still as the rows must be.
    """
    prepared = prepare("airhockey-hit")
    robot, random = prepared.context.robot, np.random.default_rng(52)
    cases = [
        (q + offset * np.where(np.arange(6) % 2 == 0, random.normal(size=6), 0.0), d)
        for q, d in states("in a vertical plane", robot)[::3]
    ]
    velocities, speeds = solve(prepared, fastest, cases, kernels_of)
    for case, program, v, speed in zip(
        cases, programs(robot, cases), velocities, speeds, strict=True
    ):
        assert program.a @ v == pytest.approx(speed, rel=1e-9), case
        assert np.all(np.abs(v) <= program.limit * (1 + 1e-12)), case
        assert np.abs(program.b @ v).max() < 1e-9, case
        assert speed > program.highs() * (1 - 1e-6), case


@pytest.mark.parametrize("name", ["airhockey-hit", "airhockey-replan"])
def test_hits_of_a_pipeline_have_their_direction_and_speed(prepare: Prepare, name):
    prepared = prepare(name)
    candidates = run_stages(prepared, 1500, seed=53, until="HittingVelocity")
    arm, limit = Arm(prepared.context.robot), prepared.context.robot.velocity_limit
    for q, dq, angle, speed in zip(
        candidates["goal_q"].T,
        candidates["goal_dq"].T,
        candidates["hit_angle"][0],
        candidates["hit_speed"][0],
        strict=True,
    ):
        x, y, z = arm.velocity(q, dq)
        assert x * np.cos(angle) + y * np.sin(angle) == pytest.approx(speed, abs=1e-12)
        assert abs(y * np.cos(angle) - x * np.sin(angle)) < 1e-12
        assert abs(z) < 1e-12
        assert np.all(np.abs(dq) <= limit)


def test_full_speed_hits_are_on_a_limit(prepare: Prepare):
    prepared = prepare("airhockey-replan")
    candidates = run_stages(prepared, 3000, seed=54, until="HittingVelocity")
    full = candidates["hit_speed"][0] == candidates["hit_speed_max"][0]
    ratio = (
        np.abs(candidates["goal_dq"]) / prepared.context.robot.velocity_limit[:, None]
    )
    np.testing.assert_allclose(ratio.max(0)[full], 1.0, rtol=1e-12)


def stage_on(prepared, q: Array, angle: float) -> CandidateBatch:
    candidates = CandidateBatch(1)
    candidates["goal_q"], candidates["hit_angle"] = (
        q[:, None].copy(),
        np.array([[angle]]),
    )
    HittingVelocity(full_speed=1.0).prepare(prepared.context)(
        candidates, np.random.default_rng(0)
    )
    return candidates


def test_a_stretched_arm_that_cannot_move_along_the_hit_is_rejected(prepare: Prepare):
    """Straight up: the tip can only move sideways, and only in circles about the base."""
    prepared = prepare("airhockey-hit")
    for q in (np.zeros(6), np.array([0.0, np.pi / 4, 0.0, 0.0, 0.0, 0.0])):
        for angle in (0.0, np.pi / 2, 1.0):
            candidates = stage_on(prepared, q, angle)
            assert all(
                np.isfinite(values).all() for values in candidates.columns.values()
            ), (q, angle)


def test_hits_below_the_minimum_speed_are_rejected(prepare: Prepare):
    prepared = prepare("airhockey-hit")
    robot = prepared.context.robot
    assert len(stage_on(prepared, robot.home, 0.0).alive) == 1
    candidates = CandidateBatch(1)
    candidates["goal_q"], candidates["hit_angle"] = (
        robot.home[:, None].copy(),
        np.zeros((1, 1)),
    )
    HittingVelocity(full_speed=1.0, min_speed=10.0).prepare(prepared.context)(
        candidates, np.random.default_rng(0)
    )
    assert candidates.reasons == ["no hitting velocity"]
    assert len(candidates.alive) == 0
