"""The paper's forms of conditions that the default loss penalizes in another form, for comparison.

The orientation loss ``Huber(1 - R_22)`` has no gradient at the solution. The collision
losses use points, and an edge fits between points. The robot loss has no gradient
inside an obstacle (paper, Appendix B, additional loss functions).
"""

from itertools import product
from math import ceil
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.convex_distances import SMOOTHING_M2
from cnpgen.kernels.symbolic.kinematics import forward_kinematics
from cnpgen.kernels.symbolic.linalg import Vec, add, dot, scale, subtract
from cnpgen.kernels.symbolic.obstacle_distances import (
    SymbolicUprightBox,
    symbolic_solids,
)
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.problems.constraints.axis import Vertical
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Condition, Conditions, Constraint
from cnpgen.robots.parameter_ranges import UPRIGHT_TOLERANCE

MAX_POINT_SPACING_M = 0.1  # between points on the capsule axes of the robot


def published_conditions(constraint: Constraint, state: SymbolicState) -> Conditions:
    """Return the conditions that the paper penalizes; for other constraints those of ``Constraint.penalized``.

    A sum inside one Huber loss of the paper is one value that must be 0.
    """
    import casadi as ca

    if isinstance(constraint, Vertical):
        up = state.along_upright([row[2] for row in state.kinematics.rotation])
        ratio = constraint.tolerance / state.parameters.get(
            UPRIGHT_TOLERANCE, constraint.tolerance
        )
        return _zero(
            "orientation",
            "1",
            (1 - up[2]) * (1 if isinstance(ratio, float) else ratio**2),
        )
    boxes = [
        solid.bounds
        for solid in symbolic_solids(state)
        if isinstance(solid, SymbolicUprightBox)
    ]
    if len(boxes) < len(state.obstacles):
        return constraint.penalized(state)
    if (
        isinstance(constraint, RobotClearance)
        and (radius := constraint.radius) is not None
    ):
        violations = (radius - _distance(point, boxes) for point in _points(state))
        return _zero("robot clearance", "m", sum(ca.fmax(x, 0) for x in violations))
    if isinstance(constraint, ObjectContact):
        depths = (
            -ca.mmax(ca.vertcat(*_gaps(corner, box)))
            for corner in _corners(state)
            for box in boxes
        )
        violations = (depth - constraint.depth for depth in depths)
        return _zero("object contact", "m", sum(ca.fmax(x, 0) for x in violations))
    return constraint.penalized(state)


def _zero(name: str, unit: str, value: Any) -> Conditions:
    return (Condition(name, unit, [value], np.zeros(1), np.zeros(1), "position"),)


def _points(state: SymbolicState) -> list[Vec]:
    """Return the ends of the robot's capsule axes, each once, and points between them."""
    base = forward_kinematics(state.robot.chain, [float(q) for q in state.robot.home])
    origins = [np.array(x, float) for x in (*base.origins, base.tip)]
    ends: dict[int, Vec] = {}
    between: list[Vec] = []
    for (a, b), (i, j) in zip(state.segments, state.robot.capsule_axes, strict=True):
        intervals = ceil(
            float(np.linalg.norm(origins[j] - origins[i])) / MAX_POINT_SPACING_M - 1e-9
        )
        between += [
            add(a, scale(subtract(b, a), k / intervals)) for k in range(1, intervals)
        ]
        ends |= {i: a, j: b}
    return [*ends.values(), *between]


def _distance(point: Vec, boxes: list[Any]) -> Any:
    """Return the distance of a point from the closest box, 0 inside."""
    import casadi as ca

    distances = []
    for box in boxes:
        gaps = [ca.fmax(gap, 0) for gap in _gaps(point, box)]
        distances.append(ca.sqrt(sum(gap * gap for gap in gaps) + SMOOTHING_M2))
    return ca.mmin(ca.vertcat(*distances)) if distances else np.inf


def _gaps(point: Vec, box: Any) -> list[Any]:
    """Return the signed distances of a point from the faces of a box, positive outside."""
    gaps = []
    for x, (low, high) in zip(point, box, strict=True):
        gaps += [] if low is None else [low - x]
        gaps += [] if high is None else [x - high]
    return gaps


def _corners(state: SymbolicState) -> list[Vec]:
    kin = state.kinematics
    half = [edge / 2 for edge in state.object_size or (0.0, 0.0, 0.0)]
    signs = product((-1.0, 1.0), repeat=3)
    offsets = [
        [sign * edge for sign, edge in zip(corner, half, strict=True)]
        for corner in signs
    ]
    return [
        add(kin.tip, [dot(row, offset) for row in kin.rotation]) for offset in offsets
    ]
