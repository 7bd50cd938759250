"""Scene request: what a motion plan request asks beside obstacles, start and goal states."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.problems.constraints.constraint import LinkConstraint
from cnpgen.robots.obstacle import Obstacle
from cnpgen.schema.argument_types import check_fields

BASE_FRAMES = ("", "world")  # names of the frame of the robot's base
MIN_SCALE = 1e-3  # of the limits, as in a problem file


@dataclass(frozen=True, eq=False)
class AttachedObject:
    """Object that a link of the robot carries, or a fixed one that some links may touch.

    Attributes:
        name: Name of the object.
        link: Link that carries it; empty for the base of an object of the world.
        shapes: Its shapes.
        frames: Frame of the pose of each shape, a link of the robot at the start state;
            empty for the robot's base.
        touch_links: Links and attached objects that may touch it, beside ``link``.
        mass: Its mass [kg], 0 if it is unknown.
    """

    name: str
    link: str
    shapes: tuple[Obstacle, ...]
    frames: tuple[str, ...]
    touch_links: tuple[str, ...] = ()
    mass: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def digest(self) -> tuple[object, ...]:
        """Everything that makes two attached objects equal."""
        # The order of links in a file does not matter.
        links = tuple(sorted(set(self.touch_links)))
        return self.name, self.link, self.shapes, self.frames, links, self.mass


@dataclass(frozen=True, eq=False)
class SceneRequest:
    """Demands of a motion plan request beside obstacles, start and goal states.

    Attributes:
        robot_name: Name of the robot; empty if it is not given.
        start_dq: Joint velocities at the start [rad/s], shape (n,), or None for rest.
        velocity_scale: Fraction of the velocity limits that the motion may use.
        acceleration_scale: Fraction of the acceleration limits.
        goal_below: Tolerances of the goal states below them [rad], shape (G, n), or
            None.
        goal_above: Tolerances above them.
        goal_frame: Frame of the goal pose.
        other_goal_frames: Frames of the other goal poses; empty if all are in that of
            the robot's base.
        obstacle_frames: Frame of the pose of each obstacle; empty for obstacles in the
            frame of the robot's base. Other frames are links of the robot at the start
            state.
        obstacle_touch_links: Links and attached objects that may touch each obstacle;
            empty if none may touch any.
        fixed_frames: Frames that the file places, and whether each is the base; only
            the root link of the robot may be one of them.
        attached: Objects that the robot carries.
        link_sizes: Links that keep clear of obstacles as if they were larger: the
            factor of their sizes, at least 1, and what these grow by to all sides [m].
            Attached objects grow with their link.
        constraints: Constraints on every state, in addition to those of the problem.
        constraint_frames: Frame of each of them, which must not move; empty for those
            in the frame of the robot's base.
        accepted: Elements of the file whose loss the caller accepted.
    """

    robot_name: str = ""
    start_dq: Array | None = None
    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0
    goal_below: Array | None = None
    goal_above: Array | None = None
    goal_frame: str = ""
    other_goal_frames: tuple[str, ...] = ()
    obstacle_frames: tuple[str, ...] = ()
    obstacle_touch_links: tuple[tuple[str, ...], ...] = ()
    fixed_frames: tuple[tuple[str, bool], ...] = ()
    attached: tuple[AttachedObject, ...] = ()
    link_sizes: tuple[tuple[str, float, float], ...] = ()
    constraints: tuple[LinkConstraint, ...] = ()
    constraint_frames: tuple[str, ...] = ()
    accepted: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def places(self) -> bool:
        """Whether poses depend on frames of links, or links are named."""
        frames = self.goal_frame, *self.other_goal_frames, *self.obstacle_frames
        named = self.attached, self.link_sizes, self.constraints
        touching = any(self.obstacle_touch_links)
        return touching or any((*frames, self.fixed_frames, *named))

    @property
    def changes(self) -> tuple[object, ...]:
        """Changes of the robot's problem: scaling factors, attached objects, sizes of links, and constraints."""
        objects = tuple(each.digest for each in self.attached)
        scales = self.velocity_scale, self.acceleration_scale
        # Frames and goals do not change the problem, only its boundary problems.
        return *scales, objects, frozenset(self.link_sizes), self.constraints

    @property
    def changes_problem(self) -> bool:
        """Whether the request needs another problem than that of the robot."""
        return self.changes != NO_REQUEST.changes

    def frame_of(self, index: int) -> str:
        """Return the frame of an obstacle."""
        return self.obstacle_frames[index] if self.obstacle_frames else ""

    def start_velocity(self, n: int) -> Array:
        """Return the joint velocities at the start [rad/s], shape (n,)."""
        return np.zeros(n) if self.start_dq is None else np.asarray(self.start_dq)

    def errors(self, n: int, goals: int, obstacles: int) -> Iterator[str]:
        """Yield errors of the request of a scene with n joints, and numbers of goal states and obstacles."""
        for name, shape in (
            ("start_dq", (n,)),
            ("goal_below", (goals, n)),
            ("goal_above", (goals, n)),
        ):
            values = getattr(self, name)
            if values is None:
                continue
            if np.shape(values) != shape:
                yield f"{name} must have shape {shape}, got {np.shape(values)}"
            elif not np.isfinite(values).all():
                yield f"{name} must be finite, got {np.asarray(values).tolist()}"
            elif name != "start_dq" and (np.asarray(values) < 0).any():
                yield f"{name} must not be negative, got {np.asarray(values).tolist()}"
        for name in ("velocity_scale", "acceleration_scale"):
            scale = getattr(self, name)
            if not MIN_SCALE <= scale <= 1:
                yield f"{name} must be between {MIN_SCALE:g} and 1, got {scale:g}"
        for link, scale, padding in self.link_sizes:
            if not (1 <= scale < np.inf and 0 <= padding < np.inf):
                yield f"link_sizes of {link!r} must be at least 1 and 0, got {scale:g} and {padding:g}"
        for name in ("obstacle_frames", "obstacle_touch_links"):
            if (count := len(getattr(self, name))) not in {0, obstacles}:
                yield f"{name} must have {obstacles} entries, got {count}"


NO_REQUEST = SceneRequest()
