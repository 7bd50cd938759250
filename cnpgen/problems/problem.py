"""Problem: definition of a valid motion, and its identity."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.documents import JsonMapping, JsonObject, NamedErrors
from cnpgen.errors import MachineError, UsageError
from cnpgen.problems.constraints.axis import TipAxis
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.constraints.link_clearance import ObjectClearance
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.objectives import Centrifugal, ObjectiveTerm
from cnpgen.robots.drive import NO_DRIVE, DriveSpec
from cnpgen.robots.obstacle import Obstacle, invalid_obstacle
from cnpgen.robots.parameter_ranges import (
    NO_PARAMETERS,
    PAYLOAD_CENTRE,
    PAYLOAD_PARAMETERS,
    UPRIGHT_TOLERANCE,
    ParameterRanges,
    optional_key,
)
from cnpgen.robots.robot_spec import HeldObject, LimitSpec, Payload, RobotSpec
from cnpgen.robots.scene import PARKED_POSITION_M
from cnpgen.robots.shape.inline import with_inline_meshes
from cnpgen.robots.shape.mesh_files import find_urdf
from cnpgen.robots.solid import pose_width
from cnpgen.robots.urdf import read_urdf, urdf_tree
from cnpgen.robots.urdf_changes import (
    PAYLOAD,
    with_collision_geometry,
    with_disabled_pairs,
    with_ignored_pairs,
    with_locked_joints,
    with_payload_link,
    with_point_masses,
    without_disabled_pairs,
)
from cnpgen.robots.urdf_elements import check_elements, check_names
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.keys import NAME, Range, field, to_dict
from cnpgen.store.files.cache_folder import (
    default_cache_folder,
    make_private_folder,
    trust_problem,
)
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Kind = TypeVar("Kind", bound=Constraint)

MAX_TABLES = 100  # of obstacles or constraints


@dataclass(frozen=True, kw_only=True)
class Objective:
    """Objective of a motion: its duration plus weighted terms."""

    centrifugal: float = field(
        "weight of the centrifugal acceleration |kappa| v^2 of the tip relative to time",
        unit="s^2/m",
        default=0.0,
        low=0.0,
    )
    term: tuple[ObjectiveTerm, ...] = optional_key(
        "further terms", default=(), form="[[objective.term]] tables"
    )

    @property
    def terms(self) -> tuple[ObjectiveTerm, ...]:
        """All terms in addition to the duration."""
        own = (Centrifugal(weight=self.centrifugal),) if self.centrifugal > 0 else ()
        return (*own, *self.term)


class SceneColumns(NamedTuple):
    """Columns of the values of a scene, ``obstacle_poses`` of kernels and ``Scene.poses``."""

    obstacles: slice  # their poses and sizes
    constraint: (
        slice  # values of ``Problem.scene_constraint``, such as a puck's position
    )
    parameters: slice


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Definition of a valid motion.

    Attributes:
        path: Path of the problem file, the base of the URDF's relative path.
    """

    name: str = field(
        "name of the problem: lower-case letters, digits and hyphens", pattern=NAME
    )
    title: str = field("title in one line", default="")
    version: int = optional_key(
        "rules of the file: from 2 on, friction in the URDF without"
        " drive.urdf_dynamics is an error instead of a warning",
        default=1,
        low=1,
        high=2,
    )
    robot: RobotSpec = field("robot and its planned joints")
    limits: LimitSpec = field(
        "planning limits, as fractions of the URDF's or in their place"
    )
    drive: DriveSpec = optional_key(
        "rotor inertia, friction and limits of the drives", default=NO_DRIVE
    )
    object: HeldObject | None = field("upright cuboid that the tip holds", default=None)
    payload: Payload | None = optional_key("additional load at the tip")
    parameters: ParameterRanges = optional_key(
        "ranges of the parameters that differ from sample to sample",
        default=NO_PARAMETERS,
    )
    obstacle: tuple[Obstacle, ...] = field(
        "obstacles around the robot", default=(), form="[[obstacle]] tables"
    )
    constraint: tuple[Constraint, ...] = field(
        "constraints on every state of a valid motion",
        default=(),
        form="[[constraint]] tables",
    )
    trajectory: TrajectorySpec = field(
        "parametrization of motions", default=TrajectorySpec()
    )
    objective: Objective = field("objective of the optimization", default=Objective())
    path: Path = Path()
    # In a dataset, a plan or a model: implausible sizes and limits were accepted
    # before.
    is_stored: bool = False
    # ``urdf_text`` of a stored problem, which is not read again.
    read_urdf_text: str | None = dataclasses.field(
        default=None, compare=False, repr=False
    )
    # A problem with the same robot: its ``urdf_text``, read when it is needed.
    same_robot: "Problem | None" = dataclasses.field(
        default=None, compare=False, repr=False
    )

    @checked_arguments
    def first(self, kind: type[Kind]) -> Kind | None:
        """Return the first constraint of a kind; None if there is none."""
        return next((each for each in self.constraint if isinstance(each, kind)), None)

    @checked_arguments
    def with_obstacles(self, obstacles: Sequence[Obstacle]) -> "Problem":
        """Return the problem among other obstacles; robot, limits and constraints stay the same.

        Raises:
            UsageError: A size or a pose of an obstacle is not finite, too large or not
                positive.
        """
        if error := invalid_obstacle(obstacles):
            raise UsageError(error, concerns="obstacles")
        return self.replaced(obstacle=tuple(obstacles))

    def replaced(self, **fields: Any) -> "Problem":
        """Return the problem with other fields and the same text of the URDF, which is expensive to read again."""
        # Copies of copies refer to the first problem, so that the chain is one step
        # long.
        return dataclasses.replace(self, same_robot=self.same_robot or self, **fields)

    @property
    def has_sample_obstacles(self) -> bool:
        """Whether samples place obstacles: some are parked far below the robot by default."""
        return any(obstacle.position == PARKED_POSITION_M for obstacle in self.obstacle)

    @property
    def own_obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles that samples do not place."""
        return tuple(
            obstacle
            for obstacle in self.obstacle
            if obstacle.position != PARKED_POSITION_M
        )

    @property
    def sample_obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles, with those that stay in place, if samples place some of them; otherwise none."""
        return self.obstacle if self.has_sample_obstacles else ()

    @property
    def for_planning(self) -> "Problem":
        """The problem without obstacles if samples place them: kernels of planners and losses do not depend on them."""
        return self.with_obstacles(()) if self.has_sample_obstacles else self

    @property
    def arm_radius(self) -> float | None:
        """Radius of the capsules of the paper's geometry, from the first clearance constraint [m], or None."""
        clearance = self.first(RobotClearance)
        return None if clearance is None else clearance.radius

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        for key in ("obstacle", "constraint"):
            if (count := len(getattr(self, key))) > MAX_TABLES:
                yield (
                    key,
                    f"there are {count:,} of them, expected at most {MAX_TABLES}: kernels grow with each",
                )
        limits = [
            key for key in ("torque", "line", "power") if getattr(self.drive, key)
        ]
        if limits and self.first(JointTorque) is None:
            yield (
                f"drive.{limits[0]}",
                "limits motors, and no constraint joint-torque of the problem applies it",
            )
        # The columns of a scene have one block for such values.
        if sum(constraint.scene_width > 0 for constraint in self.constraint) > 1:
            yield (
                "constraint",
                "more than one of them has values of each motion, such as a puck, expected one",
            )
        depth = max(
            (item.depth for item in self.constraint if isinstance(item, ObjectContact)),
            default=0.0,
        )
        if self.object is not None and min(self.object.size) <= 2 * depth:
            yield (
                "object",
                f"is {min(self.object.size):g} m thin, where contacts {depth:g} m deep are legal (object-contact):"
                " expected more than twice the depth",
            )

        yield from self._parameter_errors()

    def _parameter_errors(self) -> NamedErrors:
        if self.parameters.changes_payload and self.payload is None:
            (name, *_) = (
                name for name in self.parameters.names if name in PAYLOAD_PARAMETERS
            )
            yield (
                "parameters",
                f"{name} needs the body of the load: give [payload], too",
            )
        moving = [name for name in self.parameters.names if name in PAYLOAD_CENTRE]
        if moving and self.payload is not None and self.payload.touch_links:
            yield (
                "parameters",
                f"{moving[0]} moves the payload, whose body ('touch_links') cannot move: omit one of them",
            )
        if (
            names := [
                name for name in self.parameters.names if name.startswith("upright_")
            ]
        ) and (
            count := sum(isinstance(item, TipAxis) for item in self.constraint)
        ) != 1:
            yield (
                "parameters",
                f"{names[0]} needs one constraint 'vertical' or 'axis', the problem has {count}",
            )
        nominal = self.nominal_parameters.tolist()
        for name, span, value in zip(
            self.parameters.names, self.parameters.ranges, nominal, strict=True
        ):
            # Samples without parameters use the nominal value, which must be a valid
            # one.
            if not span.low <= value <= span.high:
                yield (
                    "parameters",
                    f"{name} must include {value:g}, the value of samples without parameters",
                )
        if self.parameters.tilts_table or self.parameters.changes_rectangle:
            yield from self._table_errors()

    def _table_errors(self) -> NamedErrors:
        tables = [
            constraint
            for constraint in self.constraint
            if isinstance(constraint, Table)
        ]
        if len(tables) != 1:
            yield (
                "parameters",
                f"table parameters need one constraint 'table', the problem has {len(tables)}",
            )
        for side in ("x", "y") if tables else ():
            low, high = (
                getattr(self.parameters, f"table_{side}_{end}")
                for end in ("low", "high")
            )
            sides: Range = getattr(tables[0], side)
            # The worst sample has the highest low side and the lowest high side.
            if (low.high if low else sides.low) >= (high.low if high else sides.high):
                yield (
                    "parameters",
                    f"table_{side}_low must be below table_{side}_high in all samples",
                )
        if self.parameters.tilts_table and any(table.start_band for table in tables):
            yield (
                "parameters",
                "table parameters need starts on the table: remove start_band of the constraint 'table'",
            )

    @property
    def object_size(self) -> Vector3 | None:
        """Edge lengths of the held object [m], None if nothing is held."""
        # The code of a plug-in may use names, poses and sizes as constants.
        return None if self.object is None else self.object.size

    @property
    def nominal_parameters(self) -> Array:
        """Parameters of a sample for which none are given, shape (width,)."""
        values: dict[str, float] = {}
        if (payload := self.payload) is not None:
            values |= {"payload_mass": payload.mass} | dict(
                zip(PAYLOAD_CENTRE, payload.centre, strict=True)
            )
        if (table := self.first(Table)) is not None:
            values |= table.bounds
        uprights = (item for item in self.constraint if isinstance(item, TipAxis))
        values[UPRIGHT_TOLERANCE] = next(
            (item.nominal_tolerance for item in uprights), 0.0
        )
        return self.parameters.nominal(values)

    @property
    def table_origin(self) -> Array:
        """Center of the rectangle of the table, about which it turns [m], shape (3,).

        Zero without a table.
        """
        table = self.first(Table)
        if table is None:
            return np.zeros(3)
        return np.array(
            [
                (table.x.low + table.x.high) / 2,
                (table.y.low + table.y.high) / 2,
                table.z,
            ]
        )

    @cached_property
    def scene_constraint(self) -> Constraint | None:
        """The constraint that depends on values of each motion (``Constraint.scene_values``), or None."""
        return next(
            (constraint for constraint in self.constraint if constraint.scene_width),
            None,
        )

    @property
    def scene_columns(self) -> SceneColumns:
        """Columns of the values of a scene."""
        constraint = self.scene_constraint
        obstacles = pose_width(self.obstacle)
        # Order: poses of obstacles, values of the constraint, parameters.
        own = obstacles + (0 if constraint is None else constraint.scene_width)
        end = own + len(self.parameters)
        return SceneColumns(slice(obstacles), slice(obstacles, own), slice(own, end))

    @property
    def scene_width(self) -> int:
        """Number of values of a scene."""
        width: int = self.scene_columns.parameters.stop
        return width

    @property
    def uses_link_geometry(self) -> bool:
        """Whether obstacles, links or the held object must keep a distance from the links' geometry in the URDF."""
        return self.robot.geometry == "urdf" or self.first(ObjectClearance) is not None

    @property
    def uses_jerk(self) -> bool:
        """Whether a constraint or a term of the objective uses jerks."""
        return any(item.uses_jerk for item in self.constraint) or any(
            term.uses_jerk for term in self.objective.term
        )

    @property
    def path_orders(self) -> int:
        """Number of derivatives of p(s), including p itself, in the constraints.

        For r(s) it is one less.
        """
        # p, p', p'' determine accelerations; jerks need p''', too.
        return 4 if self.uses_jerk else 3

    @property
    def urdf_path(self) -> Path:
        """The URDF file.

        Raises:
            PluginError: The URDF belongs to a package that is not installed.
        """
        return find_urdf(self.robot.urdf, self.path, self.packages)

    @property
    def packages(self) -> list[Path]:
        """Folders that are searched for packages of the URDF."""
        return [self.path.parent / each for each in self.robot.packages]

    @cached_property
    def urdf_text(self) -> str:
        """Text of the URDF, read once, so that robot, kernels and identity use the same text.

        Locked joints are fixed. If constraints use the URDF's geometry, the text
        includes the hulls of meshes, the pairs of an SRDF and the box of a payload that
        is a body.

        Raises:
            RecipeError: The URDF, a mesh or the SRDF cannot be read, or is not UTF-8,
                or a joint cannot be locked.
        """
        # A stored text has been processed by all steps below.
        if self.read_urdf_text is not None:
            return self.read_urdf_text
        if self.same_robot is not None:
            return self.same_robot.urdf_text
        spec = self.robot
        positions = dict(zip(spec.locked_joints, spec.locked_positions, strict=True))
        text = self._checked_urdf()
        text = with_locked_joints(text, positions, is_stored=self.is_stored)
        text = with_point_masses(text)
        # Meshes need not exist where no constraint uses the geometry.
        if not self.uses_link_geometry:
            return text
        # The geometry of a stored problem is in its file, with the additions of then.
        if not self.is_stored:
            text = with_collision_geometry(text, spec.visual_links, spec.skipped_meshes)
        text = with_inline_meshes(
            text,
            self.urdf_path,
            self.packages,
            most=spec.convex_parts,
            links=spec.decomposed,
            # Only decompositions into several parts are kept in the cache.
            keep=kept_folder() if spec.convex_parts > 1 else None,
        )
        if spec.srdf:
            srdf = self.path.parent / spec.srdf
            text = with_disabled_pairs(
                text, srdf, planned=spec.joints, allow_unused=spec.allow_unused
            )
        return self._with_payload(text)

    def _checked_urdf(self) -> str:
        """Return the text of the file, whose elements are checked unless the problem is stored."""
        text = read_urdf(self.urdf_path)
        if not self.is_stored:
            # The reader of the robot raises errors about the text itself.
            with suppress(ValueError):
                tree = urdf_tree(text)
                allowed = self.robot.allow_unused
                check_elements(tree, self.urdf_path, allow_unused=allowed)
                check_names(tree, self.urdf_path)
                return without_disabled_pairs(text)
        return text

    def _with_payload(self, text: str) -> str:
        """Return a URDF with the box of a payload that is a body, and with the ignored pairs."""
        spec = self.robot
        text = with_payload_link(text, spec, self.payload, is_stored=self.is_stored)
        # Links that hold the payload touch it in every state.
        touching = () if self.payload is None else self.payload.touch_links
        ignored = *spec.ignored_pairs, *((link, PAYLOAD) for link in touching)
        # Last: the ignored pairs may name the link of the payload.
        return with_ignored_pairs(text, ignored) if ignored else text

    @cached_property
    def identity(self) -> str:
        """Hash (sha256) of everything that kernels and plans of the problem depend on; the key of caches.

        It depends on the values of the object and not on a file. Only the title, the
        version of the file's rules, the file paths and the sources of limits are
        excluded.
        """
        content = json.dumps(
            without_labels(to_dict(self, label=_all_of)), sort_keys=True
        )
        return hashlib.sha256(content.encode() + self.urdf_text.encode()).hexdigest()

    @cached_property
    def structure(self) -> str | None:
        """Hash (sha256) as ``identity``, without names, poses and sizes of obstacles; None with plug-ins.

        Kernels that read these numbers from their arguments are equal for all problems
        of one structure.
        """
        kinds = [*self.constraint, *(obstacle.form for obstacle in self.obstacle)]
        if not all(type(kind).__module__.startswith("cnpgen.") for kind in kinds):
            return None
        content = without_labels(to_dict(self, label=_all_of))
        # The name does not affect kernels, but is part of the identity.
        content = {key: value for key, value in content.items() if key != "name"}
        content["obstacle"] = [
            _structure_of(obstacle) for obstacle in content["obstacle"]
        ]
        text = json.dumps(content, sort_keys=True)
        return hashlib.sha256(
            # The prefix keeps the hash apart from an identity with the same content.
            b"structure" + text.encode() + self.urdf_text.encode()
        ).hexdigest()


def _structure_of(obstacle: JsonMapping) -> JsonObject:
    """Return the keys of a resolved obstacle that kernels contain as constants: all but name, pose and sizes."""
    # Kernels contain the ranges of an obstacle as constants.
    if obstacle.get("x") is not None or obstacle.get("y") is not None:
        return {
            key: value
            for key, value in obstacle.items()
            if key not in {"name", "top", "below"}
        }
    # Turned obstacles have other symbolic distances than upright ones.
    turned = any(obstacle.get("rotation") or ())
    return {key: obstacle.get(key) for key in ("kind", "mesh", "scale")} | {
        "turned": turned
    }


# Keys of [robot] that only locate, read or describe files; their results are in the
# text of the URDF.
FILES = (
    "urdf",
    "packages",
    "srdf",
    "ignored_pairs",
    "convex_parts",
    "decomposed",
    "hull_gap",
)
SOURCES = "sources"  # key of [limits] that only describes them


def kept_folder() -> Path | None:
    """Return the cache folder of shapes; None if other users may write to it."""
    try:
        folder = default_cache_folder()
        make_private_folder(folder)
    except (OSError, MachineError):
        return None
    # A cache that other users may write to could contain their shapes.
    return None if trust_problem(folder) else folder


def resolved(recipe: object) -> JsonObject:
    """Return a problem, pipeline or dataset recipe as plain dicts and lists in SI units.

    The result includes referenced recipes and default values.
    """
    return to_dict(recipe, label=_use)


def _use(obj: object) -> dict[str, str]:
    """Label a stage or a constraint with the name of its kind and, for a plug-in, its package and code."""
    # Other objects, such as ranges, need no label.
    group = registry.group_of(type(obj))
    if not group:
        return {}
    about = {
        "package": registry.package_of(group, type(obj)),
        "source": registry.source_digest(type(obj)),
    }
    return {
        "use": registry.name_of(group, type(obj)),
        **{key: text for key, text in about.items() if text},
    }


def _all_of(obj: object) -> dict[str, str]:
    """Label a kind with its name, code and fields that are not keys, as objects built in Python have them."""
    label = _use(obj)
    if not label:
        return {}
    others = (spec for spec in dataclasses.fields(obj) if "doc" not in spec.metadata)  # type: ignore[arg-type]
    return label | {spec.name: repr(getattr(obj, spec.name)) for spec in others}


def without_labels(problem: JsonMapping) -> JsonObject:
    """Remove title, version, file names and sources of limits from a resolved problem: they do not affect its motions."""
    robot = {key: value for key, value in problem["robot"].items() if key not in FILES}
    labels = {"title", "version"}
    kept = {key: value for key, value in problem.items() if key not in labels}
    return kept | {"robot": robot, "limits": without_sources(problem["limits"])}


def without_sources(limits: JsonMapping) -> JsonObject:
    """Remove the sources from resolved limits."""
    return {key: value for key, value in limits.items() if key != SOURCES}
