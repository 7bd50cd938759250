"""A pipeline ready to run: blocks of rows, each a pure function of (seed, split, block index)."""

import hashlib
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cnpgen.errors import RecipeError, UsageError
from cnpgen.kernels.library import Backend, problem_kernels
from cnpgen.pipelines.acceptance import acceptance, bookkeeping_fields
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.piece import Block, Piece
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Array, Round, Work
from cnpgen.problems.constraints.constraint import EXACTNESS
from cnpgen.problems.robot import load_robot
from cnpgen.schema import registry
from cnpgen.store.field import Field

HOPELESS = 1e-4  # acceptance below which a pipeline is given up, once it has had a fair chance
FAIR_CHANCE = 100_000  # draws

# Stored order of the fields that the shipped stages write; others follow in the order of their stages.
ORDER = (
    "start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "goal_ddq", "start_xyz", "goal_xyz",
    "hit_angle", "hit_speed", "hit_speed_max",
)  # fmt: skip


class PreparedPipeline:
    """Stages with their kernels loaded.

    Args:
        pipeline: The recipe.
        backend: Which kernels to run.
        cache_folder: Where kernels are cached.
        dtype: "float64" or "float32": what rows are stored as, and checked as.

    Attributes:
        context: Problem, robot and kernels.
        fields: The fields of a row, in stored order.
        block_rows: Rows per block.
    """

    def __init__(self, pipeline: Pipeline, *, backend: Backend, cache_folder: Path, dtype: str = "float64") -> None:
        if dtype not in EXACTNESS:
            raise UsageError(f"dtype must be {' or '.join(map(repr, EXACTNESS))}, got {dtype!r}")
        problem = pipeline.problem
        robot = load_robot(problem)
        kernels = problem_kernels(problem, robot, backend, cache_folder)
        self.pipeline = pipeline
        self.block_rows = min(stage.block_rows for stage in pipeline.stage)
        self.context = Context(problem, robot, kernels, dtype)
        self.fields = _ordered_fields(pipeline, self.context)
        written = _check_needs(pipeline, self.context)
        with kernels.compiling_together():
            self._stages = _prepare(pipeline, self.context)
            self._accept = acceptance(self.context, written)

    def block(self, seed: int, split: str, index: int, *, first: int = 0, stop: int | None = None) -> Block:
        """Make rows ``first`` to ``stop`` of one block.

        Args:
            seed: Root seed of the dataset.
            split: Name of the split.
            index: Index of the block in the split.
            first: First row wanted.
            stop: One after the last row wanted; by default, and at most, ``block_rows``.

        Raises:
            RecipeError: Practically no draw is accepted.
        """
        (block,) = self.pieces(seed, split, index, [(first, self.block_rows if stop is None else stop)])
        return block

    def pieces(self, seed: int, split: str, index: int, ranges: Sequence[tuple[int, int]]) -> Iterator[Block]:
        """Make several ranges of rows of one block, drawing it only once.

        Args:
            seed: Root seed of the dataset.
            split: Name of the split.
            index: Index of the block in the split.
            ranges: (first row, one after the last row) of every piece, ascending, not overlapping.

        Yields:
            Every piece as soon as it is whole.

        Raises:
            RecipeError: Practically no draw is accepted.
        """
        random = random_generator(seed, split, index)
        waiting = deque(Piece(self.fields, first, stop) for first, stop in ranges)
        made = tried = 0
        while waiting:
            batch = self._round(random, self._round_size(made, tried))
            tried += batch.size
            while waiting and waiting[0].take(batch, made):
                yield waiting.popleft().block(index * self.block_rows)
            made += len(batch.alive)
            if waiting:
                self._check_hope(batch, made, tried)

    def _round(self, random: np.random.Generator, size: int) -> Round:
        batch = Round(size)
        for label, run in self._stages:
            batch.stage = label
            run(batch, random)
        if self.context.dtype == "float32":
            for field in self.fields:
                if field.name in batch.columns:
                    batch[field.name] = as_stored(batch[field.name], field)
        batch.stage = "acceptance"
        self._accept(batch, random)
        return batch

    def _round_size(self, made: int, tried: int) -> int:
        """How many draws the next round of a block has: what its own acceptance so far says is missing, and some more.

        It depends on the block alone and not on how many of its rows are wanted.
        """
        rows = self.block_rows
        if tried == 0:
            return rows // 2
        if made == 0:
            return 2 * rows
        missing = (rows - made) * tried / made
        return int(np.clip(np.ceil(1.03 * missing) + rows // 128, rows // 16, 2 * rows))

    def _check_hope(self, batch: Round, made: int, tried: int) -> None:
        if tried >= FAIR_CHANCE and made < HOPELESS * tried:
            counts = np.bincount(batch.fate, minlength=1 + len(batch.reasons))[1:]
            worst = sorted(zip(counts.tolist(), batch.reasons, strict=True), reverse=True)[:3]
            reasons = ", ".join(f"{reason} ({count / batch.size:.1%})" for count, reason in worst if count)
            text = f"{made} of {tried:,} draws were accepted; of the last {batch.size:,}, rejected for {reasons}"
            raise RecipeError([f"{self.pipeline.path}: {text}"])


def random_generator(seed: int, split: str, index: int) -> np.random.Generator:
    """Return the random numbers of one block: SFC64 seeded by a SeedSequence of (seed; sha256 of the split, block)."""
    words = np.frombuffer(hashlib.sha256(split.encode()).digest(), "<u4").tolist()
    sequence = np.random.SeedSequence(seed, spawn_key=(*words, index))
    return np.random.Generator(np.random.SFC64(sequence))


def as_stored(values: Array, field: Field) -> Array:
    """Round to float32 and back; what would be rounded beyond a limit of the field is rounded inwards."""
    rounded = values.astype(np.float32)
    for bound, inwards, beyond in ((field.valid_min, np.inf, np.less), (field.valid_max, -np.inf, np.greater)):
        if bound is not None:
            limit = np.array(bound)[:, None]
            stored = limit.astype(np.float32)
            stored = np.where(beyond(stored, limit), np.nextafter(stored, np.float32(inwards)), stored)
            rounded = np.where(beyond(rounded, limit) & ~beyond(values, limit), stored, rounded)
    return rounded.astype(np.float64)


def _prepare(pipeline: Pipeline, context: Context) -> list[tuple[str, Work]]:
    """Prepare and label every stage; raise all their mistakes at once, each with file and stage."""
    runs, mistakes = [], []
    for number, stage in enumerate(pipeline.stage, start=1):
        kind = registry.name_of(registry.STAGES, type(stage))
        try:
            runs.append((f"{number}. {kind}", stage.prepare(context)))
        except RecipeError as error:
            mistakes += [f"{pipeline.path}: stage {number} ({kind}): {mistake}" for mistake in error.mistakes]
    if mistakes:
        raise RecipeError(mistakes)
    return runs


def _ordered_fields(pipeline: Pipeline, context: Context) -> tuple[Field, ...]:
    """Merge what the stages provide; a later stage may overwrite a field but not change what it is."""
    fields: dict[str, Field] = {}
    for stage in pipeline.stage:
        for field in stage.provides(context):
            fields[field.name] = field
    known = [fields.pop(name) for name in ORDER if name in fields]
    return (*known, *fields.values(), *bookkeeping_fields())


def _check_needs(pipeline: Pipeline, context: Context) -> set[str]:
    """Return the columns that the stages write; raise RecipeError where a stage needs one that is not there."""
    written: set[str] = set()
    mistakes = []
    for number, stage in enumerate(pipeline.stage, start=1):
        missing = [name for name in stage.needs if name not in written]
        if missing:
            kind = registry.name_of(registry.STAGES, type(stage))
            text = f"needs {', '.join(missing)}, which no stage before it writes"
            mistakes.append(f"{pipeline.path}: stage {number} ({kind}): {text}")
        written.update(stage.writes(context))
    needed = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "start_xyz", "goal_xyz")
    mistakes.extend(
        f"{pipeline.path}: no stage writes {name}, which every sample must have"
        for name in needed
        if name not in written
    )
    if mistakes:
        raise RecipeError(mistakes)
    return written
