"""Moving pucks: their motion by SciPy, their contact by impulses, and hits that meet them."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import scipy

from cnpgen.addons.online.moving_pucks import NO_MEETING, TOO_LATE, PuckModel
from cnpgen.addons.online.plan_hits import plan_hits
from cnpgen.errors import UsageError
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.results import HitOptions
from tests.conftest import Arm
from tests.refusals import is_refused

TARGET = np.array([2.49, 0.0])  # m
CONTACT_RANGE = 0.0798  # m, sum of the radii


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner("airhockey-online")


@pytest.fixture(scope="module")
def still(planner):
    return planner.robot.home, np.zeros(6), np.zeros(6)


@pytest.fixture(scope="module")
def pucks() -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of pucks, which move in all directions at up to 0.5 m/s."""
    random = np.random.default_rng(5)
    angle, speed = random.uniform(-np.pi, np.pi, 40), random.uniform(0.0, 0.5, 40)
    position = np.stack(
        [random.uniform(0.85, 1.2, 40), random.uniform(-0.3, 0.3, 40)], axis=1
    )
    return position, speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def integrate(model: PuckModel, position, velocity, time: float) -> np.ndarray:
    """Position and velocity after a time, by SciPy's integrator with events at the bands."""
    low, high = (
        np.array([model.home_edge, -model.half_width]),
        np.array([np.inf, model.half_width]),
    )

    def bands(_, state):
        return np.min(np.concatenate([state[:2] - low, high - state[:2]]))

    bands.terminal, bands.direction = True, -1
    state, begin = np.array([*position, *velocity]), 0.0
    while begin < time:
        solution = scipy.integrate.solve_ivp(
            lambda _, s: [s[2], s[3], -model.drag * s[2], -model.drag * s[3]],
            (begin, time),
            state,
            events=bands,
            rtol=1e-10,
            atol=1e-12,
        )
        state, begin = solution.y[:, -1].copy(), solution.t[-1]
        if solution.status == 1:
            axis = 2 + int(
                min(state[1] + model.half_width, model.half_width - state[1])
                < state[0] - model.home_edge
            )
            state[axis] *= -model.band_restitution
            state[5 - axis] *= 1 - model.band_loss
    return state


@pytest.mark.parametrize("time", [0.3, 1.5])
def test_predicted_pucks_move_as_integrated_by_scipy(pucks, time):
    model = PuckModel(band_restitution=0.6, band_loss=0.3, half_width=0.35)
    position, velocity = model.predict(*pucks, np.full(40, time))
    expected = np.array(
        [integrate(model, *puck, time) for puck in zip(*pucks, strict=True)]
    )
    np.testing.assert_allclose(
        np.concatenate([position, velocity], axis=1), expected, atol=1e-7
    )
    assert (
        np.abs(pucks[1][:, 1] - velocity[:, 1]) > 0.3
    ).any() or time < 1  # some have met a band


def test_a_puck_without_drag_keeps_its_velocity():
    position, velocity = PuckModel(drag=0.0).predict(
        np.zeros((1, 2)) + 1, np.array([[0.1, -0.1]]), np.array([2.0])
    )
    np.testing.assert_allclose(position, [[1.2, 0.8]])
    np.testing.assert_allclose(velocity, [[0.1, -0.1]])


def test_the_contact_reverses_the_approach_and_friction_ends_sliding():
    """With much friction the surfaces roll on each other: the impulse of a homogeneous disc, J = m r^2 / 2."""
    normal, tangent = np.array([[0.6, 0.8]]), np.array([-0.8, 0.6])
    before, mallet = np.array([[0.2, -0.4]]), np.array([[1.1, 0.7]])
    after = PuckModel(restitution=0.4, friction=10.0).velocity_after(
        before, mallet, normal
    )
    assert (after - mallet)[0] @ normal[0] == pytest.approx(
        0.4 * (mallet - before)[0] @ normal[0]
    )
    impulse = (after - before)[0] @ tangent  # per mass
    surface_speed = after[0] @ tangent + 2 * impulse  # spin times radius is 2 J / m
    assert surface_speed == pytest.approx(mallet[0] @ tangent)
    smooth = PuckModel(restitution=0.4, friction=0.0).velocity_after(
        before, mallet, normal
    )
    assert smooth[0] @ tangent == pytest.approx(before[0] @ tangent)
    weak = PuckModel(restitution=0.4, friction=0.005).velocity_after(
        before, mallet, normal
    )
    normal_impulse = (weak - before)[0] @ normal[0]
    assert abs((weak - before)[0] @ tangent) == pytest.approx(0.005 * normal_impulse)


def test_pucks_that_touch_the_mallet_before_the_meeting_have_a_reason(planner, still):
    tip = Arm(open_problem(planner.model.problem)[1]).pose(still[0]).translation[:2]
    random = np.random.default_rng(3)
    angle, distance = (
        random.uniform(-np.pi, np.pi, 50),
        random.uniform(0, CONTACT_RANGE - 1e-4, 50),
    )
    near = tip + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for options in (
        {"meeting_time": 2.0, "puck_velocity": [-0.1, 0.05]},
        {"puck_velocity": [0.3, 0.05]},
    ):
        assert set(plan_hits(planner, still, near, TARGET, **options).reasons) == {
            "start touches the puck"
        }
    crossing = np.add(tip, [0.3, -0.3]), np.array([0.0, 0.35])  # beside the mallet
    model = PuckModel(drag=0.0)
    free = plan_hits(
        planner,
        still,
        crossing[0],
        TARGET,
        puck_velocity=crossing[1],
        meeting_time=0.9,
        options=HitOptions(puck_model=model),
    )
    assert free.reasons == ("",)
    through = (
        np.add(tip, [0.229, -0.147]),
        np.array([-0.405, 0.26]),
    )  # through the mallet
    met = plan_hits(
        planner,
        still,
        through[0],
        TARGET,
        puck_velocity=through[1],
        meeting_time=2.057,
        options=HitOptions(puck_model=model),
    )
    assert met.reasons == ("early contact with the puck",)


@pytest.mark.parametrize("friction", [0.0, 0.1, 1.0])
def test_hits_in_the_computed_directions_send_pucks_to_the_target(pucks, friction):
    model, speed = PuckModel(restitution=0.5, friction=friction), np.full(40, 1.4)
    angle = model.hit_angle(pucks[1], speed, TARGET - pucks[0])
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    after = model.velocity_after(pucks[1], speed[:, None] * normal, normal)
    line = (TARGET - pucks[0]) / np.linalg.norm(TARGET - pucks[0], axis=1)[:, None]
    np.testing.assert_allclose(
        after / np.linalg.norm(after, axis=1)[:, None], line, atol=1e-6
    )
    assert np.abs(angle - np.arctan2(line[:, 1], line[:, 0])).max() > 0.05


def test_the_mallet_meets_moving_pucks_at_the_time_of_the_contact(
    planner, still, pucks
):
    hits = plan_hits(
        planner,
        still,
        pucks[0],
        TARGET,
        puck_velocity=pucks[1],
        options=HitOptions(speed_share=0.95),
    )
    assert len(hits.plans) >= 35
    assert set(hits.reasons) <= {
        "",
        "cannot brake at the goal",
        "start touches the puck",
        NO_MEETING,
    }
    arm, model = Arm(open_problem(planner.model.problem)[1]), PuckModel()
    q, dq, _ = hits.plans.states_at(hits.contact_time)
    for row, number in enumerate(hits.plans.sample_id):
        puck = integrate(
            model, pucks[0][number], pucks[1][number], hits.contact_time[row]
        )
        distance = puck[:2] - arm.pose(q[row]).translation[:2]
        assert np.linalg.norm(distance) == pytest.approx(CONTACT_RANGE, abs=4e-4)
        normal = distance / np.linalg.norm(distance)
        mallet = arm.velocity(q[row], dq[row])[:2]
        after = model.velocity_after(puck[None, 2:], mallet[None], normal[None])[0]
        line = TARGET - puck[:2]
        assert np.cross([*after, 0], [*line, 0])[2] / np.linalg.norm(
            after
        ) / np.linalg.norm(line) == pytest.approx(0, abs=0.03)


def test_an_arm_at_rest_waits_for_a_given_meeting_time(planner, still, pucks):
    hits = plan_hits(
        planner, still, pucks[0], TARGET, puck_velocity=pucks[1], meeting_time=0.8
    )
    np.testing.assert_allclose(hits.delay + hits.contact_time, 0.8)
    assert (hits.delay > 0).all()
    puck = PuckModel().predict(*pucks, np.full(40, 0.8))[0][hits.plans.sample_id]
    at_start = (
        hits.plans.columns["puck_xy"],
        hits.plans.columns["puck_velocity"],
        hits.contact_time,
    )
    np.testing.assert_allclose(PuckModel().predict(*at_start)[0], puck, atol=1e-9)
    early = plan_hits(
        planner, still, pucks[0], TARGET, puck_velocity=pucks[1], meeting_time=0.1
    )
    assert Counter(early.reasons)[TOO_LATE] > 20
    assert not len(early.plans)


def test_a_puck_at_rest_gives_the_same_hit_as_without_velocity(planner, still):
    one = plan_hits(planner, still, [1.0, 0.2], TARGET)
    other = plan_hits(planner, still, [1.0, 0.2], TARGET, puck_velocity=[0.0, 0.0])
    np.testing.assert_allclose(
        one.plans.boundary.goal_q, other.plans.boundary.goal_q, atol=1e-12
    )
    assert one.contact_time == pytest.approx(other.contact_time)


def test_ways_back_continue_hits_without_a_jump_and_are_valid(planner, still, pucks):
    hits = plan_hits(
        planner,
        still,
        pucks[0],
        TARGET,
        puck_velocity=pucks[1],
        home=planner.robot.home,
        options=HitOptions(speed_share=0.95),
    )
    assert evaluate_plans(hits.return_plans).valid.all()
    sequences = hits.sequences
    np.testing.assert_allclose(
        sequences.duration, hits.plans.duration + hits.return_plans.duration
    )
    end = sequences.motion.at_times(sequences.duration[:, None])
    np.testing.assert_allclose(
        end.q[:, 0], np.tile(planner.robot.home, (len(sequences), 1)), atol=1e-9
    )
    np.testing.assert_allclose(end.dq, 0.0, atol=1e-9)


@pytest.mark.parametrize("plant", ["nominal", "heavier", "delayed"])
def test_hits_of_moving_pucks_score_in_the_simulator(planner, still, plant):
    pytest.importorskip("mujoco")
    from cnpgen.addons.benchmark.simulator.simulate import simulate_plans

    position, velocity = (
        [[1.0, 0.2], [1.1, -0.1], [0.95, -0.2]],
        [[-0.2, -0.3], [0.1, 0.35], [-0.1, 0.4]],
    )
    moving = plan_hits(planner, still, position, TARGET, puck_velocity=velocity)
    assert all(
        result.success
        for result in simulate_plans(moving.plans, plant=plant, workers=1).executed
    )
    naive = plan_hits(planner, still, position, TARGET)
    pucks = {"puck_xy": np.array(position), "puck_velocity": np.array(velocity)}
    blind = simulate_plans(
        replace(naive.plans, columns={**naive.plans.columns, **pucks}),
        plant=plant,
        workers=1,
    )
    assert not any(result.scored for result in blind.executed)


def test_invalid_arguments_raise_errors(planner, still):
    with is_refused(UsageError, argument="puck"):
        plan_hits(
            planner,
            still,
            [[1.0, 0.1], [1.0, 0.2]],
            TARGET,
            puck_velocity=np.zeros((3, 2)),
        )
    moving = (still[0], still[1] + 0.1, still[2])
    with is_refused(UsageError, argument="state"):
        plan_hits(planner, moving, [1.0, 0.1], TARGET, meeting_time=0.6)
    with is_refused(UsageError, argument="home"):
        _ = plan_hits(planner, still, [1.0, 0.1], TARGET).sequences
    with is_refused(UsageError, argument="home"):
        plan_hits(planner, still, [1.0, 0.1], TARGET, home=np.zeros((2, 6)))
    with is_refused(UsageError, argument="restitution"):
        PuckModel(restitution=-1.0)
