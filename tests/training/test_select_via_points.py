"""Selection of via points: greedy, deterministic, and fewer plans with violations."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import load_model
from cnpgen.planner.planner import Planner
from cnpgen.training import select_via_points as via_points
from tests.conftest import needs_compiled_code
from tests.refusals import is_refused


def test_the_greedy_cover_selects_the_row_with_most_remaining_columns() -> None:
    repaired = np.array(
        [[1, 1, 0, 0, 0], [0, 1, 1, 1, 0], [1, 0, 0, 0, 0], [0, 0, 0, 0, 0]], bool
    )
    assert via_points._greedy_cover(repaired, 3) == [
        1,
        0,
    ]  # no row covers the remaining column
    assert via_points._greedy_cover(repaired, 1) == [1]


@pytest.mark.slow  # it compiles for a minute
@needs_compiled_code
def test_selected_via_points_repair_plans_of_other_problems(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(via_points, "CONFIGURATIONS_TRIED", 40)
    shipped = load_model("heavy-object-anywhere")
    model = replace(shipped, config=replace(shipped.config, via_points=()))
    rows = draw_boundary_problems("heavy-object-anywhere", 400, seed=5).boundary
    chosen = via_points.with_via_points(model, rows, count=3)
    assert 1 <= len(chosen.config.via_points) <= 3
    assert chosen.config == via_points.with_via_points(model, rows, count=3).config
    with is_refused(UsageError):
        via_points.with_via_points(chosen, rows)
    with is_refused(UsageError, argument="count"):
        via_points.with_via_points(model, rows, count=0)
    others, inference = (
        draw_boundary_problems("heavy-object-anywhere", 400, seed=6).boundary,
        Planner(chosen)._inference,
    )
    assert inference.via_points is not None
    plans = [Planner(each).plan_batch(others) for each in (model, chosen)]
    obstacle_poses = plans[0].scene.poses
    violating = [
        (inference.via_points.violation(each.motion, obstacle_poses) > 1).sum()
        for each in plans
    ]
    assert violating[1] < 0.85 * violating[0]
