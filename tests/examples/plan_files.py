"""Files of plans for the tests of commands: stored right plans, and every kind of garbage between them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cnpgen.plans import Plans, make_plans
from cnpgen.store.files.checksum_file import HEADER_BYTES
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.plans import Plan, joined, load, perturbed


def plans_of(*plans: Plan, sample_id: Sequence[int] | None = None) -> Plans:
    """Put plans of one problem together, as they would be in a file."""
    problem, _, motion, boundary, _, goal_xyz = joined(*plans)
    start_xyz = np.concatenate([plan.start_xyz for plan in plans])
    return make_plans(
        problem,
        boundary,
        path_control_points=motion.path,
        rate_control_points=motion.rate,
        columns={"start_xyz": start_xyz, "goal_xyz": goal_xyz},
        sample_id=sample_id,
    )


def remove_checksum(path: Path) -> Path:
    """Take the checksum off a file of plans, so that it may be changed."""
    with path.open("r+b") as file:
        file.write(bytes(HEADER_BYTES))
    return path


def _still(plan: Plan) -> Plan:
    """The goal is the start: a plan that stays there."""
    here, rest = plan.boundary.goal_q, 0 * plan.boundary.goal_q
    boundary = replace(
        plan.boundary, start_q=here, start_dq=rest, start_ddq=rest, goal_dq=rest
    )
    path = np.repeat(here[:, None], plan.motion.path.shape[1], axis=1)
    return replace(
        plan,
        boundary=boundary,
        motion=Motion(path, plan.motion.rate),
        start_xyz=plan.goal_xyz,
    )


def _with(plan: Plan, what: str, index: tuple[int, ...], value: float) -> Plan:
    changed = getattr(plan.motion, what).copy()
    changed[(0, *index)] = value
    return plan.changed(**{what: changed})


def garbage(label: str = "hit") -> dict[str, tuple[Plan, str]]:
    """Name -> plan and the reason that the verdict gives."""
    plan = load(label)
    return {
        "right": (plan, "ok"),
        "nan": (_with(plan, "path", (5, 2), np.nan), "not finite"),
        "negative rate": (plan.changed(rate=-plan.motion.rate), "rate not positive"),
        "a rate that is negative in between": (
            _with(plan, "rate", (9,), -50.0),
            "rate not positive",
        ),
        "zero rate, which takes forever": (
            plan.changed(rate=0 * plan.motion.rate),
            "rate not positive",
        ),
        "infinite rate, which takes no time": (
            plan.changed(rate=np.inf * plan.motion.rate),
            "not finite",
        ),
        "almost no time": (
            plan.changed(rate=plan.motion.rate * 1e12),
            "boundary conditions",
        ),
        "a year": (plan.changed(rate=plan.motion.rate * 1e-8), "too long"),
        "metres away": (perturbed(plan, 100.0), "joint torque limit"),
        "the goal is the start": (_still(plan), "ok"),
        "right again": (plan, "ok"),
    }
