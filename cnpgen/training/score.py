"""What a model is worth: its plans for validation rows, judged by Pinocchio and Coal."""

import math
from typing import Any

import numpy as np

from cnpgen.planner.kit import Kit
from cnpgen.planner.model import Model
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.trajectory.boundary import Boundary

MEANS = ("duration_s", "z_error_mm_s", "vertical_error_rad_s")


def validate(model: Model, kit: Kit, boundary: Boundary, *, workers: int | None = 1) -> dict[str, Any]:
    """Plan and judge.

    Args:
        model: The model.
        kit: The kit of its problem.
        boundary: Boundary conditions of N validation rows.
        workers: Processes that judge.

    Returns:
        For JSON: number of ``plans``; shares that are ``valid``, and by the paper's rules ``paper_valid``; the means of
        some metrics; ``broken``, condition -> plans that break it; ``score``, what models are compared by: one per cent
        of the plans is worth one per cent of the motion time.
    """
    plans = kit.plan(model, boundary)
    summary = evaluate_plans(plans, workers=workers).summary()
    metrics = summary["metrics_of_all"]
    duration = float(np.mean(plans.duration))
    return {
        "plans": summary["plans"],
        "valid": summary["valid_ratio"],
        "paper_valid": summary["paper_valid_ratio"],
        **{name: metrics[name]["mean"] for name in MEANS if name in metrics},
        "broken": {name: each["plans_out"] for name, each in summary["conditions"].items() if each["plans_out"]},
        "score": summary["valid_ratio"] - math.log(duration),
    }
