"""Network that proposes the next configuration towards a goal, trained on certified plans (Li et al., 2021).

From a state, the goal and the obstacles, it predicts the change of every joint within a
time as a normal distribution. The configuration head predicts the mean, within the
velocity limits, and the linear head the deviation. Proposals are samples of it; the
authors sample by dropout. ``benchmarks/train_proposals.py`` trains it;
datasets/proposals/README.md has the commands.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.network.architecture import Architecture, Weights, forward
from cnpgen.schema.catalogue import recipes_root
from cnpgen.store.files.checksum_file import read_with_checksum

PROPOSALS_KIND = "cnpgen-proposals"
PROPOSALS_VERSION = 1
MIN_PROPOSAL_DEVIATION = 0.02  # fraction of the reach


@dataclass(frozen=True, eq=False)
class Proposals:
    """A trained network, whose heads have n outputs each; its parameters are float32.

    ``mean`` and ``scale`` have the mean of every input over the training rows and the
    reciprocal of its standard deviation, 0 for constant inputs, shape (F,). ``reach``
    is the maximum change of a joint [rad], shape (n,), within the time ``ahead`` [s].
    ``training`` has data of the training, as text.
    """

    architecture: Architecture
    parameters: AnyArray
    mean: AnyArray
    scale: AnyArray
    reach: AnyArray
    ahead: float
    training: Mapping[str, str] = field(default_factory=dict)

    def propose(
        self,
        state: AnyArray,
        goal_q: AnyArray,
        obstacle_poses: AnyArray,
        random: np.random.Generator,
    ) -> AnyArray:
        """Sample a next configuration [rad], shape (n,), from a state of shape (2 n,) towards a goal of shape (n,)."""
        # Without the puck of a hit.
        poses = obstacle_poses[None, : len(self.mean) - 2 * len(state)]
        inputs = standardize(
            inputs_of(state[None], goal_q[None], poses), self.mean, self.scale
        )
        prediction = forward(self._weights, inputs)
        change = random.normal(
            prediction.path[0], MIN_PROPOSAL_DEVIATION + np.exp(prediction.log_rate[0])
        )
        return np.asarray(state[: len(goal_q)] + self.reach * change)

    @cached_property
    def _weights(self) -> Weights:
        return self.architecture.split(self.parameters)


def inputs_of(states: AnyArray, goal_q: AnyArray, obstacle_poses: AnyArray) -> AnyArray:
    """Concatenate inputs: states (N, 2 n), goals (N, n), their differences, and obstacles (N, m)."""
    return np.concatenate(
        [states, goal_q, goal_q - states[:, : goal_q.shape[1]], obstacle_poses], axis=1
    )


def standardize(inputs: AnyArray, mean: AnyArray, scale: AnyArray) -> AnyArray:
    """Standardize inputs, shape (N, F), for the network."""
    return ((inputs - mean) * scale).astype(np.float32)


def load_proposals(path: str | Path) -> Proposals:
    """Read a network; raise DatasetError if the file is damaged or of another kind."""
    content = read_with_checksum(
        Path(path), kind=PROPOSALS_KIND, version=PROPOSALS_VERSION
    )
    arrays = dict(content.arrays)
    try:
        names = ("inputs", "hidden", "layers", "path_outputs", "rate_outputs")
        sizes = dict(zip(names, arrays.pop("architecture").tolist(), strict=True))
        ahead = float(arrays.pop("ahead")[0])
        return Proposals(
            Architecture(**sizes), ahead=ahead, training=content.texts, **arrays
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path} is damaged: {error}") from error


def shipped_proposals(problem: str) -> Path:
    """Find the network that cnpgen ships for a problem.

    Raise UsageError if there is none.
    """
    folder = recipes_root() / "datasets" / "proposals"
    path = folder / f"{problem}.h5"
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in folder.glob("*.h5")))
        raise UsageError(
            f"no network proposes configurations for {problem!r}, only for {known} (datasets/proposals)"
        )
    return path
