"""Loading of the robot of a problem, with scaled limits and consistency checks."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.constraints.object_clearance import ObjectClearance
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.plausible_sizes import check_plausible_sizes
from cnpgen.problems.problem import Problem, kept_folder
from cnpgen.robots.attached import Attached, PayloadBody
from cnpgen.robots.chain import chain_from_model
from cnpgen.robots.robot import Robot, mistakes_in, reduced_model
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.held_object import HeldBody, load_held_shape
from cnpgen.robots.shape.shape import Shape, load_shape
from cnpgen.schema.keys import PerJoint
from cnpgen.schema.units import PLAUSIBLE_MAX, suggested_unit
from cnpgen.store.joint_units import unit_of

Array = NDArray[np.float64]

JERK_RATE = 5.0  # 1/s: jerk limit / acceleration limit in the authors' code


def load_robot(problem: Problem) -> Robot:
    """Load the robot of a problem.

    Raises:
        RecipeError: The URDF cannot be read, or is inconsistent with the joints, tip, base configuration or limits.
        PluginError: The URDF belongs to a package that is not installed.
    """
    spec, limits = problem.robot, problem.limits
    with mistakes_in(problem.path):
        urdf, attached = problem.urdf_text, _attached(problem)
        model = reduced_model(problem.urdf_path, urdf, spec.joints, attached)
        chain = chain_from_model(model, attached.tip)
        rated = _given(limits.velocity, "velocity", model.velocityLimit)
        torque = _given(limits.torque, "torque", model.effortLimit)
        velocity = limits.velocity_scale * rated
        most = np.minimum(limits.acceleration_rate * velocity, limits.acceleration_cap)
        acceleration = _given(limits.acceleration, "acceleration", most)
        jerk = _given(limits.jerk, "jerk", JERK_RATE * acceleration)
    center = (np.array(model.upperPositionLimit) + np.array(model.lowerPositionLimit)) / 2
    half = limits.position_scale * (np.array(model.upperPositionLimit) - np.array(model.lowerPositionLimit)) / 2
    robot = Robot(
        urdf=problem.urdf_path,
        urdf_text=urdf,
        joint_names=tuple(spec.joints),
        tip=attached.tip,
        attached=attached,
        position_lower=center - half,
        position_upper=center + half,
        velocity_limit=velocity,
        acceleration_limit=acceleration,
        jerk_limit=jerk,
        torque_limit=limits.torque_scale * torque,
        rated_velocity=rated,
        base=np.array(spec.base),
        chain=chain,
        parameters=problem.parameters,
        table_origin=problem.table_origin,
        nominal_parameters=problem.nominal_parameters,
    )
    if mistakes := list(_mistakes(problem, robot)):
        raise RecipeError(mistakes)
    with mistakes_in(problem.path):
        shape = load_shape(urdf, robot.model, kept_folder()) if spec.geometry == "urdf" else None
        model, robot = robot.model, replace(robot, shape=shape, held_shape=_held_shape(problem, robot))
    vars(robot)["model"] = model  # a cached property, expensive to build again
    if not problem.is_stored:
        check_plausible_sizes(robot, problem)
    return robot


def _attached(problem: Problem) -> Attached:
    """Return the attachments of the problem."""
    spec, ranges, payload = problem.robot, problem.limits.position or (), problem.payload
    if ranges and len(ranges) != len(spec.joints):
        raise RecipeError(
            [f"limits.position: needs {len(spec.joints)} ranges, one per planned joint, got {len(ranges)}"]
        )
    return Attached(
        spec.tip,
        rotation=turned(*spec.tip_rotation),
        translation=np.array(spec.tip_offset),
        payload=PayloadBody(payload.mass, np.array(payload.centre), payload.inertia_matrix) if payload else None,
        ranges={name: (each.low, each.high) for name, each in zip(spec.joints, ranges, strict=False)},
    )


def _given(values: PerJoint | None, what: str, otherwise: Array) -> Array:
    """Return the limits of the problem for all joints, or the defaults."""
    if values is None:
        return np.array(otherwise)
    if len(values.values) not in (1, len(otherwise)):
        n, found = len(otherwise), len(values.values)
        raise RecipeError([f"limits.{what}: needs one number, or {n}, one per planned joint, got {found}"])
    return np.broadcast_to(np.array(values.values), len(otherwise)).copy()


def _held_shape(problem: Problem, robot: Robot) -> Shape | None:
    """Load the geometry for collisions of the held object with the robot, if a constraint needs it."""
    if problem.object is None or problem.first(ObjectClearance) is None:
        return None
    held = HeldBody(problem.object.size, problem.object.touch_links, robot.tip_frame)
    return load_held_shape(robot.urdf_text, robot.model, held, kept_folder())


def _mistakes(problem: Problem, robot: Robot) -> Iterator[str]:
    """Yield error messages for limits that no motion satisfies."""
    limits = {"velocity": robot.velocity_limit, "torque": robot.torque_limit}
    for what, values in limits.items():
        for name, value in zip(robot.joint_names, values, strict=True):
            if not (np.isfinite(value) and value > 0):
                yield f"{robot.urdf}: {name}: the {what} limit must be positive and finite, got {value:g}"
    if any(isinstance(constraint, JointTorque) for constraint in problem.constraint):
        yield from _weightless(robot)
    yield from (mistakes := list(_position_mistakes(problem, robot)))
    if not mistakes:
        yield from _base_mistakes(problem, robot)


def _position_mistakes(problem: Problem, robot: Robot) -> Iterator[str]:
    """Yield error messages for position limits that are equal or in another unit."""
    limits = zip(robot.joint_names, robot.model.lowerPositionLimit, robot.model.upperPositionLimit, strict=True)
    for (name, low, high), sliding in zip(limits, robot.sliding, strict=True):
        text, largest, unit = f"{robot.urdf}: {name}: ", max(low, high, key=abs), "m" if sliding else "rad"
        most = PLAUSIBLE_MAX[unit]
        if low >= high:
            yield f"{text}the lower position limit must be below the upper one, got {low:g} and {high:g}"
        elif abs(largest) > most and not problem.is_stored:
            remedy = "give ranges of joints without limits in [limits] ('position')"
            expected = f"limits of positions are at most {most:.3g} {unit}, got {largest:g} {unit}"
            yield f"{text}{expected}{suggested_unit(largest, unit, -most, most)}; {remedy}"


def _weightless(robot: Robot) -> Iterator[str]:
    """Yield error messages for joints that move no mass, which have no torques to limit."""
    mass = np.cumsum([joint.mass for joint in robot.chain.joints][::-1])[::-1]
    for name in np.array(robot.joint_names)[mass <= 0].tolist():
        text = "no link that it moves has a mass, so that its torque means nothing: give the links an <inertial>"
        yield f"{robot.urdf}: {name}: {text}, or leave out the constraint 'joint-torque'"


def _base_mistakes(problem: Problem, robot: Robot) -> Iterator[str]:
    """Yield error messages for a base configuration that is inconsistent with the joints or limits."""
    low, high, base = robot.position_lower, robot.position_upper, robot.base
    if base.shape != low.shape:
        yield f"{problem.path}: robot.base: needs {robot.n} values, one per planned joint, got {base.size}"
        return
    worst = int(np.argmax(np.maximum(low - base, base - high)))
    if not low[worst] <= base[worst] <= high[worst]:
        unit = unit_of(robot.units("rad"), worst)
        hint = suggested_unit(base[worst], unit, low[worst], high[worst]) if abs(base[worst]) > 2 * np.pi else ""
        yield (
            f"{problem.path}: robot.base: {robot.joint_names[worst]} = {base[worst]:g} {unit} is outside its planning"
            f" limits [{low[worst]:g}, {high[worst]:g}]{hint}"
        )
    for table in (each for each in problem.constraint if isinstance(each, Table)):
        height = _tip_height(robot, base)
        if height < table.z - max(table.band, table.tolerance):
            text = f"the tip is {table.z - height:.3g} m below the table, at z = {height:.4g} m, expected {table.z:g} m"
            yield f"{problem.path}: robot.base: {text} or more: is the tip the frame that you mean, and 'z' its height?"


def _tip_height(robot: Robot, q: Array) -> float:
    """Return the height of the tip at joint positions q [m]."""
    import pinocchio as pin

    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    return float(pin.updateFramePlacement(robot.model, data, robot.tip_frame).translation[2])
