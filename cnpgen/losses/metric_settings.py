"""The settings of a metric and the suggested first weights."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.problems.problem import Problem
from cnpgen.schema.argument_types import check_fields, checked_arguments
from cnpgen.schema.arguments import numbers

Kind = Literal["fixed", "ramped", "learned"]
Average = Literal["mean", "median", "trimmed"]

WEIGHT_FACTOR = 100.0  # of the weight in the problem file, for constraint classes without ``training_weight``


@dataclass(frozen=True, kw_only=True)
class MetricSettings:
    """The dependence of weights on the progress of a run (0 at its start, 1 at its end) and on the losses of plans.

    Attributes:
        kind: "fixed": the first weights; "ramped": growing weights; "learned": the published rule.
        growth: Factor by which ramped weights grow, and budgets of the learned metric shrink, during the ramp.
        ramp: Progress at the start and the end of the ramp, which is geometric.
        gamma: Step size of the learned metric.
        every: Interval of its steps: "epoch", as published, or "batch".
        largest_log: Bound on ``|log(mean L_i / C_i)|`` in a step, from the authors' implementation.
        lowest: Lower bound of a learned weight; without it the weight of a term without violations decreases forever.
        highest: Upper bound of a learned weight.
        budget_factor: Factor of all budgets of the learned metric.
        average: Average over the plans of a batch: "mean" as published, "median" or "trimmed".
        frozen: Progress after which a learned metric is constant.
    """

    kind: Kind = "ramped"
    growth: float = 30.0
    ramp: tuple[float, float] = (0.1, 0.95)
    gamma: float = 1e-2
    every: Literal["epoch", "batch"] = "epoch"
    largest_log: float = 10.0
    lowest: float = 0.0
    highest: float = math.inf
    budget_factor: float = 1.0
    average: Average = "mean"
    frozen: float = math.inf

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("growth", "gamma", "largest_log", "highest", "budget_factor"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} of a metric must be above 0, got {getattr(self, name)}", concerns=name)
        if not self.lowest <= self.highest:
            raise UsageError(f"must be at most highest = {self.highest}, got {self.lowest}", argument="lowest")
        ramp = numbers("ramp", self.ramp)
        if ramp.shape != (2,) or not 0 <= ramp[0] < ramp[1]:
            raise UsageError(
                f"the ramp of a metric must begin at 0 or later and before it ends, got {self.ramp!r:.99}",
                concerns="ramp",
            )

    @checked_arguments
    def grown(self, progress: float) -> float:
        """Return the factor of the ramp."""
        begin, end = self.ramp
        return float(self.growth ** min(max((progress - begin) / (end - begin), 0.0), 1.0))


# The paper's rule with the authors' bound of the logarithm; the paper's budgets belong to PlanLoss(..., form="paper").
PUBLISHED = MetricSettings(kind="learned", growth=1.0)
# The same rule for short runs: steps per batch, decreasing budgets, bounds, and a mean that is robust to outliers.
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


@checked_arguments
def suggested_weights(problem: Problem, weights0: ArrayLike) -> NDArray[np.float64]:
    """Return first weights: ``training_weight`` of the constraint classes, else 100 times those of the problem file.

    With the weights of the shipped classes, planners of the shipped problems became valid within minutes. They are the
    base of the fixed and ramped metrics.

    Args:
        problem: The problem.
        weights0: Weights from the problem file, ``PlanLoss.weights0``, shape (m,).
    """
    weights = numbers("weights0", weights0)
    if weights.shape != (len(problem.constraint),):
        expected = f"({len(problem.constraint)},), one weight per constraint"
        raise UsageError(f"must have shape {expected}, got {weights.shape}", argument="weights0")
    pairs = zip(problem.constraint, weights.tolist(), strict=True)
    suggested = [
        WEIGHT_FACTOR * weight if constraint.training_weight is None else constraint.training_weight
        for constraint, weight in pairs
    ]
    return np.array(suggested)
