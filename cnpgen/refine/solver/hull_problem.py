"""Problems whose distances are measured on hulls by compiled code, beside kernels that do not depend on the obstacles.

The kernels of such a problem are those of the problem without clearances, so that all its scenes share them.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from cnpgen.kernels.collision.collision_checker import MAX_JOINTS
from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.bounds import NO_TIGHTENING, bounds_template
from cnpgen.refine.solver.hulls import LINK_CONSTRAINTS, OBJECT_CONSTRAINTS
from cnpgen.robots.robot import Robot
from cnpgen.world.world import World

TEMPLATE_POINTS = 32  # of a grid that is only used to find equalities


def can_measure_hulls(problem: Problem, robot: Robot, world: World) -> bool:
    """Return whether hulls replace capsules: distances of link geometry, among obstacles or without equalities.

    On a manifold without obstacles a kernel with the few capsules of the links takes less time.
    """
    others = without_distances(problem)
    if robot.n > MAX_JOINTS or robot.shape is None or len(others.constraint) in {0, len(problem.constraint)}:
        return False
    if problem.obstacle:
        return True
    return not bounds_template(others, world, np.linspace(0, 1, TEMPLATE_POINTS), NO_TIGHTENING).equal.any()


def without_distances(problem: Problem) -> Problem:
    """Return a problem without distances that hulls measure, and without obstacles unless a plug-in may use them."""
    measured = LINK_CONSTRAINTS if problem.object_size is None else LINK_CONSTRAINTS | OBJECT_CONSTRAINTS
    others = tuple(item for item in problem.constraint if not isinstance(item, measured))
    return _changed(problem, constraint=others, obstacle=problem.obstacle if problem.structure is None else ())


def without_contacts(problem: Problem) -> Problem:
    """Return a problem whose links may not touch each other or an obstacle, not even within a tolerance."""
    strict = (
        replace(each, tolerance=0.0) if isinstance(each, LINK_CONSTRAINTS) else each for each in problem.constraint
    )
    return _changed(problem, constraint=tuple(strict))


def _changed(problem: Problem, **changes: Any) -> Problem:
    changed = replace(problem, **changes)
    vars(changed)["urdf_text"] = problem.urdf_text  # a cached property, expensive to read again
    return changed
