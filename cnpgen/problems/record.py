"""A problem as text, so that a file of plans can be judged without any other file."""

import hashlib
import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.problems.load import restore_problem
from cnpgen.problems.problem import Problem, resolved
from cnpgen.store.files.documents import canonical_sha256, plain
from cnpgen.trajectory.spec import TrajectorySpec

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot
    from cnpgen.store.blueprint import Blueprint

Array = NDArray[np.float64]

_JUDGED_BY = ("tolerance", "budget", "weight")  # how strictly a plan is judged, not what it is a plan for


@dataclass(frozen=True)
class ProblemRecord:
    """A problem as text.

    Attributes:
        recipe: The resolved problem as JSON, every number in SI.
        urdf: The robot's URDF.
    """

    recipe: str
    urdf: str

    @cached_property
    def content(self) -> dict[str, Any]:
        """The resolved problem, as ``cnpgen.problems.problem.resolved`` returns it.

        Raises:
            ValueError: The text is not the JSON of a problem.
        """
        content = json.loads(self.recipe)
        if not isinstance(content, dict) or not {"name", "robot", "constraint"} <= content.keys():
            raise ValueError("the recipe is not that of a problem")
        return content

    @property
    def name(self) -> str:
        """Name of the problem."""
        return str(self.content["name"])

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The n planned joints."""
        return tuple(self.content["robot"]["joints"])

    @property
    def trajectory(self) -> TrajectorySpec:
        """Parameterisation that the problem suggests."""
        return TrajectorySpec(**self.content["trajectory"])

    @cached_property
    def digest(self) -> str:
        """The sha256 over what plans of this problem mean.

        Left out is what may differ between files that can be compared: name and title, the base configuration, the
        suggested parameterisation, the objective, and by how much constraints may be violated.
        """
        return canonical_sha256(_meaning(self))

    def differences(self, other: "ProblemRecord") -> list[str]:
        """List the keys in which two problems differ, of those that the digest covers: ``"limits.velocity_scale"``."""
        return list(_differences(_meaning(self), _meaning(other)))

    @contextmanager
    def restored(self) -> Iterator[Problem]:
        """Rebuild the problem; its URDF is in a temporary folder, which is gone when the block ends.

        Raises:
            RecipeError: The problem needs another version of cnpgen, or a plug-in that is not installed.
        """
        with tempfile.TemporaryDirectory(prefix="cnpgen-") as folder:
            yield restore_problem(self.content, self.urdf, Path(folder))

    def tip_positions(self, q: Array) -> Array:
        """Compute where the tip is, with Pinocchio.

        Args:
            q: Joint positions [rad], shape (N, n).

        Returns:
            World frame [m], shape (N, 3).
        """
        import pinocchio as pin

        _, robot = open_problem(self)
        model = robot.model
        data, frame = model.createData(), model.getFrameId(robot.tip)
        found = np.empty((len(q), 3))
        for row, configuration in enumerate(q):
            pin.forwardKinematics(model, data, configuration)
            found[row] = pin.updateFramePlacement(model, data, frame).translation
        return found


def record_problem(problem: Problem) -> ProblemRecord:
    """Write a problem and its URDF down."""
    recipe = json.dumps(plain(resolved(problem)), ensure_ascii=False, allow_nan=False)
    return ProblemRecord(recipe, problem.urdf_path.read_bytes().decode())


def record_of(blueprint: "Blueprint") -> ProblemRecord:
    """Return the problem that a dataset was made for, from its blueprint."""
    recipe = json.dumps(blueprint.recipe["pipeline"]["problem"], ensure_ascii=False)
    return ProblemRecord(recipe, str(blueprint.robot["urdf"]))


@lru_cache(maxsize=8)
def open_problem(record: ProblemRecord) -> "tuple[Problem, Robot]":
    """Rebuild a problem and its robot, which is loaded as far as Pinocchio's model; the files are gone afterwards.

    Raises:
        RecipeError: The problem needs another version of cnpgen, or a plug-in that is not installed.
    """
    from cnpgen.problems.robot import load_robot

    with record.restored() as problem:
        robot = load_robot(problem)
        robot.skeleton  # noqa: B018 - it and the model are read from the URDF when they are first asked for
    return problem, robot


def _meaning(record: ProblemRecord) -> dict[str, Any]:
    """Reduce a problem to what its plans mean."""
    kept = {
        key: value for key, value in record.content.items() if key not in {"name", "title", "trajectory", "objective"}
    }
    robot = {key: value for key, value in kept["robot"].items() if key not in {"urdf", "base"}}
    robot["urdf"] = hashlib.sha256(record.urdf.encode()).hexdigest()
    constraints: dict[str, Any] = {}
    for kind in kept["constraint"]:
        count = sum(name.split()[0] == kind["use"] for name in constraints)
        name = f"{kind['use']} {count + 1}" if count else kind["use"]
        constraints[name] = {key: value for key, value in kind.items() if key not in _JUDGED_BY}
    return kept | {"robot": robot, "constraint": constraints}


def _differences(one: Any, other: Any, key: str = "") -> Iterator[str]:
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for name in [*one, *(name for name in other if name not in one)]:
            yield from _differences(one.get(name), other.get(name), f"{key}.{name}" if key else name)
    elif one != other:
        yield key
