"""Values of a problem's conditions over time, for plots and pages: tilt, clearances, distances from the manifold."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.judges.plans.joint_limits import is_proven
from cnpgen.judges.plans.measure import MeasuredCondition, measure, name_part
from cnpgen.problems.constraints.clearance import DistanceConstraint
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.problem import Problem
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World

_UPRIGHT = "upright"  # the angle of "tilt" includes this condition
_COSINE = "tilt cosine"  # drawn as an angle
# SI unit -> factor and unit of plots
_SCALES = {
    "m": (1e3, "mm"),
    "rad": (180 / np.pi, "deg"),
}


@dataclass(frozen=True)
class ConditionCurve:
    """Values of one condition along a motion, with bounds."""

    name: str  # name of the condition, as in the verdict
    # Name of the values: of an equality they are deviations, of several values
    # distances from their bounds.
    label: str
    unit: str  # unit of values and bounds, "mm" and "deg" instead of "m" and "rad"
    parts: tuple[str, ...]  # names of the m values; one empty name for a single value
    values: Array  # values, shape (m, K)
    lower: Array  # lower bounds, shape (K,); -inf for none
    upper: Array  # upper bounds, shape (K,); inf for none
    tolerance: float  # violation of a bound that is accepted
    # Closest points of two bodies in the world [m], shape (K, 2, 3); None if no
    # distance.
    points: Array | None = None
    # Names of the closest bodies at every state, empty if it is no distance.
    pairs: tuple[str, ...] = ()

    @property
    def violated(self) -> Mask:
        """Mask of the states at which a value is outside its bounds by more than the tolerance, shape (K,)."""
        outside = np.maximum(self.lower - self.values, self.values - self.upper)
        return np.asarray(~(outside <= self.tolerance).all(axis=0))


def plot_unit(unit: str) -> tuple[float, str]:
    """Return the factor and the name of the unit in which plots show an SI unit."""
    return _SCALES.get(unit, (1.0, unit))


def condition_curves(
    problem: Problem, world: PathWorld, s: Array
) -> list[ConditionCurve]:
    """Measure all conditions that are no limits of joints at phases s, shape (K,), where the robot is."""
    # A copy, since measuring between samples moves the world.
    start_tip = world.tip_position[:, 0].copy()
    curves: list[ConditionCurve] = []
    for constraint in problem.constraint:
        if is_proven(constraint) or isinstance(constraint, JointTorque):
            continue
        if (
            isinstance(constraint, DistanceConstraint)
            and constraint.bodies != "held object"
        ):
            curves += _distance_curves(problem, constraint, world)
        else:
            curves += _value_curves(problem, measure(constraint, world, s, start_tip))
    return curves


def _value_curves(
    problem: Problem, measured: list[MeasuredCondition]
) -> Iterator[ConditionCurve]:
    """Convert measured conditions: one value with its bounds, several values as distances from their bounds."""
    for condition in measured:
        stated = condition.condition
        if stated.name == _UPRIGHT:
            continue
        if stated.name == _COSINE:
            yield _tilt_curve(condition)
        elif len(condition.g) == 1:
            yield _bounded_curve(condition)
        else:
            yield _distance_inside(problem, condition)


def _unit_of(condition: MeasuredCondition) -> tuple[float, str, float]:
    """Return the factor and the unit of plots, and the accepted violation in this unit."""
    unit = condition.condition.unit
    factor, shown = plot_unit(unit if isinstance(unit, str) else unit[0])
    return factor, shown, factor * float(condition.tolerance.min())


def _bounded_curve(condition: MeasuredCondition) -> ConditionCurve:
    """Convert one value with its bounds; an equality becomes the deviation from its value."""
    stated = condition.condition
    factor, shown, tolerance = _unit_of(condition)
    center = stated.lower[0] if stated.is_equality else 0.0
    return ConditionCurve(
        stated.name,
        f"{stated.name}, deviation" if center else stated.name,
        shown,
        ("",),
        factor * (condition.g - center),
        factor * (stated.lower[0] - center - condition.relaxation),
        factor * (stated.upper[0] - center + condition.relaxation),
        tolerance,
    )


def _distance_inside(problem: Problem, condition: MeasuredCondition) -> ConditionCurve:
    """Convert several values, whose bounds may differ, to distances from the closer bound, positive inside."""
    stated = condition.condition
    factor, shown, tolerance = _unit_of(condition)
    count = condition.g.shape[1]
    parts = tuple(
        name_part(problem, condition.constraint, stated, i)
        for i in range(len(condition.g))
    )
    return ConditionCurve(
        stated.name,
        f"{stated.name}, distance inside",
        shown,
        parts,
        -factor * condition.violation,
        np.zeros(count),
        np.full(count, np.inf),
        tolerance,
    )


def _tilt_curve(condition: MeasuredCondition) -> ConditionCurve:
    """Convert the cosine of a tilt to an angle."""
    least = float(condition.condition.lower[0])
    # The tolerance is on the cosine; the accepted angle follows from the smaller
    # cosine.
    limit, accepted = (
        float(np.degrees(np.arccos(cosine)))
        for cosine in (least, least - condition.tolerance[0])
    )
    angle = np.degrees(np.arccos(np.clip(condition.g, -1.0, 1.0)))
    count = angle.shape[1]
    return ConditionCurve(
        _COSINE,
        "tilt",
        "deg",
        ("",),
        angle,
        np.full(count, -np.inf),
        np.full(count, limit),
        accepted - limit,
    )


def _distance_curves(
    problem: Problem, constraint: DistanceConstraint, world: PathWorld
) -> Iterator[ConditionCurve]:
    """Measure the smallest distance of a constraint on distances at every state, with the closest points."""
    (stated,) = constraint.judged(cast(World, world))
    if not stated.g:
        return
    # A robot without link geometry is a chain of segments with the arm's radius.
    radius = (
        (problem.arm_radius or 0.0)
        if constraint.bodies == "robot" and world.robot.shape is None
        else 0.0
    )
    closest = world.pairs(constraint.bodies).closest_points(radius)
    count = len(closest.distance)
    least = np.full(count, 1e3 * (float(stated.lower[0]) - radius))
    names = [name_part(problem, constraint, stated, i) for i in range(len(stated.g))]
    pairs = tuple(names[pair] for pair in closest.pair)
    tolerance = 1e3 * float(constraint.allowed(stated)[0])
    values = 1e3 * closest.distance[None]
    unbounded = np.full(count, np.inf)
    name = stated.name
    yield ConditionCurve(
        name,
        name,
        "mm",
        ("",),
        values,
        least,
        unbounded,
        tolerance,
        closest.points,
        pairs,
    )
