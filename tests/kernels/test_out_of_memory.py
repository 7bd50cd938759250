"""Functions in C that allocate memory: each failing allocation gives a MachineError, and the next call works."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import MachineError
from cnpgen.kernels.collision.clearance_loss import ClearanceLoss
from cnpgen.kernels.collision.collision_checker import (
    SOURCES,
    CollisionChecker,
    load_collision_library,
)
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.kernels.observation.compiled_observations import (
    SOURCE,
    CompiledObservations,
)
from cnpgen.robots.observation.camera import Camera
from cnpgen.robots.observation.primitives import scene_primitives
from cnpgen.robots.solid import place_obstacles
from tests.conftest import needs_compiler
from tests.examples.narrow import BESIDE_WALL, WALL
from tests.kernels.test_manifold_search import Setting
from tests.kernels.test_tree_search import search, setting  # noqa: F401 - a fixture
from tests.losses.test_hull_loss import SCENE

pytestmark = needs_compiler

FAILING_ALLOCATIONS = """\
#include <stdlib.h>
static long allocations_left = -1; /* negative: all succeed */
void fail_after(long count) { allocations_left = count; }
static int fails(void) { return allocations_left >= 0 && allocations_left-- == 0; }
static void *checked_malloc(size_t size) { return fails() ? 0 : malloc(size); }
static void *checked_calloc(size_t count, size_t size) { return fails() ? 0 : calloc(count, size); }
static void *checked_realloc(void *old, size_t size) { return fails() ? 0 : realloc(old, size); }
#define malloc checked_malloc
#define calloc checked_calloc
#define realloc checked_realloc
"""
MAX_ALLOCATIONS = 60


@pytest.fixture(scope="module")
def failing(tmp_path_factory) -> Path:
    """C source of allocations of which one fails."""
    path = tmp_path_factory.mktemp("allocations") / "failing.c"
    path.write_text(FAILING_ALLOCATIONS)
    return path


def library_of(failing):
    kernels = KernelLibrary(*choose_backend("compiled"), "", {})
    return load_collision_library(kernels, [failing, *SOURCES])


def failures(library, call) -> int:
    """Fail the first, second, ... allocation of a call until it succeeds; return the number of failed ones."""
    expected = call()
    for count in range(MAX_ALLOCATIONS):
        library.fail_after(count)
        try:
            result = call()
        except MachineError:
            pass
        else:
            library.fail_after(-1)
            np.testing.assert_equal(result, expected)
            return count
        library.fail_after(-1)
        np.testing.assert_equal(call(), expected)
    raise AssertionError("the call needs more allocations")


def test_collision_checks_and_searches_without_memory(failing, setting):  # noqa: F811
    problem, robot, _ = setting
    library = library_of(failing)
    checker = CollisionChecker(library, robot)
    checker.place(problem.obstacle, place_obstacles(problem.obstacle))
    q = np.linspace(*BESIDE_WALL, 5).T.copy()
    calls = {
        "states": lambda: checker.clear_states(q),
        "contacts": lambda: checker.close_bodies(q, 1.0, of_obstacles=True).distance,
        "poses": lambda: checker.joint_poses(q),
        "path": lambda: search((problem, robot, checker)),
        "line": lambda: search((problem, robot, checker), max_extensions=0),
    }
    counts = {name: failures(library, call) for name, call in calls.items()}
    assert counts["states"] == counts["contacts"] == counts["poses"] == 6
    assert counts["path"] == 6 + 7 + 2  # memory, states and trees, shortcuts
    assert counts["line"] == 6 + 7


@pytest.mark.slow
def test_a_search_on_a_manifold_without_memory(failing, tmp_path):
    there = Setting(tmp_path, WALL)
    library = library_of(failing)
    checker = CollisionChecker(library, there.robot)
    checker.place(there.problem.obstacle, there.poses)
    there.tool.hulls.placed_checker = lambda _: checker
    assert failures(library, there.search) >= 6 + 7 + 2 + 2  # a tree grows


def test_a_tree_that_grows_without_memory(failing, setting):  # noqa: F811
    problem, robot, _ = setting
    library = library_of(failing)
    checker = CollisionChecker(library, robot)
    checker.place(problem.obstacle, place_obstacles(problem.obstacle))

    def run():
        return search((problem, robot, checker), extension=0.03, shortcuts=0)

    assert failures(library, run) >= 6 + 7 + 2 + 2  # both arrays of a tree grow


def test_losses_without_memory(failing, setting):  # noqa: F811
    robot = setting[1]
    library = library_of(failing)
    loss, q = ClearanceLoss(library, robot), np.array(BESIDE_WALL)[:, :, None]
    assert failures(library, lambda: loss(q, scene_primitives([SCENE]), 0.05)) == 6 + 2


def test_observations_without_memory(failing):
    kernels = KernelLibrary(*choose_backend("compiled"), "", {})
    library = kernels.load_source(failing, SOURCE)
    backend, scene = CompiledObservations(library), scene_primitives([SCENE])
    seed = np.ones(1, np.uint64)
    assert failures(library, lambda: backend.surface_points(scene, 9, seed)) == 1
    camera = Camera(width=8, height=6)
    depth, seeds = np.ones((1, 6, 8), np.float32), np.ones(1, np.uint64)
    assert failures(library, lambda: backend.depth_points(depth, camera, 5, seeds)) == 1


LIMITED = """
import resource, sys
import numpy as np
from cnpgen.errors import MachineError
from cnpgen.kernels.library import KernelLibrary, choose_backend
from cnpgen.kernels.observation.compiled_observations import SOURCE, CompiledObservations
from cnpgen.robots.observation.camera import Camera

library = KernelLibrary(*choose_backend("compiled"), "", {}).load_source(SOURCE)
backend = CompiledObservations(library)
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + (16 << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
side = 4096  # one number per pixel needs 64 MB
camera = Camera(width=side, height=side)
none = np.empty((0, side, side), np.float32)
try:
    backend.depth_points(none, camera, 1, np.empty(0, np.uint64))
except MachineError as error:
    print(error)
"""


@pytest.mark.skipif(
    not Path("/proc/self/statm").exists() or not hasattr(resource, "RLIMIT_AS"),
    reason="needs a limit of memory",
)
def test_a_process_at_its_limit_of_memory_reports_it():
    done = subprocess.run(
        [sys.executable, "-c", LIMITED], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "there is no memory left" in done.stdout
