"""Attempts among obstacles: on hulls in place of capsules, and along joint-space paths of RRT-Connect."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.refiner import Refiner
from cnpgen.refine.rrt_connect import find_paths
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.task import MAX_JUDGED_VIOLATION, Attempt, Outcome, RefinementTask
from cnpgen.refine.tree_paths import TreeSearch

Array = NDArray[np.float64]

MAX_PENETRATION_M = 0.02  # of links in a plan that hull levels continue from
MIN_END_PENETRATION_M = 1e-5  # of an end: smaller ones may be rounding errors
MAX_LINE_PENETRATION_M = 0.05  # of the initial line, above which joint-space paths come first


def is_deep(refiner: Refiner, task: RefinementTask, hulls: Hulls) -> bool:
    """Return whether the initial line is so deep in an obstacle that paths around it are tried first."""
    motion = refiner.transcription(task, refiner.levels.coarse)
    positions = motion.positions(refiner.line_guess(task))
    return hulls.violation(positions, task.scene.poses[0]) > MAX_LINE_PENETRATION_M


def ends_penetrate(task: RefinementTask, hulls: Hulls) -> bool:
    """Return whether an end is inside an obstacle or another link, so that no motion is valid."""
    ends = np.stack([task.boundary.start_q[0], task.boundary.goal_q[0]], axis=1)
    return hulls.violation(ends, task.scene.poses[0], above_tolerance=True) > MIN_END_PENETRATION_M


def around_obstacles(refiner: Refiner, task: RefinementTask, best: Attempt, hulls: Hulls) -> Iterator[Attempt]:
    """Yield attempts on hulls in place of capsules, and along joint-space paths around the obstacles.

    The best attempt so far is continued first if its links hardly penetrate anything.
    """
    if ends_penetrate(task, hulls):
        return
    if refiner.measures_hulls:
        found_path = False
        for guess in path_guesses(refiner, task, hulls):
            found_path, attempt = True, along_path(refiner, task, guess)
            yield attempt
            if attempt.violation <= MAX_JUDGED_VIOLATION:
                yield refiner.solve(task, refiner.levels.strict, attempt.variables, Outcome.RESTARTED)
        if not found_path:
            yield replace(best, outcome=Outcome.NO_PATH, iterations=0)
        return
    positions = refiner.check.transcription(task).positions(best.variables)
    best_first = hulls.violation(positions, task.scene.poses[0]) < MAX_PENETRATION_M
    if best_first:
        yield from _on_hulls(refiner, task, best, hulls)
    for guess in path_guesses(refiner, task, hulls):
        attempt = along_path(refiner, task, guess)
        yield attempt
        yield from _on_hulls(refiner, task, attempt if attempt.violation <= 1 else guess, hulls)
    if not best_first:
        yield from _on_hulls(refiner, task, best, hulls)


def _on_hulls(refiner: Refiner, task: RefinementTask, guess: Attempt, hulls: Hulls) -> Iterator[Attempt]:
    """Yield attempts on hulls in place of capsules: on the coarse and on the strict level."""
    coarse = refiner.solve(task, refiner.levels.warm, guess.variables, Outcome.RESTARTED, hulls)
    yield coarse
    if coarse.violation <= 1:
        yield refiner.solve(task, refiner.levels.strict, coarse.variables, Outcome.RESTARTED, hulls)


def path_guesses(refiner: Refiner, task: RefinementTask, hulls: Hulls | None = None) -> Iterator[Attempt]:
    """Yield motions along valid joint-space paths, scaled in time if they are from rest to rest."""
    boundary, space = task.boundary, refiner.rest_space(task, hulls)
    if hulls is not None and refiner.measures_hulls:
        paths = TreeSearch(task, space, hulls, refiner.manifold(task)).paths()
    else:
        paths = find_paths(boundary.start_q[0], boundary.goal_q[0], refiner.robot, space.follow)
    for states in paths:
        guess = refiner.path_guess(task, states)
        yield refiner.measured(task, guess, Outcome.RESTARTED, unlimited=True)


def along_path(refiner: Refiner, task: RefinementTask, guess: Attempt) -> Attempt:
    """Optimize a motion along a joint-space path: with a high penalty of violations first, then as usual."""
    best = refiner.solve(task, refiner.levels.path, guess.variables, Outcome.RESTARTED)
    same_level = refiner.levels.path is refiner.levels.warm and best.outcome is not Outcome.TIME_SCALED
    if best.violation <= 1 and not same_level:
        again = refiner.solve(task, refiner.levels.warm, best.variables, Outcome.RESTARTED)
        best = refiner.continue_scaled(task, again if again.is_better(best) else best)
    return replace(best, outcome=Outcome.RESTARTED)
