"""The forms that the paper publishes for what the shipped problems penalise in another form, for comparison.

Its orientation loss ``Huber(1 - R_22)`` has no gradient at the solution, its collision losses use points, between which
an edge fits, and its robot loss has no gradient inside an obstacle (paper, Appendix B, additional loss functions).
"""

from itertools import product
from math import ceil
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.kinematics import forward_kinematics
from cnpgen.kernels.symbolic.linalg import Vec, add, dot, scale, subtract
from cnpgen.kernels.symbolic.solids import UprightForm, symbolic_solids
from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.constraints.vertical import Vertical

APART = 0.1  # m: no point on the robot is further than this from its neighbour
POINT = 1e-12  # m^2: keeps the distance of a point inside a box differentiable


def published(constraint: Constraint, state: SymbolicState) -> tuple[Condition, ...]:
    """State what the paper penalises; what it does not say, as ``Constraint.penalised`` does.

    Sums that the paper puts into one Huber loss are one value that must be 0.
    """
    import casadi as ca

    if isinstance(constraint, Vertical):
        return _zero("orientation", "1", 1 - state.kinematics.rotation[2][2])
    boxes = [solid.bounds for solid in symbolic_solids(state) if isinstance(solid, UprightForm)]
    if len(boxes) < len(state.obstacles):
        return constraint.penalised(state)
    if isinstance(constraint, RobotClearance) and (radius := constraint.radius) is not None:
        near = (radius - _distance(point, boxes) for point in _points(state))
        return _zero("robot clearance", "m", sum(ca.fmax(x, 0) for x in near))
    if isinstance(constraint, ObjectContact):
        deep = (-_depth(corner, box) - constraint.depth for corner in _corners(state) for box in boxes)
        return _zero("object contact", "m", sum(ca.fmax(x, 0) for x in deep))
    return constraint.penalised(state)


def _zero(name: str, unit: str, value: Any) -> tuple[Condition, ...]:
    return (Condition(name, unit, [value], np.zeros(1), np.zeros(1), "position"),)


def _points(state: SymbolicState) -> list[Vec]:
    """Ends of the robot's segments, each once, and points between them."""
    base = forward_kinematics(state.robot.chain, [float(q) for q in state.robot.base])
    origins = [np.array(x, float) for x in (*base.origins, base.tip)]
    ends: dict[int, Vec] = {}
    between: list[Vec] = []
    for (a, b), (i, j) in zip(state.segments, state.robot.skeleton, strict=True):
        pieces = ceil(float(np.linalg.norm(origins[j] - origins[i])) / APART - 1e-9)
        between += [add(a, scale(subtract(b, a), k / pieces)) for k in range(1, pieces)]
        ends |= {i: a, j: b}
    return [*ends.values(), *between]


def _distance(point: Vec, boxes: list[Any]) -> Any:
    """Distance of a point from the nearest box, 0 inside."""
    import casadi as ca

    distance: Any = np.inf
    for box in boxes:
        gaps = [ca.fmax(gap, 0) for gap in _gaps(point, box)]
        distance = ca.fmin(ca.sqrt(sum(gap * gap for gap in gaps) + POINT), distance)
    return distance


def _depth(point: Vec, box: Any) -> Any:
    """Largest distance beyond a face: negative, and minus the depth, inside."""
    import casadi as ca

    deepest: Any = -np.inf
    for gap in _gaps(point, box):
        deepest = ca.fmax(gap, deepest)
    return deepest


def _gaps(point: Vec, box: Any) -> list[Any]:
    """How far a point is beyond every face of a box."""
    gaps = []
    for x, (low, high) in zip(point, box, strict=True):
        gaps += [] if low is None else [low - x]
        gaps += [] if high is None else [x - high]
    return gaps


def _corners(state: SymbolicState) -> list[Vec]:
    kin, half = state.kinematics, [edge / 2 for edge in state.object_size or (0.0, 0.0, 0.0)]
    signs = product((-1.0, 1.0), repeat=3)
    offsets = [[sign * edge for sign, edge in zip(each, half, strict=True)] for each in signs]
    return [add(kin.tip, [dot(row, offset) for row in kin.rotation]) for offset in offsets]
