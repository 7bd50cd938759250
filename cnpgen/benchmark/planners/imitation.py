"""Training of the network that proposes configurations, on plans: the likelihood of what came next on them."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.planners.proposals import LEAST, Proposals, inputs_of, standardised
from cnpgen.errors import UsageError
from cnpgen.machine.versions import __version__
from cnpgen.planner.network.architecture import Architecture, Weights, initial_parameters
from cnpgen.planner.network.forward import backward, forward
from cnpgen.plans.plans import Plans
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.record import open_problem
from cnpgen.training.adam import learning_rate, start_adam

Array = NDArray[Any]

MOMENTS = 40  # states of every plan
HIDDEN, LAYERS, BATCH, STEPS, RATE = 128, 3, 256, 12_000, 2e-3


def train_proposals(plans: Plans, *, ahead: float, steps: int = STEPS, seed: int = 0) -> Proposals:
    """Train a network to tell what comes next on plans.

    Args:
        plans: Valid plans of one problem: rows of a certified dataset, for example.
        ahead: What "next" is: so much later [s].
        steps: Steps of training.
        seed: Seed of parameters, moments and batches.

    Raises:
        UsageError: There are no plans.
    """
    if not len(plans):
        raise UsageError("no plans to train on")
    random = np.random.default_rng(seed)
    inputs, moved = _rows(plans, ahead, random)
    robot = open_problem(plans.problem)[1]
    reach, deviation = robot.velocity_limit * ahead, inputs.std(axis=0)
    scale = np.where(deviation > 1e-9, 1 / np.maximum(deviation, 1e-9), 0.0)
    architecture = Architecture(
        inputs=inputs.shape[1], hidden=HIDDEN, layers=LAYERS, path_outputs=robot.n, rate_outputs=robot.n
    )
    parameters = initial_parameters(architecture, seed=seed, head_scale=0.1, rate_bias=-1.0)
    made = {"made": f"{len(plans)} plans of {plans.problem.name}, {steps} steps, seed {seed}, cnpgen {__version__}"}
    network = Proposals(architecture, parameters, inputs.mean(axis=0), scale, reach, ahead, made)
    features, targets = standardised(inputs, network.mean, scale), (moved / reach).astype(np.float32)
    return replace(network, parameters=_fitted(network, features, targets, steps, random))


def _rows(plans: Plans, ahead: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Return inputs and what the joints moved by afterwards [rad], at random moments of all plans."""
    first = random.uniform(0, 1, (len(plans), MOMENTS)) * plans.duration[:, None]
    now = plans.motion.at_times(first)
    later = plans.motion.at_times(np.minimum(first + ahead, plans.duration[:, None]))
    tops = obstacle_tops(plans.problem, plans.columns["start_xyz"], plans.columns["goal_xyz"])
    goal_q, tops = (np.repeat(each, MOMENTS, axis=0) for each in (plans.boundary.goal_q, tops))
    states = np.concatenate([now.q, now.dq], axis=2).reshape(len(goal_q), -1)
    return inputs_of(states, goal_q, tops), (later.q - now.q).reshape(len(goal_q), -1)


def _fitted(network: Proposals, features: Array, targets: Array, steps: int, random: np.random.Generator) -> Array:
    """Take all steps; return the average of the last parameters."""
    adam, gradient = start_adam(network.parameters.copy()), np.empty_like(network.parameters)
    split = network.architecture.split
    for step in range(steps):
        batch = random.integers(0, len(features), BATCH)
        likelihood_gradient(split(adam.parameters), features[batch], targets[batch], out=split(gradient))
        adam.update(gradient, rate=learning_rate(step, steps, peak=RATE, final=0.01, warm_up=100))
    return adam.average


def likelihood_gradient(weights: Weights, features: Array, targets: Array, *, out: Weights) -> float:
    """Write the gradient of the mean negative logarithm of the likelihood, up to a constant.

    Args:
        weights: Of the network.
        features: Its standardised inputs, shape (N, F).
        targets: What the joints moved by, as shares of their reach, shape (N, n).
        out: Where to, as ``weights``.

    Returns:
        What it is the gradient of.
    """
    given = forward(weights, features)
    deviation = np.exp(given.log_rate) + LEAST
    off = (given.path - targets) / deviation
    slope = (1 - off * off) / deviation * (deviation - LEAST)
    backward(
        weights,
        given,
        path_gradient=off / deviation / len(features),
        log_rate_gradient=slope / len(features),
        out=out,
    )
    return float(np.mean(np.sum(off * off / 2 + np.log(deviation), axis=1)))
