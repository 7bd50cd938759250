"""Recomputation of the diagnostics in rows: torque ratio and clearance at both ends."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cnpgen.judges.rows.row_report import ENDS, Array, Check, Index, compare
from cnpgen.problems.problem import Problem
from cnpgen.world.world import World

# Tolerances of stored diagnostics, in their units. Coal's distances have errors of 4e-11 m. In float32 the rounding of
# joint positions moves the arm by 1e-7 m and changes its highest speed by 2e-6 m/s in 40,000 rows.
DIAGNOSTIC_TOLERANCES = {"float64": 1e-8, "float32": 1e-4}


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic of both ends.

    Attributes:
        name: Name of the diagnostic.
        unit: SI unit.
        compute: Function that computes it from a world's state.
        stored: Stored values, shape (rows, 2); nan at an end without one.
        recomputed: Recomputed values, shape (rows, 2).
    """

    name: str
    unit: str
    compute: Callable[[World], float]
    stored: Array
    recomputed: Array

    def note(self, world: World, row: int, end: int) -> None:
        """Compute the diagnostic at a state if the row stores it."""
        if np.isfinite(self.stored[row, end]):
            self.recomputed[row, end] = self.compute(world)

    def judged(self, finite: Index, dtype: str) -> tuple[Check, Index]:
        """Compare stored and recomputed values in finite rows."""
        index, end = np.nonzero(~np.isnan(self.stored[finite]))
        row = finite[index]
        error = np.abs(self.stored[row, end] - self.recomputed[row, end])
        tolerance = DIAGNOSTIC_TOLERANCES[dtype]
        return compare(self.name, self.unit, violation=error, tolerance=tolerance, row=row, end=end)


def stored_diagnostics(problem: Problem, columns: Mapping[str, Array]) -> list[Diagnostic]:
    """List the diagnostics in columns, field -> values of shape (rows, width), that can be recomputed."""
    kinds = [("torque_ratio", "holding torque ratio", "1", _torque_ratio), *_clearance(problem)]
    return [
        Diagnostic(name, unit, compute, stored, np.full_like(stored, np.nan))
        for field, name, unit, compute in kinds
        if not np.isnan(stored := _both_ends(columns, field)).all()
    ]


def _both_ends(columns: Mapping[str, Array], field: str) -> Array:
    """Return a field of both ends, shape (rows, 2); nan where it is missing."""
    missing = np.full((len(columns["start_q"]), 1), np.nan)
    return np.concatenate([columns.get(f"{end}_{field}", missing) for end in ENDS], axis=1)


def _torque_ratio(world: World) -> float:
    return float(np.max(np.abs(world.holding_torque) / world.robot.torque_limit))


def _clearance(problem: Problem) -> Iterator[tuple[str, str, str, Callable[[World], float]]]:
    """Yield the clearance: the distance from the closest obstacle minus the arm radius of the problem."""
    radius = problem.arm_radius
    if radius is not None and problem.obstacle:
        yield "clearance", "clearance", "m", lambda world: min(world.segment_distances()) - radius
