"""How a model is trained."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from cnpgen.errors import UsageError
from cnpgen.losses.metric_settings import BOUNDED, PUBLISHED, MetricSettings
from cnpgen.planner.model import Meaning
from cnpgen.planner.tasks import EXPECTED_TIMES
from cnpgen.schema.arguments import integer, number

METRICS = {
    "fixed": MetricSettings(kind="fixed"),
    "ramped": MetricSettings(),
    "learned": PUBLISHED,
    "bounded": BOUNDED,
}
LEAST = {
    "hidden": 1, "layers": 1, "batch_size": 1, "nodes": 1, "shifts": 1,
    "warm_up": 0, "seed": 0, "bending_steps": 0, "landing_steps": 0,
}  # fmt: skip
INTERVALS = {
    "learning_rate": "(0, inf)", "final_rate": "[0, 1]", "path_scale": "(0, inf)", "head_scale": "[0, inf)",
    "rate_bias": "(-inf, inf)", "sample_clip": "(0, inf]", "batch_clip": "(0, inf]", "memory": "[0, 1)",
    "imitation": "[0, 1)",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class TrainingSettings:
    """What decides, together with rows, problem and number of steps, every bit of a trained model.

    Attributes:
        hidden: Width of the network's layers.
        layers: Depth of its trunk.
        batch_size: Rows per step; all of them where there are fewer.
        learning_rate: Its peak.
        final_rate: The last learning rate, as a fraction of the peak.
        warm_up: Steps until the peak.
        seed: Seed of the first parameters and of the order of rows.
        path_scale: What the configuration head's output is a multiple of [rad].
        head_scale: Factor of the heads' first weights.
        rate_bias: Logarithm of the first guess of expected time over duration.
        bending_steps: Gauss-Newton steps that bend the line onto the manifold.
        landing_steps: Likewise of what the network gives.
        within_limits: Whether both keep control points within the joint limits.
        paced: Whether the planner fits rates to the limits behind the network; steps do not see it, validations do.
        nodes: Quadrature nodes of the loss.
        shifts: So many shifted sets of nodes are used in turn, so that nothing hides between them.
        sample_clip: Largest norm of a sample's gradient, in running medians.
        batch_clip: Largest norm of a batch's gradient, in running norms.
        memory: Of the average of the parameters.
        metric: How the weights of the constraint terms change.
        expected_time: What the network's rates are multiples of the inverse of; see ``Meaning``.
        margins: Constraint term -> what its limits are multiplied by, in (0, 1], where not the usual factor.
        imitation: Fraction of the run, at its beginning, that imitates the plans of a certified dataset.
    """

    hidden: int = 128
    layers: int = 5
    batch_size: int = 64
    learning_rate: float = 1e-3
    final_rate: float = 0.01
    warm_up: int = 200
    seed: int = 0
    path_scale: float = 0.5
    head_scale: float = 0.1
    rate_bias: float = -0.5
    bending_steps: int = 1
    landing_steps: int = 1
    within_limits: bool = False
    paced: bool = False
    nodes: int = 32
    shifts: int = 16
    sample_clip: float = 30.0
    batch_clip: float = 2.0
    memory: float = 0.999
    metric: MetricSettings = field(default_factory=MetricSettings)
    expected_time: str = "distance"
    margins: Mapping[str, float] = field(default_factory=dict)
    imitation: float = 0.0

    def __post_init__(self) -> None:
        for name, least in LEAST.items():
            integer(name, getattr(self, name), least=least)
        for name, interval in INTERVALS.items():
            _within(name, getattr(self, name), interval)
        _within("growth", self.metric.growth, "(0, inf)")
        for term, factor in self.margins.items():
            _within(f"margin of {term!r}", factor, "(0, 1]")
        if self.expected_time not in EXPECTED_TIMES:
            raise UsageError(f"expected_time must be one of {', '.join(EXPECTED_TIMES)}, got {self.expected_time!r}")

    @property
    def form(self) -> str:
        """Form of the loss: "paper" where the metric is the paper's, whose budgets are meant for it, else "signed"."""
        return "paper" if self.metric.kind == "learned" and self.metric.every == "epoch" else "signed"

    @property
    def meaning(self) -> Meaning:
        """What the network's outputs stand for."""
        return Meaning(
            path_scale=self.path_scale,
            bending_steps=self.bending_steps,
            landing_steps=self.landing_steps,
            expected_time=self.expected_time,
            within_limits=self.within_limits,
            paced=self.paced,
        )


@dataclass(frozen=True, kw_only=True)
class Length:
    """How long a run is: one of the three.

    Attributes:
        steps: Steps.
        epochs: Times that every row is trained on.
        cpu_seconds: CPU time of the steps [s].
    """

    steps: int | None = None
    epochs: float | None = None
    cpu_seconds: float | None = None

    def __post_init__(self) -> None:
        given = {name: value for name, value in vars(self).items() if value is not None}
        if len(given) != 1:
            raise UsageError(f"say how long to train by one of steps, epochs or cpu_seconds, got {given or 'none'}")
        if self.steps is not None:
            integer("steps", self.steps, least=1)
        else:
            _within(*given.popitem(), "(0, inf)")


def _within(name: str, value: Any, interval: str) -> None:
    """Refuse what is no number, or not in an interval such as ``[0, 1)``, which may hold infinity."""
    low, high = map(float, interval[1:-1].split(","))
    found = value if isinstance(value, float) and math.isinf(value) else number(name, value)
    if not low <= found <= high or (found == low and interval[0] == "(") or (found == high and interval[-1] == ")"):
        raise UsageError(f"{name} must be in {interval}, got {value!r}")
