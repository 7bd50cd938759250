"""The passes that refining consists of: their grids, how much room they leave to bounds, and how they iterate."""

from dataclasses import dataclass, replace

from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.bounds import Tightening
from cnpgen.refine.solver.sqp import Settings

EARLY, LATE = 0.012, 0.05  # phases where tightening is whole; contacts at the ends need the later one
WARM_RADIUS = 0.1  # first trust radius from a plan that is nearly right
WIDE_FUNNEL = 1.0  # from a plan that is nearly right; it saves steps, and loses some motions from nothing
WARM_NEAR = ((0.09, 1.0), (0.04, 0.3), (-1.0, 0.1))  # first steps from such a plan speed it up as a whole
NARROW_FUNNEL, HEAVY = 0.03, 1000.0  # along a way that is free
FAR = 100.0  # a plan that violates more, in scaled units, is a worse start than a straight line
FROM_NOTHING, CROWDED = 0.1, 0.05  # shares of the tolerance from nothing, where small steps still lead far


@dataclass(frozen=True)
class Pass:
    """One grid with its tightening and iteration settings."""

    points: int
    tightening: Tightening
    settings: Settings


@dataclass(frozen=True)
class Passes:
    """The passes of a problem.

    Attributes:
        given: From a given plan.
        first: From a straight line.
        polish: On a finer grid, from where the first pass ended.
        strict: The same with more room to every bound, where the verdict still finds something.
        other: From other starts.
        way: From a motion along a way that is free: what it breaks weighs more than any time that it takes.
    """

    given: Pass
    first: Pass
    polish: Pass
    strict: Pass
    other: Pass
    way: Pass


def default_passes(problem: Problem, settings: Settings) -> Passes:
    """Choose grids and tightening; obstacles need more room between the points of a grid."""
    crowded = bool(problem.obstacle)
    gentle, edge = (1e-3, LATE) if crowded else (1e-4, EARLY)
    room = Tightening(limit=4e-3, gentle=gentle, clearance=1e-3, band=0.088, edge=edge)
    strict = Tightening(limit=8e-3, gentle=2e-3, clearance=3e-3, band=0.05, edge=LATE)
    wide = replace(room, edge=strict.edge)
    near = replace(settings, radius=WARM_RADIUS)
    short = replace(near, max_iterations=settings.max_iterations // 2)
    cold = replace(settings, cost_tolerance=(CROWDED if crowded else FROM_NOTHING) * settings.cost_tolerance)
    longer = replace(cold, max_iterations=settings.max_iterations * 3 // 2)
    return Passes(
        Pass(128, room, replace(near, near=WARM_NEAR, funnel=WIDE_FUNNEL, far=FAR)),
        Pass(128, room, cold),
        Pass(256, room, short),
        Pass(256, strict, short),
        Pass(192, wide, longer),
        Pass(192, wide, replace(longer, radius=WARM_RADIUS, funnel=NARROW_FUNNEL, penalty=HEAVY)),
    )
