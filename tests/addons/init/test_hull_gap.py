"""Gap between convex parts and triangle meshes, compared with Pinocchio's own reading of the meshes."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.init import hull_gap
from cnpgen.addons.init.hull_gap import HullGap, measure_hull_gap
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.shape import link_pairs
from cnpgen.robots.urdf import read_urdf
from cnpgen.world.world import World
from tests.examples.meshes import Meshes
from tests.examples.shaped_robot import arm_of_channels

STATES = 400


@pytest.fixture(autouse=True)
def few_states(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(hull_gap, "GAP_STATES", STATES)
    monkeypatch.setattr(link_pairs, "SAMPLED_STATES", STATES)
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))


def gap_of(problem: Problem) -> HullGap:
    robot, path = load_robot(problem), problem.urdf_path
    return measure_hull_gap(
        read_urdf(path), path, problem.packages, model=robot.model, shape=robot.shape
    )


@pytest.mark.parametrize("robot", ["", "convex_parts = 4"], ids=["hulls", "parts"])
def test_the_gap_is_that_of_the_judge_and_of_pinocchio(tmp_path, robot):
    problem = arm_of_channels(tmp_path, robot)
    loaded, gap = load_robot(problem), gap_of(arm_of_channels(tmp_path, robot))
    world, meshes, still = (
        World(loaded),
        Meshes(problem, loaded, tmp_path),
        np.zeros(loaded.n),
    )
    states = np.random.default_rng(0).uniform(
        loaded.position_lower, loaded.position_upper, (STATES, loaded.n)
    )
    free, accepted = np.zeros(STATES, bool), np.zeros(STATES, bool)
    for k, q in enumerate(states):
        world.set_state(q, still, still, np.zeros(0))
        free[k], accepted[k] = not meshes.touches(q), min(world.self_distances()) > 0
    assert (gap.free, gap.accepted) == (free.sum(), accepted.sum())
    assert gap.rejected == (free & ~accepted).sum()
    assert max(pair.rejected for pair in gap.pairs) <= gap.fraction
    assert gap.rejected >= 3 if not robot else gap.rejected == 0
