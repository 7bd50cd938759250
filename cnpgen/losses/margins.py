"""How much tighter than the problem's the bounds are while training, so that what is learned has room to spare."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError, nearest


@dataclass(frozen=True)
class Margins:
    """Tightened bounds, term by term; equalities are never tightened.

    A penalty leaves a violation of the order of 1 / weight: with limits a few tenths of a percent smaller, plans meet
    the true ones.

    Attributes:
        factors: Term -> what its limits (of joints) are multiplied by, in (0, 1].
        insets: Term -> by how much its other bounds are moved inwards, in their SI unit, e.g. the table's edges [m].
    """

    factors: Mapping[str, float] = field(default_factory=dict)
    insets: Mapping[str, float] = field(default_factory=dict)

    def tightening(self, terms: Sequence[str]) -> NDArray[np.float64]:
        """Return the factor of every term, then the inset of every term, shape (2 m,).

        Args:
            terms: The names of the m constraint terms.

        Raises:
            UsageError: A name is not a term, a factor is not in (0, 1] or an inset is not a number.
        """
        for mistake in self._mistakes(terms):
            raise UsageError(mistake)
        return np.array(
            [self.factors.get(term, 1.0) for term in terms] + [self.insets.get(term, 0.0) for term in terms], float
        )

    def _mistakes(self, terms: Sequence[str]) -> Iterator[str]:
        for name in (*self.factors, *self.insets):
            if name not in terms:
                yield f"margin of {name!r}: no such term; expected one of {', '.join(terms)}{nearest(name, terms)}"
        for name, factor in self.factors.items():
            if not 0 < factor <= 1:
                yield f"margin of {name!r}: the factor of a limit must be above 0 and at most 1, got {factor}"
        for name, inset in self.insets.items():
            if not np.isfinite(inset):
                yield f"margin of {name!r}: an inset must be a finite number, got {inset}"


# A penalty leaves violations of the order of 1 / weight, and a network errs by a percent here and there.
FACTORS = {
    "joint-position": 0.999,
    "joint-velocity": 0.99,
    "joint-acceleration": 0.985,
    "joint-jerk": 0.97,
    "joint-torque": 0.97,
}
INSETS = {"table": 1e-3, "object-contact": 5e-4}  # m


def suggested_margins(terms: Sequence[str]) -> Margins:
    """Return the margins of the terms whose kinds are known; none of others.

    Args:
        terms: ``PlanLoss.terms``; the second of a kind is called ``kind-2``.
    """
    return Margins(_known(terms, FACTORS), _known(terms, INSETS))


def _known(terms: Sequence[str], by_kind: Mapping[str, float]) -> dict[str, float]:
    kinds = {name: re.sub(r"-\d+$", "", name) for name in terms}
    return {name: by_kind[kind] for name, kind in kinds.items() if kind in by_kind}
