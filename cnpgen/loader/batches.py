"""The batches of a split, epoch by epoch, from any row on."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cnpgen.errors import UsageError
from cnpgen.loader.batch import Batch
from cnpgen.loader.columns import tail
from cnpgen.loader.cut import Cut
from cnpgen.loader.form import Form
from cnpgen.loader.kept import Kept, make_kept
from cnpgen.loader.order import Order
from cnpgen.loader.position import Position, position_from_json, position_to_json
from cnpgen.loader.shards import SplitShards
from cnpgen.loader.windows import Windows
from cnpgen.schema.arguments import integer


class Batches:
    """Every ``for`` over it gives the rest of an epoch; after its last batch the next epoch begins.

    The order is a function of seed, epoch and shards alone. A split that takes at most 256 MiB is kept in memory once
    its rows were read; of a larger one, two windows are. Can be forked, and pickled (without rows).

    Args:
        source: Where rows come from.
        form: What is wanted of them.
        cut: How they are dealt out.
        position: Where to begin.

    Attributes:
        times_set: How often the position was set since, by ``epoch`` or ``load_state``.
        taken_elsewhere: Of whatever hands batches to other processes: whether those took some since the position was
            last set, which is not seen here. ``state()`` asks.

    Raises:
        UsageError: There are fewer rows than one batch needs, or in the last batch than there are ranks.
    """

    def __init__(self, source: SplitShards, form: Form, cut: Cut, position: Position) -> None:
        if cut.drop_last and cut.batch_size > source.rows:
            raise UsageError(
                f"batch_size {cut.batch_size} is more than the {source.rows} rows of split {source.split!r};"
                " drop_last=False gives them as one batch"
            )
        cut.check_ranks(source.rows, first=position.row)
        self._source, self._form, self._cut, self._position = source, form, cut, position
        self._kept: Kept | None = None
        self.times_set = 0
        self.taken_elsewhere: list[Callable[[], bool]] = []

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_kept": None, "taken_elsewhere": []}

    def __repr__(self) -> str:
        source, position = self._source, self._position
        where = f"seed {position.seed}, epoch {position.epoch}, row {position.row:,}"
        rows = f"{self._cut.batch_size} of the {source.rows:,} rows of split {source.split!r}"
        return f"<batches of {rows}, at {where}: {self._form.layout.summary}>"

    @property
    def epoch(self) -> int:
        """Number of the epoch that the next batch is of; may be set, to begin another one."""
        return self._position.epoch

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        self._position = replace(self._position, epoch=integer("epoch", epoch, least=0), row=0)
        self.times_set += 1

    @property
    def signature(self) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Field name -> shape of its value in one row, and its type."""
        integer_type, form = np.dtype(np.int64), self._form
        return {
            field.name: (tail(field), form.dtype if field.name in form.layout.slices else integer_type)
            for field in form.layout.fields
        }

    def __len__(self) -> int:
        """Return the number of batches in a whole epoch."""
        return self._cut.count(self._source.rows)

    def __iter__(self) -> Iterator[Batch]:
        """Give the batches from here to the end of the epoch; with the last one it stands at the next epoch.

        Raises:
            DatasetError: A shard is missing or damaged.
            UsageError: Something else moved the position between two batches.
        """
        source, cut = self._source, self._cut
        begin = position = self._position = self._forward(self._position)
        windows, end = self._windows(begin), cut.end(source.rows, first=begin.row)
        row = begin.row
        while (first := row + cut.worker * cut.batch_size) < end:
            batch = windows.batch(first, min(first + cut.batch_size, end), rank=cut.rank, world=cut.world)
            row = min(row + cut.workers * cut.batch_size, end)
            self._position = position = self._forward(Position(begin.seed, begin.shuffle, begin.epoch, row))
            yield batch
            if self._position is not position:
                raise UsageError(
                    "batches were taken by another loop, or load_state was called, within a loop over the same batches"
                )

    def _windows(self, begin: Position) -> Windows:
        """Prepare to read an epoch."""
        rows = tuple(shard.rows for shard in self._source.shards)
        order = Order(self._source.split, rows, begin.seed, begin.epoch, begin.shuffle)
        self._kept = self._kept or make_kept(self._source, self._form)
        return Windows(self._source, self._form, order, self._kept)

    def _forward(self, position: Position) -> Position:
        """Go on to the next epoch from where no batch is left of this one."""
        left = self._cut.end(self._source.rows, first=position.row) > position.row
        return position if left or not position.row else replace(position, epoch=position.epoch + 1, row=0)

    def state(self, *, epoch: int | None = None, batch: int | None = None) -> dict[str, Any]:
        """Say where it is, as a small JSON-able dict, the same on every rank.

        By default that is after the last batch handed out. Where something takes batches ahead of their use (workers,
        a prefetch), the user alone knows how many were used:

        Args:
            epoch: The epoch; this one by default.
            batch: How many batches of that epoch were used.

        Raises:
            UsageError: The epoch has not so many batches; or workers took batches, and it is not said which were used.
        """
        position = self._position
        if epoch is not None or batch is not None:
            used = integer("batch", batch or 0, least=0)
            if used > len(self):
                raise UsageError(f"an epoch has {len(self)} batches, {used} cannot have been used")
            row = min(used * self._cut.batch_size, self._source.rows)
            epoch = position.epoch if epoch is None else integer("epoch", epoch, least=0)
            position = self._forward(replace(position, epoch=epoch, row=row))
        elif any(taken() for taken in self.taken_elsewhere):
            raise UsageError(
                "the workers of a DataLoader took these batches, so that it is not known here how many were used: say"
                " it with state(epoch=..., batch=...), or leave num_workers at 0"
            )
        return position_to_json(position, self._source)

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go to where ``state()`` was called: the next loop begins with the batch after it and reads none before.

        The state brings its seed, epoch and shuffling along. Batch size, ranks, fields and form are this object's own;
        a state counts rows, so that it may be loaded with another batch size or number of ranks.

        Raises:
            UsageError: This is not the state of a loader, or from there on the last batch has fewer rows than ranks.
            DatasetError: It is of another dataset or split.
        """
        position = self._forward(position_from_json(state, self._source))
        self._cut.check_ranks(self._source.rows, first=position.row)
        self._position = position
        self.times_set += 1

    def for_worker(self, worker: int, workers: int, *, epoch: int | None = None) -> "Batches":
        """Return the part of one of several workers, which take the batches from here on, or of an epoch, in turn."""
        cut = replace(self._cut, worker=worker, workers=workers)
        position = self._position if epoch is None else replace(self._position, epoch=epoch, row=0)
        return Batches(self._source, self._form, cut, position)
