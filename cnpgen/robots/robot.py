"""Robot: Pinocchio model, reduced to the planned joints, with its attachments and planning limits of the problem."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import RecipeError, listed, nearest
from cnpgen.robots.chain import Chain, frame_of, name_links_uniquely
from cnpgen.robots.drive import Drive
from cnpgen.robots.parameter_ranges import NO_PARAMETERS, ParameterRanges
from cnpgen.robots.robot_spec import Payload
from cnpgen.robots.shape.shape import Shape
from cnpgen.robots.urdf import number_in, urdf_tree
from cnpgen.robots.urdf_parameters import (
    LIMITED,
    NO_SOFT_LIMITS,
    UrdfJoint,
    UrdfParameters,
    check_model,
    urdf_parameters,
)
from cnpgen.schema.old_keywords import old_attribute
from cnpgen.store.joint_units import units_of_joints

if TYPE_CHECKING:
    import pinocchio as pin


@dataclass(frozen=True)
class Attached:
    """Attachments to the robot of a URDF.

    Attributes:
        frame: URDF frame to which the tip frame is fixed.
        rotation: Rotation of the tip frame in it, shape (3, 3).
        translation: Origin of the tip frame in it [m], shape (3,).
        payload: Body carried at the tip frame, or None.
        ranges: Planned joint -> position limits [rad] that replace those of the URDF.
        uses_soft_limits: Whether soft limits of the URDF narrow its position limits.
    """

    frame: str
    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))
    payload: Payload | None = None
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    uses_soft_limits: bool = True

    @property
    def tip(self) -> str:
        """Name of the tip frame: the URDF's own, or that of a new one."""
        moved = not np.array_equal(self.rotation, np.eye(3)) or self.translation.any()
        return f"{self.frame} with offset" if moved else self.frame


@dataclass(frozen=True)
class Robot:
    """Robot of a problem, used by stages, kernels and checks.

    Attributes:
        urdf: Path of the URDF file, for messages only; the file may be deleted.
        urdf_text: Text of the URDF.
        joint_names: The n planned joints; every other joint of the URDF stays at zero.
        tip: Name of the tip frame in the model.
        attached: Attachments of the problem.
        position_lower: Lower planning limits of joint positions [rad], shape (n,).
        position_upper: Upper planning limits of joint positions [rad], shape (n,).
        velocity_limit: Symmetric planning limit of joint velocities [rad/s], shape
            (n,).
        acceleration_limit: Symmetric planning limit of joint accelerations [rad/s^2],
            shape (n,).
        jerk_limit: Symmetric planning limit of joint jerks [rad/s^3], shape (n,); only
            ``joint-jerk`` constrains them.
        torque_limit: Symmetric planning limit of joint torques [N m], shape (n,).
        rated_velocity: The URDF's own velocity limit [rad/s], shape (n,).
        home: Home configuration [rad], the key `base` of files, shape (n,).
        chain: Parameters of the kinematic chain from the world to the tip.
        shape: Collision geometry; None for the paper's, a line through the joint
            origins.
        held_shape: Link geometry and the held object, for collisions between the two;
            None if these are not checked.
        parameters: Parameters that differ from sample to sample.
        table_origin: Point about which the table turns, the center of its rectangle
            [m], shape (3,).
        nominal_parameters: Parameters of a sample for which none are given, shape
            (width,).
        drive: Drives of the joints; None for torques of the rigid body alone.
        built_model: ``model`` if the same one was built before.
    """

    urdf: Path
    urdf_text: str
    joint_names: tuple[str, ...]
    tip: str
    attached: Attached
    position_lower: Array
    position_upper: Array
    velocity_limit: Array
    acceleration_limit: Array
    jerk_limit: Array
    torque_limit: Array
    rated_velocity: Array
    home: Array
    chain: Chain
    shape: Shape | None = None
    held_shape: Shape | None = None
    parameters: ParameterRanges = NO_PARAMETERS
    table_origin: Array = field(default_factory=lambda: np.zeros(3))
    nominal_parameters: Array = field(default_factory=lambda: np.empty(0))
    drive: Drive | None = None
    built_model: "pin.Model | None" = field(default=None, compare=False, repr=False)
    base = old_attribute("base", "home")

    @cached_property
    def holding_limit(self) -> Array:
        """Limit of torques that hold the arm still: what friction at rest leaves of the planning limits, shape (n,)."""
        drive = self.drive
        if drive is None or not drive.motor_rows:
            return self.torque_limit
        # The limit of the joint counts too where both sides of the gear are limited.
        left = drive.resting_limit - drive.resting_friction
        return np.minimum(self.torque_limit, left) if drive.limits_joint else left

    @property
    def n(self) -> int:
        """Number of planned joints."""
        return len(self.joint_names)

    @cached_property
    def state_bounds(self) -> tuple[Array, Array]:
        """Lower and upper limits of positions, velocities and accelerations at both ends, shape (6 n,) each."""
        moving = self.velocity_limit, self.acceleration_limit
        # Positions, velocities and accelerations at the start, then those at the goal.
        low = [self.position_lower, *(-limit for limit in moving)]
        return np.concatenate(2 * low), np.concatenate(
            2 * [self.position_upper, *moving]
        )

    @cached_property
    def prismatic(self) -> tuple[bool, ...]:
        """Whether each joint is prismatic [m] and not revolute [rad]."""
        return tuple(joint.prismatic for joint in self.chain.joints)

    def units(self, revolute: str) -> str:
        """Return the units of a joint quantity from its unit for revolute joints.

        See ``units_of_joints``.
        """
        return units_of_joints(revolute, self.prismatic)

    @cached_property
    def capsule_axes(self) -> tuple[tuple[int, int], ...]:
        """Segments that represent the moving links: index pairs into (joint origins..., tip).

        Segments connect the origins of successive joints. Coincident points are merged,
        collinear neighbors become one segment, and parts that joint 1 does not move are
        omitted.
        """
        return _capsule_axes(self.model, self.tip)

    @cached_property
    def model(self) -> "pin.Model":
        """The Pinocchio model reduced to the planned joints."""
        if self.built_model is not None:
            return self.built_model
        return reduced_model(self.urdf, self.urdf_text, self.joint_names, self.attached)

    @cached_property
    def tip_frame(self) -> int:
        """Index of the tip frame in the model."""
        return frame_of(self.model, self.tip)

    def tip_positions(self, q: Array) -> Array:
        """Compute tip positions with Pinocchio [m], shape (N, 3), from joint positions [rad], shape (N, n)."""
        import pinocchio as pin

        data = self.model.createData()
        positions = np.empty((len(q), 3))
        for row, configuration in enumerate(q):
            pin.forwardKinematics(self.model, data, configuration)
            positions[row] = pin.updateFramePlacement(
                self.model, data, self.tip_frame
            ).translation
        return positions

    @cached_property
    def reach(self) -> float:
        """Length of the polyline from the world's origin over all joints to the tip [m]."""
        placements = [
            *self.model.jointPlacements,
            self.model.frames[self.tip_frame].placement,
        ]
        return float(
            sum(np.linalg.norm(placement.translation) for placement in placements)
        )


def reduced_model(
    urdf: Path, text: str, joints: tuple[str, ...], attached: Attached
) -> "pin.Model":
    """Build the Pinocchio model of a URDF, reduced to the planned joints, with the attachments of a problem.

    The path is for messages. Joints that are not planned are locked at zero. The model
    has no rotors and no friction (``Drive``).
    """
    return read_model(urdf, text, joints, attached)[0]


def read_model(
    urdf: Path, text: str, joints: tuple[str, ...], attached: Attached
) -> tuple["pin.Model", tuple[UrdfJoint, ...]]:
    """Build the model of ``reduced_model``, and return the planned joints of the URDF with it."""
    import pinocchio as pin

    model, parameters = _complete_model(urdf, text, joints, attached)
    known = list(model.names)[1:]
    missing = [
        f"{urdf.name} has no joint {name!r}{nearest(name, known)}"
        for name in joints
        if name not in known
    ]
    if missing:
        raise RecipeError([f"robot.joints: {text}" for text in missing])
    locked = [index for index, name in enumerate(known, 1) if name not in joints]
    reduced = (
        pin.buildReducedModel(model, locked, pin.neutral(model)) if locked else model
    )
    # The first name is that of the world, which is no joint of the URDF.
    if tuple(reduced.names)[1:] != tuple(joints):
        raise RecipeError(
            [
                f"robot.joints: must be in the URDF's order {list(reduced.names)[1:]}, got {list(joints)}"
            ]
        )
    by_name = {joint.name: joint for joint in parameters.joints.values()}
    planned = tuple(by_name[name] for name in joints)
    with recipe_errors_in(urdf):
        check_model(reduced, parameters)
        if attached.uses_soft_limits:
            _narrow_to_soft_limits(reduced, planned, attached)
    # Attachments come after the comparison with the URDF, which does not contain them.
    attach(reduced, attached)
    return reduced, planned


def _complete_model(
    urdf: Path, text: str, joints: tuple[str, ...], attached: Attached
) -> tuple["pin.Model", UrdfParameters]:
    """Build the model of all joints of a URDF, and return its numbers with it."""
    import pinocchio as pin

    try:
        tree = urdf_tree(text)
        if errors := [f"robot.joints: {text}" for text in _mimic_errors(tree, joints)]:
            raise RecipeError(errors)
        limited = bounded(text, tree, attached)
        with recipe_errors_in(urdf):
            parameters = urdf_parameters(tree)
            _check_order_of_limits(parameters, joints)
        try:
            model = pin.buildModelFromXML(limited)
        except ValueError:
            with recipe_errors_in(urdf):
                # The refusal may come from swapped limits of a joint that is not
                # planned.
                names = [joint.name for joint in parameters.joints.values()]
                _check_order_of_limits(parameters, names)
            raise
        name_links_uniquely(model)
    except (ValueError, RuntimeError, IndexError) as error:
        raise RecipeError(
            [f"{urdf}: not a URDF that Pinocchio can read: {error}"]
        ) from error
    return model, parameters


def _narrow_to_soft_limits(
    model: "pin.Model", planned: Sequence[UrdfJoint], attached: Attached
) -> None:
    """Intersect the position limits of a model with soft limits, as MoveIt does; ranges of the problem replace both."""
    errors = []
    for joint in planned:
        if joint.soft == NO_SOFT_LIMITS or joint.name in attached.ranges:
            continue
        place = model.idx_qs[model.getJointId(joint.name)]
        hard = model.lowerPositionLimit[place], model.upperPositionLimit[place]
        low = max(hard[0], joint.soft[0])
        high = min(hard[1], joint.soft[1])
        if low >= high:
            soft = f"[{joint.soft[0]:g}, {joint.soft[1]:g}]"
            text = f"joint {joint.name!r}: its soft limits {soft} leave nothing of its limits"
            errors.append(
                f'{text} [{hard[0]:g}, {hard[1]:g}]; [limits] soft = "ignore" drops them'
            )
        model.lowerPositionLimit[place] = low
        model.upperPositionLimit[place] = high
    if errors:
        raise RecipeError(errors)


def _mimic_errors(tree: ElementTree.Element, planned: Sequence[str]) -> Iterator[str]:
    """Yield error messages for mimic joints, which Pinocchio treats as independent, in a wrong position."""
    for joint in tree.iter("joint"):
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        name = joint.get("name", "")
        other = mimic.get("joint", "")
        if name in planned:
            yield f"{name!r} mimics {other!r} and cannot be planned by itself; mimic joints are not supported"
        elif other in planned:
            yield f"{name!r} mimics the planned joint {other!r}, but would stay at zero; mimic joints are not supported"
        # A joint that mimics one at zero stands at its offset.
        elif offset := _mimic_offset(mimic):
            yield f"{name!r} mimics {other!r} with {offset}, but would stay at zero; mimic joints are not supported"


def _mimic_offset(mimic: ElementTree.Element) -> str:
    """Return an error message for a non-zero offset, otherwise an empty text."""
    try:
        return "an offset" if number_in(mimic, "offset", 0.0) else ""
    except ValueError as error:
        return str(error)


def _check_order_of_limits(parameters: UrdfParameters, joints: Collection[str]) -> None:
    """Raise an error that lists the joints whose lower limits are above the upper ones."""
    limits = {
        joint.name: joint.limits
        for joint in parameters.joints.values()
        if joint.name in joints
    }
    errors = [
        f"joint {name!r}: its limits lower={of['lower']:g} and upper={of['upper']:g} are swapped: exchange them"
        for name, of in limits.items()
        if of.get("lower", 0.0) > of.get("upper", 0.0)
    ]
    if errors:
        raise RecipeError(errors)


@contextmanager
def recipe_errors_in(urdf: Path) -> Iterator[None]:
    """Put the name of a file, such as the URDF, before the errors that the block raises."""
    try:
        yield
    except RecipeError as error:
        raise type(error)([f"{urdf}: {error}" for error in error.errors]) from error


def _capsule_axes(model: "pin.Model", tip: str) -> tuple[tuple[int, int], ...]:
    """Merge the chain of joint origins into segments.

    Parts that are straight at random configurations always are.
    """
    import pinocchio as pin

    data = model.createData()
    random = np.random.default_rng(0)
    poses = []
    for _ in range(4):
        q = random.uniform(model.lowerPositionLimit, model.upperPositionLimit)
        pin.framesForwardKinematics(model, data, q)
        origins = [data.oMi[i].translation for i in range(1, model.njoints)]
        poses.append(np.array([*origins, data.oMf[frame_of(model, tip)].translation]))
    points = np.array(poses)  # (configurations, points, 3)

    # A point that no joint moves has equal positions in all configurations.
    def still(a: int) -> bool:
        return bool(np.ptp(points[:, a], axis=0).max() < 1e-9)

    def straight(a: int, b: int, c: int) -> bool:
        first = points[:, b] - points[:, a]
        second = points[:, c] - points[:, b]
        # A link that folds back is a separate segment.
        onwards = bool((first * second).sum(axis=1).min() > 0)
        # Both parts lie on one line where their cross product vanishes.
        return onwards and bool(np.abs(np.cross(first, second)).max() < 1e-9)

    kept = [0]
    for point in range(1, points.shape[1]):
        # Points that always coincide are one end of a segment.
        if np.abs(points[:, point] - points[:, kept[-1]]).max() < 1e-9:
            continue
        if len(kept) > 1 and straight(kept[-2], kept[-1], point):
            kept[-1] = point
        else:
            kept.append(point)
    # A segment between two points that stand still belongs to the base.
    return tuple((a, b) for a, b in pairwise(kept) if not (still(a) and still(b)))


def attach(model: "pin.Model", attached: Attached) -> None:
    """Add the attachments of a problem to a reduced model."""
    import pinocchio as pin

    if not model.existFrame(attached.frame):
        known = [frame.name for frame in model.frames]
        text = f"{model.name} has no frame {attached.frame!r}{nearest(attached.frame, known)}"
        raise RecipeError([f"robot.tip: {text}; its frames: {listed(known)}"])
    index = frame_of(model, attached.frame)
    frame = model.frames[index]
    # In the frame of the joint: pose of the frame, then the offset of the tip in it.
    placement = frame.placement * pin.SE3(attached.rotation, attached.translation)
    if attached.tip != attached.frame:
        model.addFrame(
            pin.Frame(
                attached.tip,
                frame.parentJoint,
                index,
                placement,
                pin.FrameType.OP_FRAME,
            ),
            False,
        )
    if body := attached.payload:
        inertia = pin.Inertia(body.mass, np.array(body.centre), body.inertia_matrix)
        model.appendBodyToJoint(frame.parentJoint, inertia, placement)
    for name, (low, high) in attached.ranges.items():
        place = model.idx_qs[model.getJointId(name)]
        model.lowerPositionLimit[place] = low
        model.upperPositionLimit[place] = high


def bounded(urdf: str, tree: ElementTree.Element, attached: Attached) -> str:
    """Return a URDF with complete limits, in which continuous joints with a given range are revolute.

    Absent limits are zero, as in a URDF that states none. The tree is modified in
    place.
    """
    before = ElementTree.tostring(tree, encoding="unicode")
    for joint in tree.iter("joint"):
        turns = joint.get("type") == "continuous"
        turns = turns and joint.get("name") in attached.ranges
        if turns:
            joint.set("type", "revolute")
        limit = joint.find("limit")
        if limit is None and joint.get("type") in LIMITED:
            limit = ElementTree.SubElement(joint, "limit")
        if limit is not None:
            limit.attrib.update({"velocity": "0", "effort": "0"} | limit.attrib)
        if limit is not None and turns:
            # These limits only make the element complete; ``attach`` sets the range.
            limit.attrib.update(lower="0", upper="0")
    text = ElementTree.tostring(tree, encoding="unicode")
    return urdf if text == before else text
