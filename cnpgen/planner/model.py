"""A trained model: the network's numbers, what its inputs and outputs mean, and where it comes from."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.network.architecture import Architecture, Weights
from cnpgen.planner.network.features import Features
from cnpgen.planner.network.forward import forward
from cnpgen.planner.tasks import Tasks
from cnpgen.problems.record import ProblemRecord

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class Meaning:
    """What the network's outputs stand for.

    Attributes:
        path_scale: What the configuration head's output is a multiple of [rad]; pi in the paper.
        bending_steps: Gauss-Newton steps that bend the line onto the manifold's equalities; none in the paper.
        landing_steps: Likewise of what the network gave.
        expected_time: What its rates are multiples of the inverse of: the time of the "distance" at the velocity
            limits, as in the paper, or the least time in which joints could "reach" their goal states.
        within_limits: Whether control points are put back within the joint limits after every one of these steps.
        paced: Whether rates are then made as large, or as small, as limits allow or ask for (``pacing``).
        middles: Where the corners are of the other lines that are tried where a plan breaks something [rad], n numbers
            each (``detours``).
    """

    path_scale: float
    bending_steps: int
    landing_steps: int
    expected_time: str = "distance"
    within_limits: bool = False
    paced: bool = False
    middles: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True)
class Outputs:
    """What a network says of N tasks.

    Attributes:
        offsets: What interior path control points are off the line by [rad], shape (N, interior points x n).
        rate: Rate control points [1/s], shape (N, R).
    """

    offsets: NDArray[np.float64]
    rate: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A trained model.

    Attributes:
        problem: The problem that it plans for, with its URDF.
        architecture: The network's architecture.
        parameters: All of its numbers, float32, shape (architecture.n_parameters,).
        features: Its inputs.
        meaning: Its outputs.
        rest: Names of the boundary conditions that were zero in every training row.
        training: How it was made: command, seed, dataset, steps, seconds, score; JSON-able.
        log: Its training log, one JSON object per line.
    """

    problem: ProblemRecord
    architecture: Architecture
    parameters: NDArray[np.float32]
    features: Features
    meaning: Meaning
    rest: tuple[str, ...] = ()
    training: Mapping[str, Any] = field(default_factory=dict)
    log: str = ""

    def __repr__(self) -> str:
        return f"<Model of {self.problem.name!r}: a network of {self.architecture}>"

    def outputs(self, tasks: Tasks) -> Outputs:
        """Ask the network for N tasks: in float32 itself, sums and the exponential in float64."""
        given = forward(self._weights, self.features.of(tasks))
        offsets = self.meaning.path_scale * given.path.astype(np.float64)
        if tasks.correction is not None:
            offsets += tasks.correction.reshape(offsets.shape)
        return Outputs(offsets, np.exp(given.log_rate.astype(np.float64)) / tasks.expected_time[:, None])

    @cached_property
    def _weights(self) -> Weights:
        return self.architecture.split(self.parameters)

    @cached_property
    def fixed_at_goal(self) -> int:
        """Number of path control points that the goal fixes: 2, or 3 where motions end with a given acceleration."""
        interior = self.architecture.path_outputs // len(self.problem.joint_names)
        return self.problem.trajectory.path_control_points - 3 - interior

    @property
    def rests(self) -> bool:
        """Whether all of its motions begin and end at rest, so that they may be slowed down."""
        return begins_and_ends_at_rest(self.rest, self.fixed_at_goal)


def begins_and_ends_at_rest(rest: Iterable[str], fixed_at_goal: int) -> bool:
    """Whether motions may be slowed down of which the named boundary conditions are zero; a free one need not be."""
    moving = {"start_dq", "start_ddq", "goal_dq"} | ({"goal_ddq"} if fixed_at_goal == 3 else set())
    return moving <= set(rest)
