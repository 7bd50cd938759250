"""The verdict of a page: reasons, and the time and place of every condition's smallest margin."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.condition_curves import ConditionCurve, plot_unit
from cnpgen.judges.plans.verdict import Margin, Verdict

Array = NDArray[np.float64]


def view_verdict(
    verdict: Verdict, curves: Sequence[ConditionCurve], times: Array, poses: Array, joints: Sequence[str]
) -> dict[str, Any]:
    """Return a verdict for JSON, its margins located in time and space, the largest violation first.

    The poses of the joints, the universe first and the tip last, have shape (K, joints, 4, 4), the times [s] (K,).
    """
    by_name = {curve.name: curve for curve in curves}
    margins = sorted(verdict.margins.values(), key=lambda margin: -margin.severity)
    causes = []
    for margin in margins:
        frame = int(np.abs(times - margin.time).argmin())
        point = _point(margin, by_name.get(margin.name), poses[frame], frame, joints).tolist()
        name, text = f"{margin.name} {margin.part}".strip(), margin_text(margin)
        causes.append({"name": name, "text": text, "frame": frame, "ok": margin.ok, "point": point})
    return {"valid": verdict.valid, "reason": str(verdict.reason), "causes": causes}


def margin_text(margin: Margin) -> str:
    """Return a margin as text in the units of plots."""
    factor, unit = plot_unit(margin.unit)
    side = "outside" if margin.violation > 0 else "inside"
    amount, tolerance = factor * abs(margin.violation), factor * margin.tolerance
    return f"{amount:.3g} {unit} {side}, tolerance {tolerance:.3g} {unit}"


def _point(margin: Margin, curve: ConditionCurve | None, poses: Array, frame: int, joints: Sequence[str]) -> Array:
    """Return the place of a margin [m], shape (3,): between the closest points, at the joint, or at the tip."""
    if curve is not None and curve.points is not None:
        return np.asarray(curve.points[frame].mean(axis=0))
    if margin.part in joints:
        return np.asarray(poses[1 + list(joints).index(margin.part), :3, 3])
    return np.asarray(poses[-1, :3, 3])
