"""The robot of a problem: the URDF's limits scaled as the problem says, and what does not fit."""

from collections.abc import Iterator

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.problems.problem import Problem
from cnpgen.robots.chain import chain_from_model
from cnpgen.robots.robot import Robot, reduced_model


def load_robot(problem: Problem) -> Robot:
    """Load the robot of a problem.

    Raises:
        RecipeError: The URDF cannot be read, or joints, tip, base configuration and limits do not fit it.
    """
    spec, limits = problem.robot, problem.limits
    try:
        urdf = problem.urdf_text
        model = reduced_model(problem.urdf_path, urdf, spec.joints)
        chain = chain_from_model(model, spec.tip)
    except RecipeError as error:
        raise RecipeError([f"{problem.path}: {mistake}" for mistake in error.mistakes]) from error
    velocity = limits.velocity_scale * np.array(model.velocityLimit)
    middle = (np.array(model.upperPositionLimit) + np.array(model.lowerPositionLimit)) / 2
    half = limits.position_scale * (np.array(model.upperPositionLimit) - np.array(model.lowerPositionLimit)) / 2
    robot = Robot(
        urdf=problem.urdf_path,
        urdf_text=urdf,
        joint_names=tuple(spec.joints),
        tip=spec.tip,
        position_lower=middle - half,
        position_upper=middle + half,
        velocity_limit=velocity,
        acceleration_limit=np.minimum(limits.acceleration_rate * velocity, limits.acceleration_cap),
        torque_limit=limits.torque_scale * np.array(model.effortLimit),
        rated_velocity=np.array(model.velocityLimit),
        base=np.array(spec.base),
        chain=chain,
    )
    if mistakes := list(_mistakes(problem, robot)):
        raise RecipeError(mistakes)
    return robot


def _mistakes(problem: Problem, robot: Robot) -> Iterator[str]:
    """Say which limits no motion can meet."""
    limits = {"velocity": robot.velocity_limit, "torque": robot.torque_limit}
    for what, values in limits.items():
        for name, value in zip(robot.joint_names, values, strict=True):
            if not (np.isfinite(value) and value > 0):
                yield f"{robot.urdf}: {name}: the {what} limit must be positive and finite, got {value:g}"
    low, high = np.array(robot.model.lowerPositionLimit), np.array(robot.model.upperPositionLimit)
    for joint in np.flatnonzero(~(low < high)):
        text = f"the lower position limit must be below the upper one, got {low[joint]:g} and {high[joint]:g}"
        yield f"{robot.urdf}: {robot.joint_names[joint]}: {text}"
    if (low < high).all():
        yield from _base_mistakes(problem, robot)


def _base_mistakes(problem: Problem, robot: Robot) -> Iterator[str]:
    """Say whether the base configuration fits the joints and their limits."""
    low, high, base = robot.position_lower, robot.position_upper, robot.base
    if base.shape != low.shape:
        yield f"{problem.path}: robot.base: needs {robot.n} values, one per planned joint, got {base.size}"
        return
    worst = int(np.argmax(np.maximum(low - base, base - high)))
    if not low[worst] <= base[worst] <= high[worst]:
        yield (
            f"{problem.path}: robot.base: {robot.joint_names[worst]} = {base[worst]:g} rad is outside its planning"
            f" limits [{low[worst]:g}, {high[worst]:g}]"
        )
