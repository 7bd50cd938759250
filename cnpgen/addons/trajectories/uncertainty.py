"""Errors of measured conditions whose states are known up to bounds.

Distances change by at most the displacement of the robot's points, which motion bounds
give (Schwarzer et al. 2005). Other conditions are measured again with every value of
the state moved by its bound, one by one and in random combinations. The sum of the
changes, times a safety factor for curvature, bounds the error.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cnpgen.addons.trajectories.curve_family import UNDEFINED, CurveFamily
from cnpgen.arrays import Array, Indices
from cnpgen.judges.plans.continuous_collision import is_contact
from cnpgen.judges.plans.evaluated_trajectory import EvaluatedTrajectory
from cnpgen.judges.plans.measure import MeasuredCondition, measure
from cnpgen.problems.constraints.joint import POWER_UNIT, JointTorque
from cnpgen.problems.problem import Problem
from cnpgen.world.drive import friction_bounds
from cnpgen.world.path import PathWorld

MAX_BLOCKS = 400  # of samples that share one error
CURVATURE_FACTOR = 1.5  # on the sum of changes
COMBINATIONS = 8  # random ones of all changes
SCENE_FACTOR = 2.0  # on the largest change by one of the possible scenes


@dataclass(frozen=True)
class Uncertainty:
    """Errors of conditions along a family of curves."""

    s: Array  # phases at which the blocks begin, shape (B,)
    # By ``_key``: in every block, shape (m, B), or one of all.
    errors: dict[tuple[int, str], Array | float]

    def add(self, condition: MeasuredCondition, s: Array) -> MeasuredCondition:
        """Return a condition at phases s, shape (K,), with the error of its values."""
        error = self.errors[_key(condition)]
        # One error of all times; an error of 0 leaves the condition as it is.
        if isinstance(error, float):
            return replace(condition, uncertainty=error) if error else condition
        # Errors are measured at the middle of blocks. The largest of a block and both
        # neighbors covers the times between.
        block = np.searchsorted(self.s, s, "right") - 1
        near = [np.clip(block + step, 0, len(self.s) - 1) for step in (-1, 0, 1)]
        return replace(
            condition, uncertainty=np.max([error[:, k] for k in near], axis=0)
        )


def _key(condition: MeasuredCondition) -> tuple[int, str]:
    """Return what identifies a condition.

    Two constraints may state conditions of one name.
    """
    return id(condition.constraint), condition.condition.name


def uncertainty_of(  # noqa: PLR0917 - the family, and everything that measures its conditions
    problem: Problem,
    family: CurveFamily,
    world: PathWorld,
    scenes: Sequence[Array],
    measured: Sequence[MeasuredCondition],
    s: Array,
) -> Uncertainty:
    """Compute the errors of measured conditions at phases s of the samples, shape (K,), by moving another robot.

    The first scene has the poses and sizes of the nominal curve, shape (width,); others
    are possible ones.
    """
    # No point of the robot moves farther than sum_j reach_j |dq_j| for changes of q.
    reach = world.motion_bounds(family.max_positions())
    displacement = float((family.bounds[0] @ reach).max())
    # Both ends place obstacles; the tip at the start relaxes bounds.
    ends = family.bounds[0][[0, -1]] @ reach
    placed = (
        float(ends.max())
        if any(obstacle.below for obstacle in problem.obstacle)
        else 0.0
    )
    errors: dict[tuple[int, str], Array | float] = {}
    smooth = []
    for condition in measured:
        if is_contact(condition.constraint):
            errors[_key(condition)] = displacement + placed
        else:
            smooth.append(condition)
    starts = np.unique(
        np.linspace(0, len(s), min(MAX_BLOCKS, len(s)) + 1).astype(np.intp)
    )[:-1]
    is_known = not any(bound.any() for bound in family.bounds)
    if smooth and (len(scenes) > 1 or not is_known):
        found = _changes(problem, family, world, scenes, smooth, s, starts)
        for condition, change in zip(smooth, found, strict=True):
            relaxed = float(ends[0]) if condition.relaxation.any() else 0.0
            friction = _friction_changes(family, world, condition, s, starts)
            errors[_key(condition)] = change + relaxed + friction
    else:
        errors |= {_key(condition): 0.0 for condition in smooth}
    return Uncertainty(s[starts], errors)


def _friction_changes(
    family: CurveFamily,
    world: PathWorld,
    condition: MeasuredCondition,
    s: Array,
    starts: Indices,
) -> Array | float:
    """Bound the changes of the friction of drives in every block, shape (m, B); 0 for other conditions.

    Friction changes within a few samples about a reversal, which the midpoint of a
    block may miss. It rises with the velocity, so both ends of the velocities bound it.
    """
    drive = world.robot.drive
    is_torque = isinstance(condition.constraint, JointTorque)
    parts = condition.condition.parts
    if drive is None or not is_torque or not parts:
        return 0.0
    dq = family.evaluate(s, jerk=False).dq
    error = family.bounds_at(s)[1]
    # Rows of a condition may be some joints only.
    joints = [world.robot.joint_names.index(part) for part in parts]
    nominal = friction_bounds(drive, dq)
    moved = [friction_bounds(drive, dq + sign * error) for sign in (-1, 1)]
    changes = [
        np.abs(other - bound)[joints]
        for ends in moved
        for other, bound in zip(ends, nominal, strict=True)
    ]
    # Friction enters the power times the velocity.
    if condition.condition.unit == POWER_UNIT:
        changes = [change * (np.abs(dq) + error)[joints] for change in changes]
    return np.maximum.reduceat(np.max(changes, axis=0), starts, axis=1)


def _changes(  # noqa: PLR0917 - as of uncertainty_of
    problem: Problem,
    family: CurveFamily,
    world: PathWorld,
    scenes: Sequence[Array],
    smooth: Sequence[MeasuredCondition],
    s: Array,
    starts: Indices,
) -> list[Array]:
    """Bound the errors of smooth conditions in every block, shape (m, B) each."""
    # The middle of every block.
    at = s[(np.append(starts[1:], len(s)) + starts) // 2]
    evaluated = family.evaluate(at, jerk=problem.uses_jerk)
    states = [values for values in vars(evaluated).values() if values is not None]
    # The largest bound of a block applies to its middle.
    bounds = [
        np.maximum.reduceat(values, starts, axis=1)
        for values in family.bounds_at(s)[: len(states)]
    ]
    still = [np.zeros_like(state) for state in states]
    nominal = _values(world, smooth, at, states, scenes[0])

    def changes(offsets: Sequence[Array], scene: Array = scenes[0]) -> list[Array]:
        moved = [state + offset for state, offset in zip(states, offsets, strict=True)]
        found = _values(world, smooth, at, moved, scene)
        return [np.abs(g - g0) for g, g0 in zip(found, nominal, strict=True)]

    total = [np.zeros_like(g) for g in nominal]
    _add_single_changes(total, changes, bounds)
    _add_scene_changes(total, [changes(still, scene) for scene in scenes[1:]])
    # A fixed seed gives equal verdicts for equal samples.
    random = np.random.default_rng(0)
    for _ in range(COMBINATIONS):
        offsets = [bound * random.choice([-1.0, 1.0], bound.shape) for bound in bounds]
        # Values that interact may have more effect than the sum of their single ones.
        for row, change in zip(total, changes(offsets), strict=True):
            np.maximum(row, change, out=row)
    return [
        CURVATURE_FACTOR * np.where(np.isfinite(row), row, UNDEFINED) for row in total
    ]


def _values(
    world: PathWorld,
    conditions: Sequence[MeasuredCondition],
    s: Array,
    states: Sequence[Array],
    scene: Array,
) -> list[Array]:
    """Measure conditions again at phases s in other states; return their values, shape (m, K) each."""
    moved = EvaluatedTrajectory(*states)
    world.set_path(moved.q, moved.dq, moved.ddq, scene, moved.jerk)
    constraints = {id(each.constraint): each.constraint for each in conditions}
    # The position of the tip at the start is used by the relaxation only.
    every = {
        _key(condition): condition.g
        for constraint in constraints.values()
        for condition in measure(constraint, world, s, np.zeros(3))
    }
    return [every[_key(condition)] for condition in conditions]


def _add_single_changes(
    total: Sequence[Array],
    changes: Callable[[Sequence[Array]], list[Array]],
    bounds: Sequence[Array],
) -> None:
    """Add first-order effects: each value moves alone, in both directions, and changes add up."""
    for order, bound in enumerate(bounds):
        for joint in np.flatnonzero(bound.any(axis=1)).tolist():
            both = []
            for sign in (-1, 1):
                offsets = [np.zeros_like(each) for each in bounds]
                offsets[order][joint] = sign * bound[joint]
                both.append(changes(offsets))
            for row, low, high in zip(total, *both, strict=True):
                np.add(row, np.maximum(low, high), out=row)


def _add_scene_changes(
    total: Sequence[Array], changes: Sequence[Sequence[Array]]
) -> None:
    """Add the largest of the changes by scenes: only one of these is the true one, so they are not summed."""
    if changes:
        for row, *of_scenes in zip(total, *changes, strict=True):
            np.add(row, SCENE_FACTOR * np.max(of_scenes, axis=0), out=row)
