"""Planners in C of all kinds of models: fitted rates, parameters, time scaling, goal accelerations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.deploy.export_planner import planner_files
from cnpgen.errors import DatasetError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.model_file import find_model
from cnpgen.planner.planner import Planner
from cnpgen.plans.evaluate import evaluate_plans
from tests.addons.deploy.compiled_planner import (
    CompiledPlanner,
    Planned,
    compiled_planner,
    needs_compiler,
)
from tests.addons.deploy.test_export_planner import (
    MANY_ROWS,
    NO_RATE,
    NOT_FINITE,
    PARAMETER,
    VALID,
    assert_equal_motions,
    requests_of,
)
from tests.conftest import some
from tests.examples.example_robots import needs_robots
from tests.refusals import is_refused

pytestmark = [needs_compiler, pytest.mark.slow]
ROWS = 200
NEAR_A_LIMIT = 1e-3  # of a limit: there rounding decides which bound is first


def prepared(
    model: str, folder: Path
) -> tuple[Planner, CompiledPlanner, np.ndarray, Planned]:
    """Return a planner, its C form, requests and their plans in C."""
    planner = Planner(model)
    boundary = draw_boundary_problems(model, ROWS, seed=4).boundary
    requests = requests_of(planner._checked(boundary))
    compiled = compiled_planner(model, folder, "-O1")
    return planner, compiled, requests, compiled.plan(requests)


@pytest.mark.parametrize(
    "model",
    [
        *some(
            [
                "airhockey-tables",
                "heavy-object",
                "heavy-object-loads",
                "airhockey-replan",
            ],
            2,
        ),
        pytest.param("panda-cup", marks=[needs_robots, pytest.mark.extended]),
        pytest.param("ur5-wipe", marks=[needs_robots, pytest.mark.extended]),
    ],
)
def test_plans_of_a_model_equal_those_of_python(model: str, tmp_path: Path):
    planner, _, requests, planned = prepared(model, tmp_path)
    boundary = planner._checked(draw_boundary_problems(model, ROWS, seed=4).boundary)
    plans = planner.plan_batch(boundary)
    valid = planned.code == VALID
    assert valid.mean() > 0.85
    assert_equal_motions(planned, plans, valid)
    np.testing.assert_allclose(
        planned.duration[valid], plans.duration[valid], rtol=1e-5
    )
    accepted = evaluate_plans(plans[np.flatnonzero(valid)]).valid
    assert accepted.mean() > 0.97  # the check sees a grid only
    assert len(requests) == ROWS


@pytest.mark.extended
@pytest.mark.parametrize(
    "model",
    [
        "airhockey-tables",
        "airhockey-replan",
        "heavy-object",
        "heavy-object-loads",
        pytest.param("panda-cup", marks=needs_robots),
        pytest.param("ur5-wipe", marks=needs_robots),
    ],
)
def test_many_plans_of_a_model_equal_those_of_python(model: str, tmp_path: Path):
    planner = Planner(model)
    drawn = draw_boundary_problems(model, MANY_ROWS, seed=11).boundary
    boundary = planner._checked(drawn)
    planned = compiled_planner(model, tmp_path, "-O2").plan(requests_of(boundary))
    plans, valid = planner.plan_batch(boundary), planned.code == VALID
    assert valid.mean() > 0.9
    assert_equal_motions(planned, plans, valid)


def test_time_parametrized_plans_have_equal_verdicts(tmp_path: Path):
    """The greedy sweep is discontinuous: rounding of the network may change the rates, but not the verdicts."""
    planner, _, _, planned = prepared("airhockey-online", tmp_path)
    boundary = draw_boundary_problems("airhockey-online", ROWS, seed=4).boundary
    plans = planner.plan_batch(boundary)
    written = np.flatnonzero(planned.code == VALID)
    np.testing.assert_allclose(
        planned.path[written], plans.path_control_points[written], rtol=0, atol=1e-6
    )
    close = np.isclose(
        planned.rate[written], plans.rate_control_points[written], rtol=1e-4
    ).all(axis=1)
    assert close.mean() > 0.97
    own = plans[written]
    in_c = replace(
        own,
        path_control_points=planned.path[written],
        rate_control_points=planned.rate[written],
    )
    theirs, ours = evaluate_plans(own), evaluate_plans(in_c)
    for row in np.flatnonzero(theirs.valid != ours.valid):
        margins = [
            (margin.violation - margin.tolerance) / max(abs(margin.bound), 1e-9)
            for verdict in (theirs.verdicts[row], ours.verdicts[row])
            for margin in verdict.margins
        ]
        assert min(map(abs, margins)) < NEAR_A_LIMIT


def test_parameters_outside_of_their_range_have_their_own_code(tmp_path: Path):
    _, compiled, requests, planned = prepared("airhockey-tables", tmp_path)
    row = int(np.flatnonzero(planned.code == VALID)[0])
    for column, value, code in (
        (30, 9.0, PARAMETER),
        (33, -1.0, PARAMETER),
        (31, np.nan, NOT_FINITE),
    ):
        request = requests[row].copy()
        request[column] = value
        found = compiled.plan(request[None], admit=True)
        assert found.code[0] == code
        assert found.duration[0] == 0
        np.testing.assert_array_equal(found.path[0], np.tile(request[:6], (15, 1)))


def test_a_moving_start_that_no_rate_can_slow_down_is_refused(tmp_path: Path):
    _, compiled, requests, planned = prepared("airhockey-online", tmp_path)
    fast = requests[planned.code == VALID][:20].copy()
    fast[:, 6:12] *= 8  # outside the velocity limits at the very start
    found = compiled.plan(fast, admit=True)
    assert (found.code == NO_RATE).any()
    assert np.all(found.duration[found.code != VALID] == 0)


def test_rows_of_a_dataset_give_the_ranges(tmp_path: Path):
    rows = make_dataset("airhockey-hit", tmp_path / "rows", n=400, workers=1).folder
    files = planner_files(find_model("airhockey-hit"), rows)
    header = files["airhockey_hit.h"]
    assert "training rows of a dataset" in header
    assert (
        files["airhockey_hit.c"]
        != planner_files(find_model("airhockey-hit"))["airhockey_hit.c"]
    )
    other = make_dataset("airhockey-online", tmp_path / "other", n=60, workers=1).folder
    with is_refused(DatasetError, argument="other"):
        planner_files(find_model("airhockey-hit"), other)
