"""How a model is trained."""

from dataclasses import dataclass, field

from cnpgen.errors import UsageError
from cnpgen.losses.schedule import BOUNDED, PUBLISHED, MetricSettings

METRICS = {
    "fixed": MetricSettings(kind="fixed"),
    "ramped": MetricSettings(),
    "learned": PUBLISHED,
    "bounded": BOUNDED,
}


@dataclass(frozen=True, kw_only=True)
class TrainingSettings:
    """What decides, together with rows, problem and number of steps, every bit of a trained model.

    Attributes:
        hidden: Width of the network's layers.
        layers: Depth of its trunk.
        batch_size: Rows per step.
        learning_rate: Its peak.
        final_rate: The last learning rate, as a fraction of the peak.
        warm_up: Steps until the peak.
        seed: Seed of the first parameters and of the order of rows.
        path_scale: What the configuration head's output is a multiple of [rad].
        head_scale: Factor of the heads' first weights.
        rate_bias: Logarithm of the first guess of expected time over duration.
        bending_steps: Gauss-Newton steps that bend the line onto the manifold.
        landing_steps: Likewise of what the network gives.
        nodes: Quadrature nodes of the loss.
        shifts: So many shifted sets of nodes are used in turn, so that nothing hides between them.
        sample_clip: Largest norm of a sample's gradient, in running medians.
        batch_clip: Largest norm of a batch's gradient, in running norms.
        memory: Of the average of the parameters.
        metric: How the weights of the constraint terms change.
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
    nodes: int = 32
    shifts: int = 16
    sample_clip: float = 30.0
    batch_clip: float = 2.0
    memory: float = 0.999
    metric: MetricSettings = field(default_factory=MetricSettings)
    imitation: float = 0.0

    def __post_init__(self) -> None:
        for name in ("hidden", "layers", "batch_size", "nodes", "shifts"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("learning_rate", "path_scale", "sample_clip", "batch_clip"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} must be above 0, got {getattr(self, name)}")
        if not 0 <= self.imitation < 1:
            raise UsageError(f"imitation must be at least 0 and below 1, got {self.imitation}")


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
        ((name, value),) = given.items()
        if not value > 0:
            raise UsageError(f"{name} must be above 0, got {value}")
