"""The metric of the constraint manifold: the weight e^alpha of every term (paper, section on loss function learning).

Published is a learned metric: after every epoch each alpha takes a step towards the value at which its term would be as
large as its budget, ``alpha += gamma log(mean L_i / C_i)``. On short runs that is slow, and budgets that cannot be met
wind it up; weights that only grow with the progress of a run are the default.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.losses.metric_settings import Average, MetricSettings

Array = NDArray[np.float64]
TRIMMED = 0.1  # fraction of the plans, those with the largest losses, that a trimmed mean leaves out


def alpha_step(
    alpha: ArrayLike, losses: ArrayLike, budgets: ArrayLike, *, gamma: float, largest_log: float = 10.0
) -> Array:
    """Take one step of the metric, ``alpha_i + gamma log(L_i / C_i)`` (paper, update rule of alpha).

    Args:
        alpha: Logarithms of the weights, shape (m,).
        losses: Mean of every term, shape (m,). One that is not finite changes nothing.
        budgets: Acceptable value of every term (the paper's C-bar^2), shape (m,). Without one (0) a weight stays.
        gamma: Step.
        largest_log: Bound on the absolute value of the logarithm.
    """
    before, mean, budget = (np.asarray(x, float) for x in (alpha, losses, budgets))
    learned = (budget > 0) & np.isfinite(mean)
    with np.errstate(divide="ignore"):
        logs = np.log(mean, where=learned, out=np.zeros_like(mean)) - np.log(
            budget, where=learned, out=np.zeros_like(mean)
        )
    return np.asarray(before + gamma * np.clip(logs, -largest_log, largest_log))


def average_loss(terms: ArrayLike, average: Average) -> Array:
    """Average every term over plans, those that are none left out; nan if there is no other.

    Args:
        terms: Losses of N plans, shape (N, m).
        average: How.

    Returns:
        Shape (m,).
    """
    values = np.asarray(terms, float)
    values = values[np.isfinite(values).all(axis=1)]
    if len(values) == 0:
        return np.full(values.shape[1], np.nan)
    if average == "median":
        return np.asarray(np.median(values, axis=0))
    if average == "trimmed":
        values = np.sort(values, axis=0)[: len(values) - int(TRIMMED * len(values))]
    return np.asarray(values.mean(axis=0))


class Metric:
    """The weights of one training run.

    Args:
        weights: First weights (e^alpha), shape (m,), positive.
        budgets: Acceptable value of every term (the paper's C-bar^2), shape (m,); 0 where there is none.
        settings: How weights change.

    Attributes:
        alpha: Logarithms of the weights as learned so far, shape (m,).
    """

    def __init__(self, weights: ArrayLike, budgets: ArrayLike, settings: MetricSettings | None = None) -> None:
        first, self._budgets = np.asarray(weights, float), np.asarray(budgets, float)
        if first.ndim != 1 or first.shape != self._budgets.shape:
            raise UsageError(
                f"weights and budgets must have one shape (m,), got {first.shape} and {self._budgets.shape}"
            )
        if not (np.isfinite(first).all() and (first > 0).all()):
            raise UsageError(f"first weights must be positive and finite, got {first.tolist()}")
        if not (np.isfinite(self._budgets).all() and (self._budgets >= 0).all()):
            raise UsageError(f"budgets must be finite and not negative, got {self._budgets.tolist()}")
        self.settings = settings or MetricSettings()
        self.alpha: Array = np.log(first)
        self._sum, self._count = np.zeros(len(first)), 0

    def weights(self, progress: float) -> Array:
        """Return the weights for the next batch, shape (m,).

        Args:
            progress: How much of the run is done, in [0, 1].
        """
        growth = self.settings.grown(progress) if self.settings.kind == "ramped" else 1.0
        return np.asarray(np.exp(self.alpha) * growth)

    def observe(self, terms: ArrayLike, progress: float) -> None:
        """Take note of what the plans of a batch cost.

        Args:
            terms: As ``LossValue.terms``, shape (N, 1 + m).
            progress: How much of the run is done, in [0, 1].
        """
        if self.settings.kind != "learned":
            return
        mean = average_loss(np.asarray(terms)[:, 1:], self.settings.average)
        if np.isfinite(mean).all():
            self._sum, self._count = self._sum + mean, self._count + 1
        if self.settings.every == "batch":
            self._learn(progress)

    def end_epoch(self, progress: float) -> None:
        """Take the step of an epoch, where steps are taken after epochs."""
        if self.settings.kind == "learned" and self.settings.every == "epoch":
            self._learn(progress)

    def _learn(self, progress: float) -> None:
        chosen, count = self.settings, self._count
        if count and progress < chosen.frozen:
            budgets = self._budgets / chosen.grown(progress)
            alpha = alpha_step(
                self.alpha, self._sum / count, budgets, gamma=chosen.gamma, largest_log=chosen.largest_log
            )
            with np.errstate(divide="ignore"):
                self.alpha = np.clip(alpha, np.log(chosen.lowest), np.log(chosen.highest))
        self._sum, self._count = np.zeros(len(self.alpha)), 0

    def state(self) -> dict[str, Any]:
        """Return all that has been learned, as what JSON can hold."""
        return {"alpha": self.alpha.tolist(), "sum": self._sum.tolist(), "count": self._count}

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from a state of the same run.

        Raises:
            UsageError: It is the state of another metric.
        """
        try:
            alpha, total, count = np.array(state["alpha"], float), np.array(state["sum"], float), int(state["count"])
        except (KeyError, TypeError, ValueError) as error:
            raise UsageError(f"not the state of a metric: {error}") from error
        if alpha.shape != self.alpha.shape or total.shape != self.alpha.shape:
            raise UsageError(f"the state is that of a metric of {alpha.size} terms, expected {self.alpha.size}")
        self.alpha, self._sum, self._count = alpha, total, count
