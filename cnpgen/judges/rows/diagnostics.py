"""Diagnostics that rows store of their ends, recomputed: how close each is to torque limits and to obstacles."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.judges.rows.report import ENDS, Array, Check, Index, compare
from cnpgen.world.state import World

if TYPE_CHECKING:
    from cnpgen.problems.problem import Problem

# What stored diagnostics may differ by, in their units. Coal's distances have errors of 4e-11 m. In float32 the rounded
# joint positions move the arm by 1e-7 m and its highest speed by 2e-6 m/s in 40,000 rows: bounds must hold for all.
ALLOWED = {"float64": 1e-8, "float32": 1e-4}


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic of both ends.

    Attributes:
        name: What it is.
        unit: Its unit.
        compute: Computes it of a world's state.
        stored: What the rows say, shape (rows, 2); nan at an end of which they say nothing.
        found: What is computed, shape (rows, 2).
    """

    name: str
    unit: str
    compute: Callable[[World], float]
    stored: Array
    found: Array

    def note(self, world: World, row: int, end: int) -> None:
        """Compute it of a state, where the row says something about it."""
        if np.isfinite(self.stored[row, end]):
            self.found[row, end] = self.compute(world)

    def judged(self, finite: Index, dtype: str) -> tuple[Check, Index]:
        """Compare what is stored in finite rows with what was computed."""
        some, end = np.nonzero(~np.isnan(self.stored[finite]))
        row = finite[some]
        error = np.abs(self.stored[row, end] - self.found[row, end])
        return compare(
            self.name, self.unit, violation=error, allowed=np.full(len(row), ALLOWED[dtype]), row=row, end=end
        )


def stored_diagnostics(problem: "Problem", columns: Mapping[str, Array]) -> list[Diagnostic]:
    """List the diagnostics that rows have and that can be recomputed.

    Args:
        problem: The problem.
        columns: Field -> values, shape (rows, width).
    """
    kinds = [("torque_ratio", "holding torque ratio", "1", _torque_ratio), *_clearance(problem)]
    return [
        Diagnostic(name, unit, compute, stored, np.full_like(stored, np.nan))
        for field, name, unit, compute in kinds
        if not np.isnan(stored := _both_ends(columns, field)).all()
    ]


def _both_ends(columns: Mapping[str, Array], field: str) -> Array:
    """Return a field of both ends, shape (rows, 2); nan where there is none."""
    nothing = np.full((len(columns["start_q"]), 1), np.nan)
    return np.concatenate([columns.get(f"{end}_{field}", nothing) for end in ENDS], axis=1)


def _torque_ratio(world: World) -> float:
    return float(np.max(np.abs(world.holding_torque) / world.robot.torque_limit))


def _clearance(problem: "Problem") -> Iterator[tuple[str, str, str, Callable[[World], float]]]:
    """The distance from the nearest obstacle, less the radius that the problem gives the arm."""
    radius = problem.arm_radius
    if radius is not None and problem.obstacle:
        yield "clearance", "clearance", "m", lambda world: min(world.segment_distances()) - radius
