"""Parameters of manifolds: the rectangle of the table, the upright direction and its tolerance."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import cnpgen
from cnpgen.judges.rows.verify import verify_rows
from cnpgen.kernels.library import choose_backend
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.recipe import DatasetRecipe, as_dataset_recipe
from cnpgen.pipelines.completion import Completion
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.collision import Collision
from cnpgen.plans.plans import Plans
from cnpgen.problems.constraints.axis import Axis, TipAxis
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.robots.parameter_ranges import NO_PARAMETERS, ParameterRanges
from cnpgen.schema.keys import Range
from cnpgen.training.settings import TrainingSettings
from cnpgen.trajectory.boundary import assemble
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.examples.example_robots import needs_robots
from tests.examples.shipped import PROBLEMS

TABLE_RANGES = ParameterRanges(
    table_x_low=Range(0.55, 0.62),
    table_x_high=Range(1.4, 2.0),
    table_y_low=Range(-0.5, -0.35),
    table_y_high=Range(0.35, 0.5),
)
UPRIGHT_RANGES = ParameterRanges(
    upright_roll=Range(-0.1, 0.1),
    upright_pitch=Range(-0.1, 0.15),
    upright_tolerance=Range(0.01, 0.06),
)


def rectangles() -> Problem:
    """Return the table with a rectangle per sample."""
    return replace(PROBLEMS["airhockey-tables"], parameters=TABLE_RANGES)


def objects() -> Problem:
    """Return the carried object with an upright direction per sample, without obstacles."""
    loads = PROBLEMS["heavy-object-loads"]
    return replace(
        loads,
        parameters=UPRIGHT_RANGES,
        obstacle=(),
        constraint=loads.constraint[:5],
    )


def wipe() -> Problem:
    """Return the wiping arm with an upright direction per sample."""
    return replace(PROBLEMS["ur5-wipe"], parameters=UPRIGHT_RANGES)


def wipe_in_range() -> Problem:
    """Return the wiping arm whose axis is free within 0.04 rad."""
    return in_range(wipe(), 0.04)


def in_range(problem: Problem, angle: float) -> Problem:
    """Return a problem whose axis is free within an angle."""
    constraints = [
        replace(item, angle=angle, tolerance=0.01) if isinstance(item, Axis) else item
        for item in problem.constraint
    ]
    return replace(problem, constraint=tuple(constraints))


def recipe_of(name: str, problem: Problem) -> DatasetRecipe:
    """Return a shipped dataset for another problem, without collisions."""
    recipe = as_dataset_recipe(name)
    stages = tuple(
        stage for stage in recipe.pipeline.stage if not isinstance(stage, Collision)
    )
    return replace(
        recipe, pipeline=replace(recipe.pipeline, problem=problem, stage=stages)
    )


def drawn(problem: Problem, n: int) -> np.ndarray:
    """Return random parameters of a problem, shape (n, width)."""
    low, high = np.array(
        [(span.low, span.high) for span in problem.parameters.ranges]
    ).T
    return np.random.default_rng(7).uniform(low, high, (n, len(low)))


def with_values(problem: Problem, values: np.ndarray) -> Problem:
    """Return the problem without parameters that is equal to a problem at some values."""
    named = dict(zip(problem.parameters.names, values.tolist(), strict=True))
    roll, pitch, tolerance = (
        named.get(f"upright_{name}") for name in ("roll", "pitch", "tolerance")
    )
    constraints = []
    for item in problem.constraint:
        if isinstance(item, Table):
            x, y = (
                Range(named[f"table_{side}_low"], named[f"table_{side}_high"])
                for side in "xy"
            )
            constraints.append(replace(item, x=x, y=y))
        elif isinstance(item, TipAxis):
            axis, direction = item.directions
            direction = pin.rpy.rpyToMatrix(roll, pitch, 0.0) @ direction
            angle = getattr(item, "angle", 0.0)
            bounds = (
                {"angle": tolerance, "tolerance": item.tolerance}
                if angle
                else {"tolerance": tolerance}
            )
            constraints.append(
                Axis(axis=tuple(axis), direction=tuple(direction.tolist()), **bounds)
            )
        else:
            constraints.append(item)
    return replace(problem, parameters=NO_PARAMETERS, constraint=tuple(constraints))


@lru_cache
def solved(name: str) -> Plans:
    """Return refined plans of problems with parameters."""
    dataset, problem = {
        "rectangle": ("airhockey-tables", rectangles()),
        "vertical": ("heavy-object-loads", objects()),
    }[name]
    problems = draw_boundary_problems(recipe_of(dataset, problem), 6, seed=3)
    return cnpgen.solve_plans(problems).plans


@pytest.mark.parametrize(
    "make",
    [
        rectangles,
        objects,
        pytest.param(wipe, marks=needs_robots),
        pytest.param(wipe_in_range, marks=needs_robots),
    ],
    ids=lambda make: make.__name__,
)
def test_both_forms_agree_on_motions_and_at_their_ends(
    make: Callable[[], Problem],
) -> None:
    problem = make()
    robot, random, n = load_robot(problem), np.random.default_rng(2), 8
    exact = tuple(
        item for item in problem.constraint if isinstance(item, Table | TipAxis)
    )
    problem = replace(problem, constraint=exact, obstacle=(), object=None)
    model, values = cnpgen.RobotModel(problem, backend="numpy"), drawn(problem, n)
    q, dq, ddq = (
        mean + random.uniform(-1, 1, (n, robot.n)) for mean in (robot.home, 0, 0)
    )
    tip = model.forward_kinematics(q)[0]
    scene = model.scene(tip, tip, parameters=values)
    found = model.constraint_values(q, dq, ddq, scene=scene)
    for row in range(n):
        world = World(robot)
        world.set_state(q[row], dq[row], ddq[row], scene.poses[row])
        expected = [
            value
            for item in exact
            for condition in item.measured(world)
            for value in condition.g
        ]
        np.testing.assert_allclose(
            found.g[row], np.array(expected, float), rtol=1e-9, atol=1e-10
        )


@pytest.mark.parametrize("name", ["rectangle", "vertical"])
def test_samples_plans_and_verdicts_have_their_own_values(name: str) -> None:
    plans = solved(name)
    with plans.problem.restored() as problem:
        columns = plans.boundary.arrays() | dict(plans.columns)
        assert verify_rows(problem, load_robot(problem), columns).ok
        verdicts = cnpgen.evaluate_plans(plans).verdicts
        assert all(verdict.valid for verdict in verdicts)
        for row, verdict in enumerate(verdicts):
            own = record_problem(with_values(problem, plans.boundary.parameters[row]))
            one = replace(
                plans[row],
                problem=own,
                boundary=replace(plans[row].boundary, parameters=None),
            )
            (expected,) = cnpgen.evaluate_plans(one).verdicts
            assert expected.valid
            for margin, other in zip(
                verdict.margins.values(), expected.margins.values(), strict=True
            ):
                assert margin.tolerance == pytest.approx(other.tolerance)
                assert margin.violation == pytest.approx(
                    other.violation, rel=1e-6, abs=1e-7
                )
            assert verdict.paper.valid == expected.paper.valid
        others = replace(
            plans,
            boundary=replace(plans.boundary, parameters=drawn(problem, len(plans))),
        )
        assert not all(
            verdict.valid for verdict in cnpgen.evaluate_plans(others).verdicts
        )


@pytest.mark.parametrize("form", ["signed", "paper"])
@pytest.mark.parametrize("name", ["rectangle", "vertical"])
def test_losses_are_those_of_the_problem_at_these_values(name: str, form: str) -> None:
    plans, random, step = solved(name), np.random.default_rng(4), 1e-6
    with plans.problem.restored() as problem:
        loss = PlanLoss(problem, dtype="float64", nodes=12, backend="numpy", form=form)
        boundary, spec = plans.boundary, problem.trajectory
        inner = plans.motion.path[:, 3:-2]
        inner, rate = inner + 0.05 * random.normal(size=inner.shape), plans.motion.rate
        path, poses, weights = (
            assemble(boundary, inner, rate, spec),
            plans.scene.poses.copy(),
            loss.weights0,
        )
        if (
            name == "vertical" and form == "signed"
        ):  # the loss of a tilt is relative to the tolerance of the sample
            poses[:, -1] = problem.nominal_parameters[-1]
        both = [
            loss(path, rate, weights=each, obstacle_poses=poses)
            for each in (weights, 0 * weights)
        ]
        by_path = random.normal(size=path.shape)
        gradients = [(each.path_gradient * by_path).sum((1, 2)) for each in both]
        ends = [
            loss(path + h * by_path, rate, weights=weights, obstacle_poses=poses)
            for h in (step, -step)
        ]
        violations = [each.total - each.terms[:, 0] for each in ends]
        np.testing.assert_allclose(
            gradients[0] - gradients[1],
            (violations[0] - violations[1]) / (2 * step),
            rtol=1e-5,
        )
        if name == "vertical" and form == "paper":
            return
        for row, values in enumerate(poses[:, -len(problem.parameters) :]):
            own = with_values(problem, values)
            alone = PlanLoss(own, dtype="float64", nodes=12, backend="numpy", form=form)
            scene = poses[[row], : own.scene_width] if own.scene_width else None
            one = alone(path[[row]], rate[[row]], weights=weights, obstacle_poses=scene)
            np.testing.assert_allclose(both[0].total[row], one.total[0], rtol=1e-9)


@pytest.mark.extended
def test_a_planner_projects_onto_the_manifold_of_each_sample(tmp_path: Path) -> None:
    recipe = recipe_of("heavy-object-loads", objects())
    cnpgen.make_dataset(recipe, tmp_path / "rows", n=300, workers=1)
    settings = TrainingSettings(hidden=16, line_projection_steps=3, projection_steps=3)
    cnpgen.train_model(
        tmp_path / "rows",
        tmp_path / "m.h5",
        settings=settings,
        steps=2,
        check_rows=3,
        workers=1,
    )
    planner = cnpgen.Planner(tmp_path / "m.h5")
    problems = draw_boundary_problems(recipe, 4, seed=9)
    boundary = problems.boundary
    plans = planner.plan(
        boundary.start_q, boundary.goal_q, parameters=boundary.parameters
    )
    assert not np.allclose(boundary.parameters[0], boundary.parameters[1])
    positions = np.array(
        [plans.states_at(share * plans.duration)[0] for share in np.linspace(0, 1, 20)]
    )
    for row, (roll, pitch, _) in enumerate(boundary.parameters):
        up, q = pin.rpy.rpyToMatrix(roll, pitch, 0.0)[:, 2], positions[:, row].T
        world = PathWorld(planner.robot)
        world.set_path(q, 0 * q, 0 * q, np.empty(0))
        tilt = np.arccos(np.einsum("i,ik->k", up, world.tip_rotation[:, 2]))
        assert tilt[[0, -1]].max() < 1e-6
        assert tilt.max() < 0.02
        assert np.arccos(world.tip_rotation[2, 2]).min() > 0.5 * np.hypot(roll, pitch)


@pytest.mark.parametrize(
    ("name", "ranges", "text"),
    [
        (
            "heavy-object-loads",
            ParameterRanges(table_x_low=Range(0.5, 0.6)),
            "constraint 'table'",
        ),
        (
            "airhockey-tables",
            ParameterRanges(upright_roll=Range(-0.1, 0.1)),
            "upright_roll needs one constraint",
        ),
        (
            "airhockey-tables",
            ParameterRanges(table_x_low=Range(0.5, 2.1)),
            "table_x_low must be below table_x_high in all samples",
        ),
        (
            "airhockey-tables",
            ParameterRanges(table_y_high=Range(0.5, 0.6)),
            "table_y_high must include 0.45",
        ),
        (
            "heavy-object-loads",
            ParameterRanges(upright_tolerance=Range(0.1, 0.2)),
            "upright_tolerance must include 0.0314159",
        ),
    ],
)
def test_recipe_errors_in_ranges_are_named(
    name: str, ranges: ParameterRanges, text: str
) -> None:
    problem = PROBLEMS[name]
    assert any(
        text in error for _, error in replace(problem, parameters=ranges).validate()
    )


def test_configurations_of_tasks_are_along_the_direction_of_each_sample() -> None:
    boundary = solved("vertical").boundary
    robot = load_robot(objects())
    for q, (roll, pitch, _) in zip(boundary.goal_q, boundary.parameters, strict=True):
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, q)
        R = pin.updateFramePlacement(robot.model, data, robot.tip_frame).rotation
        np.testing.assert_allclose(
            R[:, 2], pin.rpy.rpyToMatrix(roll, pitch, 0.0)[:, 2], atol=1e-8
        )


def test_tasks_are_checked_with_the_rectangle_of_each_sample() -> None:
    backend, folder = choose_backend(None)
    pipeline = recipe_of("airhockey-tables", rectangles()).pipeline
    context = PreparedPipeline(
        pipeline, backend=backend, cache_folder=folder, dtype="float64"
    ).context
    columns = {
        "start_xyz": np.array([[0.65], [0.0], [0.16]]),
        "goal_xyz": np.array([[1.0], [0.4], [0.16]]),
        "hit_angle": np.zeros((1, 1)),
        "hit_speed_share": np.full((1, 1), 0.5),
        "parameters": np.array(
            [[0.6, 2.0, -0.45, y_high] for y_high in (0.45, 0.36, 0.5)]
        ).T,
    }
    tasks = Completion(pipeline, context, list(columns))(columns)
    assert tasks.alive.tolist() == [0, 2]
