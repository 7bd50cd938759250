"""Replanning scenarios: second motions continue the first ones without a jump, and score."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.benchmark.answers import execution_of, joined
from cnpgen.addons.benchmark.results_file import answer_to_dict
from cnpgen.addons.benchmark.simulator.plant import PLANTS
from cnpgen.addons.benchmark.simulator.reference import states_of
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.errors import RecipeError
from cnpgen.planner.planner import Planner
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.schema.catalogue import list_recipes
from tests.conftest import some
from tests.refusals import is_refused


@pytest.mark.parametrize("name", some(["replan", "online"], 1, "slow"))
def test_a_switch_is_continuous_in_position_velocity_and_acceleration(
    name: str,
) -> None:
    suite = load_suite(name)
    problems, prefix = suite.problems()
    assert prefix is not None
    assert len(problems) == 24
    plans = refine_plans(
        Planner(suite.model).plan_batch(problems.boundary)[::8], workers=1
    ).plans
    for plan, index in zip(plans, range(0, 24, 8), strict=True):
        first, until = states_of(prefix[index].motion), float(prefix.until[index])
        before, after = (
            first(np.array([until])),
            states_of(plan.motion)(np.array([0.0])),
        )
        for one, other in zip(before, after, strict=True):
            assert np.abs(one - other).max() < 1e-9
        around = joined(prefix[index], states_of(plan.motion))(
            until + np.array([-1e-7, 1e-7])
        )
        assert np.abs(np.diff(around[0], axis=0)).max() < 1e-6
        early = np.array([0.1])
        assert np.array_equal(
            joined(prefix[index], states_of(plan.motion))(early)[0], first(early)[0]
        )


@pytest.mark.slow
def test_only_the_opposite_puck_is_hit() -> None:
    pytest.importorskip("mujoco")
    suite = load_suite("online")
    problems, prefix = suite.problems(1)
    assert prefix is not None
    plan = refine_plans(
        Planner(suite.model).plan_batch(problems.boundary, columns=problems.columns),
        workers=1,
    ).plans
    execution = execution_of(
        (problems, answer_to_dict(plan), prefix[0]), PLANTS["nominal"]
    )
    scene, reference = execution.scene, execution.reference
    assert suite.replanning is not None
    np.testing.assert_allclose(
        scene.puck, suite.replanning.pucks.positions()[:, -1], atol=1e-6
    )
    assert reference.duration == pytest.approx(0.15 + plan.duration[0])
    assert np.abs(reference.dq[0]).max() < 1e-9  # the first motion begins at rest
    assert execution.executed.success
    assert execution.executed.hit_time == pytest.approx(reference.duration, abs=0.02)


def test_a_switch_after_the_end_of_the_first_motion_is_refused(tmp_path: Path) -> None:
    text = (
        list_recipes("suite")["online"]
        .read_text(encoding="utf-8")
        .replace("250 ms", "400 ms")
    )
    (tmp_path / "late.toml").write_text(text, encoding="utf-8")
    with is_refused(RecipeError):
        load_suite(tmp_path / "late.toml").problems()


def test_a_grid_with_a_puck_in_its_center_is_refused(tmp_path: Path) -> None:
    text = (
        list_recipes("suite")["online"]
        .read_text(encoding="utf-8")
        .replace("rows = 4", "rows = 3")
    )
    (tmp_path / "odd.toml").write_text(text, encoding="utf-8")
    with is_refused(RecipeError):
        load_suite(tmp_path / "odd.toml")
