"""Levels on the links' hulls: exact derivatives, and a solution where capsules leave none."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy

from cnpgen.kernels.collision.tree_search import TreeSettings
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine import attempts, rrt_connect
from cnpgen.refine import refiner as refiner_module
from cnpgen.refine.grid_levels import GridLevel
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.hull_levels import HullFeedback
from cnpgen.refine.solver.hulls import MEASURED_RANGE_M, has_clearance_constraints
from cnpgen.refine.solver.sqp import DEFAULT_SETTINGS, Result
from cnpgen.refine.strategy import PlanChecker, RefinementSearch, refine_task
from cnpgen.refine.task import MAX_JUDGED_VIOLATION, Outcome
from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World
from tests.conftest import needs_compiled_code
from tests.examples.coal_hulls import CoalHulls, compiled_hulls
from tests.examples.meshes import Meshes
from tests.examples.narrow import (
    BESIDE_WALL,
    BOXES,
    IN_SLOT,
    LIMITS,
    SLOT,
    WALL,
    between,
    narrow,
    refiner,
)
from tests.examples.shaped_robot import (
    HELD_OBJECT,
    KINDS,
    OBSTACLES,
    SELF,
    write_problem,
)

STEP = 1e-6  # rad, of finite differences
CONTACT_TURN_RAD, CONTACT_M, CLOSE_M = (
    1e-3,
    5e-5,
    0.01,
)  # the contact is half the tolerance


@pytest.fixture(params=["coal", "compiled"])
def make_hulls(request):
    return {"coal": CoalHulls, "compiled": compiled_hulls}[request.param]


def clear_states(hulls, q: np.ndarray, poses: np.ndarray):
    """Return a mask of the states that Coal, or the checker of trees, finds clear."""
    if isinstance(hulls, CoalHulls):
        return hulls.clear_states(q.T.copy(), poses)
    return hulls.placed_checker(poses).clear_states(
        q.T,
        obstacle_distance=hulls.obstacle_distance,
        self_distance=hulls.self_distance,
    )


@needs_compiled_code
def test_distances_agree_with_meshes(tmp_path, make_hulls):
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    hulls, meshes = make_hulls(problem, robot), Meshes(problem, robot, tmp_path)
    q = np.random.default_rng(1).uniform(
        robot.position_lower, robot.position_upper, (400, robot.n)
    )
    obstacle_poses = place_obstacles(problem.obstacle)
    expected = np.array([min(meshes.distances(state)) for state in q])
    found = hulls.measure(q.T.copy(), obstacle_poses).min(axis=1)
    in_range = (expected > 0) & (expected < MEASURED_RANGE_M)
    assert in_range.sum() > 15
    assert np.abs(found - expected)[in_range].max() < 1e-4  # round parts are prisms
    assert (found[expected > MEASURED_RANGE_M + 1e-4] == MEASURED_RANGE_M).all()
    assert np.array_equal(clear_states(hulls, q, obstacle_poses), found >= 0)
    assert hulls.violation(q.T.copy(), obstacle_poses) == pytest.approx(
        -found.min(), abs=1e-9
    )
    allowed = hulls.violation(q.T.copy(), obstacle_poses, above_tolerance=True)
    assert allowed == pytest.approx(-found.min() - 1e-4, abs=1e-9)


@needs_compiled_code
def test_distances_of_positions_that_are_not_finite_are_nan(tmp_path, make_hulls):
    problem = load_problem(write_problem(tmp_path))
    robot = load_robot(problem)
    q = np.where(np.arange(3) == 1, np.nan, 0.0) + np.zeros((robot.n, 1))
    assert np.isnan(
        make_hulls(problem, robot).measure(q, place_obstacles(problem.obstacle))
    ).all()


@needs_compiled_code
@pytest.mark.parametrize("obstacles", [KINDS, OBSTACLES], ids=["kinds", "boxes"])
def test_compiled_rows_are_the_distances_of_hulls_and_their_gradients(
    tmp_path, obstacles
):
    problem = load_problem(write_problem(tmp_path, obstacles=obstacles))
    robot, tool = load_robot(problem), Refiner(problem, load_robot(problem))
    kernels, poses = tool.residual_kernels, place_obstacles(problem.obstacle)
    hulls, width, rows = (
        tool.hulls,
        kernels.values.tape.inputs[0],
        kernels.values.tape.outputs[0],
    )
    w = np.random.default_rng(0).uniform(0.1, 1.0, (width, 40))
    q = (
        np.random.default_rng(1)
        .uniform(robot.position_lower, robot.position_upper, (40, robot.n))
        .T.copy()
    )
    w[: robot.n] = q
    with_rows, scene = hulls.row_kernels(kernels, poses), np.zeros((0, 40))
    (values,) = with_rows.values(w, scene)
    again, jacobian = with_rows.jacobian(w, scene)
    own, own_jacobian = kernels.jacobian(w, scene)
    distances = CoalHulls(problem, robot).measure(q, poses)
    np.testing.assert_allclose(values[:rows], own, rtol=1e-12)
    np.testing.assert_allclose(
        values, again, atol=1e-9
    )  # initial guesses of GJK differ
    limited = np.minimum(0.1 * values[rows:].T, hulls.min_distances + MEASURED_RANGE_M)
    np.testing.assert_allclose(
        limited, distances, atol=1e-4
    )  # cylinders are prisms for Coal
    near = 0.1 * values[rows:] < hulls.min_distances[:, None] + MEASURED_RANGE_M
    assert (
        values[rows:][~near] == 100
    ).all()  # so far from their bounds that no solver selects them
    jacobian = jacobian.reshape(width, -1, 40)
    np.testing.assert_allclose(
        jacobian[:, :rows], own_jacobian.reshape(width, rows, 40), rtol=1e-12
    )
    gradients = 0.1 * jacobian[: robot.n, rows:]
    compared = 0
    for joint, step in enumerate(STEP * np.eye(robot.n)[..., None]):
        ends = [hulls.measure(q + side * step, poses).T for side in (1, -1)]
        close = (np.array(ends) < hulls.min_distances[:, None] + MEASURED_RANGE_M).all(
            axis=0
        ) & near
        found = (ends[0] - ends[1]) / (2 * STEP)
        assert np.abs(found - gradients[joint])[close].max() < 1e-4  # of curved bodies
        compared += close.sum()
    assert compared > 150
    assert not jacobian[robot.n :, rows:].any()
    assert np.abs(gradients).max() > 0.1


CONTACT_ONLY = (
    HELD_OBJECT
    + """
[[constraint]]
use = "object-contact"
depth = 0.002
tolerance = 5e-4
[[constraint]]
use = "object-clearance"
distance = 0.01
tolerance = 1e-3
"""
)
HELD = SELF + CONTACT_ONLY
LEVEL = """
[[constraint]]
use = "plane"
point = [0, 0, 0.45]
normal = [0, 0, 1]
tolerance = 1e-3
"""


@needs_compiled_code
@pytest.mark.parametrize("obstacles", [KINDS, OBSTACLES], ids=["kinds", "boxes"])
def test_distances_of_the_held_object_are_those_of_the_verdict(
    tmp_path, obstacles, make_hulls
):
    problem = load_problem(write_problem(tmp_path, obstacles=obstacles, more=HELD))
    robot, poses = load_robot(problem), place_obstacles(problem.obstacle)
    hulls, links = (
        make_hulls(problem, robot, with_object=True),
        make_hulls(problem, robot),
    )
    count = len(links.min_distances)
    held, beside = (
        slice(count, count + len(problem.obstacle)),
        slice(count + len(problem.obstacle), None),
    )
    assert (hulls.min_distances[held] == -0.002).all()
    np.testing.assert_allclose(hulls.tolerances[held], 5e-4)
    assert (hulls.min_distances[beside] == 0.01).all()
    np.testing.assert_allclose(hulls.tolerances[beside], 1e-3)
    q = np.random.default_rng(3).uniform(
        robot.position_lower, robot.position_upper, (300, robot.n)
    )
    world, zero, expected, around = (
        World(robot, problem.obstacle, problem.object_size),
        np.zeros(robot.n),
        [],
        [],
    )
    for state in q:
        world.set_state(state, zero, zero, poses)
        expected.append(world.object_distances())
        around.append(min(world.held_object_distances()))
    expected, around = np.array(expected), np.array(around)
    found = hulls.measure(q.T.copy(), poses)
    np.testing.assert_allclose(
        found[:, : held.start], links.measure(q.T.copy(), poses), atol=1e-12
    )
    assert (
        np.abs(found[:, held] - np.minimum(expected, MEASURED_RANGE_M - 0.002)).max()
        < 1e-4
    )  # prisms
    nearest = found[:, beside].min(axis=1)
    assert np.abs(nearest - np.minimum(around, MEASURED_RANGE_M + 0.01)).max() < 1e-4
    assert (around < 0.01).sum() > 10
    enters = expected.min(axis=1) < -0.003
    assert 3 < enters.sum() < 290
    clear = clear_states(hulls, q, poses)
    assert not clear[enters].any()
    free = (found[:, held].min(axis=1) >= -0.002) & (nearest >= 0.01)
    np.testing.assert_array_equal(clear, clear_states(links, q, poses) & free)


@needs_compiled_code
def test_an_end_within_the_tolerance_of_a_contact_is_accepted(tmp_path):
    """Both ends hold the object 3 mm deep in a table, where 0 mm are legal and 5 mm accepted."""
    table = BOXES.format(
        [0.75, 0.0, 0.1], [0.5, 2.0, 0.2], [-2.0, 0.0, 0.4], [0.1, 0.1, 0.1]
    )
    more = LIMITS + CONTACT_ONLY.replace(
        "depth = 0.002\ntolerance = 5e-4", "depth = 0.0\ntolerance = 5e-3"
    )
    more = more.replace("[0.08, 0.06, 0.12]", "[0.25, 0.25, 0.25]")
    problem = load_problem(write_problem(tmp_path, obstacles=table, more=more))
    robot, poses = load_robot(problem), place_obstacles(problem.obstacle)
    tool, world, zero = (
        Refiner(problem, robot),
        World(robot, problem.obstacle, problem.object_size),
        np.zeros(4),
    )

    def depth(lift: float) -> float:
        world.set_state(np.array([0.0, lift, 0.9, 0.0]), zero, zero, poses)
        return min(world.object_distances()) + 0.003

    lift = scipy.optimize.brentq(depth, -0.7, -0.3)
    task = between(problem, np.array([[-0.8, lift, 0.9, 0.0], [0.8, lift, 0.9, 0.0]]))
    found = refine_task(
        tool, PlanChecker(problem, robot, degree=tool.spec.degree), task
    )
    assert found.valid
    assert found.iterations < 60
    accepted = tool.hulls.accepted_at(np.array([task.boundary.start_q[0]]).T, poses)
    assert accepted.max() == pytest.approx(0.003, abs=1e-6)


@needs_compiled_code
def test_rows_of_distances_follow_those_of_interpreted_kernels(tmp_path):
    problem = load_problem(write_problem(tmp_path, obstacles=KINDS))
    robot, poses = load_robot(problem), place_obstacles(problem.obstacle)
    numpy = problem_kernels(problem, robot, *choose_backend("numpy"))
    tools = Refiner(problem, robot), Refiner(problem, robot, kernels=numpy)
    random = np.random.default_rng(2)
    w = random.uniform(0.1, 1.0, (tools[0].residual_kernels.values.tape.inputs[0], 30))
    compiled, interpreted = (
        tool.hulls.row_kernels(tool.residual_kernels, poses).jacobian(
            w, np.zeros((0, 30))
        )
        for tool in tools
    )
    for found, expected in zip(interpreted, compiled, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@needs_compiled_code
def test_compiled_rows_of_the_held_object_have_its_depth(tmp_path):
    problem = load_problem(write_problem(tmp_path, more=HELD))
    robot = load_robot(problem)
    tool, poses = Refiner(problem, robot), place_obstacles(problem.obstacle)
    kernels, hulls = tool.residual_kernels, tool.hulls
    q = (
        np.random.default_rng(3)
        .uniform(robot.position_lower, robot.position_upper, (60, robot.n))
        .T.copy()
    )
    w = np.ones((kernels.values.tape.inputs[0], 60))
    w[: robot.n] = q
    rows = kernels.values.tape.outputs[0]
    (values,) = hulls.row_kernels(kernels, poses).values(w, np.zeros((0, 60)))
    distances = CoalHulls(problem, robot, with_object=True).measure(q, poses)
    limited = np.minimum(0.1 * values[rows:].T, hulls.min_distances + MEASURED_RANGE_M)
    np.testing.assert_allclose(limited, distances, atol=1e-4)


@needs_compiled_code
@pytest.mark.parametrize(
    "more",
    [
        SELF,
        HELD,
        SELF + LEVEL,
        HELD + LEVEL,
        CONTACT_ONLY + LIMITS.partition('[[constraint]]\nuse = "self')[0],
    ],
    ids=["links", "held", "level", "held level", "contact only"],
)
def test_scenes_of_a_robot_share_kernels(tmp_path, more):
    problem = load_problem(write_problem(tmp_path, obstacles=KINDS, more=more))
    other = problem.with_obstacles(problem.obstacle[:2])
    tapes = [
        Refiner(item, load_robot(item)).residual_kernels.values.tape
        for item in (problem, other)
    ]
    assert tapes[0].inputs == tapes[1].inputs
    assert tapes[0].to_bytes() == tapes[1].to_bytes()


@needs_compiled_code
def test_collisions_between_grid_points_require_more_clearance(tmp_path):
    problem = narrow(tmp_path, WALL)
    tool, task = Refiner(problem, load_robot(problem)), between(problem, BESIDE_WALL)
    path, _ = tool.check.transcription(task).unpack(tool.line_guess(task))
    poses, s = task.scene.poses[0], np.linspace(0, 1, 9)
    assert (
        HullFeedback(tool.spec, s).missing_clearance(path, tool.hulls, poses) is None
    )  # deeper than fed back
    q = np.linspace(*BESIDE_WALL, 400).T.copy()
    missing = tool.hulls.missing(q, np.zeros(400), poses)
    distances = tool.hulls.measure(q, poses)
    np.testing.assert_allclose(
        missing, np.maximum(tool.hulls.min_distances - distances, 0), atol=1e-12
    )
    assert missing.max() > 0.02


@needs_compiled_code
def test_a_collision_of_the_verdict_becomes_larger_distances_around_its_phase(tmp_path):
    problem = narrow(tmp_path, WALL)
    tool, task = Refiner(problem, load_robot(problem)), between(problem, BESIDE_WALL)
    path, _ = tool.check.transcription(task).unpack(tool.line_guess(task))
    feedback, poses = HullFeedback(tool.spec, np.linspace(0, 1, 9)), task.scene.poses[0]
    extra = feedback.clearance_at(path, tool.hulls, poses, phase=0.45, depth=0.003)
    assert extra.shape == (9, len(tool.hulls.min_distances))
    assert not extra[:2].any()
    assert not extra[6:].any()
    assert extra[3:5].max() > 0.003
    collides = tool.hulls.min_distances - tool.hulls.measure(path[[7]].T, poses)[0] > 0
    assert (extra[3][collides] > 0.003).all()


@needs_compiled_code
def test_motions_through_a_wall_between_grid_points_are_continued_on_the_fine_level(tmp_path, monkeypatch):  # fmt: skip
    problem = narrow(tmp_path, WALL)
    tool, task = refiner(problem), between(problem, BESIDE_WALL)
    guess, levels = tool.line_guess(task), list[GridLevel]()  # through the wall

    violations = [0.0, 0.0, 0.1]  # at the grid points

    def run_level(_, level, x, *__):
        levels.append(level)
        return Result(x, 1.0, violations[len(levels) - 1], 1, converged=True)

    monkeypatch.setattr(tool, "run_level", run_level)
    warm, fine = tool.levels.warm, tool.levels.fine
    for _ in range(2):  # the second time there is a violation at the grid points
        attempt = tool.solve(task, warm, guess, Outcome.SOLVED)
        assert attempt.violation > MAX_JUDGED_VIOLATION
    assert levels == [warm, fine, warm]


def test_the_level_for_paths_follows_the_usual_one_from_its_second_failure(monkeypatch):
    violations = {("warm", 3): 0.5, ("path", 2): 0.1}  # others fail
    made = list[tuple[str, int]]()

    def along(refiner, task, level, guess):
        made.append((level, guess))
        violation = violations.get((level, guess), 9.0)
        return SimpleNamespace(violation=violation, variables=None)

    monkeypatch.setattr(attempts, "path_guesses", lambda *_: range(4))
    monkeypatch.setattr(attempts, "along_path", along)
    levels = SimpleNamespace(warm="warm", path="path", strict="strict")
    solved = list[str]()
    tool = SimpleNamespace(
        levels=levels, solve=lambda task, level, *_: solved.append(level)
    )
    list(attempts.along_tree_paths(tool, None, None))
    assert made == [
        ("warm", 0),
        ("warm", 1),
        ("path", 1),
        ("warm", 2),
        ("path", 2),
        ("warm", 3),
    ]
    assert solved == ["strict", "strict"]


def test_large_trees_follow_the_first_ones(monkeypatch):
    grown, hits = (
        list[TreeSettings](),
        set[int](),
    )  # hits: numbers of the trees that find a path

    def find(checker, ends, box, velocity, settings, *, seed, manifold, at_rest):
        if not settings.max_extensions:
            return None  # the straight line collides
        grown.append(settings)
        return np.zeros((3, 2)) if len(grown) - 1 in hits else None

    monkeypatch.setattr(rrt_connect, "find_tree_path", find)
    robot = SimpleNamespace(
        position_lower=-np.ones(2), position_upper=np.ones(2), velocity_limit=np.ones(2)
    )
    monkeypatch.setattr(rrt_connect, "meets_at_rest", lambda *_: True)
    hulls = SimpleNamespace(
        obstacle_distance=0.0, self_distance=0.0, placed_checker=lambda _: None
    )
    boundary = SimpleNamespace(start_q=np.zeros((1, 2)), goal_q=np.ones((1, 2)))
    task = SimpleNamespace(
        boundary=boundary, scene=SimpleNamespace(poses=np.zeros((1, 0)))
    )
    search = rrt_connect.TreeSearch(task, robot, None, None, None, hulls, True)
    cases = (
        ({0, 1, 3}, (12, 0, 6)),  # small trees with every margin find enough paths
        (set(), (4, 3, 3)),  # nothing connects
        ({0, 3}, (4, 6, 6)),
        ({1, 5, 6, 9}, (4, 3, 6)),  # large trees find the missing paths
        ({8}, (4, 3, 6)),
    )
    for numbers, expected in cases:
        grown.clear()
        hits = numbers
        assert len(list(search.paths())) == len(numbers)
        kinds = [(settings.max_extensions, settings.extension) for settings in grown]
        assert kinds == [
            kind
            for kind, count in zip(
                [(4_000, 1.0), (128_000, 0.5), (128_000, 0.3)], expected, strict=True
            )
            for _ in range(count)
        ]
        assert [settings.margin for settings in grown[:4]] == [6e-3, 3e-3, 1e-3, 0.0]
    grown.clear()
    hits = {0, 1, 3}
    next(search.paths())
    assert len(grown) == 12  # large trees grow when their paths are needed


@pytest.mark.slow
@needs_compiled_code
def test_a_problem_without_a_path_reports_it(tmp_path, monkeypatch):
    problem = narrow(tmp_path, WALL)
    tool, task = refiner(problem), between(problem, BESIDE_WALL)
    monkeypatch.setattr(attempts, "path_guesses", lambda *_: iter(()))
    monkeypatch.setattr(attempts, "_from_other_guesses", lambda *_: iter(()))
    found = refine_task(
        tool, PlanChecker(problem, load_robot(problem), degree=tool.spec.degree), task
    )
    assert not found.valid
    assert found.outcome is Outcome.NO_PATH


@pytest.mark.slow
@needs_compiled_code
def test_no_path_is_searched_if_an_end_is_inside_an_obstacle(tmp_path, monkeypatch):
    problem = narrow(tmp_path, SLOT)
    tool, inside = (
        refiner(problem),
        between(problem, np.add(IN_SLOT, [0.0, 0.0, 0.1, 0.0])),
    )
    monkeypatch.setattr(attempts, "path_guesses", lambda *_: pytest.fail("a path"))
    found = refine_task(
        tool, PlanChecker(problem, load_robot(problem), degree=tool.spec.degree), inside
    )
    assert (
        found.reason == "robot in collision"
    )  # not that of the attempt, which also exceeds other limits


def test_robots_without_a_shape_have_no_hulls(tmp_path):
    shaped = load_problem(write_problem(tmp_path))
    assert has_clearance_constraints(shaped, load_robot(shaped))
    paper = 'geometry = "paper-capsules"'
    bare = load_problem(
        write_problem(tmp_path, robot=paper, clearance='radius = "5 cm"', more="")
    )
    assert not has_clearance_constraints(bare, load_robot(bare))


@pytest.mark.slow
@needs_compiled_code
@pytest.mark.parametrize("compiled", [True, False])
def test_a_slot_that_is_too_narrow_for_capsules_is_wide_enough_for_hulls(
    tmp_path, compiled, monkeypatch
):
    problem = narrow(tmp_path, SLOT)
    if not compiled:
        monkeypatch.setattr(refiner_module, "can_measure_hulls", lambda *_: False)
    robot, task = load_robot(problem), between(problem, IN_SLOT)
    tool = Refiner(problem, robot)
    assert tool.measures_hulls == compiled
    hulls, checker, start = (
        compiled_hulls(problem, robot),
        PlanChecker(problem, robot, degree=tool.spec.degree),
        tool.line_guess(task),
    )
    if not compiled:
        capsules = tool.run_level(task, tool.levels.warm, start)
        assert capsules.violation > 0.01  # 1 mm
    found = tool.run_level(task, tool.levels.warm, start, hulls)
    assert found.violation < DEFAULT_SETTINGS.violation_tolerance
    path, rate = tool.check.transcription(task).unpack(found.x)
    assert checker.verdict(task, path, rate).valid
    states = (
        Motion(path[None], rate[None], tool.spec.degree).at(np.linspace(0, 1, 300)).q[0]
    )
    meshes = Meshes(problem, robot, tmp_path)
    assert (
        min(min(meshes.distances(q)) for q in states) > -1e-4
    )  # the tolerance of the problem


@needs_compiled_code
def test_a_contact_of_an_end_does_not_prolong_the_search(tmp_path, monkeypatch):
    """The start is closer to the roof than required, within the tolerance: every motion has this contact."""
    problem = narrow(tmp_path, SLOT)
    robot = load_robot(problem)
    farther = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, -0.0005, 0.0, 0.0]])
    task = between(problem, np.add(IN_SLOT, farther))
    tool = Refiner(problem, robot)
    ends = np.stack([task.boundary.start_q[0], task.boundary.goal_q[0]], axis=1)
    start, goal = tool.hulls.measure(ends, task.scene.poses[0]).min(axis=1)
    assert goal - start > 1e-4
    constraints = (
        replace(each, distance=start + CONTACT_M)
        if isinstance(each, RobotClearance)
        else each
        for each in problem.constraint
    )
    closer = replace(problem, constraint=tuple(constraints))
    vars(closer)["urdf_text"] = problem.urdf_text
    tool, checker = (
        Refiner(closer, robot),
        PlanChecker(closer, robot, degree=problem.trajectory.degree),
    )
    assert tool.accepted_at_ends(task)[0].max() == pytest.approx(CONTACT_M, abs=1e-9)
    assert tool.accepted_at_ends(task)[1].max() == 0
    monkeypatch.setattr(
        checker, "strict_verdict", None
    )  # it would find the contact of the start
    assert refine_task(tool, checker, task).valid


@pytest.mark.slow
@needs_compiled_code
def test_a_contact_within_the_tolerance_is_removed(tmp_path):
    """A plan approaches an obstacle half way; the required distance is larger by half the tolerance."""
    problem = narrow(tmp_path, SLOT)
    robot, task, degree = (
        load_robot(problem),
        between(problem, IN_SLOT),
        problem.trajectory.degree,
    )
    tool = Refiner(problem, robot)
    found = refine_task(tool, PlanChecker(problem, robot, degree=degree), task)
    path = found.path.copy()
    path[5:-5, 1] += CONTACT_TURN_RAD
    q = (
        Motion(path[None], found.rate[None], degree)
        .at(np.linspace(0, 1, 2000))
        .q[0]
        .T.copy()
    )
    close = tool.hulls.placed_checker(task.scene.poses[0]).close_bodies(
        q, CLOSE_M, of_obstacles=True
    )
    distance = close.distance.min() + CONTACT_M
    constraints = (
        replace(each, distance=distance) if isinstance(each, RobotClearance) else each
        for each in problem.constraint
    )
    larger = replace(problem, constraint=tuple(constraints))
    tool, checker = Refiner(larger, robot), PlanChecker(larger, robot, degree=degree)
    x = tool.check.transcription(task).pack(path, found.rate)
    touching = replace(found, path=path, x=x, violation=1.0)
    assert checker.verdict(task, touching.path, touching.rate).valid
    assert (
        checker.strict_verdict(task, touching.path, touching.rate).reason
        == RobotClearance.reason
    )
    search = RefinementSearch(tool, checker, task)
    assert not search.add(touching)
    assert search.continue_rejected(touching)
    best = search.best()
    assert checker.strict_verdict(task, best.path, best.rate).valid
