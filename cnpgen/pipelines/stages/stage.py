"""The contract of a stage, and the round of draws that stages work on."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.store.field import Field

if TYPE_CHECKING:
    from cnpgen.pipelines.context import Context

Array = NDArray[np.float64]

BLOCK_ROWS = 4096  # rows per block, unless a stage wants fewer


class Round:
    """A round of draws and the columns that are known of those still alive.

    Attributes:
        size: Number of draws of the round, N.
        alive: Index of each surviving draw in the round, shape (n,), ascending.
        fate: For every draw of the round, 0 while alive, else 1 + the index of its reason, shape (N,).
        reasons: The reasons seen so far, in order of first use.
        columns: Name -> values of the surviving draws, shape (width, n), contiguous rows.
        stage: Label of the stage that works on the round now.
        origins: Reason -> label of the stage that first gave it.
        drawn: Name -> values of all draws, shape (width, N), for columns written before any rejection.
        last: Whether no draws can follow, so that all of this round count.
    """

    def __init__(self, size: int, *, last: bool = False) -> None:
        self.size, self.last = size, last
        self.alive = np.arange(size)
        self.fate = np.zeros(size, np.uint16)
        self.reasons: list[str] = []
        self.columns: dict[str, Array] = {}
        self.drawn: dict[str, Array] = {}
        self.stage = ""
        self.origins: dict[str, str] = {}

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def __setitem__(self, name: str, values: Array) -> None:
        if values.ndim != 2 or values.shape[1] != len(self.alive):
            raise ValueError(f"column {name!r} must have shape (width, {len(self.alive)}), got {values.shape}")
        self.columns[name] = values
        if len(self.alive) == self.size:
            self.drawn[name] = values

    def draw(self, random: np.random.Generator, width: int) -> Array:
        """Draw uniform numbers in [0, 1) for every draw of the round; return the survivors', shape (width, n)."""
        numbers = random.random((width, self.size))
        return numbers if len(self.alive) == self.size else np.take(numbers, self.alive, axis=1)

    def reject(self, ok: Any, reason: str) -> None:
        """End the draws where ``ok`` (shape (n,)) is false under ``reason`` and drop them from every column."""
        self.reject_first(ok[None], [reason])

    def reject_first(self, met: Any, reasons: Sequence[str]) -> None:
        """End the draws where a row of ``met`` (shape (reasons, n)) is false, under the reason of the first such row.

        All reasons count as seen, in their order, whether they end a draw or not.
        """
        for reason in reasons:
            if reason not in self.origins:
                self.reasons.append(reason)
                self.origins[reason] = self.stage
        if np.count_nonzero(met) == met.size:  # a third of the time of all()
            return
        numbers = np.array([1 + self.reasons.index(reason) for reason in reasons])
        ok = met.all(axis=0)
        self.fate[self.alive[~ok]] = numbers[met[:, ~ok].argmin(axis=0)]
        keep = np.flatnonzero(ok)
        self.alive = self.alive[keep]
        self.columns = {name: np.take(values, keep, axis=1) for name, values in self.columns.items()}


Work = Callable[[Round, np.random.Generator], None]
"""What a stage does to a round of draws."""


@dataclass(frozen=True, kw_only=True)
class Stage(ABC):
    """One step of a pipeline.

    A kind of stage is a frozen dataclass whose fields are the keys of its ``[[stage]]`` table; it is registered under
    a name in cnpgen's registry or by a package's entry point in the group ``cnpgen.stages``.

    Attributes:
        block_rows: The largest blocks that rows may be made in; a stage that takes long for a row says less.
        renews: Columns that later stages find anew. Stages before this one that find or use them do nothing for tasks.
    """

    block_rows: ClassVar[int] = BLOCK_ROWS
    renews: ClassVar[tuple[str, ...]] = ()

    @property
    def tasks(self) -> int | None:
        """How many draws there are at all, where they are listed and each is made once; None where they never end."""
        return None

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns that earlier stages must have written; those that depend on no key can be an attribute of a class."""
        return ()

    @abstractmethod
    def describe(self) -> str:
        """Say in one sentence, with this stage's numbers and their units, what it does."""

    @abstractmethod
    def provides(self, context: "Context") -> tuple[Field, ...]:
        """List the fields that this stage writes into the dataset, in order."""

    def writes(self, context: "Context") -> tuple[str, ...]:
        """List the columns that this stage writes, stored or not; by default the fields that it provides."""
        return tuple(field.name for field in self.provides(context))

    @abstractmethod
    def prepare(self, context: "Context") -> Work:
        """Load what the stage needs (kernels, geometry) and return the function that does its work.

        Args:
            context: The problem, its robot and the kernel loader.

        Returns:
            A function of (draws, random) that writes columns of a round and rejects draws of it. It must use
            ``draws.draw`` for randomness.
        """

    def takes(self, context: "Context") -> tuple[Field, ...]:
        """List the fields that tasks may give instead; by default all that it provides but diagnostics."""
        return tuple(field for field in self.provides(context) if field.role != "diagnostic")

    def complete(self, context: "Context", given: Collection[str]) -> Work:
        """Prepare the stage for tasks whose columns are partly given: what is given stays, what is not is found.

        By default a stage has nothing to do where all that it takes is given, and does its own work where nothing is.
        What it draws is then always the middle of what it could be (see ``TaskRound``).

        Args:
            context: As of ``prepare``.
            given: Names of the columns that are known of every task.

        Raises:
            UsageError: Columns that belong together are given in part.
        """
        names = [field.name for field in self.takes(context)]
        known, missing = [name for name in names if name in given], [name for name in names if name not in given]
        if known and missing:
            raise UsageError(f"{', '.join(known)}: tasks that give this must also give {', '.join(missing)}")
        return leave if known else self.prepare(context)


def leave(draws: Round, random: np.random.Generator) -> None:
    """Do nothing: what the stage would find is given."""


class TaskRound(Round):
    """Tasks in the place of draws: nothing of them is random.

    What a stage still draws, since it is not given, is the middle of all that it could be, for every task: no noise.
    What comes of one task so depends on no other.
    """

    def draw(self, random: np.random.Generator, width: int) -> Array:
        """Return 0.5 for every survivor, shape (width, n)."""
        del random
        return np.full((width, len(self.alive)), 0.5)

    def why(self) -> tuple[str, ...]:
        """Return why each of the N tasks has no answer; empty where it has one."""
        texts = ["", *self.reasons]
        return tuple(texts[fate] for fate in self.fate.tolist())
