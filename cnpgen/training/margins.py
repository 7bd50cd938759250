"""How much room training leaves to the bounds, by the kind of constraint."""

import re
from collections.abc import Mapping, Sequence

from cnpgen.losses.margins import Margins

# A penalty leaves violations of the order of 1 / weight, and a network errs by a percent here and there.
FACTORS = {"joint-position": 0.999, "joint-velocity": 0.99, "joint-acceleration": 0.985, "joint-torque": 0.97}
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
