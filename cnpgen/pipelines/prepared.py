"""Prepared pipelines: blocks of rows, each a pure function of (seed, split, block index)."""

import hashlib
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from cnpgen.errors import RecipeError, UsageError
from cnpgen.kernels.library import Backend
from cnpgen.pipelines.acceptance import acceptance
from cnpgen.pipelines.block_chunk import Block, BlockChunk
from cnpgen.pipelines.context import load_context
from cnpgen.pipelines.pipeline import Pipeline, listed_tasks
from cnpgen.pipelines.stages.stage import Array, CandidateBatch
from cnpgen.pipelines.steps import prepare_steps, steps_of, stored_fields, written_columns
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES
from cnpgen.store.field import Field

MIN_ACCEPTANCE = 1e-4  # accepted fraction below which a pipeline raises an error
MIN_CANDIDATES_BEFORE_ERROR = 100_000  # candidates before the accepted fraction is checked


class PreparedPipeline:
    """Stages with loaded kernels.

    Args:
        pipeline: Pipeline to prepare.
        backend: Backend of the kernels.
        cache_folder: Folder of compiled kernels.
        dtype: Float type in which rows are stored and checked, "float64" or "float32".

    Attributes:
        context: Problem, robot and kernels.
        fields: Fields of a row, in stored order.
        block_rows: Rows per block.
        tasks: Number of listed tasks, all in one block; None for an unlimited pipeline.

    Raises:
        RecipeError: The stages are inconsistent with each other or with the problem.
    """

    def __init__(self, pipeline: Pipeline, *, backend: Backend, cache_folder: Path, dtype: str = "float64") -> None:
        if dtype not in list(BOUNDARY_TOLERANCES):
            raise UsageError(f"must be {' or '.join(map(repr, BOUNDARY_TOLERANCES))}, got {dtype!r}", argument="dtype")
        self.pipeline = pipeline
        self.tasks = listed_tasks(pipeline)
        self.block_rows = min(stage.block_rows for stage in pipeline.stage) if self.tasks is None else self.tasks
        self.context = load_context(pipeline.problem, backend, cache_folder, dtype)
        steps = steps_of(pipeline)
        self.fields = stored_fields(steps, self.context)
        written = written_columns(pipeline.path, steps, self.context)
        with self.context.kernels.compile_in_parallel():
            self._stages = prepare_steps(steps, lambda stage: stage.prepare(self.context))
            self._accept = acceptance(self.context, written)

    def block(self, seed: int, split: str, index: int, *, first: int = 0, stop: int | None = None) -> Block:
        """Compute rows ``first`` to ``stop`` of one block.

        Args:
            seed: Root seed of the dataset.
            split: Name of the split.
            index: Index of the block in the split.
            first: First row.
            stop: End of the rows, exclusive; ``block_rows`` by default and at most.

        Raises:
            RecipeError: The accepted fraction of the candidates is below ``MIN_ACCEPTANCE``.
        """
        (block,) = self.chunks(seed, split, index, [(first, self.block_rows if stop is None else stop)])
        return block

    def chunks(self, seed: int, split: str, index: int, ranges: Sequence[tuple[int, int]]) -> Iterator[Block]:
        """Compute several ranges of rows of one block and sample the block only once.

        Args:
            seed: Root seed of the dataset.
            split: Name of the split.
            index: Index of the block in the split.
            ranges: Row range (first, exclusive end) of every chunk, ascending, without overlap.

        Yields:
            The rows of every chunk, as soon as they are complete.

        Raises:
            RecipeError: The accepted fraction of the candidates is below ``MIN_ACCEPTANCE``.
        """
        random = random_generator(seed, split, index)
        waiting = deque(BlockChunk(self.fields, first, stop) for first, stop in ranges)
        accepted = tried = 0
        while waiting:
            self._check_listed_tasks(tried, accepted, waiting[-1].stop, index)
            candidates = self._sample_batch(random, self._batch_size(accepted, tried))
            tried += candidates.size
            while waiting and waiting[0].take(candidates, accepted):
                yield waiting.popleft().block(index * self.block_rows)
            accepted += len(candidates.alive)
            if waiting:
                self._check_acceptance(candidates, accepted, tried)

    def _sample_batch(self, random: np.random.Generator, size: int) -> CandidateBatch:
        candidates = CandidateBatch(size, last=self.tasks is not None)
        for label, run_stage in self._stages:
            candidates.stage = label
            run_stage(candidates, random)
        if self.context.dtype == "float32":
            for field in self.fields:
                if field.name in candidates.columns:
                    candidates[field.name] = as_stored(candidates[field.name], field)
        candidates.stage = "acceptance"
        self._accept(candidates, random)
        return candidates

    def _batch_size(self, accepted: int, tried: int) -> int:
        """Return the size of the next batch of a block: the missing rows over the accepted fraction, plus a reserve.

        It depends on the block alone, not on the requested range of its rows.
        """
        rows = self.block_rows
        if self.tasks is not None:
            return self.tasks
        if tried == 0:
            return rows // 2
        if accepted == 0:
            return 2 * rows
        missing = (rows - accepted) * tried / accepted
        return int(np.clip(np.ceil(1.03 * missing) + rows // 128, rows // 16, 2 * rows))

    def complete_listed_tasks(self, seed: int) -> CandidateBatch:
        """Return all listed tasks; those without a solution are rejected."""
        assert self.tasks is not None
        return self._sample_batch(random_generator(seed, "", 0), self.tasks)

    def _check_listed_tasks(self, tried: int, accepted: int, rows: int, index: int) -> None:
        """Raise UsageError if more rows are requested than listed tasks have solutions."""
        if self.tasks is not None and (tried or index):
            available = (
                f"{accepted} of its {self.tasks} tasks have a solution" if tried else f"it lists {self.tasks} tasks"
            )
            raise UsageError(f"{self.pipeline.name}: {available}, {index * self.block_rows + rows} rows are requested")

    def _check_acceptance(self, candidates: CandidateBatch, accepted: int, tried: int) -> None:
        """Raise RecipeError if the accepted fraction is below ``MIN_ACCEPTANCE``."""
        if tried >= MIN_CANDIDATES_BEFORE_ERROR and accepted < MIN_ACCEPTANCE * tried:
            counts = np.bincount(candidates.outcome, minlength=1 + len(candidates.reasons))[1:]
            worst = sorted(zip(counts.tolist(), candidates.reasons, strict=True), reverse=True)[:3]
            reasons = ", ".join(f"{reason} ({count / candidates.size:.1%})" for count, reason in worst if count)
            text = f"{accepted} of {tried:,} candidates were accepted"
            text += f"; of the last {candidates.size:,}, rejected for {reasons}"
            raise RecipeError([f"{self.pipeline.path}: {text}"])


def random_generator(seed: int, split: str, index: int) -> np.random.Generator:
    """Return the generator of one block: SFC64 seeded by a SeedSequence of (seed; sha256 of the split, block)."""
    words = np.frombuffer(hashlib.sha256(split.encode()).digest(), "<u4").tolist()
    sequence = np.random.SeedSequence(seed, spawn_key=(*words, index))
    return np.random.Generator(np.random.SFC64(sequence))


def as_stored(values: Array, field: Field) -> Array:
    """Round values to float32 and back; round towards the inside where rounding would violate a limit of the field."""
    rounded = values.astype(np.float32)
    for bound, inwards, violates in ((field.valid_min, np.inf, np.less), (field.valid_max, -np.inf, np.greater)):
        if bound is not None:
            limit = np.array(bound)[:, None]
            stored = limit.astype(np.float32)
            stored = np.where(violates(stored, limit), np.nextafter(stored, np.float32(inwards)), stored)
            rounded = np.where(violates(rounded, limit) & ~violates(values, limit), stored, rounded)
    return rounded.astype(np.float64)
