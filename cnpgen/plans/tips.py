"""Correction of tip positions in the columns of plans that are inconsistent with the joints."""

import warnings
from dataclasses import replace

import numpy as np

from cnpgen.errors import counted
from cnpgen.plans.plans import Plans

# Maximum deviation of a tip position from forward kinematics, float32 included.
TIP_TOLERANCE_M = 1e-5


def correct_tips(plans: Plans, *, where: str = "") -> Plans:
    """Replace tip positions that are inconsistent with the joints, with a warning that begins with ``where``.

    Tip positions define the ends of the tip and the obstacles below the object. The
    joints have priority, since plans are executed with them and control points match
    them.
    """
    found = {}
    for end in ("start", "goal"):
        name = f"{end}_xyz"
        recorded = plans.columns[f"{end}_xyz"]
        tip = plans.problem.tip_positions(getattr(plans.boundary, f"{end}_q"))
        off = np.linalg.norm(recorded - tip, axis=1)
        # Negated, so that a recorded nan counts as wrong; joints that are not finite
        # have no tip.
        wrong = ~(off <= TIP_TOLERANCE_M) & np.isfinite(tip).all(axis=1)
        if wrong.any():
            first = int(np.argmax(wrong))
            text = f"{where}{name} of {counted(int(wrong.sum()), 'plan')} is not where {end}_q puts the tip"
            detail = f"the first is plan {first}, {off[first]:.3g} m off"
            warnings.warn(
                f"{text} ({detail}): the joint positions are used",
                RuntimeWarning,
                stacklevel=3,
            )
            found[name] = np.where(wrong[:, None], tip, recorded)
    return replace(plans, columns={**plans.columns, **found}) if found else plans
