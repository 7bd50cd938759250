"""Training settings and the length of a run."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from cnpgen.errors import UsageError
from cnpgen.losses.metric import BOUNDED, PUBLISHED, MetricSettings
from cnpgen.losses.plan_loss import FORMS
from cnpgen.planner.model import MAX_NETWORK_ITERATIONS, ModelConfig
from cnpgen.planner.network.features import FEATURE_SETS
from cnpgen.planner.tasks import EXPECTED_TIMES
from cnpgen.problems.objectives import read_objective
from cnpgen.schema.argument_types import check_fields
from cnpgen.schema.arguments import integer, number

METRICS = {
    "fixed": MetricSettings(kind="fixed"),
    "ramped": MetricSettings(),
    "learned": PUBLISHED,
    "bounded": BOUNDED,
}
MIN_INTEGERS = {
    "hidden": 1, "layers": 1, "batch_size": 1, "iterations": 1, "nodes": 1, "shifts": 1,
    "warm_up": 0, "seed": 0, "line_projection_steps": 0, "projection_steps": 0, "validations": 1,
}  # fmt: skip
VALID_INTERVALS = {
    "learning_rate": "(0, inf)", "final_rate": "[0, 1]", "path_scale": "(0, inf)", "head_scale": "[0, inf)",
    "rate_bias": "(-inf, inf)", "sample_clip": "(0, inf]", "batch_clip": "(0, inf]", "memory": "[0, 1)",
    "imitation": "[0, 1)", "iterations": f"[1, {MAX_NETWORK_ITERATIONS}]",
}  # fmt: skip


CHOICES: dict[str, tuple[str, ...]] = {
    "expected_time": EXPECTED_TIMES,
    "features": FEATURE_SETS,
    "loss_form": ("", *FORMS),
    "constraint_terms": ("all", "budgeted"),
    "keep": ("best", "last"),
    "precision": ("float32", "float64"),
}


@dataclass(frozen=True, kw_only=True)
class TrainingSettings:
    """Settings that, together with rows, problem and number of steps, determine a trained model to the bit.

    Attributes:
        hidden: Width of the network's layers.
        layers: Depth of its trunk.
        batch_size: Rows per step; all of them if there are fewer.
        learning_rate: Peak learning rate.
        final_rate: Last learning rate, as a fraction of the peak.
        warm_up: Number of steps until the peak.
        seed: Seed of the initial parameters and of the order of rows.
        path_scale: Factor of the configuration head's output [rad].
        head_scale: Factor of the heads' initial weights.
        rate_bias: Logarithm of the initial guess of expected time over duration.
        line_projection_steps: Gauss-Newton steps that project the line onto the
            equalities.
        projection_steps: Gauss-Newton steps that project the path onto the equalities.
        within_limits: Whether both clip control points to the joint limits.
        iterations: Number of evaluations of the network; see ``ModelConfig``.
        time_parametrized: Whether the planner fits rates to the limits after the
            network; training steps do not include it, validations do.
        nodes: Number of quadrature nodes of the loss.
        shifts: Number of shifted sets of nodes, used in turn to cover the phases
            between nodes.
        sample_clip: Largest norm of a sample's gradient, in running medians.
        batch_clip: Largest norm of a batch's gradient, in running norms.
        memory: Decay of the average of the parameters.
        metric: Schedule of the weights of the constraint terms.
        expected_time: Unit of durations; see ``ModelConfig``.
        margins: Constraint term -> factor of its limits, in (0, 1], that replaces the
            usual one.
        usual_margins: Whether the other bounds are tightened as the constraint classes
            suggest.
        imitation: Fraction of the run, at its beginning, that imitates the plans of a
            certified dataset.
        features: Inputs of the network: "full"; "no-scene", without obstacles that
            samples place; "states", the standardized boundary states; or "paper", the
            boundary states divided by pi and by the limits.
        loss_form: Form of the loss, "signed" or "paper" (``PlanLoss``); empty for the
            one that suits the metric.
        constraint_terms: "all", or "budgeted": only those with a budget, which are
            those of the paper.
        time_varying_bounds: Whether motions that start off the manifold have the
            time-varying bounds of the verdict.
        path_control_points: Number of path control points; None for that of the
            problem.
        rate_control_points: Number of rate control points; None for that of the
            problem.
        keep: Model that is kept: the "best" of all validations, or the "last" one.
        objective: Objective in place of that of the problem, such as "effort" or
            "effort=2, jerk=0.1" (``cnpgen.problems.objectives.read_objective``); empty
            for that of the problem.
        precision: Precision of the loss and its gradient; the network has float32.
        validations: Number of validations, evenly distributed over the run.
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
    line_projection_steps: int = 1
    projection_steps: int = 1
    within_limits: bool = False
    iterations: int = 1
    time_parametrized: bool = False
    nodes: int = 32
    shifts: int = 16
    sample_clip: float = 30.0
    batch_clip: float = 2.0
    memory: float = 0.999
    metric: MetricSettings = field(default_factory=MetricSettings)
    expected_time: str = "distance"
    margins: Mapping[str, float] = field(default_factory=dict)
    usual_margins: bool = True
    imitation: float = 0.0
    features: str = "full"
    loss_form: str = ""
    constraint_terms: str = "all"
    time_varying_bounds: bool = True
    path_control_points: int | None = None
    rate_control_points: int | None = None
    keep: str = "best"
    objective: str = ""
    precision: Literal["float32", "float64"] = "float32"
    validations: int = 10

    def __post_init__(self) -> None:
        check_fields(self)
        for name, least in MIN_INTEGERS.items():
            integer(name, getattr(self, name), least=least)
        for name, interval in VALID_INTERVALS.items():
            _within(name, getattr(self, name), interval)
        _within("growth", self.metric.growth, "(0, inf)")
        for term, factor in self.margins.items():
            _within("margins", factor, "(0, 1]", of=f" for {term!r}")
        read_objective(self.objective)
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                known = ", ".join(filter(None, choices))
                raise UsageError(
                    f"must be one of {known}, got {getattr(self, name)!r}",
                    argument=name,
                )
        # Later evaluations start from the path of the one before, which these features
        # do not contain.
        if self.iterations > 1 and self.features in {"states", "paper"}:
            raise UsageError(
                f"{self.iterations} evaluations of the network need its path as an input: expected features"
                f" 'full' or 'no-scene', got {self.features!r}",
                concerns="features",
            )
        for name in ("path_control_points", "rate_control_points"):
            if getattr(self, name) is not None:
                integer(name, getattr(self, name), least=1)

    @property
    def form(self) -> str:
        """Form of the loss: as set, else "paper" for the paper's metric, whose budgets belong to it, or "signed"."""
        if self.loss_form:
            return self.loss_form
        return (
            "paper"
            if self.metric.kind == "learned" and self.metric.every == "epoch"
            else "signed"
        )

    @property
    def config(self) -> ModelConfig:
        """Definition of the network's outputs."""
        return ModelConfig(
            path_scale=self.path_scale,
            line_projection_steps=self.line_projection_steps,
            projection_steps=self.projection_steps,
            expected_time=self.expected_time,
            within_limits=self.within_limits,
            iterations=self.iterations,
            time_parametrized=self.time_parametrized,
        )


@dataclass(frozen=True, kw_only=True)
class Length:
    """Length of a run, by exactly one of the three.

    Attributes:
        steps: Number of steps.
        epochs: Number of epochs.
        cpu_seconds: CPU time of the steps [s].
    """

    steps: int | None = None
    epochs: float | None = None
    cpu_seconds: float | None = None

    def __post_init__(self) -> None:
        lengths = {
            name: value for name, value in vars(self).items() if value is not None
        }
        if len(lengths) != 1:
            raise UsageError(
                f"pass exactly one of steps, epochs or cpu_seconds, got {lengths or 'none'}",
                concerns="steps",
            )
        if self.steps is not None:
            integer("steps", self.steps, least=1)
        else:
            _within(*lengths.popitem(), "(0, inf)")


def _within(name: str, value: Any, interval: str, *, of: str = "") -> None:
    """Raise an error if a value is no number, or outside an interval such as ``[0, 1)``, which may include infinity."""
    low, high = map(float, interval[1:-1].split(","))
    real = (
        value if isinstance(value, float) and math.isinf(value) else number(name, value)
    )
    if (
        not low <= real <= high
        or (real == low and interval[0] == "(")
        or (real == high and interval[-1] == ")")
    ):
        raise UsageError(f"must be in {interval}{of}, got {value!r}", argument=name)
