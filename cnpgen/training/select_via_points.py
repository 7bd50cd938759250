"""Select via points for a trained model: configurations that remove violations of its plans."""

from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.errors import UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.planner.inference_pipeline import (
    InferencePipeline,
    loaded_problem,
    make_inference_pipeline,
)
from cnpgen.planner.model import Model
from cnpgen.schema.arguments import integer
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion

CONFIGURATIONS_TRIED = 800  # half of them random, the others on plans without violation
MAX_VIOLATING_PLANS = 500  # plans that candidates are compared on
VIA_PHASES = np.array([0.3, 0.5, 0.7])  # phases of plans at which candidates are taken


@one_thread()
def with_via_points(
    model: Model, boundary: Boundary, *, count: int = 24, seed: int = 0
) -> Model:
    """Return a model with via points, through which its planner leads alternative lines if a plan has violations.

    Candidates are random configurations within the joint limits and configurations on
    the model's own plans. They are selected greedily by the number of plans that they
    repair, as measured by ``ViaPoints``.

    Args:
        model: A model without via points.
        boundary: Boundary problems to select by, some thousands, not those that the
            model is scored on; shape (N, n) each.
        count: Largest number of via points; fewer if no other one repairs a plan.
        seed: Seed of the random configurations.

    Raises:
        UsageError: ``count`` is no positive integer, the model already has via points,
            or samples place obstacles.
    """
    count = integer("count", count, least=1)
    if model.config.via_points:
        raise UsageError(
            f"the model already has {len(model.config.via_points)} via points"
        )
    random = np.random.default_rng(seed)
    with loaded_problem(model.problem) as loaded:
        if loaded.problem.has_sample_obstacles:
            raise UsageError(
                "via points are for problems that place their obstacles",
                concerns="model",
            )
        # Its value is not used.
        placeholder = (tuple(loaded.robot.home.tolist()),)
        config = replace(model.config, via_points=placeholder)
        inference = make_inference_pipeline(
            loaded, config, scale_time=False, fixed_at_goal=model.fixed_at_goal
        )
        lower, upper = loaded.robot.position_lower, loaded.robot.position_upper
    motion, satisfied = _planned(model, inference, boundary)
    on_plans = motion[np.flatnonzero(satisfied)].at(VIA_PHASES).q
    on_plans = on_plans.reshape(-1, len(lower))
    on_plans = on_plans[random.permutation(len(on_plans))[: CONFIGURATIONS_TRIED // 2]]
    n_random = CONFIGURATIONS_TRIED - len(on_plans)
    others = random.uniform(lower, upper, (n_random, len(lower)))
    candidates = np.concatenate([others, on_plans])
    # Each candidate is judged by the plans that it repairs.
    violating = boundary[np.flatnonzero(~satisfied)[:MAX_VIOLATING_PLANS]]
    repaired = [
        _planned(model, inference, violating, np.tile(q, (len(violating), 1)))[1]
        for q in candidates
    ]
    selected = candidates[_greedy_cover(np.array(repaired), count)]
    config = replace(model.config, via_points=tuple(map(tuple, selected.tolist())))
    return replace(model, config=config)


def _planned(
    model: Model,
    inference: InferencePipeline,
    boundary: Boundary,
    via_point: Array | None = None,
) -> tuple[Motion, Mask]:
    """Plan, along lines through via points if given.

    Return the motions and a mask of those without violation.
    """
    tasks = inference.prepare(boundary, via_point)
    motion = inference.motion(model, tasks)
    assert inference.via_points is not None
    # Violations are relative to the tolerances.
    return motion, inference.via_points.violation(motion, tasks.scene.poses) <= 1


def _greedy_cover(repaired: Mask, count: int) -> list[int]:
    """Return rows of a table whose union has most columns, selected greedily."""
    selected = list[int]()
    remaining = np.ones(repaired.shape[1], bool)
    while len(selected) < count and repaired[:, remaining].any():
        # Greedy maximum coverage: the candidate that repairs most of the plans that are
        # still violating.
        selected.append(int(repaired[:, remaining].sum(axis=1).argmax()))
        remaining &= ~repaired[selected[-1]]
    return selected
