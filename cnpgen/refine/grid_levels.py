"""Grid levels of the refiner: number of grid points, tightening of bounds and settings of the iteration."""

from dataclasses import dataclass, replace

from cnpgen.problems.problem import Problem
from cnpgen.refine.solver.bounds import Tightening
from cnpgen.refine.solver.sqp import Settings

# Phases of full tightening; contacts at the ends need the later one.
EARLY_EDGE = 0.012
LATE_EDGE = 0.05
WARM_RADIUS = 0.1  # initial trust radius from a nearly valid plan
# From a nearly valid plan; it saves steps there, but some other guesses fail with it.
WARM_VIOLATION_BOUND = 1.0
# The first steps from a plan speed it up as a whole.
WARM_SELECTION_DISTANCES = (0.09, 1.0), (0.04, 0.3), (-1.0, 0.1)
# From a motion along a valid joint-space path.
PATH_VIOLATION_BOUND = 0.03
PATH_PENALTY = 1000.0
# In scaled units; with larger ones a straight line is a better initial guess.
MAX_INITIAL_VIOLATION = 100.0
# Factors without a plan, where small steps still lead far.
COLD_COST_TOLERANCE = 0.1
CLUTTERED_COST_TOLERANCE = 0.05


@dataclass(frozen=True)
class GridLevel:
    """Number of grid points, tightening and settings of one level."""

    points: int
    tightening: Tightening
    settings: Settings


@dataclass(frozen=True)
class GridLevels:
    """Grid levels of a problem."""

    warm: GridLevel  # coarse level from an input plan
    coarse: GridLevel  # coarse level from a straight line
    fine: GridLevel  # finer grid, from the result of a coarse level
    # Finer grid with tighter bounds, for plans that the verdict rejects.
    strict: GridLevel
    restart: GridLevel  # level for other initial guesses
    # Level for motions along a valid joint-space path: violations weigh more than any
    # duration.
    path: GridLevel


def default_grid_levels(problem: Problem, settings: Settings) -> GridLevels:
    """Return the grid levels of a problem.

    Obstacles need more tightening between grid points.
    """
    cluttered = bool(problem.obstacle)
    gentle, edge = (1e-3, LATE_EDGE) if cluttered else (1e-4, EARLY_EDGE)
    usual = Tightening(limit=4e-3, gentle=gentle, clearance=1e-3, band=0.088, edge=edge)
    strict = Tightening(
        limit=8e-3, gentle=2e-3, clearance=3e-3, band=0.05, edge=LATE_EDGE
    )
    late = replace(usual, edge=strict.edge)
    close = replace(settings, radius=WARM_RADIUS)
    short = replace(close, max_iterations=settings.max_iterations // 2)
    factor = CLUTTERED_COST_TOLERANCE if cluttered else COLD_COST_TOLERANCE
    cold = replace(settings, cost_tolerance=factor * settings.cost_tolerance)
    longer = replace(cold, max_iterations=settings.max_iterations * 3 // 2)
    warm = replace(
        close,
        selection_distances=WARM_SELECTION_DISTANCES,
        violation_bound=WARM_VIOLATION_BOUND,
        max_initial_violation=MAX_INITIAL_VIOLATION,
    )
    path = replace(
        longer,
        radius=WARM_RADIUS,
        violation_bound=PATH_VIOLATION_BOUND,
        penalty=PATH_PENALTY,
    )
    return GridLevels(
        warm=GridLevel(128, usual, warm),
        coarse=GridLevel(128, usual, cold),
        fine=GridLevel(256, usual, short),
        strict=GridLevel(256, strict, short),
        restart=GridLevel(192, late, longer),
        path=GridLevel(192, late, path),
    )
