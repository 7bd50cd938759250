"""Prepared pipelines: blocks of rows, each a pure function of (seed, split, block index), with sampling statistics."""

import hashlib
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from cnpgen.arrays import Array, Columns, Indices, Integers
from cnpgen.errors import RecipeError, UsageError
from cnpgen.kernels.library import Backend
from cnpgen.pipelines.acceptance import acceptance
from cnpgen.pipelines.pipeline import (
    Pipeline,
    listed_tasks,
    prepare_steps,
    steps_of,
    stored_fields,
    written_columns,
)
from cnpgen.pipelines.stages.draw_scenes import DrawScenes
from cnpgen.pipelines.stages.stage import CandidateBatch, load_context
from cnpgen.problems.constraints.constraint import BOUNDARY_TOLERANCES
from cnpgen.store.field import Field, Fields
from cnpgen.store.sampling_statistics import DensityMap, SamplingStatistics
from cnpgen.store.scene_table import SCENE_ID, SceneTable, concatenate_scenes

MIN_ACCEPTANCE = 1e-4  # accepted fraction below which a pipeline raises an error
# Candidates before the accepted fraction is checked.
MIN_CANDIDATES_BEFORE_ERROR = 100_000
DENSITY_CELLS = 24  # along each side of a density map
BOOKKEEPING = (SCENE_ID, "attempts", "sample_id")  # fields that no stage writes


@dataclass(frozen=True)
class Block:
    """Accepted rows in sampling order, and the statistics of all candidates up to the last row.

    Attributes:
        columns: Field name -> values, shape (width, rows); (1, rows) for scalars.
        sampling: Counts of candidates and rejections, and density maps.
        scenes: Scenes of the rows, whose IDs are those of the column ``scene_id``; None
            without scenes.
    """

    columns: Columns
    sampling: SamplingStatistics
    scenes: SceneTable | None = None


class PreparedPipeline:
    """Stages with loaded kernels; rows are stored and checked in the float type ``dtype``.

    Attributes:
        context: Problem, robot and kernels.
        fields: Fields of a row, in stored order.
        block_rows: Rows per block.
        tasks: Number of listed tasks, all in one block; None for an unlimited pipeline.
        families: Names of the families of scenes; empty without scenes.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        *,
        backend: Backend,
        cache_folder: Path,
        dtype: str = "float64",
    ) -> None:
        if dtype not in list(BOUNDARY_TOLERANCES):
            raise UsageError(
                f"must be {' or '.join(map(repr, BOUNDARY_TOLERANCES))}, got {dtype!r}",
                argument="dtype",
            )
        self.pipeline = pipeline
        self.tasks = listed_tasks(pipeline)
        self.block_rows = (
            min(stage.block_rows for stage in pipeline.stage)
            if self.tasks is None
            else self.tasks
        )
        self.context = load_context(pipeline.problem, backend, cache_folder, dtype)
        steps = steps_of(pipeline)
        drawn = [stage for stage in pipeline.stage if isinstance(stage, DrawScenes)]
        self.families = drawn[0].family_names if drawn else ()
        self.fields = stored_fields(steps, self.context)
        written = written_columns(pipeline.path, steps, self.context)
        self._stages = prepare_steps(steps, lambda stage: stage.prepare(self.context))
        self._accept = acceptance(self.context, written)

    def block(
        self,
        seed: int,
        split: str,
        index: int,
        *,
        first: int = 0,
        stop: int | None = None,
    ) -> Block:
        """Compute rows ``first`` to ``stop``, exclusive, of a block of a split.

        All rows by default.
        """
        (block,) = self.chunks(
            seed, split, index, [(first, self.block_rows if stop is None else stop)]
        )
        return block

    def chunks(
        self, seed: int, split: str, index: int, ranges: Sequence[tuple[int, int]]
    ) -> Iterator[Block]:
        """Compute several ranges of rows of one block, sampled only once, and yield each as soon as it is complete.

        The ranges (first, exclusive end) ascend without overlap. Raise RecipeError if
        too few candidates are accepted.
        """
        random = random_generator(seed, split, index)
        # A block is always sampled from its beginning, so that its rows do not depend
        # on the requested range.
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
        # Values are rounded before they are checked: the check is that of the stored
        # values.
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
        # The accepted fraction is not known yet.
        if tried == 0:
            return rows // 2
        if accepted == 0:
            return 2 * rows
        # Candidates for the missing rows at the accepted fraction so far.
        missing = (rows - accepted) * tried / accepted
        return int(np.clip(np.ceil(1.03 * missing) + rows // 128, rows // 16, 2 * rows))

    def complete_listed_tasks(self, seed: int) -> CandidateBatch:
        """Return all listed tasks; those without a solution are rejected."""
        assert self.tasks is not None
        return self._sample_batch(random_generator(seed, "", 0), self.tasks)

    def _check_listed_tasks(
        self, tried: int, accepted: int, rows: int, index: int
    ) -> None:
        """Raise UsageError if more rows are requested than listed tasks have solutions."""
        if self.tasks is not None and (tried or index):
            available = (
                f"{accepted} of its {self.tasks} tasks have a solution"
                if tried
                else f"it lists {self.tasks} tasks"
            )
            raise UsageError(
                f"{self.pipeline.name}: {available}, {index * self.block_rows + rows} rows are requested"
            )

    def _check_acceptance(
        self, candidates: CandidateBatch, accepted: int, tried: int
    ) -> None:
        """Raise RecipeError if the accepted fraction is below ``MIN_ACCEPTANCE``."""
        if tried >= MIN_CANDIDATES_BEFORE_ERROR and accepted < MIN_ACCEPTANCE * tried:
            counts = np.bincount(
                candidates.outcome, minlength=1 + len(candidates.reasons)
            )[1:]
            worst = sorted(
                zip(counts.tolist(), candidates.reasons, strict=True), reverse=True
            )[:3]
            reasons = ", ".join(
                f"{reason} ({count / candidates.size:.1%})"
                for count, reason in worst
                if count
            )
            text = f"{accepted} of {tried:,} candidates were accepted"
            text += f"; of the last {candidates.size:,}, rejected for {reasons}"
            raise RecipeError([f"{self.pipeline.path}: {text}"])


class BlockChunk:
    """Rows ``first`` to ``stop``, exclusive, of a block, collected batch by batch, with counts of all candidates."""

    def __init__(self, fields: Fields, first: int, stop: int) -> None:
        self.first = first
        self.stop = stop
        self._fields = [field for field in fields if field.name not in BOOKKEEPING]
        self._parts: list[Columns] = []
        self._scenes: list[SceneTable] = []
        # Candidates, and those since the last accepted one.
        self._tried = 0
        self._waiting = 0
        self._rejections: dict[str, int] = {}
        self._stages: dict[str, str] = {}
        self._maps = [field for field in fields if field.name.endswith("_xyz")]
        self._cells = {
            field.name: np.zeros((2, DENSITY_CELLS**2), np.int64)
            for field in self._maps
        }

    def take(self, candidates: CandidateBatch, accepted: int) -> bool:
        """Append the rows of a batch, after ``accepted`` rows of the block; return whether the chunk is complete.

        The batch may contain rows of the next chunk.
        """
        taken = candidates.alive[: self.stop - accepted]
        end = accepted + len(taken)
        if end < self.first:
            return False
        # Rows of the batch that belong to an earlier chunk.
        skip = min(max(self.first - accepted, 0), len(taken))
        # No later chunk counts the candidates after the last row.
        final = candidates.last and end == accepted + len(candidates.alive)
        attempts = self._count(
            candidates, taken, first=skip, last=end == self.stop and not final
        )
        if final:
            attempts[-1:] += self._waiting
        part = {
            field.name: candidates[field.name][:, skip : len(taken)]
            for field in self._fields
        }
        self._parts.append({**part, "attempts": attempts[None]})
        if candidates.scenes is not None:
            self._take_scenes(
                candidates.scenes.table,
                candidates.scene,
                slice(skip, len(taken)),
                accepted,
            )
        return end == self.stop

    def _take_scenes(
        self, table: SceneTable, scene: Integers, rows: slice, accepted: int
    ) -> None:
        """Append the scenes of some rows of a batch; IDs are rows of the block."""
        # Of the scene of each row.
        first_rows = accepted + np.searchsorted(scene, scene)
        ids, index = np.unique(first_rows[rows], return_index=True)
        self._parts[-1][SCENE_ID] = first_rows[rows][None]
        self._scenes.append(replace(table[scene[rows][index]], scene_ids=ids))

    def _count(
        self,
        candidates: CandidateBatch,
        taken: Indices,
        *,
        first: int,
        last: bool,
    ) -> Integers:
        """Count the candidates after the ``first`` rows, up to the last row or all.

        Return the candidates per row.
        """
        rows = taken[first:]
        # Candidates after the last row of an earlier chunk are those of this one.
        start = int(taken[first - 1]) + 1 if first else 0
        stop = int(taken[-1]) + 1 if last else candidates.size
        if first:
            self._waiting = 0
        outcomes = np.bincount(
            candidates.outcome[start:stop], minlength=1 + len(candidates.reasons)
        )
        for reason, number in zip(
            candidates.reasons, outcomes[1:].tolist(), strict=True
        ):
            self._rejections[reason] = self._rejections.get(reason, 0) + number
        self._stages.update(candidates.origins)
        self._tried += stop - start
        # Not those of scenes.
        self._maps = [field for field in self._maps if field.name in candidates.drawn]
        for field in self._maps:
            cells = _cells(candidates.drawn[field.name][:, start:stop], field)
            counts = (
                np.bincount(x, minlength=DENSITY_CELLS**2)
                for x in (cells, cells[rows - start])
            )
            self._cells[field.name] += np.stack(list(counts))
        # Candidates per accepted one; those of earlier batches count for the first.
        attempts = np.diff(rows, prepend=start - 1 - self._waiting).astype(np.int64)
        self._waiting = (
            stop - 1 - int(rows[-1]) if len(rows) else self._waiting + stop - start
        )
        return attempts

    def block(self, first_row: int) -> Block:
        """Return the rows of a complete chunk of a block whose first row has the index ``first_row`` in the split."""
        columns = {
            name: np.concatenate([part[name] for part in self._parts], axis=1)
            for name in self._parts[0]
        }
        columns["sample_id"] = (
            first_row + np.arange(self.first, self.stop, dtype=np.int64)[None]
        )
        shape = (2, DENSITY_CELLS, DENSITY_CELLS)
        maps = {
            field.name: DensityMap(
                *_extent(field), *self._cells[field.name].reshape(shape)
            )
            for field in self._maps
        }
        sampling = SamplingStatistics(
            tried=self._tried,
            accepted=self.stop - self.first,
            rejections=self._rejections,
            stages=self._stages,
            densities=maps,
        )
        if not self._scenes:
            return Block(columns, sampling)
        columns[SCENE_ID] = first_row + columns[SCENE_ID]
        scenes = concatenate_scenes(self._scenes)
        return Block(
            columns,
            sampling,
            replace(scenes, scene_ids=(first_row + scenes.scene_ids).astype(np.int64)),
        )


def _extent(field: Field) -> tuple[tuple[float, float], tuple[float, float]]:
    assert field.valid_min is not None
    assert field.valid_max is not None
    return (field.valid_min[0], field.valid_max[0]), (
        field.valid_min[1],
        field.valid_max[1],
    )


def _cells(position: Array, field: Field) -> Indices:
    """Return the index of the cell of each position, for positions of shape (3, n)."""
    index = np.zeros(position.shape[1], np.intp)
    for axis, (low, high) in enumerate(_extent(field)):
        # A range of one point has all positions in one cell.
        fraction = (position[axis] - low) / max(high - low, 1e-300)
        index = index * DENSITY_CELLS + np.clip(
            (fraction * DENSITY_CELLS).astype(np.intp), 0, DENSITY_CELLS - 1
        )
    return index


def random_generator(seed: int, split: str, index: int) -> np.random.Generator:
    """Return the generator of one block: SFC64 seeded by a SeedSequence of (seed.

    Sha256 of the split, block).
    """
    # The name of the split as words of a spawn key: splits and blocks have independent
    # generators.
    words = np.frombuffer(hashlib.sha256(split.encode()).digest(), "<u4").tolist()
    sequence = np.random.SeedSequence(seed, spawn_key=(*words, index))
    return np.random.Generator(np.random.SFC64(sequence))


def as_stored(values: Array, field: Field) -> Array:
    """Round values to float32 and back.

    Round towards the inside where rounding would violate a limit of the field.
    """
    rounded = values.astype(np.float32)
    for bound, inwards, violates in (
        (field.valid_min, np.inf, np.less),
        (field.valid_max, -np.inf, np.greater),
    ):
        if bound is not None:
            limit = np.array(bound)[:, None]
            stored = limit.astype(np.float32)
            # A bound that float32 rounds outwards is replaced by its next number
            # inwards.
            stored = np.where(
                violates(stored, limit),
                np.nextafter(stored, np.float32(inwards)),
                stored,
            )
            rounded = np.where(
                violates(rounded, limit) & ~violates(values, limit), stored, rounded
            )
    return rounded.astype(np.float64)
