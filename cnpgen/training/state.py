"""Everything that a run remembers from one step to the next: all that a checkpoint needs to hold."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.forms import ANYTHING, EVERY, NUMBER, WHOLE, check_form
from cnpgen.store.files.sealed import Content
from cnpgen.training.adam import Adam, start_adam
from cnpgen.training.clipping import Clipping

Array = NDArray[Any]


@dataclass
class Sums:
    """What was summed up since the last line of the log.

    Attributes:
        terms: Sum over steps of the terms' means, shape (1 + m,).
        steps: Number of steps.
        lost: Plans whose loss was not finite.
        distance: Sum over imitating steps of the mean distance from demonstrations.
        imitating: Number of imitating steps, which are not among ``steps``.
    """

    terms: Array
    steps: int = 0
    lost: int = 0
    distance: float = 0.0
    imitating: int = 0

    def add_distances(self, distances: Array) -> None:
        """Add what a batch of imitating plans is off, shape (N, 1)."""
        self.distance += float(distances.mean(dtype=np.float64))
        self.imitating += 1

    def add(self, terms: Array) -> None:
        """Add the terms of a batch, shape (N, 1 + m); plans without a loss are counted and left out."""
        good: NDArray[np.bool_] = np.asarray(np.isfinite(terms).all(axis=1))
        if good.all():
            self.terms += terms.mean(axis=0, dtype=np.float64)
        elif good.any():
            self.terms += terms[good].mean(axis=0, dtype=np.float64)
        self.lost += int(len(good) - good.sum())
        self.steps += 1


@dataclass
class Best:
    """The best model so far.

    Attributes:
        score: What it is compared by, the larger the better; -inf before the first validation.
        step: When it was validated.
        parameters: Its parameters, shape (n_parameters,).
    """

    score: float
    step: int
    parameters: Array


@dataclass
class State:
    """The state of a run.

    Attributes:
        adam: Parameters and moments.
        clipping: Running sizes of gradients.
        steps: Steps of the whole run.
        imitating: How many of them, at the beginning, imitate.
        metric: State of the metric, JSON-able.
        sums: For the log.
        best: The best model so far.
        seconds: CPU time of all steps [s].
        checking: CPU time of validation [s].
        log: Lines of the log so far.
    """

    adam: Adam
    clipping: Clipping
    sums: Sums
    best: Best
    steps: int
    imitating: int = 0
    metric: Mapping[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    checking: float = 0.0
    log: list[str] = field(default_factory=list)

    def progress(self, step: int) -> float:
        """Return how much of the run is done at a step, without the part that imitates; in [0, 1]."""
        return max(step - self.imitating, 0) / (self.steps - self.imitating)


def start_state(parameters: Array, *, terms: int, steps: int, imitation: float = 0.0) -> State:
    """Begin a run.

    Args:
        parameters: The first parameters.
        terms: Number of the loss's terms.
        steps: Steps of the whole run.
        imitation: Fraction of them that imitate.
    """
    best = Best(-math.inf, 0, parameters.copy())
    return State(start_adam(parameters), Clipping(), Sums(np.zeros(terms)), best, steps, int(imitation * steps))


def to_content(state: State) -> Content:
    """Lay a state out as arrays and texts."""
    adam, best = state.adam, state.best
    arrays = {name: getattr(adam, name) for name in ("parameters", "average", "first", "second")}
    numbers = {
        "step": adam.step,
        "steps": state.steps,
        "imitating": state.imitating,
        "clipping": asdict(state.clipping),
        "metric": dict(state.metric),
        "sums": {name: value for name, value in vars(state.sums).items() if name != "terms"},
        "best": {"score": best.score, "step": best.step},
        "seconds": state.seconds,
        "checking": state.checking,
    }
    texts = {"numbers": json.dumps(numbers, indent=1), "log": "\n".join(state.log)}
    return Content({**arrays, "best": best.parameters, "terms": state.sums.terms}, texts)


_FORM = {
    **dict.fromkeys(("step", "steps", "imitating"), WHOLE),
    **dict.fromkeys(("seconds", "checking"), NUMBER),
    "clipping": {"sample": NUMBER, "batch": NUMBER},
    "metric": {EVERY: ANYTHING},
    "sums": {"steps": WHOLE, "lost": WHOLE, "distance": NUMBER, "imitating": WHOLE},
    "best": {"score": NUMBER, "step": WHOLE},
}


def from_content(content: Content) -> State:
    """Put a state together again.

    Raises:
        KeyError: Something is missing.
        TypeError: Something is there that this version does not know.
        ValueError: Something is not what it was.
    """
    numbers, arrays = parse_json(content.texts["numbers"]), content.arrays
    check_form(numbers, _FORM)
    names, best = ("parameters", "average", "first", "second"), numbers["best"]
    shapes = {arrays[name].shape for name in (*names, "best")}
    if len(shapes) > 1 or len(shapes.pop()) != 1 or arrays["terms"].ndim != 1:
        raise ValueError("its arrays are not those of one network")
    return State(
        Adam(**{name: np.array(arrays[name]) for name in names}, step=numbers["step"]),
        Clipping(**numbers["clipping"]),
        Sums(np.array(arrays["terms"]), **numbers["sums"]),
        Best(best["score"], best["step"], np.array(arrays["best"])),
        numbers["steps"],
        numbers["imitating"],
        numbers["metric"],
        numbers["seconds"],
        numbers["checking"],
        content.texts["log"].splitlines(),
    )
