"""Planners of scenes: features, rows of scene files, training, model files and planning."""

from dataclasses import replace

import numpy as np
import pytest
import scipy

from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, UsageError
from cnpgen.kernels.library import problem_kernels
from cnpgen.planner.control_points import control_points
from cnpgen.planner.inference_pipeline import loaded_problem, make_inference_pipeline
from cnpgen.planner.model_file import load_model, model_content, model_from_content
from cnpgen.planner.network.architecture import forward, initial_parameters
from cnpgen.planner.network.features import (
    BASIS,
    MAX_DISTANCE_M,
    MIN_DISTANCE_M,
    PATH_PHASES,
    count_scene_features,
    make_scene_features,
)
from cnpgen.planner.plan_requests import plan_scenes, scene_requests
from cnpgen.planner.planner import Planner
from cnpgen.planner.tasks import ends_of
from cnpgen.plans.plan_file import load_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import with_capacity
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.robots.observation.primitives import primitives_of
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import Scene
from cnpgen.robots.shape.hull import hull_corners
from cnpgen.robots.shape.inline import address_of
from cnpgen.robots.solid import number_slices, place_obstacles
from cnpgen.scenes import SceneProblem, save_scenes
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.training.adam import Clipping
from cnpgen.training.data import make_scene_rows
from cnpgen.training.prepare import prepare_run
from cnpgen.training.settings import TrainingSettings
from cnpgen.training.train import train_model
from cnpgen.training.training_options import TrainingOptions
from cnpgen.trajectory.spline import clamped_knots
from cnpgen.world.forward_kinematics import ForwardKinematics
from tests.conftest import needs_compiled_code
from tests.examples.numpy_observations import signed_distances
from tests.examples.shaped_robot import WEDGE, write_problem
from tests.refusals import is_refused

TINY = TrainingSettings(hidden=8, layers=1, batch_size=16, nodes=8, validations=1)


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    path = write_problem(tmp_path_factory.mktemp("crane"))
    return load_problem(path).with_obstacles(())


def obstacles(random: np.random.Generator, count: int) -> tuple[Obstacle, ...]:
    boxes = [
        Obstacle(
            name=f"box {index}",
            kind="box",
            position=tuple(random.uniform([0.3, -0.4, 0.0], [0.6, 0.4, 0.6])),
            size=tuple(random.uniform(0.05, 0.2, 3)),
            rotation=(0.0, 0.0, float(random.uniform(-1, 1))),
        )
        for index in range(count - 1)
    ]
    place = tuple(random.uniform([0.3, -0.4, 0.0], [0.6, 0.4, 0.6]))
    return (
        *boxes,
        Obstacle(name="can", kind="cylinder", position=place, radius=0.04, length=0.2),
    )


def scenes(problem, count: int) -> list[SceneProblem]:
    random, robot = np.random.default_rng(1), load_robot(problem)
    ends = random.uniform(
        robot.position_lower, robot.position_upper, (count, 2, robot.n)
    )
    return [
        SceneProblem(
            name=f"{i}",
            obstacles=obstacles(random, 2 + i % 3),
            start_q=start,
            goal_q=goal[None],
        )
        for i, (start, goal) in enumerate(ends)
    ]


def test_features_do_not_depend_on_the_order_of_obstacles(problem, tmp_path):
    robot, random = load_robot(problem), np.random.default_rng(2)
    items = [item for item in obstacles(random, 5) if item.kind == "box"]
    numbers, slices = place_obstacles(items), number_slices(items)
    turned = np.concatenate([numbers[slices[index]] for index in (2, 0, 3, 1)])
    path = random.uniform(robot.position_lower, robot.position_upper, (3, 15, robot.n))
    features = make_scene_features(
        robot, problem.trajectory, problem_kernels(problem, robot, "numpy", tmp_path)
    )
    found, other = (
        features(path, Scene(tuple(items), np.tile(poses, (3, 1))))
        for poses in (numbers, turned)
    )
    assert found.shape == (3, count_scene_features(robot.n))
    np.testing.assert_allclose(found, other, atol=1e-12)
    bodies = primitives_of(items, numbers)
    expected = np.clip(
        signed_distances(bodies, BASIS.positions).min(axis=0),
        MIN_DISTANCE_M,
        MAX_DISTANCE_M,
    )
    np.testing.assert_allclose(found[0, -BASIS.points :], expected, atol=1e-6)


def test_clearances_along_a_path_are_those_of_the_capsules(problem, tmp_path):
    robot, random = load_robot(problem), np.random.default_rng(3)
    items = obstacles(random, 4)
    path, spec = (
        random.uniform(robot.position_lower, robot.position_upper, (15, robot.n)),
        problem.trajectory,
    )
    features = make_scene_features(
        robot, spec, problem_kernels(problem, robot, "numpy", tmp_path)
    )
    scene = Scene(items, place_obstacles(items)[None])
    found = features(path[None], scene)[0]
    phases = (np.arange(PATH_PHASES) + 1) / (PATH_PHASES + 1)
    states = scipy.interpolate.BSpline(
        clamped_knots(15, spec.degree), path, spec.degree
    )(phases)
    rotations, positions = ForwardKinematics(robot.model).poses(states.T)
    bodies = primitives_of(items, scene.poses[0])
    for phase in range(PATH_PHASES):
        smallest = MAX_DISTANCE_M
        for capsule in robot.shape.moving_capsules:
            joint = robot.shape.joints[capsule.link]
            ends = (
                np.array([capsule.first, capsule.second])
                @ rotations[joint][..., phase].T
            )
            distances = signed_distances(bodies, ends + positions[joint][:, phase])
            smallest = min(smallest, float(distances.min()) - capsule.radius)
        entry = found[phase * (robot.n + 2)]
        assert (
            entry <= max(smallest, MIN_DISTANCE_M) + 1e-6
        )  # ends of the axes, and points between them
        assert entry >= max(smallest - 0.12, MIN_DISTANCE_M) - 1e-6


def test_obstacles_of_a_scene_fill_places_of_their_shape(problem):
    wedge = Obstacle(
        name="wedge",
        kind="mesh",
        position=(0.5, 0.0, 0.2),
        mesh=address_of(hull_corners(0.001 * WEDGE)),
    )
    (scene,) = scenes(problem, 1)
    mixed = replace(scene, obstacles=(*scene.obstacles, wedge))
    full = with_capacity(problem, {"box": 2, "cylinder": 1, wedge.mesh: 1})
    model = replace(load_model("heavy-object"), problem=record_problem(full))
    (placed,) = scene_requests(model, [mixed]).columns[OBSTACLE_POSES]
    part = number_slices(full.obstacle)[-1]
    np.testing.assert_allclose(placed[part], place_obstacles([wedge]))
    with is_refused(UsageError, argument="capacity"):
        scene_requests(model, [replace(mixed, obstacles=(*mixed.obstacles, wedge))])


def test_training_rows_are_problems_and_their_reverses(problem):
    items = scenes(problem, 60)
    rows = make_scene_rows(problem, items, "here")
    training, checked, judged = (
        rows.training(),
        rows.checked(1),
        rows.judged(100, after=1),
    )
    assert len(training.boundary) == 2 * 57
    assert len(checked.boundary) + len(judged.boundary) == 3
    np.testing.assert_array_equal(
        training.boundary.start_q[57:], training.boundary.goal_q[:57]
    )
    np.testing.assert_array_equal(
        training.obstacle_poses[57:], training.obstacle_poses[:57]
    )
    np.testing.assert_array_equal(judged.boundary.goal_q[-1], items[-1].goal_q[0])
    with is_refused(UsageError, argument="folder"):
        make_scene_rows(problem, items[:3], "here")


def test_the_next_iteration_starts_from_the_path_of_the_last_one(problem):
    items = scenes(problem, 5)
    rows = make_scene_rows(problem, items * 8, "here")
    random, spec = np.random.default_rng(6), problem.trajectory
    with loaded_problem(rows.problem, "numpy") as loaded:
        config = replace(TINY, iterations=2).config
        inference = make_inference_pipeline(loaded, config, scale_time=False)
    tasks = inference.prepare(rows.boundary[:5], obstacle_poses=rows.obstacle_poses[:5])
    assert tasks.correction.shape == (5, 10, 4)
    assert not tasks.correction.any()
    outputs = [random.uniform(-0.5, 0.5, (5, width)) for width in (40, 20)]
    points = control_points(tasks, *outputs, scale=0.5, spec=spec)
    following = inference.prepare.along(tasks, points.path)
    again = control_points(
        following, np.zeros((5, 40)), outputs[1], scale=0.5, spec=spec
    )
    np.testing.assert_allclose(again.path, points.path, atol=1e-12)
    features = inference.prepare.scene_features
    np.testing.assert_array_equal(
        following.observation, features(points.path, tasks.placed)
    )
    assert not np.array_equal(following.observation, tasks.observation)


def test_control_points_stay_within_the_limits(problem):
    rows = make_scene_rows(problem, scenes(problem, 40), "here")
    with loaded_problem(rows.problem, "numpy") as loaded:
        config = replace(TINY, within_limits=True).config
        inference, robot = (
            make_inference_pipeline(loaded, config, scale_time=False),
            loaded.robot,
        )
    offsets = np.random.default_rng(7).uniform(-9, 9, (40, 5))
    boundary = rows.boundary[:5]
    (path,) = inference.path(
        ends_of(boundary), offsets, np.ones((20, 5)), np.empty((0, 5))
    )
    points = path.T.reshape(5, 15, 4)
    assert (points >= robot.position_lower).all()
    assert (points <= robot.position_upper).all()
    np.testing.assert_allclose(
        points[:, :3], np.repeat(boundary.start_q[:, None], 3, axis=1)
    )


@needs_compiled_code
def test_the_gradient_is_the_sum_of_those_of_all_iterations(problem):
    rows = make_scene_rows(problem, scenes(problem, 60), "here")
    settings = replace(TINY, iterations=3)
    with loaded_problem(rows.problem) as loaded:
        run, inference = prepare_run(rows, loaded, settings)
    learner, batch = run.learner, run.rows.take(np.arange(4))
    parameters = initial_parameters(
        learner.architecture, seed=1, head_scale=1.0, rate_bias=-0.5
    )
    weights, clipping = np.ones(len(run.loss.terms) - 1), Clipping()

    def gradient(learner, rows):
        out = np.empty_like(parameters)
        learner.gradient(
            parameters, rows, weights, shift=0.0, clipping=clipping, out=out
        )
        return out.astype(float)

    single, expected = (
        replace(learner, settings=replace(settings, iterations=1, sample_clip=np.inf)),
        0.0,
    )
    learner = replace(learner, settings=replace(settings, sample_clip=np.inf))
    found = gradient(learner, batch)
    for _ in range(3):
        expected = expected + gradient(single, batch)
        activations = forward(learner.architecture.split(parameters), batch.features)
        points = control_points(
            batch.tasks,
            activations.path,
            activations.log_rate,
            scale=0.5,
            spec=learner.spec,
        )
        tasks = inference.prepare.along(batch.tasks, points.path)
        batch = replace(batch, tasks=tasks, features=learner.features.of(tasks))
    np.testing.assert_allclose(
        found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max()
    )


@needs_compiled_code
@pytest.mark.slow
def test_a_planner_is_trained_on_a_scene_file_and_plans_its_scenes(
    problem, tmp_path, capsys
):
    robot, items, file = tmp_path / "crane", scenes(problem, 60), tmp_path / "scenes.h5"
    path = write_problem(tmp_path)
    save_scenes(file, items)
    with is_refused(UsageError, argument="folder"):
        train_model(file, tmp_path / "model.h5", steps=8)
    own = load_problem(path)
    settings = replace(TINY, iterations=2)
    trained = train_model(
        file,
        tmp_path / "model.h5",
        steps=8,
        settings=settings,
        check_rows=1,
        workers=1,
        options=TrainingOptions(robot=str(path)),
    )
    model = load_model(trained.path)
    assert model.features.blocks[-2:] == ("scene", "line")
    assert model.config.iterations == 2
    content = model_content(model)
    for damage in ('"iterations": 1', '"iterations": 2.5', '"iterations": 1000'):
        texts = {
            **content.texts,
            "description": content.texts["description"].replace(
                '"iterations": 2', damage
            ),
        }
        with is_refused(DatasetError):
            model_from_content(trained.path, replace(content, texts=texts))
    assert robot.exists()
    planner = Planner(model)
    plans = plan_scenes(planner, items[:4])
    assert len(plans.scene.obstacles) == len(own.obstacle) + 8
    np.testing.assert_allclose(
        plans.path_control_points[:, 0],
        [item.start_q for item in items[:4]],
        atol=1e-12,
    )
    parked = np.tile(place_obstacles(plans.scene.obstacles), (4, 1))
    empty = planner.plan_batch(plans.boundary, columns={OBSTACLE_POSES: parked})
    assert not np.array_equal(empty.path_control_points, plans.path_control_points)
    shuffled = [replace(item, obstacles=item.obstacles[::-1]) for item in items[:4]]
    np.testing.assert_allclose(
        plan_scenes(planner, shuffled).path_control_points,
        plans.path_control_points,
        atol=1e-5,
    )
    assert (
        main(
            [
                "plan",
                str(file),
                "--model",
                str(trained.path),
                "--n",
                "4",
                "-o",
                str(tmp_path / "plans.h5"),
            ]
        )
        == 0
    )
    capsys.readouterr()
    again = load_plans(tmp_path / "plans.h5")
    np.testing.assert_allclose(
        again.columns[OBSTACLE_POSES], plans.columns[OBSTACLE_POSES], atol=1e-5
    )
    crowded = replace(items[0], obstacles=obstacles(np.random.default_rng(5), 12))
    with is_refused(UsageError, argument="capacity"):
        plan_scenes(planner, [crowded])
    with is_refused(UsageError, argument="model"):
        plan_scenes(Planner("heavy-object"), items[:1])
