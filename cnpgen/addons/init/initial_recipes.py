"""Problem, pipeline and dataset of an arm: from rest to rest between two boxes of positions, within its limits."""

import math
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.init.arm import Arm, ArmJoint, arm_notes, with_torques
from cnpgen.addons.init.draws import comfortable_base, find_boxes
from cnpgen.addons.init.joint_limits import StatedJointLimits
from cnpgen.addons.init.link_overlaps import LinkOverlaps, resolve_overlaps
from cnpgen.addons.init.stated_sources import (
    INITIAL_JERK_RATE,
    TORQUE_STATES,
    stated_sources,
)
from cnpgen.arrays import Array
from cnpgen.documents import Names
from cnpgen.errors import RecipeError
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.boundary_motion import AtRest
from cnpgen.pipelines.stages.draw import DrawPositions
from cnpgen.pipelines.stages.ik import GoalIK, StartIK
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.pipelines.stages.torque import GravityTorque
from cnpgen.problems.constraints.clearance import (
    MAX_LINK_PENETRATION_M,
    RobotClearance,
)
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import (
    JointAcceleration,
    JointJerk,
    JointPosition,
    JointTorque,
    JointVelocity,
)
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.drive import NO_DRIVE, DriveSpec
from cnpgen.robots.robot import Robot
from cnpgen.robots.robot_spec import LimitSpec, RobotSpec
from cnpgen.robots.urdf import read_urdf, urdf_tree
from cnpgen.robots.urdf_elements import SRDF_NAMES, unknown_names
from cnpgen.schema.keys import PerJoint, Range
from cnpgen.store.files.accounted import check_allowed

# Range of inverse kinematics guesses around the base configuration.
GUESS_RANGE_RAD = 0.5
GUESS_RANGE_M = 0.1
MAX_OVERLOAD = 10.0  # torque that gravity needs / torque limit of the URDF
TORQUE_SCALE = 0.8  # planning limit / URDF limit of joint torques
# Of the random states in which a joint's torque limit must suffice to hold the arm.
MIN_HOLDING_FRACTION = 0.25


@dataclass(frozen=True)
class InitialProblem:
    """Problem of an arm, with findings about its input."""

    problem: Problem
    arm: Arm  # with placeholders of missing limits
    overlaps: LinkOverlaps | None  # None without link geometry
    notes: Names


def problem_of(
    arm: Arm,
    name: str,
    folder: Path,
    packages: tuple[Path, ...],
    srdf: Path | None,
    *,
    skipped_meshes: Names = (),
    allow_unused: Names = (),
    joint_limits: StatedJointLimits | None = None,
) -> InitialProblem:
    """Make the problem of an arm, or raise RecipeError if it cannot be planned for.

    ``packages`` are folders that are searched for packages of the URDF, the SRDF
    disables pairs of links, and collision meshes of skipped links are left out.
    Elements and attributes of both files with the names of ``allow_unused`` are not
    read.
    """
    placeholder = with_torques(arm, [1.0] * len(arm.planned))
    _check_allowed(allow_unused, arm.urdf, srdf)
    problem = _problem(
        placeholder, name, folder, packages, srdf, skipped_meshes=skipped_meshes
    )
    problem = replace(problem, robot=replace(problem.robot, allow_unused=allow_unused))
    # Such as those about simplified meshes.
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        overlaps = resolve_overlaps(problem) if arm.has_shape else None
        problem = overlaps.problem if overlaps else problem
        robot = load_robot(problem)
    notes = list(dict.fromkeys(str(each.message) for each in caught))
    notes += overlaps.notes if overlaps else ()
    arm, scale, overloaded = _with_torque_limits(arm, robot)
    limits = replace(
        problem.limits, torque_scale=scale, **_replaced_limits(arm, joint_limits, robot)
    )
    problem = replace(problem, limits=limits)
    problem = _with_jerk_limits(problem, robot, arm, joint_limits)
    sources = stated_sources(arm, problem.limits, joint_limits)
    problem = replace(problem, limits=replace(problem.limits, sources=sources))
    problem, torque_notes = _with_torque(problem, robot)
    base, base_notes = comfortable_base(problem, load_robot(problem))
    problem = replace(problem, robot=replace(problem.robot, base=base))
    every = *arm_notes(arm), *notes, *torque_notes, *overloaded, *base_notes
    return InitialProblem(problem, arm, overlaps, every)


def _with_torque(problem: Problem, robot: Robot) -> tuple[Problem, Names]:
    """Return a problem with the limit of torques, or a note of the reason why it is omitted."""
    # Torques of links without masses are meaningless.
    if not robot.chain.joints[-1].mass > 0:
        text = "no mass that the last joint moves: its torques would be wrong, so 'joint-torque' is omitted"
        limits = replace(problem.limits, torque_scale=LimitSpec.torque_scale)
        return replace(problem, limits=limits), (text,)
    # After the limits of joint positions and their derivatives.
    limit = JointTorque(tolerance=5e-3, budget=6e-2)
    constraints = (*problem.constraint[:4], limit, *problem.constraint[4:])
    return replace(problem, constraint=constraints), ()


def _check_allowed(keys: Names, urdf: Path, srdf: Path | None) -> None:
    """Raise UsageError for names that neither file has as those of parts that are not read."""
    unread = unknown_names(urdf_tree(read_urdf(urdf)))
    if srdf is not None and keys:
        unread += unknown_names(urdf_tree(read_urdf(srdf)), SRDF_NAMES)
    check_allowed(keys, unread)


def dataset_of(initial: InitialProblem, folder: Path) -> tuple[DatasetRecipe, float]:
    """Return the dataset of a problem and the share of accepted candidates.

    Raise RecipeError if none are found.
    """
    problem = initial.problem
    name = initial.problem.name
    title = f"From rest to rest: {name}"
    path = folder / "pipeline.toml"
    stages = _stages(initial.arm, problem)
    pipeline, share = find_boxes(
        Pipeline(name=name, title=title, problem=problem, stage=stages, path=path)
    )
    title = f"Motions from rest to rest: {name}"
    path = folder / "dataset.toml"
    splits = {"train": 18_000, "validation": 2_000}
    return DatasetRecipe(
        name=name, title=title, pipeline=pipeline, splits=splits, path=path
    ), share


def _problem(
    arm: Arm,
    name: str,
    folder: Path,
    packages: tuple[Path, ...],
    srdf: Path | None,
    *,
    skipped_meshes: Names,
) -> Problem:
    """Return the problem without torques, with the base configuration at the centre of all limits."""
    centre = tuple((joint.lower + joint.upper) / 2 for joint in arm.planned)
    robot = RobotSpec(
        urdf=str(arm.urdf.absolute()),
        joints=tuple(joint.name for joint in arm.planned),
        tip=arm.tip,
        base=centre,
        geometry="urdf" if arm.has_shape else "paper-capsules",
        packages=tuple(str(each.absolute()) for each in packages),
        locked_joints=tuple(arm.locked_positions),
        locked_positions=tuple(arm.locked_positions.values()),
        visual_links=tuple(link for link in arm.visual if link in arm.shaped),
        srdf="" if srdf is None else str(srdf.absolute()),
        skipped_meshes=skipped_meshes,
    )
    limits = LimitSpec(
        velocity_scale=0.8, torque_scale=TORQUE_SCALE, **_replaced_limits(arm)
    )
    path = folder / "problem.toml"
    title = f"Move {arm.urdf.stem} within its limits"
    return Problem(
        name=name,
        title=title,
        version=2,
        robot=robot,
        limits=limits,
        drive=DriveSpec(urdf_dynamics=arm.urdf_dynamics) if arm.friction else NO_DRIVE,
        constraint=_constraints(arm),
        path=path.absolute(),
    )


def _constraints(arm: Arm) -> tuple[Constraint, ...]:
    """Return the limits of positions and their derivatives, and clearances of an arm with link geometry."""
    constraints: tuple[Constraint, ...] = (
        JointPosition(tolerance=1e-3),
        JointVelocity(tolerance=2e-3, budget=6e-3),
        JointAcceleration(tolerance=5e-3, budget=6e-2),
    )
    if not arm.has_shape:
        return constraints
    clearances = (
        RobotClearance(tolerance=MAX_LINK_PENETRATION_M, budget=1e-6),
        SelfClearance(tolerance=MAX_LINK_PENETRATION_M, budget=1e-6),
    )
    return (*constraints, *clearances)  # obstacles may follow


def _replaced_limits(
    arm: Arm, joint_limits: StatedJointLimits | None = None, robot: Robot | None = None
) -> dict[str, Any]:
    """Return the limits that the problem states in place of the URDF's, and accelerations of a file."""
    missing = {
        name for joint in arm.planned for name in (*joint.missing, *joint.replaced)
    }
    stated = {} if joint_limits is None else joint_limits.of("max_acceleration")
    accelerations = None
    if stated and robot is not None:
        pairs = zip(robot.joint_names, robot.acceleration_limit.tolist(), strict=True)
        accelerations = PerJoint(
            tuple(stated.get(name, usual) for name, usual in pairs)
        )
    return {
        "acceleration": accelerations,
        "position": tuple(Range(each.lower, each.upper) for each in arm.planned)
        if "position" in missing
        else None,
        "velocity": PerJoint(tuple(each.velocity for each in arm.planned))
        if "velocity" in missing
        else None,
        "torque": PerJoint(tuple(each.effort for each in arm.planned))
        if "torque" in missing
        else None,
    }


def _with_torque_limits(arm: Arm, robot: Robot) -> tuple[Arm, float, list[str]]:
    """Replace torque limits that are missing or below the torques that gravity needs.

    Return the planning limit relative to them, and notes about the latter.

    Raises:
        RecipeError: Gravity needs so much torque that masses are in another unit.
    """
    moving, at_rest = _torques(robot)
    notes = list[str]()
    planned = list[ArmJoint]()
    scale = TORQUE_SCALE
    for joint, load in zip(
        arm.planned,
        np.quantile(at_rest, MIN_HOLDING_FRACTION, axis=0).tolist(),
        strict=True,
    ):
        unit = "N" if joint.kind == "prismatic" else "N m"
        text = f"{joint.name}: gravity needs {load:.4g} {unit}, where the URDF allows {joint.effort:g} {unit}"
        if 0 < MAX_OVERLOAD * joint.effort < load:
            raise RecipeError(
                [f"{arm.urdf}: {text}: are its masses in g? <mass> is in kg"]
            )
        if 0 < joint.effort < load:
            notes.append(
                f"{text}: check the masses of its links; the placeholder of a missing limit replaces it in [limits]"
            )
            missing = tuple(dict.fromkeys((*joint.missing, "torque")))
            planned.append(replace(joint, effort=0.0, missing=missing))
        else:
            if 0 < TORQUE_SCALE * joint.effort < load:
                scale = 1.0
                notes.append(f"{text}: 'torque_scale' is 1, so that it can be held")
            planned.append(joint)
    torques = [float(max(1, math.ceil(each))) for each in moving.max(axis=0)]
    arm = with_torques(replace(arm, planned=tuple(planned)), torques)
    return arm, scale, notes


def _with_jerk_limits(
    problem: Problem,
    robot: Robot,
    arm: Arm,
    joint_limits: StatedJointLimits | None,
) -> Problem:
    """Return the problem with jerk limits of a file, or in proportion to the accelerations.

    The latter are at most those of a URDF 1.2.
    """
    stated = {} if joint_limits is None else joint_limits.of("max_jerk")
    accelerations = problem.limits.acceleration
    limits_of = (
        robot.acceleration_limit.tolist()
        if accelerations is None
        else accelerations.values
    )
    jerks = tuple(
        stated.get(
            joint.name, min(float(f"{INITIAL_JERK_RATE * limit:.3g}"), joint.jerk)
        )
        for joint, limit in zip(arm.planned, limits_of, strict=True)
    )
    limits = replace(problem.limits, jerk=PerJoint(jerks))
    *others, acceleration = problem.constraint[:3]
    constraints = (
        *others,
        acceleration,
        JointJerk(tolerance=5e-3, budget=6e-2),
        *problem.constraint[3:],
    )
    return replace(problem, limits=limits, constraint=constraints)


def _torques(robot: Robot) -> tuple[Array, Array]:
    """Return absolute torques [N m] at random states within the limits, in motion and at rest, both of shape (K, n)."""
    import pinocchio as pin

    model = robot.model
    random = np.random.default_rng(0)
    data = model.createData()
    still = np.zeros(robot.n)
    q = random.uniform(
        robot.position_lower, robot.position_upper, (TORQUE_STATES, robot.n)
    )
    dq, ddq = (
        random.uniform(-limit, limit, (TORQUE_STATES, robot.n))
        for limit in (robot.velocity_limit, robot.acceleration_limit)
    )
    moving = [pin.rnea(model, data, *state) for state in zip(q, dq, ddq, strict=True)]
    return np.abs(moving), np.abs(
        [pin.rnea(model, data, each, still, still) for each in q]
    )


def _stages(arm: Arm, problem: Problem) -> tuple[Stage, ...]:
    """Return the stages; the boxes are still to be found."""
    anywhere = (Range(0.0, 0.0),) * 3
    torques = any(isinstance(each, JointTorque) for each in problem.constraint)
    holding = {
        end: (GravityTorque(end=end),) if torques else () for end in ("start", "goal")
    }
    return (
        DrawPositions(start=anywhere, goal=anywhere),
        StartIK(
            guess=tuple(
                _near(joint, at)
                for joint, at in zip(arm.planned, problem.robot.base, strict=True)
            )
        ),
        *holding["start"],
        GoalIK(),
        *holding["goal"],
        AtRest(end="start"),
        AtRest(end="goal", acceleration="zero"),
    )


def _near(joint: ArmJoint, at: float) -> Range:
    half = GUESS_RANGE_M if joint.kind == "prismatic" else GUESS_RANGE_RAD
    return Range(
        round(max(at - half, joint.lower), 4), round(min(at + half, joint.upper), 4)
    )
