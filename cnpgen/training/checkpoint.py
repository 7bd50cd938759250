"""State of a training run, and its checkpoints: with the identity of the run, so that no other one resumes from it."""

import json
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import AnyArray, Mask
from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import DatasetError, UsageError
from cnpgen.store.files.document_structure import (
    ANY_KEY,
    ANYTHING,
    NUMBER,
    TEXT,
    WHOLE,
    check_structure,
)
from cnpgen.store.files.record_file import RecordFormat, pack_arrays, unpack_arrays
from cnpgen.training.adam import Adam, Clipping, start_adam

MIN_INTERVAL_S, MAX_INTERVAL_S = 20.0, 50.0  # wall time between two checkpoints
INTERVAL_PER_WRITING_TIME = 20.0
_ADAM_ARRAYS = ("parameters", "average", "first", "second")
_STATE_NUMBERS = ("steps", "imitating", "metric", "seconds", "checking")


@dataclass
class Sums:
    """Sums since the last line of the log.

    ``terms`` sums the terms' means over steps, shape (1 + m,). ``lost`` plans had no
    finite loss. ``distance`` sums the mean distance from demonstrations over imitating
    steps, which are not included in ``steps``.
    """

    terms: AnyArray
    steps: int = 0
    lost: int = 0
    distance: float = 0.0
    imitating: int = 0

    def add_distances(self, distances: AnyArray) -> None:
        """Add the distances of a batch of imitating plans, shape (N, 1)."""
        self.distance += float(distances.mean(dtype=np.float64))
        self.imitating += 1

    def add(self, terms: AnyArray) -> None:
        """Add the terms of a batch, shape (N, 1 + m).

        Plans without a finite loss are counted and omitted.
        """
        # Plans whose loss is not finite are counted, not averaged.
        finite: Mask = np.asarray(np.isfinite(terms).all(axis=1))
        if finite.any():
            self.terms += terms[finite].mean(axis=0, dtype=np.float64)
        self.lost += int(len(finite) - finite.sum())
        self.steps += 1


@dataclass
class Best:
    """Best model so far: score, -inf before the first validation, step, and parameters of shape (n_parameters,)."""

    score: float
    step: int
    parameters: AnyArray


@dataclass
class State:
    """State of a run of ``steps`` steps, of which the first ones imitate.

    The state of the metric is JSON-able. ``seconds`` is the CPU time of all steps,
    ``checking`` that of validation [s]. ``log`` has the lines of the log so far.
    """

    adam: Adam
    clipping: Clipping
    sums: Sums
    best: Best
    steps: int
    imitating: int = 0
    metric: JsonMapping = field(default_factory=dict)
    seconds: float = 0.0
    checking: float = 0.0
    log: list[str] = field(default_factory=list)

    def progress(self, step: int) -> float:
        """Return the fraction of the run that is done at a step, without imitating steps; in [0, 1]."""
        return max(step - self.imitating, 0) / (self.steps - self.imitating)


def start_state(
    parameters: AnyArray, *, terms: int, steps: int, imitation: float = 0.0
) -> State:
    """Return the initial state of a run, a fraction of which imitates.

    ``terms`` is the number of loss terms.
    """
    best = Best(-math.inf, 0, parameters.copy())
    return State(
        start_adam(parameters),
        Clipping(),
        Sums(np.zeros(terms)),
        best,
        steps,
        int(imitation * steps),
    )


def _pack(state: State) -> JsonObject:
    adam = state.adam
    best = state.best
    arrays = {name: getattr(adam, name) for name in _ADAM_ARRAYS}
    return {
        "step": adam.step,
        **{name: getattr(state, name) for name in _STATE_NUMBERS},
        "clipping": asdict(state.clipping),
        "sums": {
            name: value for name, value in vars(state.sums).items() if name != "terms"
        },
        "best": {"score": best.score, "step": best.step},
        "log": state.log,
        "arrays": pack_arrays(
            {**arrays, "best": best.parameters, "terms": state.sums.terms}
        ),
    }


_FORM = {
    **dict.fromkeys(("step", "steps", "imitating"), WHOLE),
    **dict.fromkeys(("seconds", "checking"), NUMBER),
    "clipping": {"sample": NUMBER, "batch": NUMBER},
    "metric": {ANY_KEY: ANYTHING},
    "sums": {"steps": WHOLE, "lost": WHOLE, "distance": NUMBER, "imitating": WHOLE},
    "best": {"score": NUMBER, "step": WHOLE},
    "log": [TEXT],
    "arrays": TEXT,
}


def _unpack(record: Any) -> State:
    """Make a state of a record.

    Raises:
        KeyError, TypeError, ValueError: A key is missing, unknown to this version, or
            has an invalid value.
    """
    check_structure(record, _FORM)
    best = record["best"]
    arrays = unpack_arrays(record["arrays"])
    shapes = {arrays[name].shape for name in (*_ADAM_ARRAYS, "best")}
    if len(shapes) > 1 or len(shapes.pop()) != 1 or arrays["terms"].ndim != 1:
        raise ValueError("its arrays do not belong to one network")
    return State(
        Adam(**{name: arrays[name] for name in _ADAM_ARRAYS}, step=record["step"]),
        Clipping(**record["clipping"]),
        Sums(arrays["terms"], **record["sums"]),
        Best(best["score"], best["step"], arrays["best"]),
        **{name: record[name] for name in _STATE_NUMBERS},
        log=record["log"],
    )


CHECKPOINT = RecordFormat(
    "cnpgen-checkpoint",
    3,
    "a checkpoint of cnpgen",
    "give the same arguments to resume it, or {force} to replace it",
    "force",
    _unpack,
)


class Checkpoints:
    """Checkpoints of one run in a file, written at intervals, with its JSON-able settings, dataset and steps."""

    def __init__(self, path: Path, identity: JsonMapping) -> None:
        self.path = path
        # In the form in which it is read back, so that equal identities compare as
        # equal.
        self.identity: JsonObject = json.loads(json.dumps(identity))
        self._next = time.monotonic() + MIN_INTERVAL_S

    def load(self, *, discard: bool = False) -> State | None:
        """Return the state of an interrupted run; None if there is none.

        With ``discard``, a checkpoint that is damaged or of another run is ignored.

        Raises:
            DatasetError: The file is damaged.
            UsageError: It is of another run.
        """
        if not self.path.exists():
            return None
        try:
            return self._load()
        except (DatasetError, UsageError):
            if discard:
                return None
            raise

    def _load(self) -> State:
        head, records = CHECKPOINT.read(self.path)
        CHECKPOINT.require(self.path, head or {}, self.identity)
        if len(records) != 1:
            raise DatasetError(f"{self.path} is damaged or cut off")
        state: State
        (state,) = CHECKPOINT.unpacked(self.path, records)
        return state

    def save_if_due(self, state: State) -> None:
        """Save the state if the interval has passed."""
        if time.monotonic() > self._next:
            self.save(state)

    def save(self, state: State) -> None:
        """Save the state."""
        started = time.monotonic()
        CHECKPOINT.replace(self.path, self.identity, _pack(state))
        # Writing takes at most a twentieth of the time, within the bounds of the
        # interval.
        interval = INTERVAL_PER_WRITING_TIME * (time.monotonic() - started)
        self._next = time.monotonic() + min(
            max(MIN_INTERVAL_S, interval), MAX_INTERVAL_S
        )

    def remove(self) -> None:
        """Remove the file."""
        self.path.unlink(missing_ok=True)
