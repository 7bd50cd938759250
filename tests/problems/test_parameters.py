"""Parameters of a problem: table, limits and load of each sample, in kernels, judges, losses and plans."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import cnpgen
from cnpgen.addons.benchmark.simulator.simulate import simulate_plans
from cnpgen.errors import RecipeError, UsageError
from cnpgen.judges.rows.verify import verify_rows
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.plans.plans import make_plans
from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem import Problem, resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.robots.table_frame import moved_box, table_frame
from cnpgen.schema.keys import Range
from cnpgen.trajectory.boundary import assemble
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.conftest import some
from tests.examples.shipped import PROBLEMS
from tests.refusals import is_refused

NAMES = "airhockey-tables", "heavy-object-loads"


def drawn(problem: Problem, n: int, seed: int = 0) -> np.ndarray:
    """Return random parameters of a problem, shape (n, width)."""
    low, high = np.array(
        [(span.low, span.high) for span in problem.parameters.ranges]
    ).T
    return np.random.default_rng(seed).uniform(low, high, (n, len(low)))


def states(problem: Problem, n: int, seed: int = 0) -> list[np.ndarray]:
    """Return random positions, velocities and accelerations, shape (n, joints) each."""
    robot, random = load_robot(problem), np.random.default_rng(seed)
    limits = np.full(robot.n, 0.5), robot.velocity_limit, robot.acceleration_limit
    return [
        mean + random.uniform(-1, 1, (n, robot.n)) * limit
        for mean, limit in zip((robot.home, 0, 0), limits, strict=True)
    ]


def measured(
    problem: Problem, scene: np.ndarray, state: list[np.ndarray]
) -> np.ndarray:
    """Return all conditions at one state with Pinocchio, shape (m,)."""
    world = World(load_robot(problem), problem.obstacle, problem.object_size)
    world.set_state(*state, scene)
    parts = [
        condition
        for constraint in problem.constraint
        for condition in constraint.solved(world)
    ]
    return np.concatenate([np.array(condition.g, float) for condition in parts])


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_one_kernel_agrees_with_pinocchio_for_all_values(name: str) -> None:
    problem = load_problem(name)
    exact = tuple(
        item
        for item in problem.constraint
        if not isinstance(item, ObjectClearance | ObjectContact)
    )
    problem = replace(problem, constraint=exact)
    model = cnpgen.RobotModel(problem, backend="numpy")
    values, state = drawn(problem, 12), states(problem, 12)
    tip = model.forward_kinematics(state[0])[0]
    velocity = np.einsum("kij,kj->ki", model.jacobian(state[0])[:, :3], state[1])
    scene = model.scene(tip, tip + 0.3, velocity, parameters=values)
    found = model.constraint_values(*state, scene=scene).g
    for row in range(12):
        expected = measured(problem, scene.poses[row], [part[row] for part in state])
        np.testing.assert_allclose(found[row], expected, rtol=1e-9, atol=1e-9)


def test_the_load_of_a_sample_is_that_of_a_problem_with_this_payload() -> None:
    (mass,) = drawn(PROBLEMS["heavy-object-loads"], 1)[0]
    payload = replace(PROBLEMS["heavy-object-loads"].payload, mass=mass)
    other = load_robot(
        replace(
            PROBLEMS["heavy-object-loads"],
            payload=payload,
            parameters=type(PROBLEMS["heavy-object-loads"].parameters)(),
        )
    )
    q, dq, ddq = (part.T for part in states(PROBLEMS["heavy-object-loads"], 5))
    world = PathWorld(
        load_robot(PROBLEMS["heavy-object-loads"]),
        PROBLEMS["heavy-object-loads"].obstacle,
        PROBLEMS["heavy-object-loads"].object_size,
    )
    for value in (9.0, mass):  # the second value replaces the first
        world.set_path(
            q,
            dq,
            ddq,
            scene_of(
                PROBLEMS["heavy-object-loads"],
                *np.zeros((2, 1, 3)),
                parameters=np.array([[value]]),
            ).poses[0],
        )
        torque = world.torque
    data = other.model.createData()
    expected = [
        pin.rnea(other.model, data, *(part[:, k].copy() for part in (q, dq, ddq)))
        for k in range(5)
    ]
    np.testing.assert_allclose(torque.T, expected, rtol=1e-10)
    assert not np.allclose(torque, PathWorld(other).torque[:, :1])


def test_center_and_inertia_of_the_load_differ_from_sample_to_sample() -> None:
    nominal = replace(
        PROBLEMS["heavy-object-loads"].payload, centre=(0.01, -0.02, 0.05)
    )
    ranges = replace(
        PROBLEMS["heavy-object-loads"].parameters,
        payload_x=Range(-0.05, 0.05),
        payload_y=Range(-0.05, 0.05),
        payload_z=Range(0.0, 0.1),
        payload_inertia=Range(0.5, 2.0),
    )
    problem = replace(
        PROBLEMS["heavy-object-loads"],
        payload=nominal,
        parameters=ranges,
        constraint=PROBLEMS["heavy-object-loads"].constraint[:4],
    )
    model = cnpgen.RobotModel(problem, backend="numpy")
    values, state = drawn(problem, 6, seed=8), states(problem, 6, seed=8)
    tip = model.forward_kinematics(state[0])[0]
    scene = model.scene(tip, tip + 0.3, parameters=values)
    found = model.constraint_values(*state, scene=scene).g
    for row, (mass, x, y, z, factor) in enumerate(values):
        body = nominal.at({"payload_mass": mass, "payload_inertia": factor})
        np.testing.assert_allclose(
            body.inertia_matrix, nominal.inertia_matrix * mass / 12 * factor, rtol=1e-12
        )
        own = replace(body, centre=(x, y, z))
        other = load_robot(replace(problem, payload=own, parameters=type(ranges)()))
        expected = pin.rnea(
            other.model, other.model.createData(), *(part[row] for part in state)
        )
        world = PathWorld(
            load_robot(problem),
            PROBLEMS["heavy-object-loads"].obstacle,
            PROBLEMS["heavy-object-loads"].object_size,
        )
        world.set_path(*(part[row][:, None] for part in state), scene.poses[row])
        np.testing.assert_allclose(world.torque[:, 0], expected, rtol=1e-10)
        np.testing.assert_allclose(found[row, -7:], expected, rtol=1e-9)


def test_the_simulator_holds_the_load_of_each_plan() -> None:
    plans = cnpgen.solve_plans(
        draw_boundary_problems("heavy-object-loads", 1, seed=4)
    ).plans
    found = {}
    for mass in (4.0, 14.0):
        one = replace(
            plans, boundary=replace(plans.boundary, parameters=np.array([[mass]]))
        )
        problem = replace(
            PROBLEMS["heavy-object-loads"],
            payload=replace(PROBLEMS["heavy-object-loads"].payload, mass=mass),
            parameters=type(PROBLEMS["heavy-object-loads"].parameters)(),
        )
        boundary = replace(plans.boundary, parameters=None)
        alone = replace(plans, problem=record_problem(problem), boundary=boundary)
        found[mass] = simulate_plans(one).executed[0]
        assert found[mass] == simulate_plans(alone).executed[0]
    assert found[4.0] != found[14.0]


def test_the_simulator_moves_the_table_of_each_plan() -> None:
    plans = cnpgen.solve_plans(
        draw_boundary_problems("airhockey-tables", 2, seed=1)
    ).plans
    for result in simulate_plans(plans).executed:
        assert result.hit
        assert not result.touched_early
        assert result.plane_error < 5e-4
    swapped = replace(
        plans,
        boundary=replace(
            plans.boundary, parameters=plans.boundary.parameters[::-1].copy()
        ),
    )
    assert all(result.plane_error > 5e-3 for result in simulate_plans(swapped).executed)
    with is_refused(UsageError, argument="plans"):
        simulate_plans(plans, environment="clone")


def test_an_unmoved_table_is_simulated_as_without_parameters() -> None:
    plans = cnpgen.solve_plans(draw_boundary_problems("airhockey-hit", 1, seed=1)).plans
    still = replace(
        plans,
        problem=record_problem(PROBLEMS["airhockey-tables"]),
        boundary=replace(plans.boundary, parameters=np.array([[0, 0, 0, 1.0]])),
    )
    assert simulate_plans(still).executed == simulate_plans(plans).executed


def test_table_coordinates_are_those_of_pinocchio() -> None:
    values, positions = (
        drawn(PROBLEMS["airhockey-tables"], 20),
        np.random.default_rng(1).uniform(-1, 1, (20, 3)),
    )
    frame = table_frame(
        PROBLEMS["airhockey-tables"].parameters,
        PROBLEMS["airhockey-tables"].table_origin,
        values,
    )
    np.testing.assert_allclose(
        frame.to_table(frame.to_world(positions)), positions, atol=1e-14
    )
    for row, (height, roll, pitch, _) in enumerate(values):
        pose = pin.SE3(
            pin.rpy.rpyToMatrix(roll, pitch, 0.0),
            PROBLEMS["airhockey-tables"].table_origin + np.array([0, 0, height]),
        )
        expected = (
            pose.actInv(positions[row]) + PROBLEMS["airhockey-tables"].table_origin
        )
        np.testing.assert_allclose(frame.to_table(positions)[row], expected, atol=1e-14)


def test_a_box_contains_the_boxes_on_all_tables() -> None:
    low, high = np.array([0.6, -0.45, 0.16]), np.array([1.3, 0.45, 0.16])
    frame = table_frame(
        PROBLEMS["airhockey-tables"].parameters,
        PROBLEMS["airhockey-tables"].table_origin,
        drawn(PROBLEMS["airhockey-tables"], 4000),
    )
    corners = frame.to_world(
        np.where(np.random.default_rng(2).random((4000, 3)) < 0.5, low, high)
    )
    box = moved_box(
        PROBLEMS["airhockey-tables"].parameters,
        PROBLEMS["airhockey-tables"].table_origin,
        low,
        high,
    )
    assert (box[0] <= corners).all()
    assert (corners <= box[1]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_gradients_agree_with_finite_differences_at_other_values(name: str) -> None:
    problems = draw_boundary_problems(name, 3, seed=5)
    loss, random = (
        PlanLoss(name, dtype="float64", nodes=12, backend="numpy"),
        np.random.default_rng(3),
    )
    spec, boundary = loss.problem.trajectory, problems.boundary
    rate = random.uniform(1.5, 2.0, (3, spec.rate_control_points))
    along = np.linspace(0, 1, 10)[None, :, None]
    inner = boundary.start_q[:, None] * (1 - along) + boundary.goal_q[:, None] * along
    path = assemble(
        boundary, inner + 0.05 * random.normal(size=inner.shape), rate, spec
    )
    poses, step = problems.scene.poses, 1e-6
    by_path, by_rate = random.normal(size=path.shape), random.normal(size=rate.shape)

    def violation(h: float) -> np.ndarray:
        value = loss(
            path + h * by_path,
            rate + h * by_rate,
            weights=loss.weights0,
            obstacle_poses=poses,
        )
        return value.total - value.terms[:, 0]

    both = [
        loss(path, rate, weights=weights, obstacle_poses=poses)
        for weights in (loss.weights0, 0 * loss.weights0)
    ]
    gradients = [
        (each.path_gradient * by_path).sum((1, 2))
        + (each.rate_gradient * by_rate).sum(1)
        for each in both
    ]
    np.testing.assert_allclose(
        gradients[0] - gradients[1],
        (violation(step) - violation(-step)) / (2 * step),
        rtol=1e-6,
    )
    other = poses.copy()
    other[:, -len(loss.problem.parameters) :] = boundary.parameters[::-1]
    assert not np.allclose(
        loss(path, rate, weights=loss.weights0, obstacle_poses=other).total,
        both[0].total,
    )


CHANGES = [(NAMES[0], [0.01, 0, 0, 0]), (NAMES[0], [0, 0, 0, -0.2]), (NAMES[1], [9])]


@pytest.mark.parametrize(("name", "change"), some(CHANGES, 1, "slow"))
def test_rows_are_judged_by_their_own_values(name: str, change: list[float]) -> None:
    problems = draw_boundary_problems(name, 12, seed=1)
    problem = load_problem(name)
    columns = problems.boundary.arrays() | dict(problems.columns)
    assert verify_rows(problem, load_robot(problem), columns).ok
    columns["parameters"] = columns["parameters"] + np.array(change)
    assert not verify_rows(problem, load_robot(problem), columns).ok


def test_plans_need_parameters_of_their_problem() -> None:
    problems = draw_boundary_problems("heavy-object-loads", 3, seed=1)
    points = {
        "path_control_points": problems.path_control_points,
        "rate_control_points": problems.rate_control_points,
    }
    for parameters, text in (
        (None, "payload_mass"),
        (np.zeros((3, 2)), r"\(3, 1\)"),
        (np.zeros((2, 1)), r"\(3, 1\)"),
    ):
        with pytest.raises(UsageError, match=text):
            make_plans(
                "heavy-object-loads",
                replace(problems.boundary, parameters=parameters),
                **points,
            )


def test_values_are_checked_against_their_ranges() -> None:
    with is_refused(UsageError, argument="parameters"):
        PROBLEMS["heavy-object-loads"].parameters.checked(np.array([[5.0], [15.0]]))
    with is_refused(UsageError, argument="parameters"):
        PROBLEMS["airhockey-tables"].parameters.checked(np.array([0, 0, 0, np.nan]))
    with is_refused(UsageError, argument="parameters"):
        PROBLEMS["airhockey-tables"].parameters.checked(np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (
            'payload_mass = "[4, 14] kg"',
            'payload_weight = "[4, 14] kg"',
            "payload_weight",
        ),
        ('payload_mass = "[4, 14] kg"', 'payload_mass = "[4, 14] m"', "kg"),
        ('payload_mass = "[4, 14] kg"', 'velocity_factor = "[0.5, 2]"', "at most 1"),
        (
            'payload_mass = "[4, 14] kg"',
            'table_roll = "[-5, 5] deg"',
            "constraint 'table'",
        ),
        (
            'payload_mass = "[4, 14] kg"',
            'payload_mass = "[4, 11] kg"',
            "payload_mass must include 12",
        ),
        ("[payload] ", "[trash] ", "payload_mass needs the body"),
    ],
)
def test_recipe_errors_in_ranges_are_named(
    tmp_path: Path, old: str, new: str, text: str
) -> None:
    content = PROBLEMS["heavy-object-loads"].path.read_text()
    assert old in content
    (tmp_path / "iiwa14_gripper.urdf").write_text(
        PROBLEMS["heavy-object-loads"].urdf_text
    )
    (tmp_path / "problem.toml").write_text(content.replace(old, new))
    with pytest.raises(RecipeError, match=text):
        load_problem(tmp_path / "problem.toml")


def test_a_problem_without_parameters_keeps_its_identity() -> None:
    assert "parameters" not in resolved(load_problem("airhockey"))
    assert load_problem("airhockey").scene_width == 4
    assert PROBLEMS["airhockey-tables"].scene_width == 8
