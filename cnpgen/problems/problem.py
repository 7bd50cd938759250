"""Problem: what a valid motion is, and what identifies it."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cnpgen.problems.constraints.clearance import ObjectContact
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.robots.spec import HeldObject, LimitSpec, Obstacle, RobotSpec
from cnpgen.schema import registry
from cnpgen.schema.keys import NAME, field, to_dict
from cnpgen.trajectory.spec import TrajectorySpec


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
        digest: sha256 of the problem file and its URDF.
    """

    name: str = field("name of the problem: lower-case letters, digits and hyphens", pattern=NAME)
    title: str = field("one line about it", default="")
    robot: RobotSpec = field("the robot")
    limits: LimitSpec = field("its planning limits")
    object: HeldObject | None = field("what it holds", default=None)
    obstacle: tuple[Obstacle, ...] = field("the boxes of the world", default=(), form="[[obstacle]] tables")
    constraint: tuple[Constraint, ...] = field("the constraint manifold", default=(), form="[[constraint]] tables")
    trajectory: TrajectorySpec = field("parameterisation of motions", default=TrajectorySpec())
    objective: Objective = field("what a good motion is", default=Objective())
    path: Path = Path()
    digest: str = ""

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
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
    def urdf_path(self) -> Path:
        """The URDF file."""
        return self.path.parent / self.robot.urdf


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


def problem_identity(problem: Problem) -> str:
    """Digest of what kernels are built from: the problem as it is, wherever it came from, and its URDF."""
    content = resolved(problem)
    del content["title"], content["robot"]["urdf"]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode() + problem.urdf_path.read_bytes()).hexdigest()
