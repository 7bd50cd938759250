"""Options of the generation of a dataset beside its recipe, size and folder."""

import operator
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cnpgen.errors import UsageError
from cnpgen.schema.argument_types import check_fields

# Called with ("checking" or "making", folder, rows, existing rows).
Begin = Callable[[str, Path, int, int], None]


@dataclass(frozen=True)
class GenerationOptions:
    """Options of ``make_dataset``.

    Attributes:
        engine: "loky" for processes of this machine; "dask" or "ray" for a cluster
            whose workers share the folder. By default loky, or the backend of
            ``joblib.parallel_config``.
        address: Address of the cluster's scheduler or head; by default a temporary
            cluster on this machine.
        dtype: Float type in which rows are stored and validated, "float64" or
            "float32".
        backend: "compiled" or "numpy"; default the fastest working one.
        model: Planner for the initial guesses of certification, which takes half the
            time; by default no initial guess. Plans are judged in the same way; they
            differ as local optima from different initial guesses differ.
        part: ``(k, m)``: generate only the k-th of m parts of the shards, counted from
            0, for arrays of batch jobs. The call that completes the shards finishes the
            dataset.
        begin: Called with ("checking", folder, existing rows, 0) before existing rows
            are compared, and with ("making", folder, rows of this call, existing rows
            of them) before rows are generated.

    Raises:
        UsageError: A value is invalid.
    """

    engine: str | None = None
    address: str | None = None
    dtype: str = "float64"
    backend: str | None = None
    model: str | Path | None = None
    part: tuple[int, int] | None = None
    begin: Begin | None = None

    def __post_init__(self) -> None:
        if self.part is not None:
            object.__setattr__(self, "part", _checked_part(self.part))
        check_fields(self)


def _checked_part(part: tuple[int, int]) -> tuple[int, int]:
    """Return (k, m) after a check."""
    try:
        k, m = map(operator.index, part)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"must be two integers (K, M) with 0 <= K < M, got {part!r}",
            argument="part",
        ) from error
    if not 0 <= k < m:
        raise UsageError(f"must be K/M with 0 <= K < M, got {k}/{m}", argument="part")
    return k, m
