"""Problem, pipeline and dataset of an arm: from rest to rest between two boxes of positions, within its limits."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from cnpgen.cli.init.arm import Arm, ArmJoint, with_torques
from cnpgen.cli.init.draws import comfortable_base, find_boxes
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.boundary_motion import AtRest
from cnpgen.pipelines.stages.draw import DrawPositions
from cnpgen.pipelines.stages.ik import GoalIK, StartIK
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.pipelines.stages.torque import GravityTorque
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import JointAcceleration, JointJerk, JointPosition, JointTorque, JointVelocity
from cnpgen.problems.constraints.self_clearance import SelfClearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.robot_spec import LimitSpec, RobotSpec
from cnpgen.schema.keys import PerJoint, Range

GUESS_RANGE_RAD, GUESS_RANGE_M = 0.5, 0.1  # range of inverse kinematics guesses around the base configuration
INITIAL_JERK_RATE = 100.0  # jerk limits per acceleration limit [1/s]; Franka Research 3: 500 ('cnpgen docs references')
TORQUE_STATES = 1000  # random states that determine placeholders of missing torque limits


def dataset_of(arm: Arm, name: str, folder: Path, packages: tuple[Path, ...]) -> tuple[DatasetRecipe, Arm, float]:
    """Make the recipes of an arm.

    Args:
        arm: The arm.
        name: Name of all three recipes.
        folder: Folder of the recipes.
        packages: Folders that are searched for packages.

    Returns:
        The dataset with its pipeline and its problem, the arm with torques in the place of missing ones, and which
        share of its draws was accepted.

    Raises:
        RecipeError: The arm cannot be planned for, or no positions were found that it reaches.
    """
    places = tuple(str(each.absolute()) for each in packages)
    provisional = with_torques(arm, [1.0] * len(arm.planned))
    robot = load_robot(_problem(provisional, name, folder, places))
    arm = with_torques(arm, _torques(robot))
    problem = _with_jerk_limits(_problem(arm, name, folder, places), robot)
    if _has_masses(robot):
        limit = JointTorque(tolerance=5e-3, budget=6e-2)
        problem = replace(problem, constraint=(*problem.constraint[:4], limit, *problem.constraint[4:]))
    base = comfortable_base(problem, load_robot(problem))
    problem = replace(problem, robot=replace(problem.robot, base=base))
    pipeline = Pipeline(
        name=name,
        title=f"From rest to rest: {name}",
        problem=problem,
        stage=_stages(arm, problem),
        path=folder / "pipeline.toml",
    )
    pipeline, share = find_boxes(pipeline)
    splits = {"train": 18_000, "validation": 2_000}
    dataset = DatasetRecipe(
        name=name,
        title=f"Motions from rest to rest: {name}",
        pipeline=pipeline,
        splits=splits,
        path=folder / "dataset.toml",
    )
    return dataset, arm, share


def _problem(arm: Arm, name: str, folder: Path, packages: tuple[str, ...]) -> Problem:
    """Return the problem without torques, with the base configuration at the centre of all limits."""
    missing = {what for joint in arm.planned for what in joint.missing}
    centre = tuple((joint.lower + joint.upper) / 2 for joint in arm.planned)
    robot = RobotSpec(
        urdf=str(arm.urdf.absolute()),
        joints=tuple(joint.name for joint in arm.planned),
        tip=arm.tip,
        base=centre,
        geometry="urdf" if arm.has_shape else "paper-capsules",
        packages=packages,
    )
    limits = LimitSpec(
        velocity_scale=0.8,
        torque_scale=0.8,
        position=tuple(Range(each.lower, each.upper) for each in arm.planned) if "position" in missing else None,
        velocity=PerJoint(tuple(each.velocity for each in arm.planned)) if "velocity" in missing else None,
        torque=PerJoint(tuple(each.effort for each in arm.planned)) if "torque" in missing else None,
    )
    constraints: tuple[Constraint, ...] = (
        JointPosition(tolerance=1e-3),
        JointVelocity(tolerance=2e-3, budget=6e-3),
        JointAcceleration(tolerance=5e-3, budget=6e-2),
    )
    if arm.has_shape:
        constraints = (*constraints, SelfClearance(tolerance=1e-3, budget=1e-6))
    path, title = folder / "problem.toml", f"Move {arm.urdf.stem} within its limits"
    return Problem(name=name, title=title, robot=robot, limits=limits, constraint=constraints, path=path.absolute())


def _with_jerk_limits(problem: Problem, robot: Robot) -> Problem:
    """Return the problem with jerk limits in proportion to the acceleration limits; URDFs have none."""
    jerks = tuple(float(f"{INITIAL_JERK_RATE * limit:.3g}") for limit in robot.acceleration_limit)
    limits = replace(problem.limits, jerk=PerJoint(jerks))
    *others, acceleration = problem.constraint[:3]
    constraints = (*others, acceleration, JointJerk(tolerance=5e-3, budget=6e-2), *problem.constraint[3:])
    return replace(problem, limits=limits, constraint=constraints)


def _has_masses(robot: Robot) -> bool:
    """Return whether every joint moves a mass; otherwise torques are meaningless."""
    return robot.chain.joints[-1].mass > 0


def _torques(robot: Robot) -> list[float]:
    """Return the largest torques [N m] at random states, at speeds and accelerations within the limits."""
    import pinocchio as pin

    model, random = robot.model, np.random.default_rng(0)
    data = model.createData()
    q = random.uniform(robot.position_lower, robot.position_upper, (TORQUE_STATES, robot.n))
    dq, ddq = (
        random.uniform(-limit, limit, (TORQUE_STATES, robot.n))
        for limit in (robot.velocity_limit, robot.acceleration_limit)
    )
    most = np.abs([pin.rnea(model, data, *state) for state in zip(q, dq, ddq, strict=True)]).max(axis=0)
    return [float(max(1, math.ceil(each))) for each in most]


def _stages(arm: Arm, problem: Problem) -> tuple[Stage, ...]:
    """Return the stages; the boxes are still to be found."""
    anywhere = (Range(0.0, 0.0),) * 3
    torques = any(isinstance(each, JointTorque) for each in problem.constraint)
    holding = {end: (GravityTorque(end=end),) if torques else () for end in ("start", "goal")}
    return (
        DrawPositions(start=anywhere, goal=anywhere),
        StartIK(guess=tuple(_near(joint, at) for joint, at in zip(arm.planned, problem.robot.base, strict=True))),
        *holding["start"],
        GoalIK(),
        *holding["goal"],
        AtRest(end="start"),
        AtRest(end="goal"),
    )


def _near(joint: ArmJoint, at: float) -> Range:
    half = GUESS_RANGE_M if joint.kind == "prismatic" else GUESS_RANGE_RAD
    return Range(round(max(at - half, joint.lower), 4), round(min(at + half, joint.upper), 4))
