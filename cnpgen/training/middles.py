"""Choosing the corners of other lines for a trained model: configurations that mend what its plans break."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.planner.kit import Kit, make_kit, surroundings
from cnpgen.planner.model import Model
from cnpgen.schema.arguments import integer
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]

TRIED = 800  # configurations, half of them random, the others on plans that break nothing
MENDED = 500  # broken plans that they are compared by
ALONG = np.array([0.3, 0.5, 0.7])  # phases at which configurations are taken from plans


@one_thread()
def with_middles(model: Model, boundary: Boundary, *, count: int = 24, seed: int = 0) -> Model:
    """Give a model configurations where its planner has lines turn a corner if a plan breaks something.

    Of random configurations within the joint limits, and of some on its own plans, those are chosen one after the other
    that mend most of the plans which are still broken. What is broken is what ``Detours`` looks at.

    Args:
        model: A model without such configurations.
        boundary: Problems to choose by, some thousands, that it was not scored on; shape (N, n) each.
        count: How many to choose at most; fewer where no other one mends anything.
        seed: Of what is random.

    Raises:
        UsageError: ``count`` is no positive integer, or the model has such configurations already.
    """
    count = integer("count", count, least=1)
    if model.meaning.middles:
        raise UsageError(f"the model has {len(model.meaning.middles)} middles already")
    random = np.random.default_rng(seed)
    with surroundings(model.problem) as given:
        cornered = replace(model.meaning, middles=(tuple(given.robot.base.tolist()),))  # any: these are not asked for
        kit = make_kit(given, cornered, slow_down=False, fixed_at_goal=model.fixed_at_goal)
        lower, upper = given.robot.position_lower, given.robot.position_upper
    motion, whole = _planned(model, kit, boundary)
    passed = motion[np.flatnonzero(whole)].at(ALONG).q.reshape(-1, len(lower))
    passed = passed[random.permutation(len(passed))[: TRIED // 2]]
    tried = np.concatenate([random.uniform(lower, upper, (TRIED - len(passed), len(lower))), passed])
    broken = boundary[np.flatnonzero(~whole)[:MENDED]]
    mended = [_planned(model, kit, broken, np.tile(each, (len(broken), 1)))[1] for each in tried]
    chosen = tried[_most_useful(np.array(mended), count)]
    return replace(model, meaning=replace(model.meaning, middles=tuple(map(tuple, chosen.tolist()))))


def _planned(
    model: Model, kit: Kit, boundary: Boundary, middle: Array | None = None
) -> tuple[Motion, NDArray[np.bool_]]:
    """Plan, along lines with corners if ``middle`` says where; say which plans break nothing."""
    tasks = kit.prepare(boundary, middle)
    tops = kit.prepare.tops(tasks.start_xyz, tasks.goal_xyz)
    motion = kit.motion(model, tasks, tops)
    assert kit.detours is not None
    return motion, kit.detours.broken(motion, tops) <= 1


def _most_useful(mended: NDArray[np.bool_], count: int) -> list[int]:
    """Choose rows of a table that have most columns between them, one after the other."""
    chosen, left = list[int](), np.ones(mended.shape[1], bool)
    while len(chosen) < count and mended[:, left].any():
        chosen.append(int(mended[:, left].sum(axis=1).argmax()))
        left &= ~mended[chosen[-1]]
    return chosen
