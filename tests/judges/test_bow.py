"""How far points leave the straight line between two moments: never further than is said, and not much less."""

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.judges.plans.bow import bows
from cnpgen.judges.plans.course import course
from cnpgen.world.path import PathWorld
from tests.examples.plans import bent, load


@pytest.mark.parametrize("label", ["hit", "replan", "transport"])
def test_no_point_leaves_the_straight_line_by_more(label: str) -> None:
    plan = bent(load(label), 0.2, seed=3)
    model, robot = plan.robot.model, plan.robot
    data, s, parts = model.createData(), np.linspace(0, 1, 105), 9
    reach = PathWorld(robot, plan.problem.obstacle, plan.problem.object_size).reach(np.zeros(robot.n))
    found = bows(plan.motion, s, reach)
    tip, share = [], np.linspace(0, 1, parts)
    finer = np.concatenate([np.linspace(a, b, parts) for a, b in pairwise(s)])
    for q in course(plan.motion, finer).q.T:
        pin.framesForwardKinematics(model, data, q.copy())
        tip.append([pose.translation.copy() for pose in [*data.oMi, data.oMf[robot.tip_frame]]])
    way = np.array(tip).reshape(len(s) - 1, parts, -1, 3)
    chord = way[:, :1] + share[:, None, None] * (way[:, -1:] - way[:, :1])
    off = np.linalg.norm(way - chord, axis=3).max(axis=(1, 2))
    assert (off <= found + 1e-15).all()
    assert np.median(found / np.maximum(off, 1e-12)) < 40


def test_a_straight_way_has_no_bow_and_steps_back_have_none() -> None:
    plan = load("hit")
    still = plan.changed(path=np.repeat(plan.motion.path[:, :1], plan.motion.path.shape[1], axis=1))
    assert np.abs(bows(still.motion, np.linspace(0, 1, 60), np.ones(6))).max() < 1e-15
    assert bows(plan.motion, np.array([0.5, 0.51, 0.3, 0.31]), np.ones(6))[1] == 0
