"""Choosing the corners of other lines: the most useful ones, the same each time, and fewer plans broken than before."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.make.boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import load_model
from cnpgen.planner.planner import Planner
from cnpgen.training import middles
from tests.conftest import needs_compiler


def test_what_mends_most_of_what_is_left_is_chosen_next() -> None:
    mended = np.array([[1, 1, 0, 0, 0], [0, 1, 1, 1, 0], [1, 0, 0, 0, 0], [0, 0, 0, 0, 0]], bool)
    assert middles._most_useful(mended, 3) == [1, 0]  # what is left then, none mends
    assert middles._most_useful(mended, 1) == [1]


@pytest.mark.slow  # it compiles for a minute
@needs_compiler
def test_other_lines_are_chosen_that_mend_plans_of_other_problems(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(middles, "TRIED", 40)
    shipped = load_model("heavy-object-anywhere")
    model = replace(shipped, meaning=replace(shipped.meaning, middles=()))
    rows = draw_boundary_problems("heavy-object-anywhere", 400, seed=5).boundary
    chosen = middles.with_middles(model, rows, count=3)
    assert 1 <= len(chosen.meaning.middles) <= 3
    assert chosen.meaning == middles.with_middles(model, rows, count=3).meaning
    with pytest.raises(UsageError, match=r"has \d middles already"):
        middles.with_middles(chosen, rows)
    with pytest.raises(UsageError, match="count"):
        middles.with_middles(model, rows, count=0)
    others, kit = draw_boundary_problems("heavy-object-anywhere", 400, seed=6).boundary, Planner(chosen)._kit
    assert kit.detours is not None
    plans = [Planner(each).plan_batch(others) for each in (model, chosen)]
    tops = kit.prepare.tops(plans[0].columns["start_xyz"], plans[0].columns["goal_xyz"])
    broken = [(kit.detours.broken(each.motion, tops) > 1).sum() for each in plans]
    assert broken[1] < 0.85 * broken[0]
