"""Goals of hits, as far as the stages that a dataset records determine them: where the arm hits, and how fast.

A hitting configuration is a maximum of ``f(q) = |J(q)^T d|^2 - |(q0 - q) / L|^2`` among the configurations that put
the tip at the goal, within the joint limits (reference 2, section on hitting): ``d`` is the direction of the hit, ``J``
the translational Jacobian of the tip, ``q0`` the base, the start or the home configuration, ``L`` the rated joint
velocities. There the gradient of f is a combination of the rows of J, but for joints at a limit, which f pushes against
it. Which of several maxima was found is not looked at. A hitting velocity is the fastest one or a fraction of it, which
is drawn.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.judges.rows.report import Array, Check, Index, compare
from cnpgen.problems.constraints.constraint import EXACTNESS

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

# How far the gradient of f may be from the rows of J [m^2/rad]. In float32 the joints are off by 1e-7 rad.
STATIONARY = {"float64": 1e-8, "float32": 1e-5}
AT_LIMIT = {"float64": 1e-9, "float32": 1e-6}  # rad: joints closer to a limit than this are at it
SAME = {"float64": 4e-16, "float32": 2.5e-7}  # what quotients of stored numbers that were equal differ by
UNLIKELY = 1e-9  # probability below which equal fractions are nobody's luck


@dataclass(frozen=True)
class HitRule:
    """What the stages of a dataset say of its goals.

    Attributes:
        near: The configuration that goals stay close to, "base", "start" or "home"; empty if no stage chooses them.
        full_speed: Fraction of the hits at the highest possible speed; None if no stage chooses the speed.
    """

    near: str = ""
    full_speed: float | None = None


def hit_rule(stages: Iterable[Mapping[str, Any]]) -> HitRule:
    """Read from resolved stages what they say of goals."""
    by_kind = {stage.get("use"): stage for stage in stages}
    near = by_kind.get("hitting-configuration", {}).get("near", "")
    return HitRule(str(near), by_kind.get("hitting-velocity", {}).get("full_speed"))


def judge_goals(
    robot: "Robot", rule: HitRule, columns: Mapping[str, Array], finite: Index, dtype: str
) -> list[tuple[Check, Index]]:
    """Judge the goals of finite rows by what the stages say of them.

    Args:
        robot: The robot.
        rule: What the stages say.
        columns: Field -> values in SI units, shape (rows, width).
        finite: The rows to judge.
        dtype: The float type that the rows are stored in.
    """
    judged = []
    if rule.near and "hit_angle" in columns:
        q, angle = columns["goal_q"][finite], columns["hit_angle"][finite, 0]
        near_base = np.broadcast_to(robot.base, q.shape)
        home = near_base if rule.near == "base" else columns[f"{rule.near}_q"][finite]
        error = _slopes(robot, q, home, angle, AT_LIMIT[dtype])
        judged.append(_compared("hitting configuration", "m^2/rad", error, STATIONARY[dtype], finite))
    if rule.full_speed is not None and "hit_speed_max" in columns:
        share = shares_of(columns)[finite]
        beyond = np.abs(columns["goal_dq"][finite]) - share[:, None] * robot.velocity_limit
        slower = np.where(share == 1, 0.0, np.inf) if rule.full_speed == 1 else np.zeros(len(finite))
        error = np.maximum(np.maximum(beyond.max(axis=1, initial=0.0), 0.0), slower)
        judged.append(_compared("hitting velocity", "rad/s", error, EXACTNESS[dtype]["velocity"], finite))
    return judged


def shares_of(columns: Mapping[str, Array]) -> Array:
    """Compute which fraction of the highest possible speed each hit has, shape (rows,)."""
    speed, highest = (np.asarray(columns[name], np.float64).reshape(-1) for name in ("hit_speed", "hit_speed_max"))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(speed / highest)


def repeated_share(shares: Array, dtype: str) -> tuple[int, float]:
    """Find a fraction below 1 that more hits have than luck gives: such hits were slowed down afterwards.

    Args:
        shares: What ``shares_of`` gives for all rows of a dataset.
        dtype: The float type that the rows are stored in.

    Returns:
        How many hits have it, and the fraction; 0 where there is none.
    """
    drawn = np.sort(shares[(shares > 0) & (shares < 1)])
    expected, count = len(drawn) * SAME[dtype], 2
    while len(drawn) * expected ** (count - 1) / math.factorial(count - 1) > UNLIKELY:
        count += 1
    close = drawn[count - 1 :] - drawn[: max(len(drawn) - count + 1, 0)] <= SAME[dtype]
    if not close.any():
        return 0, 0.0
    value = float(drawn[int(np.argmax(close))])
    return int((np.abs(drawn - value) <= SAME[dtype]).sum()), value


def _compared(name: str, unit: str, error: Array, allowed: float, rows: Index) -> tuple[Check, Index]:
    ones = np.ones(len(rows), np.int64)
    return compare(name, unit, violation=error, allowed=np.full(len(rows), allowed), row=rows, end=ones)


def _slopes(robot: "Robot", q: Array, home: Array, angle: Array, at_limit: float) -> Array:
    """Compute how steeply f still rises in a direction that is left to the joints [m^2/rad], shape (rows,)."""
    jacobian, gradient = _gradients(robot, q, home, angle)
    low, high = q - robot.position_lower < at_limit, robot.position_upper - q < at_limit
    free = jacobian * ~(low | high)[:, None]
    multiplier = np.linalg.pinv(free @ free.swapaxes(1, 2)) @ (free @ gradient[:, :, None])
    rest = gradient - (jacobian.swapaxes(1, 2) @ multiplier)[:, :, 0]
    rising = np.where(high, -rest, np.where(low, rest, np.abs(rest)))  # at a limit f may rise beyond it
    return np.asarray(rising.max(axis=1, initial=0.0))


def _gradients(robot: "Robot", q: Array, home: Array, angle: Array) -> tuple[Array, Array]:
    """Return J and the gradient of f, by Pinocchio's derivatives of the tip's velocity.

    Pinocchio differentiates the velocity of the tip's frame as if its axes turned with it. That adds a combination of
    the rows of J to the gradient, which changes nothing of what is left when such are taken out.

    Args:
        robot: The robot.
        q: Joint positions [rad], shape (rows, n).
        home: The configurations to stay close to [rad], shape (rows, n).
        angle: Directions of the hits [rad], shape (rows,).

    Returns:
        Shapes (rows, 3, n) and (rows, n).
    """
    import pinocchio as pin

    model, tip, frame = robot.model, robot.tip_frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    data, still = model.createData(), np.zeros(robot.n)
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    jacobian, slope = np.empty((len(q), 3, robot.n)), np.empty((len(q), robot.n))
    for row in range(len(q)):
        jacobian[row] = pin.computeFrameJacobian(model, data, q[row], tip, frame)[:3]
        pin.computeForwardKinematicsDerivatives(model, data, q[row], direction[row] @ jacobian[row], still)
        by_position, _ = pin.getFrameVelocityDerivatives(model, data, tip, frame)
        slope[row] = direction[row] @ by_position[:3]
    return jacobian, 2 * slope + 2 * (home - q) / robot.rated_velocity**2
