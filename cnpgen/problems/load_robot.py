"""Loading of the robot of a problem, with scaled limits and checks of consistency and of units."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import RecipeError
from cnpgen.machine.threads import one_thread
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem, kept_folder
from cnpgen.robots.chain import chain_from_model
from cnpgen.robots.drive import Drive, DriveSpec, SpeedLine
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Attached, Robot, read_model, recipe_errors_in
from cnpgen.robots.robot_spec import LimitSpec
from cnpgen.robots.scene import PARKED_POSITION_M
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.inline import unit_of_mesh
from cnpgen.robots.shape.mesh_files import find_named_file
from cnpgen.robots.shape.shape import Shape, load_held_shape, load_shape
from cnpgen.robots.urdf import read_urdf, urdf_tree
from cnpgen.robots.urdf_parameters import UrdfJoint
from cnpgen.schema.keys import PerJoint
from cnpgen.schema.units import PLAUSIBLE_MAX, suggested_unit
from cnpgen.store.joint_units import unit_of

JERK_RATE = 5.0  # 1/s: jerk limit / acceleration limit in the authors' code
MIN_REACH_M, MAX_REACH_M = 0.01, 100.0  # of an arm, along its joints
# Size of a link / reach; pedestals and mobile bases may be larger than arms.
MAX_LINK_RATIO = 20.0
MIN_LINK_RATIO = 0.02  # size of the largest moving link / reach
MIN_MESH_M = 1e-3  # size of a link with a mesh
MIN_MASS_KG = 0.01  # of bodies whose inertia is checked; lighter ones have placeholders
MIN_ARM_KG = 0.1  # that a payload is compared with
# Distance of a center of mass from its joint, and radius of gyration / reach.
MAX_CENTER_RATIO = 3.0
MAX_PAYLOAD_RATIO = 10.0  # mass of a payload / mass of the arm
MAX_OBSTACLE_RATIO = 10.0  # distance of an obstacle / reach


def load_robot(problem: Problem) -> Robot:
    """Load the robot of a problem.

    Raises:
        RecipeError: The URDF cannot be read, or is inconsistent with the joints, tip,
            base configuration or limits.
        PluginError: The URDF belongs to a package that is not installed.
    """
    spec, limits = problem.robot, problem.limits
    with recipe_errors_in(problem.path):
        path, urdf, attached = problem.urdf_path, problem.urdf_text, _attached(problem)
        model, joints = read_model(path, urdf, spec.joints, attached)
        chain = chain_from_model(model, attached.tip)
        rated = _given(limits.velocity, "velocity", model.velocityLimit)
        torque = _given(limits.torque, "torque", model.effortLimit)
        velocity = limits.velocity_scale * rated
        acceleration, jerk = _acceleration_and_jerk(limits, velocity, joints)
        drive = _drive(problem, joints, limits.torque_scale, torque)
    lower = np.array(model.lowerPositionLimit)
    upper = np.array(model.upperPositionLimit)
    # Ranges are scaled about their center c: c +- scale * (upper - lower) / 2.
    center, half = (upper + lower) / 2, limits.position_scale * (upper - lower) / 2
    robot = Robot(
        urdf=path,
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
        home=np.array(spec.base),
        chain=chain,
        parameters=problem.parameters,
        table_origin=problem.table_origin,
        nominal_parameters=problem.nominal_parameters,
        drive=drive,
    )
    if errors := list(_errors(problem, robot)):
        raise RecipeError(errors)
    return _with_shapes(problem, robot)


def _with_shapes(problem: Problem, robot: Robot) -> Robot:
    """Return a robot with the geometry of its links and of the held object, whose sizes are checked."""
    with recipe_errors_in(problem.path):
        model = robot.model
        shape = None
        if problem.robot.geometry == "urdf":
            # Sums of matrix products, and so the last digits of capsules, would depend
            # on the number of threads.
            with one_thread():
                shape = load_shape(robot.urdf_text, model, kept_folder())
        held = _held_shape(problem, robot)
    # The model is expensive to build again.
    robot = replace(robot, shape=shape, held_shape=held, built_model=model)
    # Stored problems were accepted before, possibly by earlier rules.
    if not problem.is_stored:
        _check_sizes(problem, robot)
    return robot


def _attached(problem: Problem) -> Attached:
    """Return the attachments of the problem."""
    spec = problem.robot
    ranges = problem.limits.position or ()
    if ranges and len(ranges) != len(spec.joints):
        raise RecipeError(
            [
                f"limits.position: needs {len(spec.joints)} ranges, one per planned joint, got {len(ranges)}"
            ]
        )
    return Attached(
        spec.tip,
        rotation=turned(*spec.tip_rotation),
        translation=np.array(spec.tip_offset),
        payload=problem.payload,
        ranges={
            name: (each.low, each.high)
            for name, each in zip(spec.joints, ranges, strict=False)
        },
        uses_soft_limits=problem.limits.soft == "use",
    )


def _acceleration_and_jerk(
    limits: LimitSpec, velocity: Array, joints: Sequence[UrdfJoint]
) -> tuple[Array, Array]:
    """Return the limits of accelerations and jerks, shape (n,) each, for those of velocities."""
    # Default: a_max = min(rate * v_max, cap, limit of the URDF 1.2); the problem may
    # replace it.
    most = np.minimum(limits.acceleration_rate * velocity, limits.acceleration_cap)
    most = np.minimum(most, _rates(joints, "acceleration"))
    acceleration = _given(limits.acceleration, "acceleration", most)
    # Default: j_max = min(JERK_RATE * a_max, limit of the URDF 1.2).
    most = np.minimum(JERK_RATE * acceleration, _rates(joints, "jerk"))
    return acceleration, _given(limits.jerk, "jerk", most)


def _rates(joints: Sequence[UrdfJoint], name: str) -> Array:
    """Return the limits of accelerations or jerks of a URDF 1.2, infinite where it has none, shape (n,)."""
    return np.array([joint.rates.get(name, np.inf) for joint in joints])


def _drive(
    problem: Problem, joints: Sequence[UrdfJoint], scale: float, torque: Array
) -> Drive | None:
    """Return the drives of a problem, None without rotors, friction and limits of motors.

    ``torque`` has the limits at the joint before they are scaled [N m], shape (n,).
    """
    spec = problem.drive
    none = np.zeros(len(joints))
    uses = spec.urdf_dynamics == "use"
    # Friction of the URDF counts only with urdf_dynamics = "use"; otherwise the factor
    # is zero.
    damping, friction = (
        np.array([getattr(joint, name) * uses for joint in joints])
        for name in ("damping", "friction")
    )
    # Inertia of a rotor seen at the joint: J = ratio^2 * J_rotor, unless the armature
    # itself is stated.
    rotor = _given(spec.rotor_inertia, "rotor_inertia", none, "drive")
    ratio = _given(spec.gear_ratio, "gear_ratio", none, "drive")
    terms = {
        "armature": _given(spec.armature, "armature", rotor * ratio**2, "drive"),
        "viscous": _given(spec.viscous, "viscous", damping, "drive"),
        "coulomb": _given(spec.coulomb, "coulomb", friction, "drive"),
    }
    limit = scale * _given(spec.torque, "torque", torque, "drive")
    if not (
        any(term.any() for term in terms.values())
        or any((spec.torque, spec.power, spec.line))
    ):
        return None
    return Drive(
        **terms,
        friction_help=spec.friction_help,
        reversal_speed=spec.reversal_speed,
        limits=spec.limits,
        torque_limit=limit,
        power_limit=scale * _given(spec.power, "power", none, "drive")
        if spec.power
        else None,
        lines=tuple(_lines(spec, none, scale)),
    )


def _lines(spec: DriveSpec, none: Array, scale: float) -> Iterator[SpeedLine]:
    """Yield the torque-speed lines of drives; the scale reduces the torques at all velocities."""
    for number, line in enumerate(spec.line, 1):
        table = f"drive.line {number}"
        torque = scale * _given(line.torque, "torque", none, table)
        # The line from (0, torque) to (speed, 0): its slope is torque / speed [N m
        # s/rad].
        speed = _given(line.speed, "speed", none, table)
        yield SpeedLine(torque, torque / speed, line.quadrants == "motoring")


def _given(
    values: PerJoint | None, what: str, otherwise: Array, table: str = "limits"
) -> Array:
    """Return the numbers of a table of the problem for all joints, or the defaults."""
    if values is None:
        return np.array(otherwise)
    if len(values.values) not in (1, len(otherwise)):
        n = len(otherwise)
        found = len(values.values)
        raise RecipeError(
            [
                f"{table}.{what}: needs one number, or {n}, one per planned joint, got {found}"
            ]
        )
    return np.broadcast_to(np.array(values.values), len(otherwise)).copy()


def _held_shape(problem: Problem, robot: Robot) -> Shape | None:
    """Load the geometry for collisions of the held object with the robot, if a constraint needs it."""
    if problem.object is None or problem.first(ObjectClearance) is None:
        return None
    with one_thread():  # as of the robot's own shape
        return load_held_shape(
            robot.urdf_text, robot.model, problem.object, robot.tip_frame, kept_folder()
        )


def _errors(problem: Problem, robot: Robot) -> Iterator[str]:
    """Yield error messages for limits that no motion satisfies."""
    limits = {"velocity": robot.velocity_limit, "torque": robot.torque_limit}
    for what, values in limits.items():
        for name, value in zip(robot.joint_names, values, strict=True):
            if not (np.isfinite(value) and value > 0):
                yield f"{robot.urdf}: {name}: the {what} limit must be positive and finite, got {value:g}"
    yield from _drive_errors(problem, robot)
    if any(isinstance(constraint, JointTorque) for constraint in problem.constraint):
        yield from _weightless(robot)
    yield from (errors := list(_position_errors(problem, robot)))
    # A home configuration can only be compared with limits that are ordered and in rad
    # or m.
    if not errors:
        yield from _home_errors(problem, robot)


def _drive_errors(problem: Problem, robot: Robot) -> Iterator[str]:
    """Yield error messages for drives whose friction alone exceeds their limits, so that no motion can start."""
    drive = robot.drive
    if drive is None or not drive.motor_rows:
        return
    for index, name in enumerate(robot.joint_names):
        friction = drive.resting_friction[index]
        limit = drive.resting_limit[index]
        # At rest the motor must first exceed the dry friction.
        if friction >= limit:
            unit = unit_of(robot.units("N m"), index)
            text = f"friction of {friction:.4g} {unit} at rest leaves nothing of the motor's limit of {limit:.4g} {unit}"
            yield f"{problem.path}: drive: {name}: {text}"


def _position_errors(problem: Problem, robot: Robot) -> Iterator[str]:
    """Yield error messages for position limits that are equal or in another unit."""
    limits = zip(
        robot.joint_names,
        robot.model.lowerPositionLimit,
        robot.model.upperPositionLimit,
        strict=True,
    )
    for (name, low, high), sliding in zip(limits, robot.prismatic, strict=True):
        text = f"{robot.urdf}: {name}: "
        largest = max(low, high, key=abs)
        unit = "m" if sliding else "rad"
        most = PLAUSIBLE_MAX[unit]
        if low >= high:
            yield f"{text}the lower position limit must be below the upper one, got {low:g} and {high:g}"
        elif abs(largest) > most and not problem.is_stored:
            remedy = "give ranges of joints without limits in [limits] ('position')"
            expected = f"limits of positions are at most {most:.3g} {unit}, got {largest:g} {unit}"
            yield f"{text}{expected}{suggested_unit(largest, unit, -most, most)}; {remedy}"


def _weightless(robot: Robot) -> Iterator[str]:
    """Yield error messages for joints that move no mass, which have no torques to limit."""
    # Joint i moves the masses of all joints from i to the tip: sum over k >= i of m_k.
    mass = np.cumsum([joint.mass for joint in robot.chain.joints][::-1])[::-1]
    for name in np.array(robot.joint_names)[mass <= 0].tolist():
        text = "no link that it moves has a mass, so that its torque means nothing: give the links an <inertial>"
        yield f"{robot.urdf}: {name}: {text}, or leave out the constraint 'joint-torque'"


def _home_errors(problem: Problem, robot: Robot) -> Iterator[str]:
    """Yield error messages for a base configuration that is inconsistent with the joints or limits."""
    low = robot.position_lower
    high = robot.position_upper
    base = robot.home
    if base.shape != low.shape:
        yield f"{problem.path}: robot.base: needs {robot.n} values, one per planned joint, got {base.size}"
        return
    # One message, for the joint with the largest violation.
    worst = int(np.argmax(np.maximum(low - base, base - high)))
    if not low[worst] <= base[worst] <= high[worst]:
        unit = unit_of(robot.units("rad"), worst)
        # Degrees are suggested only for values beyond a full turn, which radians hardly
        # reach.
        hint = (
            suggested_unit(base[worst], unit, low[worst], high[worst])
            if abs(base[worst]) > 2 * np.pi
            else ""
        )
        yield (
            f"{problem.path}: robot.base: {robot.joint_names[worst]} = {base[worst]:g} {unit} is outside its planning"
            f" limits [{low[worst]:g}, {high[worst]:g}]{hint}"
        )
    for table in (each for each in problem.constraint if isinstance(each, Table)):
        height = float(robot.tip_positions(base[None])[0, 2])
        # A start may be below the table by its band, any state by the tolerance.
        if height < table.z - max(table.band, table.tolerance):
            text = f"the tip is {table.z - height:.3g} m below the table, at z = {height:.4g} m, expected {table.z:g} m"
            yield f"{problem.path}: robot.base: {text} or more: is the tip the frame that you mean, and 'z' its height?"


def _check_sizes(problem: Problem, robot: Robot) -> None:
    """Raise an error that lists all lengths and masses that are probably in another unit."""
    errors = [f"{robot.urdf}: {error}" for error in _robot_errors(robot, problem)]
    if not errors:
        errors = [
            f"{problem.path}: {error}" for error in _problem_errors(robot, problem)
        ]
    if errors:
        raise RecipeError(errors)


def _robot_errors(robot: Robot, problem: Problem) -> Iterator[str]:
    """Yield error messages for lengths of the URDF."""
    reach = robot.reach
    if not MIN_REACH_M <= reach <= MAX_REACH_M:
        remedy = "lengths of a URDF are in m, not in mm: convert the <origin xyz> of its joints"
        yield f"the arm is {reach:.3g} m long, expected {MIN_REACH_M:g} to {MAX_REACH_M:g} m; {remedy}"
        return
    # The last joint carries the payload, too, which is compared with the arm
    # separately.
    joints = robot.chain.joints if problem.payload is None else robot.chain.joints[:-1]
    for name, joint in zip(robot.joint_names, joints, strict=False):
        # Nearly massless links have placeholder inertias, which do not show the unit.
        if joint.mass < MIN_MASS_KG:
            continue
        # trace(I) = 2 * integral of r^2 dm, so that the radius of gyration is
        # sqrt(trace(I) / (2 m)).
        center = np.linalg.norm(joint.com)
        gyration = np.sqrt(max(np.trace(joint.inertia), 0.0) / (2 * joint.mass))
        if max(center, gyration) > MAX_CENTER_RATIO * reach:
            text = f"the center of mass is {center:.3g} m away, the radius of gyration {gyration:.3g} m"
            yield f"{name}: {text}, the arm {reach:.3g} m long; an <inertial> is in kg, m and kg m^2, not in mm or g"
    yield from _link_errors(problem, robot, reach)


def _link_errors(problem: Problem, robot: Robot, reach: float) -> Iterator[str]:
    """Yield error messages for sizes of links."""
    if robot.shape is None:
        return
    sizes: dict[str, float] = {}
    for part in robot.shape.convex_parts:
        # Longest edge of the bounding box of the vertices, which are inflated by the
        # radius.
        size = float(np.ptp(part.vertices, axis=0).max()) + 2 * part.radius
        sizes[part.link] = max(size, sizes.get(part.link, 0.0))
    large = {
        link: size for link, size in sizes.items() if size > MAX_LINK_RATIO * reach
    }
    small = {link: size for link, size in sizes.items() if size < MIN_MESH_M}
    for link, size in large.items():
        remedy = _scale_remedy(problem, link)
        yield f"link {link!r}: its collision geometry is {size:.3g} m large, the arm {reach:.3g} m; {remedy}"
    remedy = "remove the scale of its <mesh> elements, or correct it"
    # Spheres and boxes may be placeholders.
    for link in _mesh_links(robot.urdf_text) & small.keys() if small else ():
        text = f"its collision geometry is {small[link]:.3g} m large, expected {MIN_MESH_M:g} m or more"
        yield f"link {link!r}: {text}; {remedy}"
    largest = max(size for link, size in sizes.items() if robot.shape.joints[link])
    if largest < MIN_LINK_RATIO * reach:
        yield f"no moving link is larger than {largest:.3g} m, where the arm is {reach:.3g} m long; {remedy}"


def _scale_remedy(problem: Problem, link: str) -> str:
    """Return the remedy for a mesh that is too large: the unit that its file states, or millimetres."""
    tree = urdf_tree(read_urdf(problem.urdf_path))
    meshes = [
        mesh
        for element in tree.findall("link")
        if element.get("name") == link
        for mesh in element.iterfind("*/geometry/mesh")
    ]
    for mesh in meshes:
        try:
            name = mesh.get("filename", "")
            unit = unit_of_mesh(
                find_named_file(name, problem.urdf_path, problem.packages)
            )
        except (RecipeError, OSError):
            continue
        if unit != 1.0:
            scale = " ".join([f"{unit:g}"] * 3)
            return f'write scale="{scale}" in its <mesh>: {name} states a unit of {unit:g} m'
    return 'write scale="0.001 0.001 0.001" in the <mesh> of a file in mm'


def _mesh_links(urdf: str) -> set[str]:
    links = urdf_tree(urdf).findall("link")
    return {
        link.get("name", "")
        for link in links
        if link.find("collision/geometry/mesh") is not None
    }


def _problem_errors(robot: Robot, problem: Problem) -> Iterator[str]:
    """Yield error messages for lengths and masses of the problem."""
    reach = robot.reach
    payload = problem.payload
    mass = sum(joint.mass for joint in robot.chain.joints)
    if payload is not None:
        # Masses of the chain include the payload.
        arm = mass - payload.mass
        distance = float(np.linalg.norm(payload.centre))
        # Radius of gyration, sqrt(trace(I) / (2 m)) [m].
        gyration = float(np.sqrt(np.trace(payload.inertia_matrix) / (2 * payload.mass)))
        if arm > MIN_ARM_KG and payload.mass > MAX_PAYLOAD_RATIO * arm:
            yield f"payload.mass: is {payload.mass:g} kg, where the arm has {arm:.3g} kg: masses are in kg, not in g"
        for key, length in {"centre": distance, "inertia": gyration}.items():
            if length > MAX_CENTER_RATIO * reach:
                text = f"a length of {length:.3g} m from it, where the arm is {reach:.3g} m long"
                yield f"payload.{key}: {text}; lengths are in m and inertias in kg m^2"
    for index, obstacle in enumerate(problem.obstacle, 1):
        distance = _distance(obstacle)
        if (
            distance > MAX_OBSTACLE_RATIO * reach
            # Obstacles that samples place are parked far away by default.
            and obstacle.position != PARKED_POSITION_M
        ):
            text = f"{obstacle.name!r} is {distance:.3g} m away, where the arm is {reach:.3g} m long"
            yield f"obstacle {index}: {text}: check its unit"


def _distance(obstacle: Obstacle) -> float:
    """Return a lower bound of the distance of an obstacle from the origin of the world [m]."""
    if obstacle.position is not None and not obstacle.mesh:
        corners, radius = obstacle.form.polytope()
        extent = float(np.linalg.norm(corners, axis=1).max()) + radius
        return float(np.linalg.norm(obstacle.position)) - extent
    # Distance of the origin from a range [low, high] of one coordinate: max(low, -high,
    # 0).
    sides = [
        max(each.low, -each.high, 0.0)
        for each in (obstacle.x, obstacle.y)
        if each is not None
    ]
    return float(np.linalg.norm(sides))
