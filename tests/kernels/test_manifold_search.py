"""Compiled RRT-Connect on a manifold: projected, clear by Coal, reproducible, and absent where no path exists."""

import numpy as np
import pytest
import scipy

from cnpgen.kernels.collision.tree_search import TreeSettings, find_tree_path
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.robots.solid import place_obstacles
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.world.world import World
from tests.conftest import needs_compiled_code
from tests.examples.coal_hulls import CoalHulls
from tests.examples.narrow import BESIDE_WALL, LIMITS, SLOT, WALL, between
from tests.examples.shaped_robot import write_problem

pytestmark = needs_compiled_code

HEIGHT_M, SPACING = 0.75, 0.04
LEVEL = (
    LIMITS
    + f"""
[[constraint]]
use = "plane"
point = [0, 0, {HEIGHT_M}]
normal = [0, 0, 1]
tolerance = 1e-3
"""
)


class Setting:
    """The crane beside a wall, whose tip stays at a height."""

    def __init__(self, folder, obstacles, more=LEVEL):
        self.problem = load_problem(
            write_problem(folder, obstacles=obstacles, more=more)
        )
        self.robot = load_robot(self.problem)
        self.tool, self.poses = (
            Refiner(self.problem, self.robot),
            place_obstacles(self.problem.obstacle),
        )
        self.ends = [self.level(q) for q in BESIDE_WALL]
        self.manifold = self.tool.manifold(between(self.problem, np.array(self.ends)))

    def height(self, q):
        """Height of the tip by Pinocchio [m]."""
        world, zero = (
            World(self.robot, self.problem.obstacle, None),
            np.zeros(self.robot.n),
        )
        world.set_state(q, zero, zero, self.poses)
        return world.tip_position[2]

    def level(self, q, height=HEIGHT_M):
        """Project a state onto a height with SciPy."""
        return scipy.optimize.least_squares(
            lambda x: [1e3 * (self.height(x) - height), *(1e-3 * (x - q))],
            q,
            xtol=1e-15,
        ).x

    def search(self, seed=0, ends=None, **settings):
        box = self.robot.position_lower, self.robot.position_upper
        chosen = TreeSettings(
            0.0, 0.0, **{"spacing": SPACING, "max_nodes": 20_000} | settings
        )
        checker = self.tool.hulls.placed_checker(self.poses)
        limit, ends = (
            self.robot.velocity_limit,
            tuple(self.ends if ends is None else ends),
        )
        return find_tree_path(
            checker, ends, box, limit, chosen, seed=seed, manifold=self.manifold
        )


@pytest.fixture(scope="module")
def setting(tmp_path_factory):
    return Setting(tmp_path_factory.mktemp("wall"), WALL)


@pytest.mark.parametrize("margin", [0.0, 0.006])
def test_paths_keep_the_height_and_are_clear_by_coal(setting, margin):
    path = setting.search(margin=margin)
    np.testing.assert_array_equal(path[[0, -1]], setting.ends)
    assert max(abs(setting.height(q) - HEIGHT_M) for q in path) < 1.5e-4
    assert np.abs(np.diff(path, axis=0)).max() <= 3 * SPACING
    assert (path >= setting.robot.position_lower).all()
    assert (path <= setting.robot.position_upper).all()
    distances = (
        CoalHulls(setting.problem, setting.robot)
        .measure(path[1:-1].T.copy(), setting.poses)
        .min(axis=1)
    )
    away = (
        np.minimum(*(np.abs(path[1:-1] - end).max(axis=1) for end in setting.ends))
        > 0.3
    )
    assert distances.min() >= -1e-6
    assert distances[away].min() >= margin - 1e-6
    line = np.linspace(*setting.ends, 100)
    assert (
        not CoalHulls(setting.problem, setting.robot)
        .clear_states(line.T.copy(), setting.poses)
        .all()
    )


def test_small_tolerances_are_met(tmp_path):
    tight = Setting(tmp_path, WALL, LEVEL.replace("1e-3", "1e-6"))
    path = tight.search()
    assert max(abs(tight.height(q) - HEIGHT_M) for q in path) < 1.5e-7


def test_paths_are_reproducible_and_shortened(setting):
    paths = [setting.search(seed=seed) for seed in (0, 0, 1)]
    assert np.array_equal(paths[0], paths[1])
    assert not np.array_equal(paths[0], paths[2])
    counts = [
        np.mean([len(setting.search(seed=seed, shortcuts=n)) for seed in range(6)])
        for n in (0, 200)
    ]
    assert counts[1] < 0.9 * counts[0]


def test_paths_end_at_the_goal(setting):
    for seed in range(8):
        np.testing.assert_array_equal(setting.search(seed=seed)[[0, -1]], setting.ends)


def test_paths_end_at_one_of_several_goals(setting):
    start, goal = setting.ends
    goals = np.array([goal, setting.level(goal + 0.2)])
    for seed in range(6):
        path = setting.search(seed=seed, ends=(start, goals))
        assert (goals == path[-1]).all(axis=1).sum() == 1
        assert max(abs(setting.height(q) - HEIGHT_M) for q in path) < 1.5e-4


def test_a_start_off_the_manifold_is_left(setting):
    ends = [setting.level(BESIDE_WALL[0], HEIGHT_M + 0.12), setting.ends[1]]
    path = setting.search(ends=ends)
    np.testing.assert_array_equal(path[[0, -1]], ends)
    assert max(abs(setting.height(q) - HEIGHT_M) for q in path[1:]) < 1.5e-4


def test_a_motion_around_a_wall_keeps_the_height(setting):
    checker = PlanChecker(
        setting.problem, setting.robot, degree=setting.tool.spec.degree
    )
    found = refine_task(
        setting.tool, checker, between(setting.problem, np.array(setting.ends))
    )
    assert found.valid
    states = (
        Motion(found.path[None], found.rate[None], setting.tool.spec.degree)
        .at(np.linspace(0, 1, 400))
        .q[0]
    )
    assert max(abs(setting.height(q) - HEIGHT_M) for q in states) < 1e-3
    assert np.abs(states[:, 0]).min() < 0.05  # it passes the wall


def test_the_search_ends_with_enough_nodes_or_extensions(setting):
    assert setting.search(max_nodes=3) is None
    assert setting.search(max_extensions=0) is None


def test_a_clear_line_is_projected(tmp_path):
    far = Setting(tmp_path, SLOT.replace("[0.75, 0.0", "[5.75, 0.0"))
    path = far.search(max_extensions=0)
    assert max(abs(far.height(q) - HEIGHT_M) for q in path) < 1.5e-4
    assert len(path) == np.ceil(np.abs(np.subtract(*far.ends)).max() / SPACING) + 1
