"""Problem of a request: a robot's problem with the scaling factors, attached objects and constraints of its scenes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from cnpgen.errors import RecipeError, listed
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.constraints.link_clearance import SelfClearance
from cnpgen.problems.limit_sources import NOT_STATED, WORDS, limit_sources
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, as_problem, record_problem
from cnpgen.problems.scenes.scene_problem import SceneError, SceneProblem
from cnpgen.problems.scenes.scene_request import NO_REQUEST, AttachedObject
from cnpgen.robots.attached_links import (
    attached_link_name,
    root_link,
    with_attached_link,
    with_padded_link,
)
from cnpgen.robots.robot import Robot
from cnpgen.robots.robot_spec import LimitSources
from cnpgen.robots.urdf import urdf_tree
from cnpgen.robots.urdf_changes import with_ignored_pairs
from cnpgen.schema.arguments import check_range, number
from cnpgen.schema.keys import PerJoint

MAX_HELD_ERROR = 1e-3  # rad or m
MIN_PAYLOAD_KG = 1e-6
MAX_PAYLOAD_KG = 1e4

_LOG = logging.getLogger(__name__)


def requested_problem(
    problem: Problem,
    robot: Robot,
    scenes: Sequence[SceneProblem],
    *,
    payload: float | None = None,
) -> tuple[Problem, Robot, list[SceneProblem]]:
    """Return the problem that placed scenes ask for, its robot, and the scenes without these changes.

    Scaling factors multiply the limits of velocities and accelerations. Attached
    objects become links with their geometry and mass. Constraints are added to those of
    the problem.

    Args:
        problem: The robot's problem.
        robot: Its robot.
        scenes: Placed scenes.
        payload: Mass of attached objects of unknown weight [kg].

    Raises:
        SceneError: The scenes need different problems, or an attached object has no
            mass or no place in the problem.
        UsageError: ``payload`` is out of range.
    """
    first = scenes[0]
    if payload is not None:
        _check_payload(payload, first)
    _report_held_joints(problem, scenes)
    # Plans of one call share limits, links and constraints, hence one problem.
    for scene in scenes:
        if scene.request.changes != first.request.changes:
            raise SceneError(
                f"{scene.place} has other scaling factors, attached objects, allowed collisions, sizes of links or path"
                f" constraints than {first.place}, and the plans of one call share a problem: choose the"
                " scenes of one problem by {first} and {n}",
                remedies={"first": None, "n": None},
            )
    # The problem keeps its identity, and with it its kernels.
    if not first.request.changes_problem:
        return problem, robot, list(scenes)
    constraints = *problem.constraint, *first.request.constraints
    changed = _with_scales(problem, robot, first).replaced(constraint=constraints)
    if first.request.attached or first.request.link_sizes:
        attached = first.request.attached
        objects = [_with_mass(item, problem, first, payload) for item in attached]
        changed = _with_objects(changed, objects, first)
    actual = load_robot(changed)
    _check_contacts(actual, first)
    return changed, actual, [_without_changes(scene) for scene in scenes]


def _check_payload(payload: float, scene: SceneProblem) -> None:
    """Raise UsageError if a payload is out of range, and warn if no attached object needs it."""
    mass = number("payload", payload)
    check_range("payload", mass, MIN_PAYLOAD_KG, MAX_PAYLOAD_KG, "kg")
    if all(item.mass or not item.link for item in scene.request.attached):
        _LOG.warning(
            "the payload of %g kg is not used: no scene attaches an object of weight 0",
            payload,
        )


def _report_held_joints(problem: Problem, scenes: Sequence[SceneProblem]) -> None:
    """Warn of joints that the problem holds at other positions than the start states of scenes, and of unknown ones."""
    spec = problem.robot
    tree = urdf_tree(problem.urdf_text)
    moving = {
        each.get("name", "")
        for each in tree.iter("joint")
        if each.get("type") != "fixed"
    }
    # Joints that are neither planned nor locked stay at zero.
    held = dict.fromkeys(moving - set(spec.joints), 0.0)
    held |= zip(spec.locked_joints, spec.locked_positions, strict=True)
    known = {each.get("name", "") for each in tree.iter("joint")}
    texts = dict[str, None]()
    for scene in scenes:
        for name, position in zip(scene.joint_names, scene.start_q, strict=False):
            if name not in known:
                texts[f"{name} (the robot lacks it)"] = None
            elif abs(position - held.get(name, position)) > MAX_HELD_ERROR:
                texts[f"{name} ({position:g} in the file, held at {held[name]:g})"] = (
                    None
                )
    if texts:
        _LOG.warning(
            "joints of the scenes that the problem %r does not plan: %s",
            problem.name,
            listed(list(texts), 10),
        )


def _without_changes(scene: SceneProblem) -> SceneProblem:
    request = replace(
        scene.request,
        velocity_scale=NO_REQUEST.velocity_scale,
        acceleration_scale=NO_REQUEST.acceleration_scale,
        attached=(),
        link_sizes=(),
        constraints=(),
        constraint_frames=(),
    )
    return replace(scene, request=request)


def _with_scales(problem: Problem, robot: Robot, scene: SceneProblem) -> Problem:
    """Return the problem with scaled limits of velocities and accelerations; those of jerks and torques stay."""
    request = scene.request
    if request.velocity_scale == request.acceleration_scale == 1.0:
        return problem
    # Default limits of accelerations and jerks follow from those of velocities: stated
    # as numbers, they do not scale with these. Their sources stay.
    sources = limit_sources(problem, robot)
    texts = {
        name: f"{each.basis}: {each.source or WORDS[each.basis]}"
        for name in ("acceleration", "jerk")
        if (each := sources[name]).basis != NOT_STATED
    }
    if "acceleration" in texts and request.acceleration_scale != 1.0:
        texts["acceleration"] += f", times {request.acceleration_scale:g}"
    limits = replace(
        problem.limits,
        sources=replace(problem.limits.sources or LimitSources(), **texts),
        velocity_scale=problem.limits.velocity_scale * request.velocity_scale,
        acceleration=PerJoint(
            tuple((request.acceleration_scale * robot.acceleration_limit).tolist())
        ),
        jerk=PerJoint(tuple(robot.jerk_limit.tolist())),
    )
    return problem.replaced(limits=limits)


def _with_mass(
    item: AttachedObject, problem: Problem, scene: SceneProblem, payload: float | None
) -> AttachedObject:
    """Return an attached object with a mass; an unknown one is refused for problems with torques."""
    # An object of the world is no load.
    if not item.link:
        return item
    if item.mass:
        _LOG.info(
            "%s: the weight of the attached object %r, %g, is taken as its mass in kg",
            scene.source or "the scene",
            item.name,
            item.mass,
        )
        return item
    if payload is not None:
        return replace(item, mass=payload)
    if problem.first(JointTorque) is not None:
        raise SceneError(
            f"{scene.place}: the attached object {item.name!r} has the weight 0, which"
            " means that it is unknown, and the problem limits torques: give its"
            " weight in kg, or {payload} in kg",
            remedies={"payload": None},
        )
    return item


def _with_objects(
    problem: Problem, objects: Sequence[AttachedObject], scene: SceneProblem
) -> Problem:
    """Return the problem with attached objects as links."""
    if problem.robot.geometry != "urdf":
        raise SceneError(
            f"{scene.place} has attached objects or sizes of links, and the problem {problem.name!r} has"
            ' no link geometry: expected [robot] geometry = "urdf"'
        )
    # Objects of the world become links here, so that self-clearance applies to them.
    if not all(item.link for item in objects):
        _check_clearances(problem, scene)
    record = record_problem(problem)
    names = {item.name for item in objects}
    text = record.urdf
    root = root_link(record.urdf)
    try:
        for item in objects:
            text = with_attached_link(
                text,
                item.name,
                item.link or root,
                shapes=item.shapes,
                mass=item.mass,
                # Contacts with other attached objects are added once all objects are
                # links.
                touch_links=[link for link in item.touch_links if link not in names],
            )
        touching = [
            (attached_link_name(item.name), attached_link_name(other))
            for item in objects
            for other in item.touch_links
            if other in names
        ]
        text = with_ignored_pairs(text, touching) if touching else text
        text = _with_sizes(text, objects, scene)
    except (RecipeError, ValueError) as error:
        raise SceneError(f"{scene.place}: {error}") from error
    return as_problem(ProblemRecord(record.recipe, text))


def _with_sizes(
    urdf: str, objects: Sequence[AttachedObject], scene: SceneProblem
) -> str:
    """Return a URDF with larger copies of links, and of what they carry, that obstacles must not enter."""
    fixed = [item for item in objects if not item.link]
    for link, scale, padding in scene.request.link_sizes:
        # An attached object grows with its link.
        bodies = {link: link}
        bodies |= {
            item.name: attached_link_name(item.name)
            for item in objects
            if item.link == link
        }
        for name, body in bodies.items():
            obstacles = [
                attached_link_name(item.name)
                for item in fixed
                # A body may touch these objects at any size.
                if name not in item.touch_links
            ]
            urdf = with_padded_link(urdf, body, scale, padding, obstacles=obstacles)
    return urdf


def _check_clearances(problem: Problem, scene: SceneProblem) -> None:
    """Raise SceneError if links keep another distance from an object of the world that is a link than from others."""
    own = problem.first(SelfClearance)
    others = problem.first(RobotClearance)
    if own is None or others is None or own.distance != others.distance:
        raise SceneError(
            f"{scene.place} allows collisions of links with objects of the world, and the problem"
            f" {problem.name!r} needs 'self-clearance' with the distance of 'robot-clearance' for it"
        )


def _check_contacts(robot: Robot, scene: SceneProblem) -> None:
    """Raise SceneError if an attached object always overlaps a link, which no check of a motion could notice."""
    names = {
        attached_link_name(item.name): item.name for item in scene.request.attached
    }
    for pair in () if robot.shape is None else robot.shape.pairs:
        body = next((each for each in (pair.first, pair.second) if each in names), None)
        # Pairs that overlap in every state are left out of all checks.
        if body is None or pair.left_out != "always":
            continue
        other = pair.second if body == pair.first else pair.first
        raise SceneError(
            f"{scene.place}: the object {names[body]!r} overlaps the link"
            f" {other!r} in every state: name the link in its touch_links, or allow their collision",
            concerns="scenes",
        )


def refuse_changes(scenes: Sequence[SceneProblem], why: str) -> None:
    """Raise SceneError for demands of requests that change the problem where it cannot change."""
    for scene in scenes:
        if scene.request.changes_problem:
            raise SceneError(
                f"{scene.place} has scaling factors, attached objects, allowed collisions, sizes of links or path"
                f" constraints: {why}"
            )
