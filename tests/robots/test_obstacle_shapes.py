"""The shape of a package among obstacles: every part agrees with the formula of the shape and with Coal."""

import importlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from cnpgen import (
    draw_boundary_problems,
    evaluate_plans,
    load_plans,
    save_plans,
    solve_plans,
)
from cnpgen.addons.benchmark.simulator.simulator_scene import MAX_ROUND_CORNERS
from cnpgen.addons.view.view_bodies import wrapped
from cnpgen.cli.main import main
from cnpgen.errors import PluginError, RecipeError, UsageError
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.obstacle_distances import SOLIDS
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem, resolved
from cnpgen.problems.problem_file import load_problem, restore_problem
from cnpgen.problems.scenes.observe import observe
from cnpgen.problems.scenes.scene_problem import SceneProblem, checked_scene
from cnpgen.robots.observation.observations import DistanceGrid, SurfaceCloud
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.schema.entry_points import entry_points
from cnpgen.world.collision_world import CollisionWorld
from tests.conftest import needs_compiled_code
from tests.examples.capped_cone import (
    NAME,
    ROUNDER,
    TABLE,
    cone_distance,
    installed_cone,
)
from tests.examples.coal_hulls import CoalHulls, compiled_hulls
from tests.examples.meshes import Meshes, states
from tests.examples.shaped_robot import write_pipeline, write_problem

BALL_SAG_M = 2e-4  # of the polyhedron that stands for the round edges of 2 cm


@pytest.fixture
def problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Problem]:
    with installed_cone(tmp_path, monkeypatch):
        yield load_problem(write_problem(tmp_path, obstacles=TABLE))


def slack(problem: Problem) -> float:
    """Return by how much the polytope exceeds the cone at most [m]."""
    return ROUNDER * float(problem.obstacle[0].shape.radius)


def segments(count: int) -> np.ndarray:
    """Ends of random segments about the cone [m], shape (count, 2, 3)."""
    random = np.random.default_rng(2)
    centers = np.add([0.45, 0.1, 0.25], random.normal(0, 0.25, (count, 1, 3)))
    return centers + random.normal(0, 0.1, (count, 2, 3))


def sampled(problem: Problem, ends: np.ndarray) -> np.ndarray:
    """Smallest distances of points of segments from the cone [m], shape (N,)."""
    share = np.linspace(0, 1, 2001)[:, None, None]
    points = (1 - share) * ends[:, 0] + share * ends[:, 1]
    return cone_distance(problem.obstacle[0], points).min(axis=0)


def test_the_judge_measures_the_cone(problem: Problem) -> None:
    world, ends = CollisionWorld(None), segments(200)
    world.place(solids_of(problem.obstacle, place_obstacles(problem.obstacle)))
    found = np.array(world.segment_distances(ends.tolist()))
    expected = sampled(problem, ends)
    outside = expected > 0
    assert 20 < outside.sum() < 190
    assert (found[outside] <= expected[outside] + 1e-6).all()
    assert (found[outside] >= expected[outside] - slack(problem) - 1e-5).all()


def test_solvers_have_a_lower_bound_with_the_sign_of_the_distance(
    problem: Problem,
) -> None:
    (obstacle,) = problem.obstacle
    (ends_sx, ends), (numbers_sx, numbers) = symbols("ends", 6), symbols("numbers", 12)
    solid = obstacle.form.symbolic(numbers, SOLIDS)
    distance = solid.separation(ends[:3], ends[3:], lambda value: value)
    function = ca.Function("cone", [ends_sx, numbers_sx], [distance])
    where, poses = segments(200), place_obstacles([obstacle])
    found = np.array([float(function(each.ravel(), poses)) for each in where])
    expected = sampled(problem, where)
    outside = expected > 0
    assert (found[outside] <= expected[outside] + 1e-6).all()
    # Edges and corners of the planes that bound the hull cost a part of the distance.
    assert (found[outside] >= 0.4 * expected[outside] - 0.02).all()
    assert (found[~outside] < 1e-6).all()


@needs_compiled_code
def test_compiled_clearances_agree_with_coal(problem: Problem, tmp_path: Path) -> None:
    robot = load_robot(problem)
    q = np.random.default_rng(1).uniform(
        robot.position_lower, robot.position_upper, (300, robot.n)
    )
    poses, meshes = place_obstacles(problem.obstacle), Meshes(problem, robot, tmp_path)
    compiled = compiled_hulls(problem, robot).measure(q.T.copy(), poses).min(axis=1)
    judged = CoalHulls(problem, robot).measure(q.T.copy(), poses).min(axis=1)
    np.testing.assert_allclose(compiled, judged, atol=1e-6)
    rounding, found = problem.obstacle[0].shape.rounding, map(meshes.distances, q)
    expected = np.array([min(outer - rounding, own) for outer, own in found])
    near = (expected > 0) & (expected < 0.02)
    assert near.sum() > 5
    assert (compiled[near] <= expected[near] + 1e-6).all()
    assert (compiled[near] >= expected[near] - slack(problem) - 1e-4).all()


@needs_compiled_code
def test_observations_and_views_show_the_cone(problem: Problem) -> None:
    (obstacle,) = problem.obstacle
    low, high = (0.1, -0.2, 0.0), (0.8, 0.4, 0.5)
    grid = DistanceGrid(low=low, high=high, shape=(9, 9, 9))
    found = observe([problem.obstacle], grid)["distances"][0]
    axes = np.meshgrid(*map(np.linspace, low, high, (9, 9, 9)), indexing="ij")
    expected = cone_distance(obstacle, np.stack(axes, axis=-1))
    outside = expected > 0
    assert (found[outside] <= expected[outside] + BALL_SAG_M).all()
    assert (found[outside] >= expected[outside] - slack(problem) - 1e-6).all()
    assert (np.sign(found) == np.sign(expected))[np.abs(expected) > 1e-3].all()
    cloud = observe([problem.obstacle], SurfaceCloud(points=500))["cloud"][0]
    (solid,) = solids_of(problem.obstacle, place_obstacles(problem.obstacle))
    drawn = wrapped("cone", 0, solid.position + solid.corners, solid.radius).corners
    for points in (cloud, drawn):
        assert np.abs(cone_distance(obstacle, points)).max() < slack(problem) + 2e-4
    tokens = observe([problem.obstacle], "tokens")["tokens"][0]
    assert tokens.shape == (1, 16)
    assert len(solid.corners) > MAX_ROUND_CORNERS  # a mesh in simulators


@needs_compiled_code
def test_plans_avoid_the_cone_and_need_its_package(
    tmp_path: Path, problem: Problem
) -> None:
    write_pipeline(tmp_path)
    drawn = draw_boundary_problems(tmp_path / "pipeline.toml", 6, seed=5)
    save_plans(tmp_path / "plans.h5", solve_plans(drawn, workers=1).plans)
    plans = load_plans(tmp_path / "plans.h5")
    verdicts = evaluate_plans(plans, workers=1).verdicts
    valid = [index for index, verdict in enumerate(verdicts) if verdict.valid]
    assert len(valid) >= 4
    meshes = Meshes(problem, load_robot(problem), tmp_path)
    clearances = [
        min(meshes.distances(q)[0] for q in states(plans, index)) for index in valid
    ]
    rounding = problem.obstacle[0].shape.rounding
    # Less the tolerance of the problem; the cone is in the way.
    assert rounding - 1e-4 - 1e-6 < min(clearances) < rounding + 0.01
    (tmp_path / f"{NAME}-1.0.dist-info" / "entry_points.txt").write_text("")
    entry_points.cache_clear()
    with pytest.raises(PluginError, match=NAME):
        restore_problem(resolved(problem), problem.urdf_text, tmp_path)


def test_the_identity_depends_on_dimensions_and_code(
    problem: Problem, tmp_path: Path
) -> None:
    assert problem.structure is None
    source = tmp_path / f"{NAME}.py"
    other = TABLE.replace("top_radius = 0.05", "top_radius = 0.06")
    wider = load_problem(write_problem(tmp_path, obstacles=other))
    assert wider.identity != problem.identity
    again = load_problem(write_problem(tmp_path, obstacles=TABLE))
    assert again.identity == problem.identity
    source.write_text(source.read_text() + "# another version\n")
    importlib.invalidate_caches()
    changed = load_problem(write_problem(tmp_path, obstacles=TABLE))
    assert changed.identity != problem.identity


def test_show_names_shape_and_dimensions(
    problem: Problem, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["show", str(problem.path)]) == 0
    text = capsys.readouterr().out
    assert "capped_cone: radius 0.12 m, top_radius 0.05 m" in text


def test_wrong_tables_are_refused(problem: Problem, tmp_path: Path) -> None:
    del problem
    for old, new, key in (
        ("top_radius = 0.05", "top_radius = 0", "top_radius"),
        (", length = 0.3", "", "length"),
        ('use = "capped_cone"', 'use = "cone"', "use"),
        ('kind = "convex"', "", "shape"),
        ('use = "capped_cone", radius', 'use = "sphere", radius', "top_radius"),
    ):
        table = write_problem(tmp_path, obstacles=TABLE.replace(old, new))
        with pytest.raises(RecipeError) as error:
            load_problem(table)
        assert any(key in text for text in error.value.errors), error.value.errors


def test_an_unknown_kind_is_refused_with_how_to_use_shapes_of_packages(
    tmp_path: Path,
) -> None:
    table = write_problem(tmp_path, obstacles=TABLE.replace('"convex"', '"wedge"'))
    with pytest.raises(RecipeError, match=r"kind = .convex. and shape = "):
        load_problem(table)


@pytest.mark.parametrize(
    ("name", "value"), [("radius", np.nan), ("top_radius", -0.1), ("length", 1e9)]
)
def test_dimensions_of_python_are_checked(
    problem: Problem, name: str, value: float
) -> None:
    (obstacle,) = problem.obstacle
    shape = replace(obstacle.shape, **{name: value})
    with pytest.raises(UsageError, match=name):
        problem.with_obstacles([replace(obstacle, shape=shape)])


@pytest.mark.parametrize(
    ("corners", "radius", "text"),
    [
        (np.zeros((1, 3)), 0.1, "corners are not those of a body"),
        (CUBE * [0.2, 0.2, 0], 0.1, "corners are not those of a body"),
        (CUBE, -0.1, "radius must not be negative or large"),
        (CUBE, np.nan, "radius must not be negative or large"),
    ],
)
def test_polytopes_that_are_no_bodies_are_refused(
    problem: Problem,
    monkeypatch: pytest.MonkeyPatch,
    corners: np.ndarray,
    radius: float,
    text: str,
) -> None:
    (obstacle,) = problem.obstacle
    polytope = lambda _: (corners, radius)  # noqa: E731
    monkeypatch.setattr(type(obstacle.shape), "polytope", polytope)
    with pytest.raises(UsageError, match=text):
        problem.with_obstacles([obstacle])


@pytest.mark.parametrize(
    "polytope",
    [
        "[(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], 0.0",
        "np.eye(3)",
        "np.zeros((4, 2)), 0.0",
        "np.eye(4, 3), None",
        "np.random.default_rng().normal(size=(8, 3)), 0.0",
        "np.eye(4, 3), np.random.default_rng().uniform()",
    ],
)
def test_wrong_polytopes_of_packages_are_refused(
    problem: Problem, monkeypatch: pytest.MonkeyPatch, polytope: str
) -> None:
    (obstacle,) = problem.obstacle
    method = eval(f"lambda self: ({polytope})", {"np": np})
    monkeypatch.setattr(type(obstacle.shape), "polytope", method)
    with pytest.raises(
        UsageError,
        match=rf"of the package '{NAME}' returns .*array of corners of shape \(V, 3\)",
    ):
        problem.with_obstacles([replace(obstacle, name="other")])


def test_scenes_refuse_the_shape_of_a_package(problem: Problem) -> None:
    scene = SceneProblem("one", problem.obstacle, np.zeros(4), np.zeros((1, 4)))
    with pytest.raises(UsageError, match="cone"):
        checked_scene(scene)
    with pytest.raises(UsageError, match="cone"):
        scene_plans(problem, [scene])
