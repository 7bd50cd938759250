"""Where the tip is at the ends of plans: what their columns say, put right where their joints say something else."""

import warnings
from dataclasses import replace

import numpy as np

from cnpgen.errors import counted
from cnpgen.plans.plans import Plans

SAME_PLACE = 1e-5  # m: what a tip position may differ by from the one that the joints give, float32 included


def settle_tips(plans: Plans, *, where: str = "") -> Plans:
    """Put tip positions right that are not where the joints put the tip, with a warning.

    Both say where the tip must begin and end, and tip positions say where obstacles stand that are below the object.
    The joints are what a plan is executed with, and what its control points meet: they count.

    Args:
        plans: The plans, with the columns ``start_xyz`` and ``goal_xyz``.
        where: What the warning begins with: the file.
    """
    found = {}
    for end in ("start", "goal"):
        name, said = f"{end}_xyz", plans.columns[f"{end}_xyz"]
        tip = plans.problem.tip_positions(getattr(plans.boundary, f"{end}_q"))
        off = np.linalg.norm(said - tip, axis=1)
        wrong = ~(off <= SAME_PLACE) & np.isfinite(tip).all(axis=1)
        if wrong.any():
            first = int(np.argmax(wrong))
            text = f"{where}{name} of {counted(int(wrong.sum()), 'plan')} is not where {end}_q puts the tip"
            detail = f"the first is plan {first}, {off[first]:.3g} m off"
            warnings.warn(f"{text} ({detail}): what the joints say counts", RuntimeWarning, stacklevel=3)
            found[name] = np.where(wrong[:, None], tip, said)
    return replace(plans, columns={**plans.columns, **found}) if found else plans
