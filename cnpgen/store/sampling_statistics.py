"""Sampling statistics of a shard: numbers of candidates, rejections by reason, and density maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from cnpgen.arrays import Integers
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import DatasetError
from cnpgen.store.files.document_structure import ANY_KEY, WHOLE, structure_of
from cnpgen.store.files.documents import plain


@dataclass(frozen=True, eq=False)
class DensityMap:
    """Candidates and accepted candidates on a grid in a plane.

    Attributes:
        x: Extent along the first axis [m].
        y: Extent along the second axis [m].
        candidates: Candidates per cell, shape (nx, ny), first index along x.
        accepted: Accepted candidates per cell, shape (nx, ny).
    """

    x: tuple[float, float]
    y: tuple[float, float]
    candidates: Integers
    accepted: Integers

    def merge(self, other: DensityMap) -> DensityMap:
        """Add the counts of two maps of the same grid.

        Raises:
            DatasetError: The grids differ.
        """
        if (self.x, self.y, self.candidates.shape) != (
            other.x,
            other.y,
            other.candidates.shape,
        ):
            raise DatasetError("density maps with different grids cannot be merged")
        return DensityMap(
            self.x,
            self.y,
            self.candidates + other.candidates,
            self.accepted + other.accepted,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class SamplingStatistics:
    """Numbers of accepted and rejected candidates: ``tried == accepted + sum(rejections)``.

    Attributes:
        tried: Number of candidates.
        accepted: Number of candidates that passed every stage.
        rejections: Reason -> number of rejected candidates, in pipeline order.
        stages: Reason -> stage of the pipeline that rejects for this reason.
        densities: Name -> density map.
        verification: Constraint -> worst violation among the verified rows, in the unit
            of the constraint.
    """

    tried: int
    accepted: int
    rejections: Mapping[str, int] = field(default_factory=dict)
    stages: Mapping[str, str] = field(default_factory=dict)
    densities: Mapping[str, DensityMap] = field(default_factory=dict)
    verification: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rejected = sum(self.rejections.values())
        if self.tried != self.accepted + rejected:
            raise DatasetError(
                f"{self.tried} candidates, but {self.accepted} accepted and {rejected} rejected ones"
            )
        for name, worst in self.verification.items():
            if not math.isfinite(worst):
                raise DatasetError(
                    f"the worst violation of {name!r} must be a finite number, got {worst}"
                )

    def merge(self, other: SamplingStatistics) -> SamplingStatistics:
        """Return the statistics of both sets of candidates: the sums of counts and the maxima of violations."""
        reasons = _merged_order(list(self.rejections), list(other.rejections))
        densities = dict(self.densities)
        for name, density in other.densities.items():
            densities[name] = (
                densities[name].merge(density) if name in densities else density
            )
        worst = dict(self.verification)
        for name, value in other.verification.items():
            worst[name] = max(worst.get(name, value), value)
        return SamplingStatistics(
            tried=self.tried + other.tried,
            accepted=self.accepted + other.accepted,
            rejections={
                name: self.rejections.get(name, 0) + other.rejections.get(name, 0)
                for name in reasons
            },
            stages={**self.stages, **other.stages},
            densities=densities,
            verification=worst,
        )

    def yield_json(self) -> JsonObject:
        """Return tried, accepted and rejections as a JSON-able dict."""
        return {
            "tried": self.tried,
            "accepted": self.accepted,
            "rejections": dict(self.rejections),
        }

    def to_json(self) -> JsonObject:
        """Return everything as a JSON-able dict."""
        return {
            **self.yield_json(),
            "stages": dict(self.stages),
            "verification": dict(self.verification),
            "densities": densities_to_json(self.densities),
        }


def _merged_order(first: Sequence[str], second: Sequence[str]) -> list[str]:
    """Merge two orders of reasons.

    A reason of the second one only keeps its predecessor.
    """
    merged = list(first)
    for position, reason in enumerate(second):
        if reason not in merged:
            # A reason that is new follows its predecessor in the other order, so that
            # the order of stages is kept.
            merged.insert(
                merged.index(second[position - 1]) + 1 if position else 0, reason
            )
    return merged


def densities_to_json(densities: Mapping[str, DensityMap]) -> JsonObject:
    """Return density maps as a JSON-able dict."""
    return {name: plain(vars(item)) for name, item in densities.items()}


_COUNTS = {"candidates": [[WHOLE]], "accepted": [[WHOLE]]}
DENSITIES_STRUCTURE = {ANY_KEY: structure_of(DensityMap) | _COUNTS}
SAMPLING_STRUCTURE = {
    **structure_of(SamplingStatistics),
    "densities": DENSITIES_STRUCTURE,
}


def _density(content: JsonMapping) -> DensityMap:
    (x_low, x_high), (y_low, y_high) = content["x"], content["y"]
    candidates, accepted = (
        np.array(content[key], np.int64) for key in ("candidates", "accepted")
    )
    if candidates.ndim != 2 or candidates.shape != accepted.shape:
        shapes = f"{candidates.shape} and {accepted.shape}"
        raise ValueError(
            f"a density map must have two grids of the same shape, got {shapes}"
        )
    return DensityMap(
        (float(x_low), float(x_high)),
        (float(y_low), float(y_high)),
        candidates,
        accepted,
    )


def sampling_from_json(content: JsonMapping) -> SamplingStatistics:
    """Rebuild sampling statistics from a dict with the structure ``SAMPLING_STRUCTURE``."""
    return SamplingStatistics(
        **{
            name: content[name]
            for name in ("tried", "accepted", "rejections", "stages")
        },
        densities={name: _density(item) for name, item in content["densities"].items()},
        verification={
            name: float(value) for name, value in content["verification"].items()
        },
    )


def merge_sampling(parts: Sequence[SamplingStatistics]) -> SamplingStatistics:
    """Merge sampling statistics, in order; without any, all counts are 0."""
    return reduce(
        SamplingStatistics.merge, parts, SamplingStatistics(tried=0, accepted=0)
    )
