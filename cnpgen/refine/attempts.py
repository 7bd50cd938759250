"""Order of the attempts at a task: the next one is made only if no earlier one was accepted.

No attempt follows if an end is invalid itself (``cnpgen.refine.strategy``): no path helps then.

1. Plans with finer knots than their problem: the levels of step 2 with the problem's own control points.
2. Coarse level from the input plan or a straight line, uniform time scaling, fine level, strict level.
3. Other initial guesses, and the best attempt so far after uniform time scaling.
4. Step 2 again, from a straight line at constant rate, then from the best attempt so far.
5. Without a deadline: levels on hulls in place of capsules, and joint-space paths of RRT-Connect. If the solver measures
   hulls, these paths come right after step 2, whose finer levels run only for nearly
   valid attempts. Without a path there are no further attempts.
"""

from collections.abc import Generator, Iterator
from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import MAX_JOINTS
from cnpgen.refine.grid_levels import MAX_INITIAL_VIOLATION, GridLevel
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.sqp import Result
from cnpgen.refine.task import MAX_JUDGED_VIOLATION, Attempt, Outcome, RefinementTask
from cnpgen.trajectory.remaining_trajectory import with_fewer_knots, with_finer_knots
from cnpgen.trajectory.spline_motion import Motion

# Tolerances; attempts with larger violations are left for joint-space paths.
NEARLY_VALID = 30.0
# Of the usual level along tree paths, before that for such paths follows it.
MAX_FAILURES = 1
MAX_PENETRATION_M = 0.02  # of links in a plan that hull levels continue from
# Of the initial line, above which joint-space paths come first.
MAX_LINE_PENETRATION_M = 0.05


def make_attempts(
    refiner: Refiner, task: RefinementTask, x: Array | None
) -> Iterator[Attempt]:
    """Yield attempts at a task with an input plan of variables x, or None.

    They stay near its path if they must.
    """
    task = replace(task, stay_within=None) if x is None else task
    for attempt in _all_attempts(refiner, task, x):
        if task.is_near(attempt.path, refiner.spec.degree):
            yield attempt


def _all_attempts(
    refiner: Refiner, task: RefinementTask, x: Array | None
) -> Iterator[Attempt]:
    if refiner.settings.max_iterations == 0:
        first = refiner.line_guess(task) if x is None else x
        outcome = Outcome.SOLVED if x is None else Outcome.ADJUSTED
        yield refiner.measured(task, first, outcome, unlimited=True)
        return
    # A plan with more control points than the problem's is refined with the problem's
    # first, which is faster.
    if x is not None and refiner.coarser is not None:
        yield from _with_fewer_control_points(refiner, refiner.coarser, task, x)
    adjusted = None
    if x is not None and task.at_rest:
        adjusted = refiner.measured(task, x, Outcome.ADJUSTED)
    # Trees that check hulls only take milliseconds; other paths are the last resort.
    searches_trees = refiner.measures_hulls and task.deadline is None
    # From a line deep inside an obstacle the coarse level cannot find a way around it.
    if searches_trees and x is None and _is_deep(refiner, task):
        best = refiner.measured(task, refiner.line_guess(task), Outcome.NOT_CONVERGED)
        yield best
    else:
        limit = NEARLY_VALID if searches_trees else np.inf
        best = yield from run_levels(refiner, task, x, adjusted, max_violation=limit)
    if task.stay_within is not None:
        # Other guesses are other paths.
        return
    if searches_trees:
        best = yield from _best_of(along_tree_paths(refiner, task, best), best)
    start = x if adjusted is None else adjusted.variables
    others = _from_other_guesses(refiner, task, start, best)
    best = yield from _best_of(others, best)
    best = yield from _from_even_line(refiner, task, x, best)
    if searches_trees or task.deadline is not None:
        return
    if refiner.has_hulls:
        yield from around_obstacles(refiner, task, best)
    elif task.at_rest and refiner.robot.n <= MAX_JOINTS:
        for guess in path_guesses(refiner, task):
            yield along_path(refiner, task, refiner.levels.path, guess)


def _best_of(
    attempts: Iterator[Attempt], best: Attempt
) -> Generator[Attempt, None, Attempt]:
    """Yield attempts; return the best of them and ``best``."""
    for attempt in attempts:
        yield attempt
        best = attempt if attempt.is_better(best) else best
    return best


# Levels from one initial guess


def _with_fewer_control_points(
    refiner: Refiner, coarser: Refiner, task: RefinementTask, x: Array
) -> Iterator[Attempt]:
    """Yield the attempts of the levels with the problem's own control points, written with all of the plan's.

    With three times as many control points a step takes ten times as long, for
    objectives that are 0.3 % lower.
    """
    # The ends may fix more control points than the problem's splines have.
    if coarser.spec.path_control_points < task.boundary.min_control_points(
        coarser.spec.degree
    ):
        return
    own = refiner.check.transcription(task)
    fewer = coarser.check.transcription(task)
    degree = refiner.spec.degree
    path, rate = own.unpack(x)
    fitted = with_fewer_knots(
        Motion(path[None], rate[None], degree), task.boundary, coarser.spec
    )
    guess = coarser.input_variables(
        replace(task, path=fitted.path[0], rate=fitted.rate[0])
    )
    for attempt in () if guess is None else run_levels(coarser, task, guess, None):
        motion = Motion(attempt.path[None], attempt.rate[None], degree)
        # Knot insertion does not change the curve.
        finer = with_finer_knots(motion, refiner.spec)
        variables = own.pack(finer.path[0], finer.rate[0])
        path, rate = own.unpack(variables)
        yield replace(attempt, x=variables, path=path, rate=rate)
    if task.deadline is not None:
        # Estimate for steps with all control points.
        task.deadline.max_duration *= (own.nx / fewer.nx) ** 2


def run_levels(
    refiner: Refiner,
    task: RefinementTask,
    x: Array | None,
    adjusted: Attempt | None,
    line: Array | None = None,
    *,
    max_violation: float = np.inf,
) -> Generator[Attempt, None, Attempt]:
    """Yield the attempts of the coarse, fine and strict levels; return the best one.

    For motions from rest to rest ``adjusted`` is the input plan with exact ends, scaled
    in time, which replaces x. ``line`` is the initial guess without a plan, or with a
    plan of large violation; the straight line by default. The finer levels are left out
    if the violation of the coarse level is above ``max_violation``, in tolerances.
    """
    coarse = run_coarse_level(
        refiner, task, x if adjusted is None else adjusted.variables, line
    )
    outcome = Outcome.SOLVED if coarse.converged else Outcome.NOT_CONVERGED
    feasible = coarse.violation <= refiner.settings.violation_tolerance
    if feasible:
        # The solver minimizes the objective plus the smoothing of log r; attempts are
        # compared by the objective alone.
        cost = coarse.cost - refiner.check.transcription(task).regularization(coarse.x)
        # most of these are valid, so that their violation is not needed
        yield refiner.attempt(
            task, coarse.x, cost, outcome, iterations=coarse.iterations, violation=0.0
        )
    best = refiner.measured(
        task, coarse.x, outcome, 0 if feasible else coarse.iterations
    )
    best = refiner.continue_scaled(task, best)
    if not feasible or best.x is not coarse.x:
        yield best
    # The fine levels would start far from any valid motion.
    if best.violation > max_violation:
        return best
    return (yield from _finer_levels(refiner, task, adjusted, best))


def _finer_levels(
    refiner: Refiner, task: RefinementTask, adjusted: Attempt | None, best: Attempt
) -> Generator[Attempt, None, Attempt]:
    """Yield the attempts of the fine and strict levels from ``best``; return the best one."""
    fine = refiner.solve(task, refiner.levels.fine, best.variables, Outcome.SOLVED_FINE)
    yield fine
    if (
        adjusted is not None
        and adjusted.outcome is Outcome.TIME_SCALED
        and adjusted.violation <= 1
    ):
        yield adjusted
    best = fine if fine.is_better(best) else best
    strict = refiner.solve(
        task, refiner.levels.strict, best.variables, Outcome.SOLVED_FINE
    )
    yield strict
    return strict if strict.is_better(best) else best


def run_coarse_level(
    refiner: Refiner, task: RefinementTask, x: Array | None, line: Array | None
) -> Result:
    """Run the coarse level from variables x, or from a line if there are none or their violation is too large."""
    if x is not None:
        result = refiner.run_level(task, refiner.levels.warm, x)
        if result.violation < MAX_INITIAL_VIOLATION:
            return result
    return refiner.run_level(
        task, refiner.levels.coarse, refiner.line_guess(task) if line is None else line
    )


# Other initial guesses


def _from_other_guesses(
    refiner: Refiner, task: RefinementTask, x: Array | None, best: Attempt
) -> Iterator[Attempt]:
    """Yield attempts from the input plan with more iterations, from other guesses, and from the best attempt."""
    for guess in [*([] if x is None else [x]), *refiner.other_guesses(task)]:
        other = refiner.solve(task, refiner.levels.restart, guess, Outcome.RESTARTED)
        yield other
        best = other if other.is_better(best) else best
    # Uniform scaling comes first: the solver then starts from a motion that meets the
    # limits that scaling can meet.
    last = refiner.time_scaled(task, best, unlimited=True) if task.at_rest else best
    yield refiner.solve(task, refiner.levels.warm, last.variables, Outcome.RESTARTED)
    if task.at_rest:
        # Its verdict names the limit that no time scaling meets.
        yield last


def _restart(
    refiner: Refiner, task: RefinementTask, x: Array | None, line: Array, best: Attempt
) -> Generator[Attempt, None, Attempt]:
    """Yield the attempts of all levels from another initial guess.

    Return the best of these and ``best``.
    """
    attempts = run_levels(refiner, task, x, None, line)
    return (
        yield from _best_of(
            (replace(attempt, outcome=Outcome.RESTARTED) for attempt in attempts), best
        )
    )


def _from_even_line(
    refiner: Refiner, task: RefinementTask, x: Array | None, best: Attempt
) -> Generator[Attempt, None, Attempt]:
    """Yield attempts from the line with an even rate, and from ``best``; return the best one."""
    even_line = refiner.even_line_guess(task)
    # all attempts so far may depend on the input plan or on the rising rate
    if x is not None or not np.array_equal(even_line, refiner.line_guess(task)):
        best = yield from _restart(refiner, task, None, even_line, best)
    return (yield from _restart(refiner, task, best.variables, even_line, best))


# Obstacles


def _is_deep(refiner: Refiner, task: RefinementTask) -> bool:
    """Return whether the initial line is so deep in an obstacle that paths around it are tried first."""
    motion = refiner.transcription(task, refiner.levels.coarse)
    positions = motion.positions(refiner.line_guess(task))
    return (
        refiner.hulls.violation(positions, task.scene.poses[0]) > MAX_LINE_PENETRATION_M
    )


def along_tree_paths(
    refiner: Refiner, task: RefinementTask, best: Attempt
) -> Iterator[Attempt]:
    """Yield attempts along paths of compiled trees.

    Without a path only ``best``, as one without.
    """
    failures, found_path = 0, False
    for guess in path_guesses(refiner, task):
        found_path = True
        # Trees avoid the hulls, so that their paths are nearly valid: the usual level
        # is faster, and loses few of them.
        attempt = along_path(refiner, task, refiner.levels.warm, guess)
        yield attempt
        failed = attempt.violation > MAX_JUDGED_VIOLATION
        failures += failed
        if failed and failures > MAX_FAILURES:
            attempt = along_path(refiner, task, refiner.levels.path, guess)
            yield attempt
        # Such attempts fail by little: the strict level may close the rest.
        if attempt.violation <= MAX_JUDGED_VIOLATION:
            yield refiner.solve(
                task, refiner.levels.strict, attempt.variables, Outcome.RESTARTED
            )
    if not found_path:
        yield replace(best, outcome=Outcome.NO_PATH, iterations=0)


def around_obstacles(
    refiner: Refiner, task: RefinementTask, best: Attempt
) -> Iterator[Attempt]:
    """Yield attempts on hulls in place of capsules, from the best attempt and along joint-space paths.

    The best attempt comes first if its links hardly penetrate anything.
    """
    positions = refiner.check.transcription(task).positions(best.variables)
    best_first = (
        refiner.hulls.violation(positions, task.scene.poses[0]) < MAX_PENETRATION_M
    )
    # A plan that is only slightly in collision is nearer to a valid one than a new
    # path.
    if best_first:
        yield from _on_hulls(refiner, task, best)
    for guess in path_guesses(refiner, task):
        attempt = along_path(refiner, task, refiner.levels.path, guess)
        yield attempt
        yield from _on_hulls(
            refiner, task, attempt if attempt.violation <= 1 else guess
        )
    if not best_first:
        yield from _on_hulls(refiner, task, best)


def _on_hulls(
    refiner: Refiner, task: RefinementTask, guess: Attempt
) -> Iterator[Attempt]:
    """Yield attempts on hulls in place of capsules: on the coarse and on the strict level."""
    coarse = refiner.solve(
        task, refiner.levels.warm, guess.variables, Outcome.RESTARTED, refiner.hulls
    )
    yield coarse
    if coarse.violation <= 1:
        yield refiner.solve(
            task,
            refiner.levels.strict,
            coarse.variables,
            Outcome.RESTARTED,
            refiner.hulls,
        )


def path_guesses(refiner: Refiner, task: RefinementTask) -> Iterator[Attempt]:
    """Yield motions along valid joint-space paths, scaled in time if they are from rest to rest."""
    for states in refiner.tree_search(task).paths():
        guess = refiner.path_guess(task, states)
        yield refiner.measured(task, guess, Outcome.RESTARTED, unlimited=True)


def along_path(
    refiner: Refiner, task: RefinementTask, level: GridLevel, guess: Attempt
) -> Attempt:
    """Optimize a motion along a joint-space path on a level, and then as usual."""
    best = refiner.solve(task, level, guess.variables, Outcome.RESTARTED)
    # A second run on the level on which the first one ended changes nothing.
    same_level = (
        level is refiner.levels.warm and best.outcome is not Outcome.TIME_SCALED
    )
    if best.violation <= 1 and not same_level:
        again = refiner.solve(
            task, refiner.levels.warm, best.variables, Outcome.RESTARTED
        )
        best = refiner.continue_scaled(task, again if again.is_better(best) else best)
    return replace(best, outcome=Outcome.RESTARTED)
