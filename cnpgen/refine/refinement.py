"""Result of refining a set of plans."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.documents import JsonObject
from cnpgen.errors import counted
from cnpgen.machine.times import NO_TIME, Times
from cnpgen.plans.plans import Plans
from cnpgen.refine.task import DISTANCE_PHASES, Attempt
from cnpgen.trajectory.spline import basis

REFINEMENT_FORMAT = "cnpgen-refinement"
REFINEMENT_VERSION = 1


@dataclass(frozen=True, eq=False)
class Refinement:
    """Result of refining N plans.

    Attributes:
        input_plans: Input plans, with the tip positions of their boundary conditions.
        plans: Refined plans, in the same order.
        results: Best attempt at every plan with its verdict, outcome, iterations and
            cost.
        times: Times of the run; plans from a journal took none.
    """

    input_plans: Plans
    plans: Plans
    results: tuple[Attempt, ...]
    times: Times = NO_TIME

    def __repr__(self) -> str:
        outcomes = _counted(result.outcome.name.lower() for result in self.results)
        counts = ", ".join(f"{count:,} {name}" for name, count in outcomes.items())
        plans = f"{counted(len(self.results), 'plan')} of {self.plans.problem.name!r}"
        return f"<{plans} refined, {int(self.valid.sum()):,} valid{counts and ': '}{counts}>"

    @property
    def valid(self) -> Mask:
        """Mask of the plans that the independent verdict accepts, shape (N,)."""
        return np.array([result.valid for result in self.results], bool)

    @property
    def deviation(self) -> Array:
        """Largest difference of a joint from the input path at the same phase [rad], nan without one, shape (N,)."""
        s = np.linspace(0, 1, DISTANCE_PHASES)
        pairs = zip(
            self.plans.path_control_points,
            self.input_plans.path_control_points,
            strict=True,
        )
        paths = [
            basis(s, len(path), self.plans.degree) @ (path - before)
            for path, before in pairs
        ]
        return np.array([np.abs(path).max() for path in paths])

    def summary(self) -> JsonObject:
        """Return a summary of all plans for JSON."""
        durations = self.plans.duration[self.valid]
        iterations = [result.iterations for result in self.results]
        return {
            "format": REFINEMENT_FORMAT,
            "format_version": REFINEMENT_VERSION,
            "checksum": self.input_plans.checksum,
            "plans": len(self.results),
            "valid": int(self.valid.sum()),
            "outcomes": _counted(
                result.outcome.name.lower() for result in self.results
            ),
            "reasons": _counted(
                str(result.reason) for result in self.results if not result.valid
            ),
            "mean_duration_s": float(durations.mean()) if len(durations) else None,
            "median_iterations": float(np.median(iterations)) if iterations else None,
            "seconds": self.times.rounded(),
            "not_valid": [
                {
                    "plan": index,
                    "sample_id": int(sample),
                    "reason": str(result.reason),
                    "outcome": result.outcome.text,
                }
                for index, (sample, result) in enumerate(
                    zip(self.plans.sample_id, self.results, strict=True)
                )
                if not result.valid
            ],
        }


def _counted(words: Iterator[str]) -> dict[str, int]:
    return {str(word): count for word, count in Counter(words).most_common()}
