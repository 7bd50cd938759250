"""Train a planner in torch with a complete recipe, and evaluate it on problems that it has not seen.

cnpgen make-dataset airhockey-hit --n 200000 --out hits
python own_planner_torch.py hits --minutes 2 -o plans.h5
"""

import argparse
import copy
import math
import time
from dataclasses import replace
from itertools import pairwise

import torch

import cnpgen
from cnpgen.interop.torch import BatchDataset, control_points, plan_loss, to_torch
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


class Planner(torch.nn.Module):
    """A network on standardized features; it begins near the projected straight line, a little slower than expected."""

    def __init__(self, layer, rows):
        super().__init__()
        self.layer = layer
        features = self.features(rows, layer.tasks(cnpgen.Boundary.from_batch(rows)))
        self.mean, self.scale = features.mean(0), 1 / features.std(0).clamp(min=1e-6)
        sizes = [features.shape[1], *[WIDTH] * LAYERS]
        hidden = [
            part
            for pair in pairwise(sizes)
            for part in (torch.nn.Linear(*pair), torch.nn.Tanh())
        ]
        head = torch.nn.Linear(WIDTH, layer.path_outputs + layer.rate_outputs)
        with torch.no_grad():
            head.weight *= 0.1
            head.bias.zero_()[layer.path_outputs :] = -0.5
        self.network = torch.nn.Sequential(*hidden, head)

    @staticmethod
    def features(batch, tasks):
        """Return the normalized states, tip positions, angles as sines and cosines, and the expected time."""
        start, goal = (
            torch.from_numpy(q).float()
            for q in (tasks.boundary.start_q, tasks.boundary.goal_q)
        )
        tips = [
            torch.from_numpy(xyz).float() for xyz in (tasks.start_xyz, tasks.goal_xyz)
        ]
        angles = [start.sin(), goal.sin(), start.cos(), goal.cos()]
        return torch.cat(
            [
                batch.table,
                *tips,
                *angles,
                torch.from_numpy(tasks.expected_time).float().log()[:, None],
            ],
            1,
        )

    def forward(self, batch):
        """Return the tasks of a batch and the outputs for the boundary layer."""
        tasks = self.layer.tasks(cnpgen.Boundary.from_batch(batch))
        outputs = self.network((self.features(batch, tasks) - self.mean) * self.scale)
        if outputs.requires_grad:
            outputs.register_hook(clip_samples)
        phi, log_rate = outputs.split(
            [self.layer.path_outputs, self.layer.rate_outputs], dim=1
        )
        return tasks, phi.tanh(), log_rate


def clip_samples(gradient):
    """Limit the gradient of every sample, so that a few plans in collision do not determine the step."""
    norms = gradient.norm(dim=1, keepdim=True)
    return gradient * (SAMPLE_CLIP * norms.median() / norms.clamp(min=1e-12)).clamp(
        max=1
    )


def train(planner, dataset, *, seconds, steps):
    """Train for some CPU time or steps; return the planner with the average of the last parameters."""
    margins = suggested_margins(planner.layer.problem)
    margins = replace(margins, factors={**margins.factors, **MARGINS})
    loss = cnpgen.PlanLoss(dataset.problem, nodes=NODES, margins=margins)
    metric = Metric(
        suggested_weights(loss.problem, loss.weights0),
        loss.budgets,
        MetricSettings(growth=GROWTH),
    )
    batches, average = (
        BatchDataset(dataset.batches(BATCH, fields=STATES)),
        copy.deepcopy(planner),
    )
    parameters, means = list(planner.parameters()), list(average.parameters())
    optimizer = torch.optim.Adam(parameters, fused=True)
    step, typical, begin = 0, math.inf, time.process_time()
    while True:
        for batch in batches:
            progress = (
                step / steps if steps else (time.process_time() - begin) / seconds
            )
            if progress >= 1:
                print(f"{step} steps")
                return average
            tasks, phi, log_rate = planner(batch)
            path, rate = control_points(planner.layer, tasks, phi, log_rate)
            scene = {
                "obstacle_poses": tasks.obstacle_poses,
                "start_tip": tasks.start_xyz,
            }
            shift = rotating_shift(step, SHIFTS)
            total, _ = plan_loss(
                loss, path, rate, weights=metric.weights(progress), **scene, shift=shift
            )
            optimizer.zero_grad()
            total.mean().backward()
            norm = float(
                torch.nn.utils.clip_grad_norm_(parameters, BATCH_CLIP * typical)
            )
            typical = (
                norm
                if math.isinf(typical)
                else 0.99 * typical + 0.01 * min(norm, 3 * typical)
            )
            cosine = 0.505 + 0.495 * math.cos(math.pi * progress)
            optimizer.param_groups[0]["lr"] = (
                RATE * cosine * min(1, (step + 1) / WARM_UP)
            )
            optimizer.step()
            step += 1
            with torch.no_grad():
                for mean, value in zip(means, parameters, strict=True):
                    mean.lerp_(value, 1 - min(MEMORY, (1 + step) / (10 + step)))


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
    torch.manual_seed(0)
    torch.set_num_threads(1)
    dataset = cnpgen.load_dataset(arguments.dataset)
    first = to_torch(next(iter(dataset.batches(1000, fields=STATES))))
    planner = Planner(cnpgen.BoundaryLayer(dataset.problem), first)
    planner = train(
        planner, dataset, seconds=60 * arguments.minutes, steps=arguments.steps
    )
    options = {
        "split": "validation",
        "fields": [*STATES, "sample_id"],
        "options": cnpgen.BatchOptions(shuffle=False, drop_last=False),
    }
    batch = to_torch(next(iter(dataset.batches(arguments.problems, **options))))
    with torch.no_grad():
        plans = planner.layer.plans(*planner(batch), sample_id=batch["sample_id"])
    evaluation = cnpgen.evaluate_plans(plans, workers=1)
    print(
        f"{evaluation.valid.mean():.1%} of {len(plans)} valid, {plans.duration.mean():.3f} s on average"
    )
    cnpgen.save_plans(arguments.out, plans)


if __name__ == "__main__":
    main()
