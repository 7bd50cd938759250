"""Problems of the heavy object's arm on every manifold of the tip, and configurations on them."""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from cnpgen.problems.constraints.axis import Axis
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.line import Line
from cnpgen.problems.constraints.plane import Plane
from cnpgen.problems.constraints.pose import Pose
from cnpgen.problems.constraints.tip_speed import TipSpeed
from cnpgen.problems.problem import Problem
from cnpgen.schema.keys import Range
from cnpgen.world.state import World
from tests.examples.plans import PROBLEMS, ROBOTS, load

GIVEN = PROBLEMS["heavy-object"]
LIMITS = tuple(each for each in GIVEN.constraint if type(each).__name__.startswith("Joint"))
ROBOT = ROBOTS["heavy-object"]
TIPS = np.array([[0.45, -0.3, 0.45], [0.55, 0.3, 0.55]])
SHORT, LONG = Range(-0.2, 0.2), Range(-0.3, 0.3)
MANIFOLDS = {
    "plane": (Plane(point=(0.5, 0, 0.5), normal=(-1, 0.2, 2), tolerance=1e-3),),
    "rectangle": (
        Plane(point=(0.5, 0, 0.5), normal=(0, 1, 1), along=(1, 0, 0), u=SHORT, v=LONG, tolerance=1e-3),
    ),
    "line": (Line(point=(0.5, 0, 0.5), direction=(1, 4, 1), tolerance=1e-3),),
    "axis": (Axis(axis=(0, 0, 1), direction=(1, 0, 2), tolerance=0.01),),
    "cone": (Axis(direction=(0, 0, 1), angle=0.3, tolerance=0.01), TipSpeed(limit=0.5, tolerance=0.005)),
    "pose": (Pose(rpy=(0.0, 0.1, -0.35), z=Range(0.5, 0.5), tolerance=2e-3),),
}  # fmt: skip


def problem_on(name: str) -> Problem:
    """The arm with its joint limits on a manifold, with no obstacles and no object."""
    return replace(GIVEN, constraint=(*LIMITS, *MANIFOLDS[name]), obstacle=(), object=None)


def ends_on(name: str) -> list[np.ndarray]:
    """Two configurations on a manifold."""
    world, constraints = World(ROBOT, (), None), MANIFOLDS[name]
    first = on(world, constraints, TIPS[0], load("transport").boundary.start_q[0])
    return [first, on(world, constraints, TIPS[1], first)]


def on(world: World, constraints: tuple[Constraint, ...], tip: np.ndarray, start: np.ndarray) -> np.ndarray:
    """A configuration on the manifolds near a position of the tip and near another configuration."""

    def off(q: np.ndarray) -> np.ndarray:
        world.set_state(q, 0 * q, 0 * q, np.zeros(0))
        found = []
        for condition in (each for constraint in constraints for each in constraint.measured(world)):
            g = np.array(condition.g)
            found.append(np.maximum(condition.lower - g, 0) + np.maximum(g - condition.upper, 0))
        return np.concatenate(found)

    def far(q: np.ndarray) -> np.ndarray:
        return np.concatenate([100 * off(q), world.tip_position - tip, 0.01 * (q - start)])

    bounds = 0.9 * ROBOT.position_lower, 0.9 * ROBOT.position_upper
    near = least_squares(far, np.clip(start, *(0.99 * each for each in bounds)), bounds=bounds).x
    return np.asarray(least_squares(off, near, bounds=bounds, xtol=1e-15, ftol=1e-15, gtol=1e-15).x)
