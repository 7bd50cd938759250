"""Problems of the heavy-object arm on every manifold of the tip, and configurations on them."""

from dataclasses import replace

import numpy as np
import scipy

from cnpgen.problems.constraints.axis import Axis
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import TipSpeed
from cnpgen.problems.constraints.plane import Line, Plane
from cnpgen.problems.constraints.pose import Pose
from cnpgen.problems.problem import Problem
from cnpgen.schema.keys import Range
from cnpgen.world.world import World
from tests.examples.plans import PROBLEMS, ROBOTS, load

TIPS = np.array([[0.45, -0.3, 0.45], [0.55, 0.3, 0.55]])
U_RANGE, V_RANGE = Range(-0.2, 0.2), Range(-0.3, 0.3)
MANIFOLDS = {
    "plane": (Plane(point=(0.5, 0, 0.5), normal=(-1, 0.2, 2), tolerance=1e-3),),
    "rectangle": (
        Plane(point=(0.5, 0, 0.5), normal=(0, 1, 1), along=(1, 0, 0), u=U_RANGE, v=V_RANGE, tolerance=1e-3),
    ),
    "line": (Line(point=(0.5, 0, 0.5), direction=(1, 4, 1), tolerance=1e-3),),
    "axis": (Axis(axis=(0, 0, 1), direction=(1, 0, 2), tolerance=0.01),),
    "cone": (Axis(direction=(0, 0, 1), angle=0.3, tolerance=0.01), TipSpeed(limit=0.5, tolerance=0.005)),
    "pose": (Pose(rpy=(0.0, 0.1, -0.35), z=Range(0.5, 0.5), tolerance=2e-3),),
}  # fmt: skip


def joint_limits() -> tuple[Constraint, ...]:
    """Return the joint limits of the arm."""
    constraints = PROBLEMS["heavy-object"].constraint
    return tuple(c for c in constraints if type(c).__name__.startswith("Joint"))


def problem_on(name: str) -> Problem:
    """Return the problem of the arm with its joint limits on a manifold, without obstacles and object."""
    return replace(
        PROBLEMS["heavy-object"],
        constraint=(*joint_limits(), *MANIFOLDS[name]),
        obstacle=(),
        object=None,
    )


def ends_on(name: str) -> list[np.ndarray]:
    """Return two configurations on a manifold."""
    world, constraints = World(ROBOTS["heavy-object"], (), None), MANIFOLDS[name]
    first = on(world, constraints, TIPS[0], load("transport").boundary.start_q[0])
    return [first, on(world, constraints, TIPS[1], first)]


def on(
    world: World,
    constraints: tuple[Constraint, ...],
    tip: np.ndarray,
    start: np.ndarray,
) -> np.ndarray:
    """Find a configuration on the manifolds close to a tip position and to another configuration."""

    def violation(q: np.ndarray) -> np.ndarray:
        world.set_state(q, 0 * q, 0 * q, np.zeros(0))
        violations = []
        for condition in (
            c for constraint in constraints for c in constraint.measured(world)
        ):
            g = np.array(condition.g)
            violations.append(
                np.maximum(condition.lower - g, 0) + np.maximum(g - condition.upper, 0)
            )
        return np.concatenate(violations)

    def distance(q: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [100 * violation(q), world.tip_position - tip, 0.01 * (q - start)]
        )

    robot = ROBOTS["heavy-object"]
    bounds = 0.9 * robot.position_lower, 0.9 * robot.position_upper
    near = scipy.optimize.least_squares(
        distance, np.clip(start, *(0.99 * bound for bound in bounds)), bounds=bounds
    ).x
    return np.asarray(
        scipy.optimize.least_squares(
            violation, near, bounds=bounds, xtol=1e-15, ftol=1e-15, gtol=1e-15
        ).x
    )
