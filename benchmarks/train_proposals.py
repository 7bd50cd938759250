"""Train the networks of ``cnpgen.addons.paper.proposals``, which maximize the likelihood of the next configuration."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from cnpgen.addons.paper.proposals import (
    MIN_PROPOSAL_DEVIATION,
    PROPOSALS_KIND,
    PROPOSALS_VERSION,
    Proposals,
    inputs_of,
    standardize,
)
from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError
from cnpgen.machine.versions import __version__
from cnpgen.planner.network.architecture import (
    Architecture,
    Weights,
    backward,
    forward,
    initial_parameters,
)
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.robots.solid import pose_width
from cnpgen.store.files.checksum_file import Content, write_with_checksum
from cnpgen.training.adam import learning_rate, start_adam

STATES_PER_PLAN = 40
HIDDEN_WIDTH = 128
HIDDEN_LAYERS = 3
BATCH_ROWS = 256
TRAINING_STEPS = 12_000
PEAK_LEARNING_RATE = 2e-3


def train_proposals(
    plans: Plans, *, ahead: float, steps: int = TRAINING_STEPS, seed: int = 0
) -> Proposals:
    """Train a network to predict the next configuration on plans.

    Args:
        plans: Valid plans of one problem, for example samples of a certified dataset.
        ahead: Time until the next configuration [s].
        steps: Steps of training.
        seed: Seed of parameters, times and batches.

    Raises:
        UsageError: There are no plans.
    """
    if not len(plans):
        raise UsageError("no plans to train on")
    random = np.random.default_rng(seed)
    inputs, changes = _training_rows(plans, ahead, random)
    robot = open_problem(plans.problem)[1]
    reach = robot.velocity_limit * ahead
    deviation = inputs.std(axis=0)
    scale = np.where(deviation > 1e-9, 1 / np.maximum(deviation, 1e-9), 0.0)
    architecture = Architecture(
        inputs=inputs.shape[1],
        hidden=HIDDEN_WIDTH,
        layers=HIDDEN_LAYERS,
        path_outputs=robot.n,
        rate_outputs=robot.n,
    )
    parameters = initial_parameters(
        architecture, seed=seed, head_scale=0.1, rate_bias=-1.0
    )
    made = {
        "made": f"{len(plans)} plans of {plans.problem.name}, {steps} steps, seed {seed}, cnpgen {__version__}"
    }
    network = Proposals(
        architecture, parameters, inputs.mean(axis=0), scale, reach, ahead, made
    )
    features = standardize(inputs, network.mean, scale)
    targets = (changes / reach).astype(np.float32)
    return replace(network, parameters=_fit(network, features, targets, steps, random))


def _training_rows(
    plans: Plans, ahead: float, random: np.random.Generator
) -> tuple[AnyArray, AnyArray]:
    """Return inputs and the following changes of the joints [rad], at random times of all plans."""
    first = (
        random.uniform(0, 1, (len(plans), STATES_PER_PLAN)) * plans.duration[:, None]
    )
    now = plans.motion.at_times(first)
    later = plans.motion.at_times(np.minimum(first + ahead, plans.duration[:, None]))
    ends = (
        plans.boundary.goal_q,
        plans.scene.poses[:, : pose_width(plans.scene.obstacles)],
    )
    goal_q, obstacle_poses = (
        np.repeat(values, STATES_PER_PLAN, axis=0) for values in ends
    )
    states = np.concatenate([now.q, now.dq], axis=2).reshape(len(goal_q), -1)
    return inputs_of(states, goal_q, obstacle_poses), (later.q - now.q).reshape(
        len(goal_q), -1
    )


def _fit(
    network: Proposals,
    features: AnyArray,
    targets: AnyArray,
    steps: int,
    random: np.random.Generator,
) -> AnyArray:
    """Run all training steps; return the average of the last parameters."""
    adam = start_adam(network.parameters.copy())
    gradient = np.empty_like(network.parameters)
    split = network.architecture.split
    for step in range(steps):
        batch = random.integers(0, len(features), BATCH_ROWS)
        likelihood_gradient(
            split(adam.parameters), features[batch], targets[batch], out=split(gradient)
        )
        adam.update(
            gradient,
            rate=learning_rate(
                step, steps, peak=PEAK_LEARNING_RATE, final=0.01, warm_up=100
            ),
        )
    return adam.average


def likelihood_gradient(
    weights: Weights, features: AnyArray, targets: AnyArray, *, out: Weights
) -> float:
    """Write the gradient of the mean negative logarithm of the likelihood; return this mean, up to the constant.

    Features are the standardized inputs, shape (N, F). Targets are the changes of the
    joints as fractions of their reach, shape (N, n).
    """
    prediction = forward(weights, features)
    deviation = np.exp(prediction.log_rate) + MIN_PROPOSAL_DEVIATION
    residual = (prediction.path - targets) / deviation
    log_rate_gradient = (
        (1 - residual * residual) / deviation * (deviation - MIN_PROPOSAL_DEVIATION)
    )
    backward(
        weights,
        prediction,
        path_gradient=residual / deviation / len(features),
        log_rate_gradient=log_rate_gradient / len(features),
        out=out,
    )
    return float(np.mean(np.sum(residual * residual / 2 + np.log(deviation), axis=1)))


def save_proposals(path: str | Path, proposals: Proposals) -> None:
    """Write a network to a file, atomically; equal networks give equal bytes.

    Raises:
        MachineError: The file cannot be written.
    """
    arrays = {
        name: getattr(proposals, name)
        for name in ("parameters", "mean", "scale", "reach")
    }
    arrays["ahead"] = np.array([proposals.ahead])
    arrays["architecture"] = np.array(list(asdict(proposals.architecture).values()))
    content = Content(arrays, dict(proposals.training))
    write_with_checksum(
        Path(path), content, kind=PROPOSALS_KIND, version=PROPOSALS_VERSION
    )
