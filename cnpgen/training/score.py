"""Score a model: its plans for validation rows, judged by Pinocchio and Coal."""

import math
from typing import Any

import numpy as np

from cnpgen.planner.inference_pipeline import InferencePipeline
from cnpgen.planner.model import Model
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.format import OBSTACLE_POSES
from cnpgen.training.training_rows import TrainingProblems

MEANS = ("duration_s", "z_error_mm_s", "vertical_error_rad_s")


def validate(
    model: Model, inference: InferencePipeline, problems: TrainingProblems, *, workers: int | None = 1
) -> dict[str, Any]:
    """Plan for validation rows and judge the plans.

    Args:
        model: The model.
        inference: Inference pipeline of its problem.
        problems: N validation rows.
        workers: Number of processes that judge.

    Returns:
        JSON-able: number of ``plans``; fractions ``valid`` and, by the paper's rules, ``paper_valid``; means of some
        metrics; ``broken``, condition -> number of violating plans; ``score``, which compares models: 1 % of the plans
        counts as much as 1 % of the motion time.
    """
    poses = problems.obstacle_poses
    columns = None if poses is None else {OBSTACLE_POSES: poses}
    plans = inference.plan(model, problems.boundary, columns=columns)
    summary = evaluate_plans(plans, workers=workers).summary()
    metrics = summary["metrics_of_all"]
    duration = float(np.mean(plans.duration))
    return {
        "plans": summary["plans"],
        "valid": summary["valid_ratio"],
        "paper_valid": summary["paper_valid_ratio"],
        **{name: metrics[name]["mean"] for name in MEANS if name in metrics},
        "broken": {
            name: condition["violating_plans"]
            for name, condition in summary["conditions"].items()
            if condition["violating_plans"]
        },
        "score": summary["valid_ratio"] - math.log(duration),
    }
