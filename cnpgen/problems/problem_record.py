"""Problem records: problems as text, so that plan files are self-contained."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from numpy.typing import ArrayLike

from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.errors import RecipeError, UsageError, counted
from cnpgen.problems.objectives import read_objective
from cnpgen.problems.problem import (
    FILES,
    Objective,
    Problem,
    resolved,
    without_sources,
)
from cnpgen.problems.problem_file import (
    load_problem_behind,
    names_of_stored_files,
    restore_problem,
)
from cnpgen.robots.parameter_ranges import NO_PARAMETERS, ParameterRanges
from cnpgen.robots.urdf import urdf_tree
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import concerning, numbers
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import parse, stored_values
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.files.cache_folder import temporary_folder
from cnpgen.store.files.document_structure import (
    ANY_KEY,
    NUMBER,
    TEXT,
    WHOLE,
    check_structure,
)
from cnpgen.store.files.documents import (
    canonical_sha256,
    differences,
    parse_json,
    plain,
)
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

T = TypeVar("T")

_MOVING = ("revolute", "continuous", "prismatic")
_SCALES = (
    "position_scale",
    "velocity_scale",
    "acceleration_rate",
    "acceleration_cap",
    "torque_scale",
)
EXTRAPOLATED = "-extrapolated"  # end of the names of problems with wider ranges
_FORM = {
    "name": TEXT,
    "robot": {"urdf": TEXT, "joints": [TEXT], "tip": TEXT, "base": [NUMBER]},
    "limits": dict.fromkeys(_SCALES, NUMBER),
    "constraint": [{"use": TEXT}],
    "trajectory": {ANY_KEY: WHOLE},
}
# Strictness of the verdict, not part of the problem's definition.
_JUDGED_BY = "tolerance", "budget", "weight"


@dataclass(frozen=True, repr=False)
class ProblemRecord(StoredProblem):
    """Problem as text, with the properties derived from it."""

    def __post_init__(self) -> None:
        for name in ("recipe", "urdf"):
            if not isinstance(text := getattr(self, name), str):
                raise UsageError(f"must be a text, got {text!r:.60}", argument=name)

    def __repr__(self) -> str:
        return f"<ProblemRecord of {self.name!r}: {counted(len(self.joint_names), 'joint')}>"

    @cached_property
    def content(self) -> JsonObject:
        """The resolved problem, as ``cnpgen.problems.problem.resolved`` returns it.

        Raises:
            RecipeError: The text is not the JSON of a problem.
        """
        try:
            content: JsonObject = parse_json(self.recipe)
            check_structure(content, _FORM)
        except ValueError as error:
            raise RecipeError(
                [f"problem_recipe is not that of a problem: {error}"]
            ) from error
        return content

    @property
    def name(self) -> str:
        """Name of the problem."""
        return str(self.content["name"])

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """The n planned joints."""
        return tuple(self.content["robot"]["joints"])

    @cached_property
    def prismatic_joints(self) -> tuple[bool, ...]:
        """Whether each planned joint is prismatic."""
        joints = urdf_tree(self.urdf).iter("joint")
        sliding = {
            joint.get("name") for joint in joints if joint.get("type") == "prismatic"
        }
        return tuple(name in sliding for name in self.joint_names)

    @property
    def held_joints(self) -> dict[str, float]:
        """Unplanned movable joints of the URDF -> constant position [rad or m], zero."""
        joints = urdf_tree(self.urdf).iter("joint")
        moving = (
            joint.get("name", "") for joint in joints if joint.get("type") in _MOVING
        )
        return dict.fromkeys(
            (name for name in moving if name not in self.joint_names), 0.0
        )

    @cached_property
    def trajectory(self) -> TrajectorySpec:
        """Parametrization suggested by the problem.

        Raises:
            RecipeError: There is no such parametrization.
        """
        return self._parsed(TrajectorySpec, "trajectory", self.content["trajectory"])

    def check_trajectory(self) -> None:
        """Raise a RecipeError if there is no parametrization as suggested."""
        self._parsed(TrajectorySpec, "trajectory", self.content["trajectory"])

    @cached_property
    def parameters(self) -> ParameterRanges:
        """Parameters that differ from motion to motion.

        Raises:
            RecipeError: There are no such parameters.
        """
        return self._parsed(
            ParameterRanges, "parameters", self.content.get("parameters", {})
        )

    def _parsed(self, kind: type[T], key: str, table: Any) -> T:
        errors: list[str] = []
        with stored_values():
            parsed = parse(
                kind, table, where=RecipeLocation("problem_recipe", key), errors=errors
            )
        if parsed is None:
            raise RecipeError(errors)
        return parsed

    @cached_property
    def comparable_sha256(self) -> str:
        """Hash (sha256) of the part that problems with comparable plans share: ``problem_sha256`` in files.

        Excluded are name and title, base configuration, suggested parametrization,
        objective, sources of limits, and tolerances of constraints. It does not identify a problem; caches
        must use ``Problem.identity``.
        """
        return canonical_sha256(_comparable(self))

    @checked_arguments
    def differences(self, other: ProblemRecord) -> list[str]:
        """Return the keys in which two problems differ, such as ``"limits.velocity_scale"``."""
        return [each.key for each in differences(_comparable(self), _comparable(other))]

    @contextmanager
    def restored(self) -> Iterator[Problem]:
        """Rebuild the problem; its URDF is in a temporary folder, which is deleted at the end of the block.

        Raises:
            RecipeError: The problem needs another version of cnpgen, or a plug-in that
                is not installed.
        """
        with (
            tempfile.TemporaryDirectory(prefix="cnpgen-") as folder,
            names_of_stored_files(Path(folder)),
        ):
            problem = restore_problem(self.content, self.urdf, Path(folder))
            # The stored text contains meshes and pairs already.
            # Reading the URDF again would add them twice.
            yield replace(problem, read_urdf_text=self.urdf)

    @checked_arguments
    def tip_positions(self, q: Array) -> Array:
        """Compute tip positions with Pinocchio.

        Args:
            q: Joint positions [rad], shape (N, n).

        Returns:
            Tip positions in the world frame [m], shape (N, 3).
        """
        _, robot = open_problem(self)
        q = numbers("q", q)
        if q.ndim != 2 or q.shape[1] != robot.n:
            raise UsageError(
                f"must have shape (N, {robot.n}), got {q.shape}", argument="q"
            )
        return robot.tip_positions(q)


def with_control_points(
    record: ProblemRecord, path: int | None, rate: int | None
) -> ProblemRecord:
    """Return the record of a problem with other numbers of control points of p(s) and r(s); None keeps a number."""
    counts = {"path_control_points": path, "rate_control_points": rate}
    changed = {
        key: count
        for key, count in counts.items()
        if count not in {None, record.content["trajectory"][key]}
    }
    # The record keeps its bytes, and with them its hash.
    if not changed:
        return record
    content = {
        **record.content,
        "trajectory": {**record.content["trajectory"], **changed},
    }
    found = ProblemRecord(
        json.dumps(content, ensure_ascii=False, allow_nan=False), record.urdf
    )
    try:
        found.check_trajectory()
    except RecipeError as error:
        raise UsageError(
            f"{', '.join(changed)}: {error}", concerns=next(iter(changed))
        ) from error
    return found


def with_objective(record: ProblemRecord, objective: str) -> ProblemRecord:
    """Return the record of a problem with another objective (``read_objective``).

    Empty or "time" for its own.
    """
    terms = read_objective(objective)
    if terms is None:
        return record
    # The new terms replace all of the problem's, the centrifugal weight included.
    content = {**record.content, "objective": resolved(Objective(term=terms))}
    return ProblemRecord(
        json.dumps(plain(content), ensure_ascii=False, allow_nan=False), record.urdf
    )


def with_payload_of(record: ProblemRecord, parameters: Array) -> ProblemRecord:
    """Return the record of a problem without parameters, with the payload of a sample's, shape (width,)."""
    with record.restored() as problem:
        values = dict(zip(problem.parameters.names, parameters.tolist(), strict=True))
        payload = None if problem.payload is None else problem.payload.at(values)
        return record_problem(
            replace(problem, payload=payload, parameters=NO_PARAMETERS)
        )


def record_problem(problem: Problem) -> ProblemRecord:
    """Return the record of a problem and its URDF."""
    recipe = json.dumps(plain(resolved(problem)), ensure_ascii=False, allow_nan=False)
    return ProblemRecord(recipe, problem.urdf_text)


def extrapolated(problem: Problem, parameters: ArrayLike) -> Problem:
    """Return a problem whose ranges contain values of its parameters, shape (N, p), with a name that marks it.

    A problem whose ranges contain them already is returned unchanged. UsageError is
    raised for values that no range may contain, and for a problem without parameters.
    """
    ranges = problem.parameters
    if not len(ranges):
        text = f"has no effect: the problem {problem.name!r} has no parameters"
        raise UsageError(text, argument="extrapolate")
    rows = numbers("parameters", parameters)
    if rows.ndim not in {1, 2} or rows.shape[-1] != len(ranges):
        # Errors of the shape are those of the reader.
        return problem
    wider = ranges.widened(rows.reshape(-1, len(ranges)))
    # The name must mark a problem only if its ranges differ.
    if not ranges.out_of_range(rows.reshape(-1, len(ranges))):
        return problem
    # A problem that is widened twice is marked once.
    name = problem.name.removesuffix(EXTRAPOLATED) + EXTRAPOLATED
    return replace(problem, parameters=wider, name=name)


def extrapolated_record(record: ProblemRecord, parameters: ArrayLike) -> ProblemRecord:
    """Return the record of an extrapolated problem; see ``extrapolated``."""
    problem = as_problem(record)
    wider = extrapolated(problem, parameters)
    return record if wider is problem else record_problem(wider)


def as_problem(problem: object) -> Problem:
    """Return a problem from a problem, its record, or the name or the file of a problem, a pipeline or a dataset."""
    if isinstance(problem, Problem):
        return problem
    # A record is rebuilt once for all its callers.
    if isinstance(problem, StoredProblem):
        return _rebuilt(as_record(problem))
    if isinstance(problem, str | Path):
        with concerning("problem"):
            return load_problem_behind(problem)
    expected = "a Problem, a ProblemRecord, or the name or the file of a problem, a pipeline or a dataset"
    raise UsageError(f"must be {expected}, got {problem!r:.60}", argument="problem")


def as_record(problem: object) -> ProblemRecord:
    """Return the record of a problem from any argument of ``as_problem``."""
    if isinstance(problem, ProblemRecord):
        return problem
    if isinstance(problem, StoredProblem):
        return ProblemRecord(problem.recipe, problem.urdf)
    return record_problem(as_problem(problem))


@lru_cache(maxsize=8)
def _rebuilt(record: ProblemRecord) -> Problem:
    """Rebuild a problem in a folder that exists until this process ends, since its URDF is read lazily."""
    folder = temporary_folder()
    with names_of_stored_files(folder):
        return restore_problem(record.content, record.urdf, folder)


def open_problem(record: ProblemRecord) -> tuple[Problem, Robot]:
    """Rebuild a problem and its robot, which both contain the URDF; the files are deleted afterwards.

    Raises:
        UsageError: The argument is not a record.
        RecipeError: The problem needs another version of cnpgen, or a plug-in that is
            not installed.
    """
    if not isinstance(record, ProblemRecord):
        raise UsageError(
            f"must be a ProblemRecord, got {record!r:.60}", argument="record"
        )
    return _opened(record)


@lru_cache(maxsize=8)
def _opened(record: ProblemRecord) -> tuple[Problem, Robot]:
    """Rebuild a problem and its robot; see ``open_problem``."""
    from cnpgen.problems.load_robot import load_robot

    with record.restored() as problem:
        # Scenes differ in their obstacles only: the robot, which is slow to load, is
        # shared.
        if problem.obstacle:
            # Errors are reported below, with the whole problem.
            with suppress(RecipeError):
                content = {**record.content, "obstacle": []}
                return problem, _robot_of(
                    ProblemRecord(json.dumps(content), record.urdf)
                )
        return problem, load_robot(problem)


@lru_cache(maxsize=8)
def _robot_of(record: ProblemRecord) -> Robot:
    """Load the robot of a problem without obstacles: scenes of a robot share it."""
    from cnpgen.problems.load_robot import load_robot

    with record.restored() as problem:
        return load_robot(problem)


def _comparable(record: ProblemRecord) -> JsonObject:
    """Reduce a resolved problem to the part that problems with comparable plans share."""
    kept = {
        key: value
        for key, value in record.content.items()
        if key not in {"name", "title", "version", "trajectory", "objective"}
    }
    robot = {
        key: value
        for key, value in kept["robot"].items()
        if key not in {*FILES, "base"}
    }
    # A difference of the URDF is one key, not the text.
    robot["urdf"] = hashlib.sha256(record.urdf.encode()).hexdigest()
    constraints: JsonObject = {}
    counts = Counter[str]()
    for kind in kept["constraint"]:
        # Constraints of one kind are numbered in the order of the file.
        counts[kind["use"]] += 1
        name = (
            f"{kind['use']} {counts[kind['use']]}"
            if counts[kind["use"]] > 1
            else kind["use"]
        )
        constraints[name] = {
            key: value for key, value in kind.items() if key not in _JUDGED_BY
        }
    limits = without_sources(kept["limits"])
    return kept | {"robot": robot, "limits": limits, "constraint": constraints}
