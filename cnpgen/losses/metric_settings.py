"""How the weights of a metric change in the course of a run, and which ones to begin with."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError, nearest

Kind = Literal["fixed", "ramped", "learned"]
KINDS: tuple[Kind, ...] = ("fixed", "ramped", "learned")
Average = Literal["mean", "median", "trimmed"]
AVERAGES: tuple[Average, ...] = ("mean", "median", "trimmed")

# Weights that made planners of the shipped problems valid within minutes; the base of the fixed and ramped metrics.
# Other manifolds of the tip have those of the shipped ones: of its place the table's, of an axis that of 'vertical'. A
# pose has one weight for both, the larger: its one tolerance is for millimetres, too.
SUGGESTED = {
    "joint-position": 4000.0, "joint-velocity": 100.0, "joint-acceleration": 5.0, "joint-torque": 1.5,
    "joint-jerk": 0.01,
    "table": 1e4, "plane": 1e4, "line": 1e4, "pose": 1e4, "vertical": 300.0, "axis": 300.0,
    "robot-clearance": 3000.0, "object-contact": 3e4,
}  # fmt: skip
PLUGGED_IN = 100.0  # of other kinds, times the weight in the problem file


@dataclass(frozen=True, kw_only=True)
class MetricSettings:
    """How weights follow from the progress of a run (0 at its start, 1 at its end) and from what plans cost.

    Attributes:
        kind: "fixed": the first weights; "ramped": they grow; "learned": the published rule.
        growth: By which factor ramped weights grow, and budgets of the learned metric shrink, during the ramp.
        ramp: Progress at which the ramp begins and ends; it is geometric.
        gamma: Step of the learned metric.
        every: Whether it takes its step after every "epoch", as published, or "batch".
        largest_log: Bound on ``|log(mean L_i / C_i)|`` in a step, from the authors' implementation.
        lowest: Lower bound of a learned weight; a term that is never violated falls without end otherwise.
        highest: Upper bound of a learned weight.
        average: How the plans of a batch are averaged: "mean" as published, "median" or "trimmed".
        frozen: Progress from which a learned metric stays as it is.
    """

    kind: Kind = "ramped"
    growth: float = 30.0
    ramp: tuple[float, float] = (0.1, 0.95)
    gamma: float = 1e-2
    every: Literal["epoch", "batch"] = "epoch"
    largest_log: float = 10.0
    lowest: float = 0.0
    highest: float = math.inf
    average: Average = "mean"
    frozen: float = math.inf

    def __post_init__(self) -> None:
        for name, known in (("kind", KINDS), ("every", ("epoch", "batch")), ("average", AVERAGES)):
            value = getattr(self, name)
            if value not in known:
                raise UsageError(
                    f"{name} of a metric must be one of {', '.join(known)}, got {value!r}{nearest(value, known)}"
                )
        for name in ("growth", "gamma", "largest_log", "highest"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} of a metric must be above 0, got {getattr(self, name)}")
        if not self.lowest <= self.highest:
            raise UsageError(f"lowest must be at most highest = {self.highest}, got {self.lowest}")
        if not 0 <= self.ramp[0] < self.ramp[1]:
            raise UsageError(f"the ramp of a metric must begin at 0 or later and before it ends, got {self.ramp}")

    def grown(self, progress: float) -> float:
        """Return by which factor the ramp has grown."""
        begin, end = self.ramp
        return float(self.growth ** min(max((progress - begin) / (end - begin), 0.0), 1.0))


# The paper's rule with the authors' clip; the paper's budgets are those of PlanLoss(..., form="paper").
PUBLISHED = MetricSettings(kind="learned", growth=1.0)
# The same rule for short runs: steps per batch, budgets that shrink, bounds, a mean that a few plans cannot hold up.
BOUNDED = MetricSettings(
    kind="learned",
    growth=400.0,
    ramp=(0.1, 0.6),
    gamma=1e-3,
    every="batch",
    lowest=1e-4,
    highest=1e6,
    average="trimmed",
    frozen=0.67,
)


def suggested_weights(names: Sequence[str], weights0: ArrayLike) -> NDArray[np.float64]:
    """Return weights to begin with: those that work for the known kinds, 100 times the problem file's for others.

    Args:
        names: ``PlanLoss.terms``.
        weights0: ``PlanLoss.weights0``.
    """
    given = np.asarray(weights0, float).tolist()
    kinds = [re.sub(r"-\d+$", "", name) for name in names[1:]]
    return np.array([SUGGESTED.get(kind, PLUGGED_IN * first) for kind, first in zip(kinds, given, strict=True)])
