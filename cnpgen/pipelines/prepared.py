"""A pipeline ready to run: blocks of rows, each a pure function of (seed, split, block index)."""

import hashlib
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cnpgen.errors import RecipeError, UsageError
from cnpgen.kernels.library import Backend
from cnpgen.pipelines.acceptance import acceptance
from cnpgen.pipelines.context import load_context
from cnpgen.pipelines.piece import Block, Piece
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.stage import Array, Round
from cnpgen.pipelines.steps import prepare_steps, steps_of, stored_fields, written_columns
from cnpgen.problems.constraints.constraint import EXACTNESS
from cnpgen.store.field import Field

HOPELESS = 1e-4  # acceptance below which a pipeline is given up, once it has had a fair chance
FAIR_CHANCE = 100_000  # draws


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
        tasks: How many draws there are at all, all in one block; None where they never end.

    Raises:
        RecipeError: The stages do not fit together, or to the problem.
    """

    def __init__(self, pipeline: Pipeline, *, backend: Backend, cache_folder: Path, dtype: str = "float64") -> None:
        if dtype not in list(EXACTNESS):
            raise UsageError(f"dtype must be {' or '.join(map(repr, EXACTNESS))}, got {dtype!r}")
        self.pipeline = pipeline
        self.tasks = listed_tasks(pipeline)
        self.block_rows = min(stage.block_rows for stage in pipeline.stage) if self.tasks is None else self.tasks
        self.context = load_context(pipeline.problem, backend, cache_folder, dtype)
        steps = steps_of(pipeline)
        self.fields = stored_fields(steps, self.context)
        written = written_columns(pipeline.path, steps, self.context)
        with self.context.kernels.compiling_together():
            self._stages = prepare_steps(steps, lambda stage: stage.prepare(self.context))
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
            self._check_left(tried, made, waiting[-1].stop, index)
            draws = self._round(random, self._round_size(made, tried))
            tried += draws.size
            while waiting and waiting[0].take(draws, made):
                yield waiting.popleft().block(index * self.block_rows)
            made += len(draws.alive)
            if waiting:
                self._check_hope(draws, made, tried)

    def _round(self, random: np.random.Generator, size: int) -> Round:
        draws = Round(size, last=self.tasks is not None)
        for label, work in self._stages:
            draws.stage = label
            work(draws, random)
        if self.context.dtype == "float32":
            for field in self.fields:
                if field.name in draws.columns:
                    draws[field.name] = as_stored(draws[field.name], field)
        draws.stage = "acceptance"
        self._accept(draws, random)
        return draws

    def _round_size(self, made: int, tried: int) -> int:
        """How many draws the next round of a block has: what its own acceptance so far says is missing, and some more.

        It depends on the block alone and not on how many of its rows are wanted.
        """
        rows = self.block_rows
        if self.tasks is not None:
            return self.tasks
        if tried == 0:
            return rows // 2
        if made == 0:
            return 2 * rows
        missing = (rows - made) * tried / made
        return int(np.clip(np.ceil(1.03 * missing) + rows // 128, rows // 16, 2 * rows))

    def answers(self, seed: int) -> Round:
        """Return all listed tasks, those without an answer rejected."""
        assert self.tasks is not None
        return self._round(random_generator(seed, "", 0), self.tasks)

    def _check_left(self, tried: int, made: int, wanted: int, index: int) -> None:
        """Refuse to make more rows than there are answers to listed tasks."""
        if self.tasks is not None and (tried or index):
            found = f"{made} of its {self.tasks} tasks have an answer" if tried else f"it lists {self.tasks} tasks"
            raise UsageError(f"{self.pipeline.name}: {found}, {index * self.block_rows + wanted} rows are asked for")

    def _check_hope(self, draws: Round, made: int, tried: int) -> None:
        if tried >= FAIR_CHANCE and made < HOPELESS * tried:
            counts = np.bincount(draws.fate, minlength=1 + len(draws.reasons))[1:]
            worst = sorted(zip(counts.tolist(), draws.reasons, strict=True), reverse=True)[:3]
            reasons = ", ".join(f"{reason} ({count / draws.size:.1%})" for count, reason in worst if count)
            text = f"{made} of {tried:,} draws were accepted; of the last {draws.size:,}, rejected for {reasons}"
            raise RecipeError([f"{self.pipeline.path}: {text}"])


def listed_tasks(pipeline: Pipeline) -> int | None:
    """Return how many draws there are where a stage lists them; None where none does.

    Raises:
        RecipeError: More than one stage lists them.
    """
    listed = [stage.tasks for stage in pipeline.stage if stage.tasks is not None]
    if len(listed) > 1:
        raise RecipeError([f"{pipeline.path}: {len(listed)} stages list positions, expected one at most"])
    return listed[0] if listed else None


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
