"""Problem: what a valid motion is, and what identifies it."""

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from cnpgen.errors import MachineError
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.shape.files import find_urdf
from cnpgen.robots.shape.inline import with_inline_meshes
from cnpgen.robots.shape.srdf import with_disabled_pairs
from cnpgen.robots.spec import HeldObject, LimitSpec, Payload, RobotSpec
from cnpgen.robots.urdf import read_urdf
from cnpgen.schema import registry
from cnpgen.schema.keys import NAME, field, to_dict
from cnpgen.trajectory.spec import TrajectorySpec

Kind = TypeVar("Kind", bound=Constraint)

MOST_TABLES = 100  # obstacles, and constraints


@dataclass(frozen=True, kw_only=True)
class Objective:
    """What a good motion is: the integral over time of ``1 + centrifugal |kappa| v^2`` (paper, Appendix B, eta)."""

    centrifugal: float = field(
        "weight of the centrifugal acceleration |kappa| v^2 of the tip beside the time",
        unit="s^2/m",
        default=0.0,
        low=0.0,
    )


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What a valid motion is.

    Attributes:
        path: The problem file; the URDF is looked up beside it.
    """

    name: str = field("name of the problem: lower-case letters, digits and hyphens", pattern=NAME)
    title: str = field("one line about it", default="")
    robot: RobotSpec = field("which robot, and what of it is planned")
    limits: LimitSpec = field("its planning limits, as fractions of the URDF's or in their place")
    object: HeldObject | None = field("an upright cuboid that it holds", default=None)
    payload: Payload | None = field("what else it carries at its tip", default=None, late=True)
    obstacle: tuple[Obstacle, ...] = field("what stands around the robot", default=(), form="[[obstacle]] tables")
    constraint: tuple[Constraint, ...] = field(
        "what every state of a valid motion meets", default=(), form="[[constraint]] tables"
    )
    trajectory: TrajectorySpec = field("how motions are parameterised", default=TrajectorySpec())
    objective: Objective = field("what is minimised", default=Objective())
    path: Path = Path()

    def first(self, kind: type[Kind]) -> Kind | None:
        """Return the first constraint of a kind; None if there is none."""
        return next((each for each in self.constraint if isinstance(each, kind)), None)

    @property
    def arm_radius(self) -> float | None:
        """How thick an arm that is a line is, as the first constraint of its clearance says [m]; None if none does."""
        clearance = self.first(RobotClearance)
        return None if clearance is None else clearance.radius

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        for key in ("obstacle", "constraint"):
            if (count := len(getattr(self, key))) > MOST_TABLES:
                yield key, f"there are {count:,} of them, expected at most {MOST_TABLES}: kernels grow with each"
        depth = max((item.depth for item in self.constraint if isinstance(item, ObjectContact)), default=0.0)
        if self.object is not None and min(self.object.size) <= 2 * depth:
            yield (
                "object",
                f"is {min(self.object.size):g} m thin, where contacts {depth:g} m deep are legal (object-contact):"
                " expected more than twice the depth",
            )

    @property
    def object_size(self) -> tuple[float, float, float] | None:
        """Edge lengths of the held object [m], None if nothing is held."""
        return None if self.object is None else self.object.size

    @property
    def uses_jerk(self) -> bool:
        """Whether a constraint is about jerks."""
        return any(constraint.uses_jerk for constraint in self.constraint)

    @property
    def path_orders(self) -> int:
        """How many derivatives of p(s), itself included, its constraints depend on; of r(s) they are one less."""
        return 4 if self.uses_jerk else 3

    @property
    def urdf_path(self) -> Path:
        """The URDF file.

        Raises:
            PluginError: It is one of a package that is not here.
        """
        return find_urdf(self.robot.urdf, self.path, self._packages)

    @property
    def _packages(self) -> list[Path]:
        return [self.path.parent / each for each in self.robot.packages]

    @cached_property
    def urdf_text(self) -> str:
        """The URDF, read once: the robot, its kernels and the identity are of one text, whatever becomes of the file.

        Where the robot has its real shape, the hulls of its meshes and the pairs of an SRDF are part of the text.

        Raises:
            RecipeError: The file cannot be read, or is not UTF-8; or a mesh or the SRDF.
        """
        text, spec = read_urdf(self.urdf_path), self.robot
        if spec.geometry != "urdf":
            return text
        keep = kept_folder() if spec.convex_parts > 1 else None
        text = with_inline_meshes(text, self.urdf_path, self._packages, most=spec.convex_parts, keep=keep)
        return with_disabled_pairs(text, self.path.parent / spec.srdf) if spec.srdf else text

    @cached_property
    def identity(self) -> str:
        """The sha256 over all that kernels and plans of the problem depend on; what is cached for it has this key.

        It is that of the object, however it was made, and not of a file: a copy with another value has another one.
        Only the title and the places of the files are left out.
        """
        content = json.dumps(without_labels(to_dict(self, label=_all_of)), sort_keys=True)
        return hashlib.sha256(content.encode() + self.urdf_text.encode()).hexdigest()


# Keys of [robot] that say where something is or how it is read: what came of it is in the URDF's text.
FILES = ("urdf", "packages", "srdf", "convex_parts")


def kept_folder() -> Path | None:
    """Return the folder where shapes are kept, beside the kernels; None where others may change it."""
    from cnpgen.kernels.cache import default_cache_folder, distrusted, make_private  # only robots with a shape need it

    try:
        folder = default_cache_folder()
        make_private(folder)
    except (OSError, MachineError):
        return None
    return None if distrusted(folder) else folder


def resolved(recipe: object) -> dict[str, Any]:
    """Return a problem, pipeline or dataset recipe as plain dicts and lists in SI units.

    Everything that it refers to is in it, and every default.
    """
    return to_dict(recipe, label=_use)


def _use(obj: object) -> dict[str, str]:
    """Label a stage or a constraint with the name of its kind and, for a plug-in, its package and code."""
    group = registry.group_of(type(obj))
    if not group:
        return {}
    about = {"package": registry.package_of(group, type(obj)), "source": registry.source_digest(type(obj))}
    return {"use": registry.name_of(group, type(obj)), **{key: text for key, text in about.items() if text}}


def _all_of(obj: object) -> dict[str, str]:
    """Label a kind with its name and code, and with its fields that are no keys: an object made in Python has them."""
    label = _use(obj)
    if not label:
        return {}
    others = (spec for spec in dataclasses.fields(obj) if "doc" not in spec.metadata)  # type: ignore[arg-type]
    return label | {spec.name: repr(getattr(obj, spec.name)) for spec in others}


def without_labels(problem: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out of a resolved problem what changes nothing but how it is shown or found: title and names of files."""
    robot = {key: value for key, value in problem["robot"].items() if key not in FILES}
    return {key: value for key, value in problem.items() if key != "title"} | {"robot": robot}
