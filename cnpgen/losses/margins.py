"""Margins: tightened bounds during training, so that the true bounds hold afterwards."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError, nearest
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.schema import registry
from cnpgen.schema.argument_types import check_fields, checked_arguments
from cnpgen.store.dataset_spec import StoredProblem


@dataclass(frozen=True)
class Margins:
    """Tightened bounds of terms; equalities are never tightened.

    A penalty leaves a violation of the order of 1 / weight, and a network errs by a
    percent. With limits that are a few tenths of a percent smaller, plans meet the true
    limits.

    Attributes:
        factors: Term -> factor of its limits (of joints), in (0, 1].
        insets: Term -> distance by which its other bounds are moved inwards, in SI
            units, e.g. the table's edges [m].
    """

    factors: Mapping[str, float] = field(default_factory=dict)
    insets: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("factors", "insets"):
            for value in getattr(self, name).values():
                if isinstance(value, bool) or not isinstance(
                    value, int | float | np.number
                ):
                    raise UsageError(
                        f"must be numbers by name, got {value!r:.100}", argument=name
                    )

    @checked_arguments
    def tightening(self, terms: Sequence[str]) -> NDArray[np.float64]:
        """Return the factors of all terms, then the insets of all terms, shape (2 m,).

        Args:
            terms: Names of the m constraint terms.

        Raises:
            UsageError: A name is not a term, a factor is not in (0, 1] or an inset is
                not a number.
        """
        if not all(isinstance(term, str) for term in terms):
            raise UsageError(
                f"must be names of constraint terms, got {terms!r:.100}",
                argument="terms",
            )
        for error in self._errors(terms):
            raise UsageError(error, concerns="terms")
        return np.array(
            [self.factors.get(term, 1.0) for term in terms]
            + [self.insets.get(term, 0.0) for term in terms],
            float,
        )

    def _errors(self, terms: Sequence[str]) -> Iterator[str]:
        for name in (*self.factors, *self.insets):
            if name not in terms:
                yield f"margin of {name!r}: no such term; expected one of {', '.join(terms)}{nearest(name, terms)}"
        for name, factor in self.factors.items():
            if not 0 < factor <= 1:
                yield f"margin of {name!r}: the factor of a limit must be above 0 and at most 1, got {factor}"
        for name, inset in self.insets.items():
            if not np.isfinite(inset):
                yield f"margin of {name!r}: an inset must be a finite number, got {inset}"


@checked_arguments
def suggested_margins(problem: Problem | StoredProblem | str | Path) -> Margins:
    """Return the margins that the constraint classes suggest: ``training_factor`` and ``training_inset``.

    The problem is any argument of ``PlanLoss``, such as ``dataset.problem``.
    """
    problem = as_problem(problem)
    constraints = dict(zip(constraint_terms(problem), problem.constraint, strict=True))
    factors = {
        name: constraint.training_factor for name, constraint in constraints.items()
    }
    insets = {
        name: constraint.training_inset for name, constraint in constraints.items()
    }
    return Margins(
        {name: factor for name, factor in factors.items() if factor != 1},
        {name: inset for name, inset in insets.items() if inset != 0},
    )


def constraint_terms(problem: Problem) -> list[str]:
    """Return the names of the constraint terms: their kinds, with a number from the second of a kind on (kind-2)."""
    names: list[str] = []
    for constraint in problem.constraint:
        kind = registry.name_of(registry.CONSTRAINTS, type(constraint))
        count = 1 + sum(
            type(other) is type(constraint)
            for other in problem.constraint[: len(names)]
        )
        names.append(kind if count == 1 else f"{kind}-{count}")
    return names
