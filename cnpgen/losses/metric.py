"""The metric of the constraint manifold: the weight e^alpha of every term (paper, section on loss function learning).

The published metric is learned: after every epoch each alpha takes a step toward the
value at which its term equals its budget, ``alpha += gamma log(mean L_i / C_i)``. This
is slow in short runs, and it winds up if budgets cannot be met. The default is
therefore a metric whose weights grow with the progress of a run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.problems.problem import Problem
from cnpgen.schema.argument_types import check_fields, checked_arguments
from cnpgen.schema.arguments import numbers

Kind = Literal["fixed", "ramped", "learned"]
Average = Literal["mean", "median", "trimmed"]

# Of the weight in the problem file, for constraint classes without ``training_weight``.
WEIGHT_FACTOR = 100.0
# Of the plans, those with the largest losses, excluded from a trimmed mean.
TRIMMED_FRACTION = 0.1


@dataclass(frozen=True, kw_only=True)
class MetricSettings:
    """The dependence of weights on the progress of a run (0 at its start, 1 at its end) and on the losses of plans.

    Attributes:
        kind: "fixed": the first weights; "ramped": growing weights; "learned": the
            published rule.
        growth: Factor by which ramped weights grow, and budgets of the learned metric
            shrink, during the ramp.
        ramp: Progress at the start and the end of the ramp, which is geometric.
        gamma: Step size of the learned metric.
        every: Interval of its steps: "epoch", as published, or "batch".
        largest_log: Bound on ``|log(mean L_i / C_i)|`` in a step, from the authors'
            implementation.
        lowest: Lower bound of a learned weight; without it the weight of a term without
            violations decreases forever.
        highest: Upper bound of a learned weight.
        budget_factor: Factor of all budgets of the learned metric.
        average: Average over the plans of a batch: "mean" as published, "median" or
            "trimmed".
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
                raise UsageError(
                    f"{name} of a metric must be above 0, got {getattr(self, name)}",
                    concerns=name,
                )
        if not self.lowest <= self.highest:
            raise UsageError(
                f"must be at most highest = {self.highest}, got {self.lowest}",
                argument="lowest",
            )
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
        # Geometric between the two ends of the ramp, constant before and after it.
        return float(
            self.growth ** min(max((progress - begin) / (end - begin), 0.0), 1.0)
        )


# The paper's rule with the authors' bound of the logarithm; the paper's budgets belong
# to PlanLoss(..., form="paper").
PUBLISHED = MetricSettings(kind="learned", growth=1.0)
# The same rule for short runs: steps per batch, decreasing budgets, bounds, and a mean
# that is robust to outliers.
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


def alpha_step(
    alpha: ArrayLike,
    losses: ArrayLike,
    budgets: ArrayLike,
    *,
    gamma: float,
    largest_log: float = 10.0,
) -> Array:
    """Take one step of the metric, ``alpha_i + gamma log(L_i / C_i)`` (paper, update rule of alpha), shape (m,).

    ``alpha`` are the logarithms of the weights, ``losses`` the mean of every term, and
    ``gamma`` is the step size. The logarithm is at most ``largest_log`` in absolute
    value. A mean that is not finite, or a budget (the paper's C-bar^2) of 0, leaves its
    weight unchanged.
    """
    before, mean, budget = (np.asarray(x, float) for x in (alpha, losses, budgets))
    # log(L / C) as a difference of logarithms: 0 where nothing is learned, -inf for a
    # term without violations, which the bound makes finite.
    learned = (budget > 0) & np.isfinite(mean)
    with np.errstate(divide="ignore"):
        logs = np.log(mean, where=learned, out=np.zeros_like(mean)) - np.log(
            budget, where=learned, out=np.zeros_like(mean)
        )
    return np.asarray(before + gamma * np.clip(logs, -largest_log, largest_log))


def average_loss(terms: ArrayLike, average: Average) -> Array:
    """Average every term of the losses of N plans, shape (N, m), over valid plans, shape (m,); nan without any."""
    values = np.asarray(terms, float)
    # Invalid plans have losses of nan and take no part.
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) == 0:
        return np.full(values.shape[1], np.nan)
    if average == "median":
        return np.asarray(np.median(values, axis=0))
    if average == "trimmed":
        # The largest losses of each term are left out, whichever plans they belong to.
        values = np.sort(values, axis=0)[
            : len(values) - int(TRIMMED_FRACTION * len(values))
        ]
    return np.asarray(values.mean(axis=0))


class Metric:
    """The weights of one training run.

    Args:
        weights: First weights (e^alpha), shape (m,); a term of weight 0 is omitted and
            keeps this weight.
        budgets: Acceptable value of every term (the paper's C-bar^2), shape (m,); 0
            where there is none.
        settings: Settings of the metric.

    Attributes:
        alpha: Logarithms of the present weights, shape (m,).
    """

    @checked_arguments
    def __init__(
        self,
        weights: ArrayLike,
        budgets: ArrayLike,
        settings: MetricSettings | None = None,
    ) -> None:
        first = numbers("weights", weights)
        self._budgets = numbers("budgets", budgets)
        if first.ndim != 1 or first.shape != self._budgets.shape:
            raise UsageError(
                f"weights and budgets must have one shape (m,), got {first.shape} and {self._budgets.shape}",
                concerns="budgets",
            )
        if not (np.isfinite(first).all() and (first >= 0).all()):
            raise UsageError(
                f"first weights must be finite and not negative, got {first.tolist()!s:.200}",
                concerns="weights",
            )
        if not (np.isfinite(self._budgets).all() and (self._budgets >= 0).all()):
            raise UsageError(
                f"must be finite and not negative, got {self._budgets.tolist()!s:.200}",
                argument="budgets",
            )
        self.settings = settings or MetricSettings()
        with np.errstate(divide="ignore"):
            self.alpha: Array = np.log(first)
        self._sum = np.zeros(len(first))
        self._count = 0

    @checked_arguments
    def weights(self, progress: float) -> Array:
        """Return the weights for the next batch, shape (m,).

        Args:
            progress: Completed fraction of the run, in [0, 1].
        """
        growth = (
            self.settings.grown(progress) if self.settings.kind == "ramped" else 1.0
        )
        return np.asarray(np.exp(self.alpha) * growth)

    @checked_arguments
    def observe(self, terms: ArrayLike, progress: float) -> None:
        """Record the losses of the plans of a batch.

        Args:
            terms: ``LossValue.terms``, shape (N, 1 + m).
            progress: Completed fraction of the run, in [0, 1].
        """
        if self.settings.kind != "learned":
            return
        values = numbers("terms", terms)
        count = 1 + len(self.alpha)
        if values.ndim != 2 or values.shape[1] != count:
            raise UsageError(
                f"must have shape (N, {count}), got {values.shape}", argument="terms"
            )
        mean = average_loss(values[:, 1:], self.settings.average)
        # Without a valid plan the mean is nan.
        if np.isfinite(mean).all():
            self._sum = self._sum + mean
            self._count = self._count + 1
        if self.settings.every == "batch":
            self._learn(progress)

    @checked_arguments
    def end_epoch(self, progress: float) -> None:
        """Take the step of an epoch, if the settings have steps per epoch."""
        if self.settings.kind == "learned" and self.settings.every == "epoch":
            self._learn(progress)

    def _learn(self, progress: float) -> None:
        settings = self.settings
        count = self._count
        if count and progress < settings.frozen:
            # An omitted term learns nothing.
            budgets = np.where(np.isfinite(self.alpha), self._budgets, 0.0)
            # Shrinking budgets have the effect of the growing weights of the ramped metric.
            budgets = budgets * settings.budget_factor / settings.grown(progress)
            alpha = alpha_step(
                self.alpha,
                self._sum / count,
                budgets,
                gamma=settings.gamma,
                largest_log=settings.largest_log,
            )
            with np.errstate(divide="ignore"):
                bounded = np.clip(
                    alpha, np.log(settings.lowest), np.log(settings.highest)
                )
            self.alpha = np.where(np.isfinite(self.alpha), bounded, self.alpha)
        self._sum = np.zeros(len(self.alpha))
        self._count = 0

    def state(self) -> dict[str, Any]:
        """Return the learned state, JSON-able."""
        # None: an omitted term
        alpha = [value if np.isfinite(value) else None for value in self.alpha.tolist()]
        return {"alpha": alpha, "sum": self._sum.tolist(), "count": self._count}

    @checked_arguments
    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of the same run.

        Raises:
            UsageError: It is the state of another metric.
        """
        try:
            values = [-np.inf if value is None else value for value in state["alpha"]]
            alpha = np.array(values, float)
            total = np.array(state["sum"], float)
            count = int(state["count"])
        except (KeyError, TypeError, ValueError) as error:
            raise UsageError(
                f"not the state of a metric: {error}", concerns="state"
            ) from error
        if alpha.shape != self.alpha.shape or total.shape != self.alpha.shape:
            raise UsageError(
                f"the state is that of a metric of {alpha.size} terms, expected {self.alpha.size}",
                concerns="state",
            )
        self.alpha = alpha
        self._sum = total
        self._count = count


@checked_arguments
def suggested_weights(problem: Problem, weights0: ArrayLike) -> Array:
    """Return first weights: ``training_weight`` of the constraint classes, else 100 times those of the problem file.

    With the weights of the shipped classes, planners of the shipped problems became
    valid within minutes. They are the base of the fixed and ramped metrics.

    Args:
        problem: The problem.
        weights0: Weights from the problem file, ``PlanLoss.weights0``, shape (m,).
    """
    weights = numbers("weights0", weights0)
    if weights.shape != (len(problem.constraint),):
        expected = f"({len(problem.constraint)},), one weight per constraint"
        raise UsageError(
            f"must have shape {expected}, got {weights.shape}", argument="weights0"
        )
    pairs = zip(problem.constraint, weights.tolist(), strict=True)
    suggested = [
        WEIGHT_FACTOR * weight
        if constraint.training_weight is None
        else constraint.training_weight
        for constraint, weight in pairs
    ]
    return np.array(suggested)
