"""Train a planner in JAX with a complete recipe, and evaluate it on problems that it has not seen.

The first command makes its data.

    cnpgen make-dataset airhockey-hit --n 200000 --out hits
    python own_planner_jax.py hits --minutes 2 -o plans.h5
"""

import argparse
import time
from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np

import cnpgen
from cnpgen.interop.jax import control_points, plan_loss
from cnpgen.losses import (
    Metric,
    MetricSettings,
    rotating_shift,
    suggested_margins,
    suggested_weights,
)

STATES = ["start_q", "start_dq", "start_ddq", "goal_q", "goal_dq"]
WIDTH, LAYERS, BATCH, RATE, WARM_UP = (
    192,
    5,
    128,
    1e-3,
    200,
)  # the last: steps until the full learning rate
NODES, SHIFTS = 32, 16  # quadrature nodes of the loss, which move from step to step
SAMPLE_CLIP, BATCH_CLIP = (
    30.0,
    2.0,
)  # of gradients, in medians of the batch and in running norms
GROWTH = 10000.0  # of the weights of constraints during the run
MEMORY = 0.999  # decay of the average of the parameters
MARGINS = {
    "joint-acceleration": 0.92,
    "joint-velocity": 0.98,
}  # of limits, so that small errors stay within them


def make_parameters(layer, inputs):
    """Return weights and biases; plans begin near the projected straight line, a little slower than expected."""
    random, sizes = (
        np.random.default_rng(0),
        [inputs, *[WIDTH] * LAYERS, layer.path_outputs + layer.rate_outputs],
    )
    weights = [
        random.uniform(-1, 1, pair) / np.sqrt(pair[0]) for pair in pairwise(sizes)
    ]
    weights[-1] *= 0.1
    biases = [np.zeros(width) for width in sizes[1:]]
    biases[-1][layer.path_outputs :] = -0.5
    return jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32), list(zip(weights, biases, strict=True))
    )


def features(table, tasks):
    """Return the normalized states, tip positions, angles as sines and cosines, and the expected time."""
    start, goal = tasks.boundary.start_q, tasks.boundary.goal_q
    angles = [f(q) for f in (jnp.sin, jnp.cos) for q in (start, goal)]
    return jnp.concatenate(
        [
            table,
            tasks.start_xyz,
            tasks.goal_xyz,
            *angles,
            jnp.log(tasks.expected_time)[:, None],
        ],
        1,
    )


def network(parameters, inputs):
    """Return the outputs of the network."""
    for weight, bias in parameters[:-1]:
        inputs = jnp.tanh(inputs @ weight + bias)
    return inputs @ parameters[-1][0] + parameters[-1][1]


@jax.custom_vjp
def clipped(outputs):
    """Return the outputs; limit the gradient of every sample, so that a few plans do not determine the step."""
    return outputs


def clip_samples(_, gradient):
    """Return the limited gradient."""
    norms = jnp.linalg.norm(gradient, axis=1, keepdims=True)
    return (
        gradient
        * jnp.minimum(1, SAMPLE_CLIP * jnp.median(norms) / jnp.maximum(norms, 1e-12)),
    )


clipped.defvjp(lambda outputs: (outputs, None), clip_samples)


def make_step(layer, loss, mean, scale):
    """Return the outputs of the network and a step of Adam as jitted functions."""

    def outputs(parameters, table, tasks):
        values = clipped(network(parameters, (features(table, tasks) - mean) * scale))
        return jnp.tanh(values[:, : layer.path_outputs]), values[
            :, layer.path_outputs :
        ]

    def mean_loss(parameters, table, tasks, weights, shift):
        path, rate = control_points(layer, tasks, *outputs(parameters, table, tasks))
        scene = {"obstacle_poses": tasks.obstacle_poses, "start_tip": tasks.start_xyz}
        return plan_loss(loss, path, rate, weights=weights, **scene, shift=shift)[
            0
        ].mean()

    def step(state, table, tasks, weights, shift, rate):
        parameters, first, second, average, typical, count = state
        gradient = jax.grad(mean_loss)(parameters, table, tasks, weights, shift)
        norm = jnp.sqrt(sum((x**2).sum() for x in jax.tree.leaves(gradient)))
        typical = jnp.where(
            count == 0, norm, 0.99 * typical + 0.01 * jnp.minimum(norm, 3 * typical)
        )
        gradient = jax.tree.map(
            lambda x: x * jnp.minimum(1, BATCH_CLIP * typical / norm), gradient
        )
        count = count + 1
        first = jax.tree.map(lambda m, x: 0.9 * m + 0.1 * x, first, gradient)
        second = jax.tree.map(lambda m, x: 0.999 * m + 0.001 * x**2, second, gradient)
        rate = rate * jnp.sqrt(1 - 0.999**count) / (1 - 0.9**count)
        parameters = jax.tree.map(
            lambda p, m, v: p - rate * m / (jnp.sqrt(v) + 1e-8),
            parameters,
            first,
            second,
        )
        decay = jnp.minimum(MEMORY, (1 + count) / (10 + count))
        average = jax.tree.map(
            lambda a, p: decay * a + (1 - decay) * p, average, parameters
        )
        return parameters, first, second, average, typical, count

    return jax.jit(outputs), jax.jit(step)


def train(layer, dataset, *, seconds, steps):
    """Train for some CPU time or steps; return the outputs' function with the average of the last parameters."""
    margins = suggested_margins(layer.problem)
    margins = replace(margins, factors={**margins.factors, **MARGINS})
    loss = cnpgen.PlanLoss(dataset.problem, nodes=NODES, margins=margins)
    metric = Metric(
        suggested_weights(loss.problem, loss.weights0),
        loss.budgets,
        MetricSettings(growth=GROWTH),
    )
    first = next(iter(dataset.batches(1000, fields=STATES)))
    inputs = features(first.table, layer.tasks(cnpgen.Boundary.from_batch(first)))
    outputs, update = make_step(
        layer, loss, inputs.mean(0), 1 / jnp.maximum(inputs.std(0), 1e-6)
    )
    parameters, step, begin = (
        make_parameters(layer, inputs.shape[1]),
        0,
        time.process_time(),
    )
    zeros = jax.tree.map(jnp.zeros_like, parameters)
    state = (parameters, zeros, zeros, parameters, jnp.float32(0), jnp.int32(0))
    batches = dataset.batches(BATCH, fields=STATES)
    while True:
        for batch in batches:
            progress = (
                step / steps if steps else (time.process_time() - begin) / seconds
            )
            if progress >= 1:
                print(f"{step} steps")
                return lambda table, tasks: outputs(state[3], table, tasks)
            tasks = layer.tasks(cnpgen.Boundary.from_batch(batch))
            rate = (
                RATE
                * (0.505 + 0.495 * np.cos(np.pi * progress))
                * min(1, (step + 1) / WARM_UP)
            )
            weights, shift = (
                jnp.asarray(metric.weights(progress), jnp.float32),
                rotating_shift(step, SHIFTS),
            )
            state, step = (
                update(state, batch.table, tasks, weights, shift, rate),
                step + 1,
            )


def main():
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "dataset",
        help="folder of the dataset; its validation split has the problems to plan",
    )
    parser.add_argument(
        "--minutes", type=float, default=2.0, help="CPU time of the training"
    )
    parser.add_argument(
        "--steps", type=int, help="number of steps, in place of the CPU time"
    )
    parser.add_argument("--problems", type=int, default=1000)
    parser.add_argument("-o", "--out", default="plans.h5")
    arguments = parser.parse_args()
    dataset = cnpgen.load_dataset(arguments.dataset)
    layer = cnpgen.BoundaryLayer(dataset.problem)
    planner = train(
        layer, dataset, seconds=60 * arguments.minutes, steps=arguments.steps
    )
    options = {
        "split": "validation",
        "fields": [*STATES, "sample_id"],
        "options": cnpgen.BatchOptions(shuffle=False, drop_last=False),
    }
    batch = next(iter(dataset.batches(arguments.problems, **options)))
    tasks = layer.tasks(cnpgen.Boundary.from_batch(batch))
    plans = layer.plans(
        tasks,
        *map(np.asarray, planner(batch.table, tasks)),
        sample_id=batch["sample_id"],
    )
    evaluation = cnpgen.evaluate_plans(plans, workers=1)
    print(
        f"{evaluation.valid.mean():.1%} of {len(plans)} valid, {plans.duration.mean():.3f} s on average"
    )
    cnpgen.save_plans(arguments.out, plans)


if __name__ == "__main__":
    main()
