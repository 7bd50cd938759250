"""Kernels of pipelines read poses and sizes of obstacles at run time: a moved obstacle needs no new ones."""

from dataclasses import replace

from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.pipelines.acceptance import boundary_unmet, narrow_phase
from cnpgen.pipelines.stages.collision import capsule_axes_distance, capsule_clearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from tests.examples.shaped_robot import HELD_OBJECT, KINDS, SELF, write_problem

HELD = (
    HELD_OBJECT
    + """
[[constraint]]
use = "object-contact"
depth = 0.0
tolerance = 1e-3
"""
)


def test_moved_obstacles_have_the_same_tapes(tmp_path):
    problem = load_problem(write_problem(tmp_path, obstacles=KINDS, more=SELF + HELD))
    wall, ball, *others = problem.obstacle
    moved = problem.with_obstacles(
        (
            replace(wall, position=(0.6, 0.1, 0.2)),
            replace(ball, radius=0.05, name="other"),
            *others,
        )
    )
    assert moved.identity != problem.identity
    assert moved.structure == problem.structure
    libraries = [
        problem_kernels(each, load_robot(each), *choose_backend("numpy"))
        for each in (problem, moved)
    ]
    unmet = {"needs": 2, "exact": True, "hitting": False}
    for builder, parameters in (
        (narrow_phase, {"end": "start", "dtype": "float32"}),
        (boundary_unmet, {"end": "goal", "dtype": "float32", **unmet}),
        (capsule_axes_distance, {}),
        (capsule_clearance, {}),
    ):
        one, two = (
            library.tape(builder, **parameters).to_bytes() for library in libraries
        )
        assert one == two, builder
