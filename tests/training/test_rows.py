"""Rows are prepared in blocks, as if all at once; the check rows are not those that the last model is judged on."""

import numpy as np
import pytest

from cnpgen.loader.order import Order
from cnpgen.planner.kit import make_kit
from cnpgen.training import rows as rows_module
from cnpgen.training.data import open_training_data
from cnpgen.training.prepare import prepare_run
from cnpgen.training.rows import StepRows, prepare_rows
from cnpgen.training.settings import METRICS, TrainingSettings
from tests.conftest import columns_of, some
from tests.examples.models import boundary_of_columns, meaning_of, surroundings_of


@pytest.mark.parametrize(
    ("dataset", "name"), some([("airhockey-replan", "airhockey"), ("heavy-object", "heavy-object")], 1, "slow")
)
def test_rows_prepared_in_blocks_are_those_prepared_at_once(tiny, monkeypatch, dataset, name):
    boundary = boundary_of_columns(columns_of(tiny(dataset)), 50)
    prepare = make_kit(surroundings_of(name), meaning_of(1, 1), slow_down=False).prepare
    whole, features = prepare_rows(boundary, prepare)
    monkeypatch.setattr(rows_module, "BLOCK", 16)
    seen, call = [], type(prepare).__call__
    monkeypatch.setattr(type(prepare), "__call__", lambda self, part: seen.append(len(part)) or call(self, part))
    parts, again = prepare_rows(boundary, prepare)
    assert max(seen) == 16
    np.testing.assert_allclose(again.mean, features.mean, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(parts.features, whole.features, atol=1e-5)
    np.testing.assert_array_equal(parts.tops, whole.tops)
    for part in ("start_xyz", "goal_xyz", "expected_time", "correction"):
        np.testing.assert_array_equal(getattr(parts.tasks, part), getattr(whole.tasks, part))
    np.testing.assert_array_equal(parts.tasks.boundary.goal_dq, whole.tasks.boundary.goal_dq)
    assert parts.tasks.correction.dtype == parts.features.dtype == np.float32


def test_the_order_of_rows_is_the_loader_s_which_no_numpy_changes():
    order = StepRows(100, 40, seed=3)
    for epoch in (0, 2):
        batches = np.concatenate([order.batch(2 * epoch), order.batch(2 * epoch + 1)])
        np.testing.assert_array_equal(batches, Order("train", (100,), 3, epoch).rows_of(0)[:80])


@pytest.mark.parametrize("checks", [2, 20, 1000])
def test_check_rows_are_not_among_those_that_the_last_model_is_judged_on(tiny, checks):
    source = open_training_data(tiny("airhockey-hit"))
    checked, judged = source.checked(checks).start_q, source.judged(2000, after=checks).start_q
    assert len(checked) == min(checks, 30)
    assert len(checked) + len(judged) == 60
    assert len(np.unique(np.concatenate([checked, judged]), axis=0)) == 60
    assert len(source.judged(5, after=checks)) == 5


@pytest.mark.slow
def test_the_published_metric_learns_with_the_published_form(tiny, monkeypatch):
    monkeypatch.setattr("cnpgen.training.prepare.make_landing", lambda *_, **__: None)  # dear, and no part of the form
    source = open_training_data(tiny("heavy-object"))
    for metric, form in (("learned", "paper"), ("ramped", "signed")):
        settings = TrainingSettings(hidden=8, layers=1, nodes=16, metric=METRICS[metric])
        run, _ = prepare_run(source, surroundings_of("heavy-object"), settings, check_rows=2)
        assert run.learner.loss.form == form
