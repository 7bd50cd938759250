"""The hitting configuration against SciPy's SLSQP, with objective, constraint and gradients by Pinocchio."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy

from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.stages.hitting_configuration import HittingConfiguration
from cnpgen.pipelines.stages.hitting_newton import basic_joints, newton_step
from cnpgen.pipelines.stages.ik import IK_TOLERANCE, MAX_IK_STEPS, ik_step
from cnpgen.robots.robot import Robot
from tests.conftest import Arm, Prepare, run_stages, some

Array = np.ndarray
DRAWS = 40


@dataclass
class Search:
    """The search for one hitting configuration: maximize |J^T d|^2 - |(q0 - q) / L|^2 subject to FK(q) = p."""

    robot: Robot
    arm: Arm
    position: Array
    direction: Array
    home: Array

    def value(self, q: Array) -> float:
        gain = self.arm.jacobian(q)[:3].T @ self.direction
        return float(
            gain @ gain - np.sum(((self.home - q) / self.robot.rated_velocity) ** 2)
        )

    def gradient(self, q: Array) -> Array:
        """By d^2 p / dq_j dq_k = z_j x J_k for j <= k."""
        jacobian = self.arm.jacobian(q)
        second = (
            np.cross(jacobian[3:].T[:, None], jacobian[:3].T[None]) @ self.direction
        )
        second = np.triu(second) + np.triu(second, 1).T
        gain = jacobian[:3].T @ self.direction
        return 2 * second @ gain + 2 * (self.home - q) / self.robot.rated_velocity**2

    def miss(self, q: Array) -> Array:
        return np.array(self.arm.pose(q).translation) - self.position

    def slsqp(self, start: Array) -> Array | None:
        found = scipy.optimize.minimize(
            lambda q: -self.value(q), start, jac=lambda q: -self.gradient(q), method="SLSQP",
            bounds=list(zip(self.robot.position_lower, self.robot.position_upper, strict=True)),
            constraints=[{"type": "eq", "fun": self.miss, "jac": lambda q: self.arm.jacobian(q)[:3]}],
            options={"ftol": 1e-12, "maxiter": 200},
        )  # fmt: skip
        return found.x if np.linalg.norm(self.miss(found.x)) < 1e-7 else None


@pytest.fixture(
    scope="module", params=some(["airhockey-hit", "airhockey-replan"], 1, "slow")
)
def solved(
    request: pytest.FixtureRequest, prepare: Prepare
) -> list[tuple[Search, Array, Array]]:
    """Searches, their initial guesses by inverse kinematics, and our solutions."""
    prepared = prepare(request.param)
    robot, arm = prepared.context.robot, Arm(prepared.context.robot)
    candidates = run_stages(prepared, 80, seed=41, until="HittingConfiguration")
    n = len(candidates.alive)
    home = (
        np.repeat(robot.home[:, None], n, axis=1)
        if request.param == "airhockey-hit"
        else candidates["start_q"]
    )
    first = prepared.context.kernels.load(
        ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), vertical=False, max_step=0.4
    )
    guess, _ = first(home, candidates["goal_xyz"])
    angle = candidates["hit_angle"][0]
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    return [
        (
            Search(
                robot, arm, candidates["goal_xyz"][:, k], direction[:, k], home[:, k]
            ),
            guess[:, k],
            candidates["goal_q"][:, k],
        )
        for k in range(min(n, DRAWS))
    ]


def other_starts(search: Search) -> Iterator[Array]:
    """Check near the home configuration and at random configurations."""
    random = np.random.default_rng(42)
    low, high = search.robot.position_lower, search.robot.position_upper
    for _ in range(3):
        yield np.clip(search.home + 0.7 * random.normal(size=search.robot.n), low, high)
    yield random.uniform(low, high)


def test_our_gradient_of_the_objective_is_right(solved):
    search, guess, _ = solved[0]
    step = 1e-6
    numeric = [
        (search.value(guess + step * e) - search.value(guess - step * e)) / (2 * step)
        for e in np.eye(len(guess))
    ]
    np.testing.assert_allclose(search.gradient(guess), numeric, atol=1e-7)


def test_slsqp_finds_no_better_optimum_from_the_same_initial_guess(solved):
    assert len(solved) == DRAWS
    same = 0
    for search, guess, ours in solved:
        theirs = search.slsqp(guess)
        if theirs is not None:
            assert search.value(ours) >= search.value(theirs) - 1e-6, (
                ours,
                theirs,
                search,
            )
            same += bool(np.abs(ours - theirs).max() < 1e-4)
    assert same > 0.9 * DRAWS


@pytest.mark.slow
def test_slsqp_finds_no_better_optimum_from_other_initial_guesses(solved):
    """80 candidates; 19,029 runs of SLSQP for 1251 replanning candidates and 1362 hits found no better optimum."""
    reached = 0
    for search, _, ours in solved:
        for start in other_starts(search):
            theirs = search.slsqp(start)
            if theirs is not None:
                reached += 1
                assert search.value(ours) >= search.value(theirs) - 1e-6, (
                    ours,
                    theirs,
                    search,
                )
    assert reached > 3 * DRAWS


def test_the_tip_is_at_the_puck_and_the_joints_within_their_limits(solved):
    for search, _, ours in solved:
        assert np.linalg.norm(search.miss(ours)) < 1e-9
        assert np.all(search.robot.position_lower <= ours)
        assert np.all(ours <= search.robot.position_upper)


def test_the_projected_gradient_vanishes_and_the_projected_hessian_is_negative(solved):
    for search, _, ours in solved:
        jacobian = search.arm.jacobian(ours)[:3]
        null = np.linalg.svd(jacobian)[2][3:].T
        gradient = search.gradient(ours)
        assert np.abs(null.T @ gradient).max() < 1e-7
        multiplier = np.linalg.lstsq(jacobian.T, gradient, rcond=None)[0]

        def lagrangian_gradient(q, search=search, multiplier=multiplier):
            return search.gradient(q) - search.arm.jacobian(q)[:3].T @ multiplier

        hessian = [
            (
                lagrangian_gradient(ours + 1e-6 * e)
                - lagrangian_gradient(ours - 1e-6 * e)
            )
            / 2e-6
            for e in np.eye(len(ours))
        ]
        assert np.linalg.eigvalsh(null.T @ np.array(hessian) @ null).max() < 0


def test_the_search_improves_on_the_inverse_kinematics(solved):
    gains = np.array(
        [search.value(ours) - search.value(guess) for search, guess, ours in solved]
    )
    assert gains.min() > -1e-9
    assert np.mean(gains > 1e-3) > 0.9


@pytest.mark.parametrize("name", ["airhockey-hit", "airhockey-replan"])
def test_almost_no_candidate_is_rejected(prepare, name):
    candidates = run_stages(
        prepare(name), 20_000, seed=43, until="HittingConfiguration"
    )
    lost = [
        np.sum(candidates.outcome == 1 + k)
        for k, text in enumerate(candidates.reasons)
        if text == "no hitting configuration"
    ]
    assert sum(lost) < 20


def test_eliminated_joints_move_the_tip_in_all_directions_near_the_base(prepare):
    robot = prepare("airhockey-hit").context.robot
    arm, joints, random = Arm(robot), basic_joints(robot), np.random.default_rng(44)
    for _ in range(200):
        q = np.clip(
            robot.home + random.uniform(-0.5, 0.5, robot.n),
            robot.position_lower,
            robot.position_upper,
        )
        assert abs(np.linalg.det(arm.jacobian(q)[:3, joints])) > 1e-3


def test_no_step_exceeds_the_maximum(prepare):
    prepared = prepare("airhockey-replan")
    candidates = run_stages(prepared, 500, seed=45, until="HittingConfiguration")
    kernel = prepared.context.kernels.load(newton_step)
    angle = candidates["hit_angle"]
    direction = np.concatenate([np.cos(angle), np.sin(angle)])
    following, length = kernel(
        candidates["start_q"], candidates["goal_xyz"], direction, candidates["start_q"]
    )
    moved = np.linalg.norm(following - candidates["start_q"], axis=0)
    assert moved.max() <= 0.6 + 1e-12
    np.testing.assert_allclose(moved, np.minimum(length[0], 0.6), rtol=1e-9)


def sides(robot: Robot, q: Array) -> Array:
    """-1 for joints on their lower limits, 1 on their upper ones, -2 and 2 outside, else 0."""
    low, high = robot.position_lower, robot.position_upper
    return 1.0 * (q >= high) + (q > high) - 1.0 * (q <= low) - (q < low)


def test_no_candidate_is_rejected_at_a_joint_limit(prepare):
    """Near the inner edge of the reach, the optimum of 0.013 % of the candidates is outside the limit of joint 6."""
    prepared = prepare("airhockey-replan")
    robot, limited = prepared.context.robot, 0
    for seed in range(3):
        candidates = run_stages(
            prepared, 20_000, seed=seed, until="HittingConfiguration"
        )
        assert (
            np.count_nonzero(
                candidates.outcome
                == 1 + candidates.reasons.index("joint position limit at the goal")
            )
            == 0
        )
        limited += np.count_nonzero(
            (sides(robot, candidates["goal_q"].T) != 0).any(axis=1)
        )
    assert limited >= 3


@pytest.fixture(scope="module")
def cramped(prepare: Prepare) -> list[tuple[Search, Array]]:
    """Searches of an arm that may move each joint 0.6 rad only, and our optima that are on a limit."""
    context = prepare("airhockey-replan").context
    base, low, high = (
        context.robot.home,
        context.robot.position_lower,
        context.robot.position_upper,
    )
    robot = replace(
        context.robot,
        position_lower=np.maximum(low, base - 0.6),
        position_upper=np.minimum(high, base + 0.6),
    )
    kernels = replace(
        context.kernels,
        identity="cramped",
        arguments={**context.kernels.arguments, "robot": robot},
    )
    candidates = run_stages(
        prepare("airhockey-replan"), 1500, seed=46, until="HitAngleInCone"
    )
    candidates.reject(
        (np.abs(sides(robot, candidates["start_q"].T)) < 2).all(axis=1), "elsewhere"
    )
    HittingConfiguration(near="start").prepare(
        replace(context, robot=robot, kernels=kernels)
    )(candidates, None)
    angle, q, arm = candidates["hit_angle"][0], candidates["goal_q"], Arm(robot)
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    on_limit = (sides(robot, q.T) != 0).any(axis=1)
    return [
        (
            Search(
                robot,
                arm,
                candidates["goal_xyz"][:, k],
                direction[:, k],
                candidates["start_q"][:, k],
            ),
            q[:, k],
        )
        for k in np.flatnonzero(on_limit)
    ]


@pytest.mark.slow
def test_optima_on_limits_agree_with_slsqp(cramped):
    assert len(cramped) > 40
    same = 0
    for search, ours in cramped[:40]:
        for start in [ours, *other_starts(search)]:
            theirs = search.slsqp(start)
            if theirs is not None:
                assert search.value(ours) >= search.value(theirs) - 1e-6, (
                    ours,
                    theirs,
                    search,
                )
                same += bool(np.abs(ours - theirs).max() < 1e-4)
    assert same > 60


def test_the_gradient_points_outwards_for_joints_on_limits_and_vanishes_for_the_others(
    cramped,
):
    held = []
    for search, ours in cramped:
        jacobian, gradient = search.arm.jacobian(ours)[:3], search.gradient(ours)
        side = sides(search.robot, ours)
        multiplier = np.linalg.lstsq(
            jacobian[:, side == 0].T, gradient[side == 0], rcond=None
        )[0]
        pull = gradient - jacobian.T @ multiplier
        assert np.abs(pull[side == 0]).max() < 1e-7
        assert (side * pull)[side != 0].min() > 0
        assert np.linalg.norm(search.miss(ours)) < 1e-9
        held.append(np.count_nonzero(side))
    assert {1, 2, 3} <= set(held)
