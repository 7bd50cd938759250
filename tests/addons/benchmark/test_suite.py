"""Suites: pucks on grids, samples of datasets, errors in the file."""

from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.errors import RecipeError
from cnpgen.schema.catalogue import list_recipes
from tests.examples.plans import ROBOTS
from tests.refusals import is_refused


def test_every_shipped_suite_is_named_after_its_file() -> None:
    assert {"hits-81", "hits-110", "heavy-100"} <= list_recipes("suite").keys()
    assert all(load_suite(name).name == name for name in list_recipes("suite"))


def test_hits_81_has_every_puck_of_the_grid_with_a_hit_towards_the_goal() -> None:
    suite, robot = load_suite("hits-81"), ROBOTS["airhockey"]
    assert suite.pucks is not None
    problems, puck = suite.problems()[0], suite.pucks.positions().T
    assert len(problems) == 81
    assert {tuple(row) for row in puck.round(9).tolist()} == {
        (round(x, 9), round(y, 9))
        for x in np.linspace(0.8, 1.2, 9)
        for y in np.linspace(-0.4, 0.4, 9)
    }
    tip, direction = problems.columns["goal_xyz"], np.array([2.478, 0.0]) - puck
    np.testing.assert_allclose(
        np.linalg.norm(puck - tip[:, :2], axis=1), 0.07, atol=1e-12
    )
    across = (puck - tip[:, :2])[:, 0] * direction[:, 1] - (puck - tip[:, :2])[
        :, 1
    ] * direction[:, 0]
    assert np.abs(across).max() < 1e-12
    np.testing.assert_allclose(
        problems.problem.tip_positions(problems.boundary.goal_q), tip, atol=1e-8
    )
    assert np.all(problems.boundary.start_q == robot.home)
    assert not problems.boundary.start_dq.any()
    assert np.abs(problems.boundary.goal_dq).max() <= robot.velocity_limit.max() * (
        1 + 1e-12
    )
    assert np.isnan(problems.path_control_points).all()


def test_a_suite_of_samples_is_reproducible_for_every_number_of_problems() -> None:
    suite = load_suite("heavy-100")
    few, more = suite.problems(2)[0], suite.problems(3)[0]
    assert np.array_equal(few.boundary.goal_q, more.boundary.goal_q[:2])
    assert (
        len(load_suite("airhockey-replan").problems(4)[0]) == 4
    )  # a dataset is a suite of its samples


SAMPLES = 'name = "a"\nversion = "1.0.0"\n[samples]\nrecipe = "heavy-object"\n'
MISTAKES = {
    'name = "a"\nversion = "1.0.0"\n[pucks]\nrows = 0\n': "rows: 0 is too small",
    'name = "a"\nversion = "1.0.0"\n[samples]\nrecipe = "heavy-object"\nseed = -1\n': "seed: -1 is too small",
    'name = "a"\nversion = "1.0.0"\n[turns]\nwhen = ["350 ms"]\n': "turns: unknown key",
    f"{SAMPLES}[planners.trajop]\niterations = 3\n": "planners.trajop: unknown planner (did you mean 'trajopt'?)",
    f"{SAMPLES}[planners.trajopt]\niterations = 0\n": "planners.trajopt.iterations: 0 is too small",
    f"{SAMPLES}[planners.trajopt]\nknots = 3\n": "planners.trajopt.knots: unknown key",
    f"{SAMPLES}[planners]\ntrajopt = 3\n": "planners.trajopt: expected a table",
    'name = "a"\nversion = "1"\n[samples]\nrecipe = "heavy-object"\n': "version: '1' does not match",
}


@pytest.mark.parametrize("text", MISTAKES)
def test_recipe_errors_in_a_suite_are_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "suite.toml").write_text(text, encoding="utf-8")
    with pytest.raises(RecipeError) as caught:
        load_suite(tmp_path / "suite.toml")
    assert MISTAKES[text].replace("'", '"') in str(caught.value).replace("'", '"')


def test_a_suite_has_pucks_or_samples_and_not_both(tmp_path: Path) -> None:
    text = list_recipes("suite")["hits-81"].read_text(encoding="utf-8")
    (tmp_path / "both.toml").write_text(
        text + '\n[samples]\nrecipe = "heavy-object"\n', encoding="utf-8"
    )
    with is_refused(RecipeError):
        load_suite(tmp_path / "both.toml")


def test_a_grid_without_end_is_refused_before_it_is_made(tmp_path: Path) -> None:
    text = list_recipes("suite")["hits-81"].read_text(encoding="utf-8")
    (tmp_path / "large.toml").write_text(
        text.replace("= 9", "= 9000000000"), encoding="utf-8"
    )
    with is_refused(RecipeError):
        load_suite(tmp_path / "large.toml")


def test_too_many_problems_are_refused_before_sampling(tmp_path: Path) -> None:
    replanning = list_recipes("suite")["replan"].read_text(encoding="utf-8")
    sampled = list_recipes("suite")["heavy-100"].read_text(encoding="utf-8")
    for text, message in (
        (
            sampled.replace("n = 100", f"n = {10**15}"),
            "is too large, expected at most 100000",
        ),
        (
            replanning.replace('["350 ms"]', str([0.1] * 500)),
            "switch_times: 12,000 switches are too many, expected at most 10,000",
        ),
    ):
        (tmp_path / "large.toml").write_text(text, encoding="utf-8")
        with pytest.raises(RecipeError, match=message):
            load_suite(tmp_path / "large.toml")


def test_pucks_need_a_table(tmp_path: Path) -> None:
    text = list_recipes("suite")["hits-81"].read_text(encoding="utf-8")
    (tmp_path / "heavy.toml").write_text(
        text.replace('"airhockey"', '"heavy-object"'), encoding="utf-8"
    )
    with is_refused(RecipeError):
        load_suite(tmp_path / "heavy.toml").problems()


def test_an_unknown_suite_is_refused_by_name() -> None:
    with is_refused(RecipeError, argument="name_or_path"):
        load_suite("hits-82")


@pytest.mark.slow
def test_replans_200_has_distinct_problems_from_moving_states() -> None:
    problems, prefix = load_suite("replans-200").problems()
    assert prefix is not None
    assert len(problems) == 200
    assert (
        len({tuple(row) for row in problems.columns["goal_xyz"].round(6).tolist()})
        == 200
    )
    assert np.all(np.abs(problems.boundary.start_dq).max(axis=1) > 0.1)
    assert np.all(prefix.until == 0.25)
