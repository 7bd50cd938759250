"""Base class of stages, and the context and batch of candidates that they process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.errors import RecipeError, UsageError
from cnpgen.kernels.library import Backend, KernelLibrary, problem_kernels
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.schema import registry
from cnpgen.schema.keys import field as key
from cnpgen.store.field import Field, Fields

if TYPE_CHECKING:
    from cnpgen.pipelines.stages.batch_scenes import BatchScenes

Kind = TypeVar("Kind", bound=Constraint)

BLOCK_ROWS = 4096  # rows per block, unless a stage requires fewer


@dataclass(frozen=True)
class Context:
    """Loaded problem of a stage.

    Attributes:
        problem: Definition of a valid motion.
        robot: Robot with its planning limits.
        kernels: Library of compiled kernels.
        dtype: Float type of stored rows.
    """

    problem: Problem
    robot: Robot
    kernels: KernelLibrary
    dtype: str = "float64"

    def constraint(self, kind: type[Kind]) -> Kind:
        """Return the problem's constraint of a kind.

        Raises:
            RecipeError: The problem has no constraint of this kind.
        """
        if (constraint := self.problem.first(kind)) is not None:
            return constraint
        name = registry.name_of(registry.CONSTRAINTS, kind)
        raise RecipeError(
            [
                f"needs a constraint {name!r}, which the problem {self.problem.path} does not have"
            ]
        )

    def joint_field(
        self, name: str, unit: str, long_name: str, role: str = "input"
    ) -> Field:
        """Describe a field with one column per planned joint, bounded by the planning limits of its unit.

        Args:
            name: Name of the field.
            unit: Unit for revolute joints: "rad", "rad/s" or "rad/s^2".
            long_name: Short description of the field.
            role: Role of the field, see ``Field``.
        """
        robot = self.robot
        bounds = {
            "rad": (robot.position_lower, robot.position_upper),
            "rad/s": (-robot.velocity_limit, robot.velocity_limit),
            "rad/s^2": (-robot.acceleration_limit, robot.acceleration_limit),
        }[unit]
        low, high = (tuple(float(x) for x in bound) for bound in bounds)
        return Field(
            name,
            robot.units(unit),
            long_name,
            robot.n,
            robot.joint_names,
            role,
            valid_min=low,
            valid_max=high,
        )


def load_context(
    problem: Problem, backend: Backend, cache_folder: Path, dtype: str = "float64"
) -> Context:
    """Load the robot of a problem and open its kernel library."""
    robot = load_robot(problem)
    return Context(
        problem, robot, problem_kernels(problem, robot, backend, cache_folder), dtype
    )


class CandidateBatch:
    """Batch of candidates and the columns of the remaining ones.

    Attributes:
        size: Number of candidates in the batch, N.
        alive: Indices of the remaining candidates in the batch, shape (n,), ascending.
        outcome: 0 for remaining candidates, otherwise 1 + the index of the rejection
            reason, shape (N,).
        reasons: Rejection reasons, in order of first use.
        columns: Name -> values of the remaining candidates, shape (width, n),
            contiguous rows.
        stage: Label of the current stage.
        origins: Reason -> label of the stage that used it first.
        drawn: Name -> values of all candidates, shape (width, N), for columns written
            before any rejection.
        last: Whether this is the last batch of the pipeline, so that all its candidates
            are counted.
        scenes: Scenes of the candidates, whose column ``scene`` has the index of the
            scene of each, or None.
    """

    def __init__(self, size: int, *, last: bool = False) -> None:
        self.size = size
        self.last = last
        self.alive = np.arange(size)
        self.outcome = np.zeros(size, np.uint16)
        self.reasons: list[str] = []
        self.columns: dict[str, Array] = {}
        self.drawn: dict[str, Array] = {}
        self.stage = ""
        self.origins: dict[str, str] = {}
        self.scenes: BatchScenes | None = None

    @property
    def scene(self) -> Integers:
        """Index in ``scenes`` of the scene of each remaining candidate, ascending, shape (n,)."""
        index: Integers = self.columns["scene"][0].astype(np.int64)
        return index

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def __setitem__(self, name: str, values: Array) -> None:
        if values.ndim != 2 or values.shape[1] != len(self.alive):
            raise ValueError(
                f"column {name!r} must have shape (width, {len(self.alive)}), got {values.shape}"
            )
        self.columns[name] = values
        if len(self.alive) == self.size:
            # Columns of all candidates, kept for statistics of rejected ones.
            self.drawn[name] = values

    def draw(self, random: np.random.Generator, width: int) -> Array:
        """Draw uniform numbers in [0, 1) for all N candidates.

        Return those of the remaining ones, shape (width, n).
        """
        # All N numbers are drawn, so that later stages do not depend on earlier
        # rejections.
        numbers = random.random((width, self.size))
        return (
            numbers
            if len(self.alive) == self.size
            else np.take(numbers, self.alive, axis=1)
        )

    def reject(self, ok: Any, reason: str) -> None:
        """Reject the candidates with a false ``ok``, shape (n,), under a reason, and drop them from every column."""
        self.reject_first(ok[None], [reason])

    def reject_first(self, met: Any, reasons: Sequence[str]) -> None:
        """Reject the candidates with a false entry in ``met``, shape (reasons, n), under the reason of the first one.

        All reasons are registered, in their order, even without a rejection.
        """
        for reason in reasons:
            if reason not in self.origins:
                self.reasons.append(reason)
                self.origins[reason] = self.stage
        if np.count_nonzero(met) == met.size:
            # A third of the time of all().
            return
        # The reason of a candidate is the first one that it does not meet.
        numbers = np.array([1 + self.reasons.index(reason) for reason in reasons])
        ok = met.all(axis=0)
        self.outcome[self.alive[~ok]] = numbers[met[:, ~ok].argmin(axis=0)]
        keep = np.flatnonzero(ok)
        self.alive = self.alive[keep]
        self.columns = {
            name: np.take(values, keep, axis=1) for name, values in self.columns.items()
        }


StageFunction = Callable[[CandidateBatch, np.random.Generator], None]
"""Function of (candidates, random) that writes columns of a batch and rejects candidates of it."""


@dataclass(frozen=True, kw_only=True)
class Stage(ABC):
    """One step of a pipeline.

    A kind of stage is a frozen dataclass whose fields are the keys of its ``[[stage]]``
    table. It is registered under a name in cnpgen's registry or by a package's entry
    point in the group ``cnpgen.stages``.

    Attributes:
        block_rows: Maximum number of rows per block; expensive stages use smaller
            blocks.
        replaces: Columns that later stages compute again. For tasks, earlier stages
            that write or read them are omitted.
        draws_scenes: Whether it sets ``CandidateBatch.scenes``.
    """

    block_rows: ClassVar[int] = BLOCK_ROWS
    replaces: ClassVar[tuple[str, ...]] = ()
    draws_scenes: ClassVar[bool] = False

    @property
    def tasks(self) -> int | None:
        """Number of listed tasks, each of which is used once.

        None for unlimited random candidates.
        """
        return None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Columns that earlier stages must write.

        A class attribute if they are independent of the keys.
        """
        return ()

    @abstractmethod
    def describe(self) -> str:
        """Describe the stage in one sentence, with its values and units."""

    def outputs(self, context: Context) -> Fields:
        """List the stored fields that this stage writes, in order; by default none."""
        return ()

    def writes(self, context: Context) -> tuple[str, ...]:
        """List the columns that this stage writes, stored or not.

        By default its outputs.
        """
        return tuple(field.name for field in self.outputs(context))

    @abstractmethod
    def prepare(self, context: Context) -> StageFunction:
        """Load the kernels and geometry of the stage and return its stage function.

        Args:
            context: Problem, robot and kernel library.

        Returns:
            A function of (candidates, random) that writes columns of a batch and
            rejects candidates of it. It must draw random numbers with
            ``candidates.draw`` only.
        """

    def task_inputs(self, context: Context) -> Fields:
        """List the fields that tasks may give instead.

        By default all outputs except diagnostics.
        """
        return tuple(
            field for field in self.outputs(context) if field.role != "diagnostic"
        )

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Prepare the stage for tasks: keep the given columns and compute the missing ones.

        By default the stage does nothing if all its task inputs are given, and runs as
        usual if none is given. Its random numbers are then replaced by their mean (see
        ``TaskBatch``).

        Args:
            context: Problem, robot and kernel library.
            given: Names of the columns that every task has.

        Raises:
            UsageError: Some but not all task inputs of the stage are given.
        """
        names = [field.name for field in self.task_inputs(context)]
        known = [name for name in names if name in given]
        missing = [name for name in names if name not in given]
        if known and missing:
            raise UsageError(
                f"{', '.join(known)}: tasks that give this must also give {', '.join(missing)}"
            )
        return leave if known else self.prepare(context)


def fraction(doc: str, **options: Any) -> Any:
    """Declare a key with a number from 0 to 1; see ``field``."""
    return key(doc, low=0.0, high=1.0, **options)


def leave(candidates: CandidateBatch, random: np.random.Generator) -> None:
    """Do nothing: the columns of the stage are given."""


class TaskBatch(CandidateBatch):
    """Batch of tasks instead of random candidates.

    All random numbers are replaced by their mean. The result of a task is therefore
    independent of the other tasks.
    """

    def draw(self, random: np.random.Generator, width: int) -> Array:
        """Return 0.5 for every remaining task, shape (width, n)."""
        return np.full((width, len(self.alive)), 0.5)

    def why(self) -> tuple[str, ...]:
        """Return the rejection reason of each of the N tasks.

        Empty for solved tasks.
        """
        # Outcome 0 is no rejection.
        texts = ["", *self.reasons]
        return tuple(texts[outcome] for outcome in self.outcome.tolist())
