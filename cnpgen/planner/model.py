"""A trained model: network parameters, definition of its inputs and outputs, and training metadata."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.network.architecture import Architecture, Weights, forward
from cnpgen.planner.network.features import Features
from cnpgen.planner.tasks import Tasks
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.schema.argument_types import checked_arguments

MAX_NETWORK_ITERATIONS = 20


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Definition of the network's outputs.

    Attributes:
        path_scale: Factor of the configuration head's output [rad]; pi in the paper.
        line_projection_steps: Gauss-Newton steps that project the line onto the
            equalities; 0 in the paper.
        projection_steps: Gauss-Newton steps that project the path onto the equalities.
        expected_time: Unit of durations: "distance", the time of the distance at the
            velocity limits, at least 0.2 s; "travel", the same without a lower bound,
            as in the authors' implementation; or "reach", the minimum time in which
            every joint could reach its goal state.
        within_limits: Whether control points are clipped to the joint limits after each
            of these steps, and without any of them once.
        time_parametrized: Whether rates are fitted to the limits after the network
            (``time_parametrization``).
        via_points: Via points of alternative lines for plans with violations [rad], n
            numbers each (``ViaPoints``).
        iterations: Number of evaluations of the network; each one after the first
            corrects the path of the one before.
    """

    path_scale: float
    line_projection_steps: int
    projection_steps: int
    expected_time: str = "distance"
    within_limits: bool = False
    time_parametrized: bool = False
    via_points: tuple[tuple[float, ...], ...] = ()
    iterations: int = 1


@dataclass(frozen=True)
class Outputs:
    """Network outputs of N tasks.

    Attributes:
        offsets: Offsets of interior path control points from the line [rad], shape (N,
            interior points x n).
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
        parameters: All parameters, float32, shape (architecture.n_parameters,).
        features: Definition of its inputs.
        config: Definition of its outputs.
        zero_conditions: Names of the boundary conditions that were zero in all training
            rows.
        training: Training metadata: command, seed, dataset, steps, seconds, score;
            JSON-able.
        log: Its training log, one JSON object per line.
    """

    problem: ProblemRecord
    architecture: Architecture
    parameters: NDArray[np.float32]
    features: Features
    config: ModelConfig
    zero_conditions: tuple[str, ...] = ()
    training: Mapping[str, Any] = field(default_factory=dict)
    log: str = ""

    def __repr__(self) -> str:
        text = f"a network of {self.architecture}, goal_acceleration = {self.goal_acceleration!r}"
        return f"<Model of {self.problem.name!r}: {text}>"

    @checked_arguments
    def outputs(self, tasks: Tasks) -> Outputs:
        """Evaluate the network for N tasks, in float32.

        Sums and the exponential are in float64.
        """
        return outputs_of(self, tasks)

    @cached_property
    def _weights(self) -> Weights:
        return self.architecture.split(self.parameters)

    @cached_property
    def fixed_at_goal(self) -> int:
        """Number of path control points that the goal fixes: 2, or 3 if goal accelerations are given."""
        # Interior outputs tell how many control points the goal fixes.
        interior = self.architecture.path_outputs // len(self.problem.joint_names)
        return self.problem.trajectory.path_control_points - 3 - interior

    @property
    def goal_acceleration(self) -> str:
        """Whether motions end with any acceleration, "free", or with that of the problem, "given"."""
        return "free" if self.fixed_at_goal == 2 else "given"

    @property
    def is_rest_to_rest(self) -> bool:
        """Whether all of its motions begin and end at rest, so that they may be scaled in time."""
        return is_rest_to_rest(self.zero_conditions, self.fixed_at_goal)


def outputs_of(model: Model, tasks: Tasks) -> Outputs:
    """Evaluate the network like ``Model.outputs``, without a check of the argument's type."""
    activations = forward(model._weights, model.features.of(tasks))
    # The head ends in tanh: offsets are within +- path_scale [rad].
    offsets = model.config.path_scale * activations.path.astype(np.float64)
    if tasks.correction is not None:
        offsets += tasks.correction.reshape(offsets.shape)
    rate = np.exp(activations.log_rate.astype(np.float64))
    rate /= tasks.expected_time[:, None]
    return Outputs(offsets, rate)


def is_rest_to_rest(zero_conditions: Iterable[str], fixed_at_goal: int) -> bool:
    """Return whether motions with these zero conditions begin and end at rest.

    A free condition need not be zero.
    """
    # A free acceleration at the goal is no condition.
    moving = {"start_dq", "start_ddq", "goal_dq"} | (
        {"goal_ddq"} if fixed_at_goal == 3 else set()
    )
    return moving <= set(zero_conditions)
