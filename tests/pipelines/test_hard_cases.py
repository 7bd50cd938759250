"""Difficult cases, found by comparing thousands of samples with SciPy's SLSQP from several initial guesses."""

import json
from pathlib import Path

import numpy as np
import pytest

from cnpgen.pipelines.stages.hitting_configuration import HittingConfiguration
from cnpgen.pipelines.stages.hitting_newton import objective
from cnpgen.pipelines.stages.stage import CandidateBatch
from tests.conftest import Prepare

CASES = json.loads(
    (Path(__file__).parents[1] / "data" / "hitting_configurations.json").read_text()
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['best']:.3f}")
def test_the_better_of_two_local_optima_is_found(prepare: Prepare, case: dict) -> None:
    prepared = prepare("airhockey-replan")
    (stage,) = (
        each
        for each in prepared.pipeline.stage
        if isinstance(each, HittingConfiguration)
    )
    candidates = CandidateBatch(1)
    for name in ("start_q", "goal_xyz"):
        candidates[name] = np.array(case[name])[:, None]
    direction = np.array(case["direction"])[:, None]
    candidates["hit_angle"] = np.arctan2(direction[1:], direction[:1])
    stage.prepare(prepared.context)(candidates, np.random.default_rng())
    (found,) = prepared.context.kernels.load(objective)(
        candidates["goal_q"], direction, candidates["start_q"]
    )
    assert found[0, 0] >= case["best"] - 1e-6
