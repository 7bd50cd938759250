"""Which configuration is next on the way to a goal: a network that has seen certified plans (Li et al., 2021).

From a state, the goal and the obstacles it tells the change of every joint within a moment, as a normal distribution:
the mean from the configuration head, which cannot leave what the joint's velocity limit allows, and the deviation
from the linear head. Proposals are drawn from it, as those of the authors' network are by dropout.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.network.architecture import Architecture, Weights
from cnpgen.planner.network.forward import forward
from cnpgen.schema.catalogue import recipes_root
from cnpgen.store.files.sealed import Content, read_sealed, write_sealed

Array = NDArray[Any]

KIND, VERSION = "cnpgen-proposals", 1
LEAST = 0.02  # of the reach: the network is no more certain than that


@dataclass(frozen=True, eq=False)
class Proposals:
    """A trained network.

    Attributes:
        architecture: The network's architecture; both heads have n outputs.
        parameters: All of its numbers, float32.
        mean: Of every input over the training rows, shape (F,).
        scale: One over its standard deviation; 0 where it was constant, shape (F,).
        reach: The farthest a joint can get within the moment [rad], shape (n,).
        ahead: The moment [s].
        training: How it was made, as text.
    """

    architecture: Architecture
    parameters: Array
    mean: Array
    scale: Array
    reach: Array
    ahead: float
    training: Mapping[str, str] = field(default_factory=dict)

    def propose(self, state: Array, goal_q: Array, tops: Array, random: np.random.Generator) -> Array:
        """Draw a configuration that may be next [rad], shape (n,).

        Args:
            state: Where the arm is and how it moves, shape (2 n,).
            goal_q: Where it is to be in the end [rad], shape (n,).
            tops: Heights of the obstacles' upper faces [m], shape (obstacles,).
            random: Where random numbers come from.
        """
        inputs = standardised(inputs_of(state[None], goal_q[None], tops[None]), self.mean, self.scale)
        given = forward(self._weights, inputs)
        drawn = random.normal(given.path[0], LEAST + np.exp(given.log_rate[0]))
        return np.asarray(state[: len(goal_q)] + self.reach * drawn)

    @cached_property
    def _weights(self) -> Weights:
        return self.architecture.split(self.parameters)


def inputs_of(states: Array, goal_q: Array, tops: Array) -> Array:
    """Put inputs beside each other: states (N, 2 n), goals (N, n), how far they are, and obstacles (N, m)."""
    return np.concatenate([states, goal_q, goal_q - states[:, : goal_q.shape[1]], tops], axis=1)


def standardised(inputs: Array, mean: Array, scale: Array) -> Array:
    """Standardise inputs, shape (N, F), for the network."""
    return ((inputs - mean) * scale).astype(np.float32)


def save_proposals(path: str | Path, proposals: Proposals) -> None:
    """Write a network to a file, atomically; equal networks give equal bytes.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    arrays = {name: getattr(proposals, name) for name in ("parameters", "mean", "scale", "reach")}
    arrays["ahead"] = np.array([proposals.ahead])
    arrays["architecture"] = np.array(list(asdict(proposals.architecture).values()))
    write_sealed(Path(path), Content(arrays, dict(proposals.training)), kind=KIND, version=VERSION)


def load_proposals(path: str | Path) -> Proposals:
    """Read a network.

    Raises:
        DatasetError: The file is damaged, or none of these.
        MachineError: The system would not let us read it.
    """
    content = read_sealed(Path(path), kind=KIND, version=VERSION)
    arrays = dict(content.arrays)
    try:
        names = ("inputs", "hidden", "layers", "path_outputs", "rate_outputs")
        sizes = dict(zip(names, arrays.pop("architecture").tolist(), strict=True))
        ahead = float(arrays.pop("ahead")[0])
        return Proposals(Architecture(**sizes), ahead=ahead, training=content.texts, **arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path} is damaged: {error}") from error


def shipped_proposals(problem: str) -> Path:
    """Find the network that cnpgen ships for a problem.

    Raises:
        UsageError: There is none.
    """
    folder = recipes_root() / "datasets" / "proposals"
    path = folder / f"{problem}.h5"
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in folder.glob("*.h5")))
        raise UsageError(f"no network proposes configurations for {problem!r}, only for {known} (datasets/proposals)")
    return path
