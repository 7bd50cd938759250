"""Problems with obstacles that each sample places, up to a capacity of each shape."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace

from cnpgen.errors import UsageError
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.observation.primitives import KINDS
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import PARKED_POSITION_M

Capacity = Mapping[str, int]  # kind, or corners of a mesh -> number of obstacles

_PARKED_ROTATION = (0.1, 0.1, 0.1)  # any rotation: boxes of scenes have rotation matrices


def with_capacity(problem: Problem, capacity: Capacity) -> Problem:
    """Return a problem with further obstacles, which stand far below the robot until a plan places them.

    Raises:
        UsageError: No constraint keeps the robot away from obstacles, or the problem has other values of each sample.
    """
    if problem.first(RobotClearance) is None:
        raise UsageError(
            f"the problem {problem.name!r} has no constraint robot-clearance: obstacles would be ignored",
            concerns="problem",
        )
    if problem.parameters or problem.scene_constraint is not None:
        raise UsageError(
            f"the problem {problem.name!r} has values of each sample (parameters or a puck), which are not supported"
            " among obstacles that samples place",
            concerns="problem",
        )
    shapes = [*KINDS, *sorted(capacity.keys() - set(KINDS))]
    parked = [_parked(shape, index) for shape in shapes for index in range(1, capacity.get(shape, 0) + 1)]
    full = replace(problem, obstacle=(*problem.obstacle, *parked))
    if "urdf_text" in vars(problem):  # a cached property, expensive to read again
        vars(full)["urdf_text"] = problem.urdf_text
    return full


def _parked(kind: str, index: int) -> Obstacle:
    if kind not in KINDS:
        name = f"mesh {hashlib.sha256(kind.encode()).hexdigest()[:8]} {index}"
        return Obstacle(name=name, kind="mesh", mesh=kind, position=PARKED_POSITION_M, rotation=_PARKED_ROTATION)
    name, small = f"{kind} {index}", 0.01
    if kind == "box":
        return Obstacle(name=name, kind=kind, position=PARKED_POSITION_M, size=(small,) * 3, rotation=_PARKED_ROTATION)
    if kind == "sphere":
        return Obstacle(name=name, kind=kind, position=PARKED_POSITION_M, radius=small)
    return Obstacle(name=name, kind=kind, position=PARKED_POSITION_M, radius=small, length=small)
