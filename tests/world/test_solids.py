"""Obstacles of every kind in the collision world: comparison with Coal's own shapes and the URDF's own geometry."""

from functools import partial
from pathlib import Path

import coal
import numpy as np
import pytest
import scipy

from cnpgen.errors import UsageError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.scenes.scene_problem import make_mesh
from cnpgen.robots.shape.hull import coal_hull
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.world.collision_world import CollisionWorld
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.conftest import some
from tests.examples.meshes import Meshes
from tests.examples.obstacles import (
    KINDS,
    ROUNDER,
    coal_distance,
    draw_obstacle,
    segment,
)
from tests.examples.shaped_robot import KINDS as AMONG_KINDS
from tests.examples.shaped_robot import write_problem
from tests.problems.test_constraints import gantry_problem

SIZE = (0.2, 0.14, 0.3)


@pytest.mark.parametrize("kind", some(KINDS, 3, "slow"))
def test_distances_of_segments_and_objects_agree_with_coal_s_own_shapes(
    kind: str,
) -> None:
    random, inside = np.random.default_rng(3), 0
    for _ in range(10):
        obstacle = draw_obstacle(kind, random)
        world, thinner = (
            CollisionWorld(SIZE),
            ROUNDER * (obstacle.radius or 0.0) if kind == "cylinder" else 0.0,
        )
        world.place(solids_of([obstacle], place_obstacles([obstacle])))
        for _ in range(20):
            first, second = random.normal(0, 0.2, (2, 3))
            position, turn = (
                random.normal(0, 0.25, 3),
                scipy.spatial.transform.Rotation.random(
                    random_state=random
                ).as_matrix(),
            )
            bodies = [
                (
                    world.segment_distance(first.tolist(), second.tolist(), 0),
                    segment(first, second),
                ),
                (
                    world.object_distance(position, turn, 0),
                    (coal.Box(*SIZE), coal.Transform3s(turn, position)),
                ),
            ]
            for (found, direction), body in bodies:
                expected = coal_distance(*body, obstacle)
                assert expected - 2e-6 - thinner <= found <= expected + 2e-6
                assert np.linalg.norm(direction) == pytest.approx(1)
                inside += expected < 0
            (distance,) = world.segment_distances([(first.tolist(), second.tolist())])
            assert distance == bodies[0][0][0]
            assert world.object_distances(position, turn) == [bodies[1][0][0]]
    assert inside > 20


@pytest.mark.parametrize("kind", KINDS)
def test_the_support_function_of_a_solid_agrees_with_its_bounds(kind: str) -> None:
    random = np.random.default_rng(4)
    obstacle = draw_obstacle(kind, random)
    (solid,) = solids_of([obstacle], place_obstacles([obstacle]))
    for axis in range(3):
        unit = np.eye(3)[axis]
        assert solid.furthest(unit) == pytest.approx(solid.high[axis], abs=1e-12)
        assert -solid.furthest(-unit) == pytest.approx(solid.low[axis], abs=1e-12)


def test_shapes_of_links_among_obstacles_of_every_kind(tmp_path: Path) -> None:
    problem = load_problem(write_problem(tmp_path, obstacles=AMONG_KINDS))
    robot, random = load_robot(problem), np.random.default_rng(3)
    world, many = World(robot, problem.obstacle), PathWorld(robot, problem.obstacle)
    reference, zero, poses = (
        Meshes(problem, robot, tmp_path),
        np.zeros(robot.n),
        place_obstacles(problem.obstacle),
    )
    hits, smallest = 0, []
    states = random.uniform(robot.position_lower, robot.position_upper, (200, robot.n))
    for q in states:
        world.set_state(q, zero, zero, poses)
        found, (expected, _) = min(world.shape_distances()), reference.distances(q)
        smallest.append(found)
        assert (found > 0) == (expected > 0)
        if expected > 0:
            assert expected - 3e-4 < found < expected + 1e-7
        hits += expected <= 0
    assert hits > 20
    many.set_path(states.T.copy(), 0 * states.T, 0 * states.T, poses)
    assert np.min(many.shape_distances()) == pytest.approx(min(smallest), abs=1e-8)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "upright"])
def test_many_states_of_a_robot_without_link_geometry_agree_with_single_states(
    tmp_path: Path, kind: str
) -> None:
    problem = gantry_problem(tmp_path)
    robot, random = load_robot(problem), np.random.default_rng(7)
    obstacles = [draw_obstacle(kind, random, spread=0.3) for _ in range(2)]
    path = np.linspace(
        *random.uniform(robot.position_lower, robot.position_upper, (2, robot.n)), 40
    ).T.copy()
    many, one = (make(robot, obstacles, SIZE) for make in (PathWorld, World))
    zero, poses = np.zeros(robot.n), place_obstacles(obstacles)
    many.set_path(path, 0 * path, 0 * path, poses)
    for what in ("segment_distances", "object_distances"):
        single = []
        for q in path.T:
            one.set_state(q.copy(), zero, zero, poses)
            single.append(getattr(one, what)())
        found, expected = np.array(getattr(many, what)()), np.array(single).T
        assert (found <= expected + 1e-8).all()
        assert found.min() == pytest.approx(expected.min(), abs=1e-8)
        if what == "object_distances":
            np.testing.assert_allclose(
                found.min(axis=1), expected.min(axis=1), atol=1e-8
            )


def test_an_obstacle_below_the_object_touches_it() -> None:
    random = np.random.default_rng(8)
    for kind in KINDS[1:]:
        obstacle = draw_obstacle(kind, random)
        obstacle = type(obstacle)(
            **vars(obstacle) | {"below": "goal", "position": (0.4, 0.1, -0.02)}
        )
        numbers = place_obstacles(
            [obstacle], {"start": np.array([0.9, 0.8]), "goal": np.array([0.3, 0.5])}
        )
        poses = [solids_of([obstacle], each)[0].high[2] for each in numbers]
        np.testing.assert_allclose(poses, [0.28, 0.48], atol=1e-12)


def prism(sides: int, *, apex: bool = False) -> np.ndarray:
    """Corners of a prism along z [m], shape (V, 3), or of a pyramid."""
    angles = np.arange(sides) * 2 * np.pi / sides
    circle = 0.1 * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    top = np.array([[0, 0, 2.0]]) if apex else np.add(circle, [0, 0, 1.0])
    return np.concatenate([circle - [0, 0, 1.0], top])


def test_distances_from_flat_faces_of_hundreds_of_corners_are_exact() -> None:
    obstacle = make_mesh("disc", prism(600), (0.5, 0, 0))
    world = CollisionWorld(None)
    world.place(solids_of([obstacle], place_obstacles([obstacle])))
    random = np.random.default_rng(0)
    heights, shifts = random.uniform(1.01, 2, 50), random.uniform(-0.05, 0.05, (50, 2))
    ends = [
        ((0.5 + x, y, z), (0.5 + x, y, z + 0.3))
        for (x, y), z in zip(shifts.tolist(), heights.tolist(), strict=True)
    ]
    np.testing.assert_allclose(world.segment_distances(ends), heights - 1, atol=1e-9)


def test_a_corner_with_too_many_edges_is_refused_by_name() -> None:
    for refuse in (coal_hull, partial(make_mesh, "pyramid")):
        with pytest.raises(UsageError, match="300 edges"):
            refuse(prism(300, apex=True))
