"""Training rows: preparation in blocks, order, and the split into check rows and scored rows."""

import numpy as np
import pytest

from cnpgen.loader.windows import Order
from cnpgen.planner.inference_pipeline import make_inference_pipeline
from cnpgen.training import training_rows as rows_module
from cnpgen.training.data import open_training_data
from cnpgen.training.prepare import prepare_run
from cnpgen.training.settings import METRICS, TrainingSettings
from cnpgen.training.training_rows import StepRows, prepare_rows
from tests.conftest import columns_of, some
from tests.examples.models import boundary_of_columns, config_of, loaded_problem_of


@pytest.mark.parametrize(
    ("dataset", "name"),
    some(
        [("airhockey-replan", "airhockey"), ("heavy-object", "heavy-object")], 1, "slow"
    ),
)
def test_rows_prepared_in_blocks_equal_those_prepared_at_once(
    tiny, monkeypatch, dataset, name
):
    boundary = boundary_of_columns(columns_of(tiny(dataset)), 50)
    prepare = make_inference_pipeline(
        loaded_problem_of(name), config_of(1, 1), scale_time=False
    ).prepare
    whole, features = prepare_rows(boundary, prepare)
    monkeypatch.setattr(rows_module, "PREPARED_ROWS_PER_BLOCK", 16)
    seen, call = [], type(prepare).__call__
    monkeypatch.setattr(
        type(prepare),
        "__call__",
        lambda self, part, **poses: seen.append(len(part)) or call(self, part, **poses),
    )
    parts, again = prepare_rows(boundary, prepare)
    assert max(seen) == 16
    np.testing.assert_allclose(again.mean, features.mean, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(parts.features, whole.features, atol=1e-5)
    np.testing.assert_array_equal(parts.tasks.scene.poses, whole.tasks.scene.poses)
    for part in ("start_xyz", "goal_xyz", "expected_time", "correction"):
        np.testing.assert_array_equal(
            getattr(parts.tasks, part), getattr(whole.tasks, part)
        )
    np.testing.assert_array_equal(
        parts.tasks.boundary.goal_dq, whole.tasks.boundary.goal_dq
    )
    assert parts.tasks.correction.dtype == parts.features.dtype == np.float32


def test_the_order_of_rows_is_that_of_the_loader():
    order = StepRows(100, 40, seed=3)
    for epoch in (0, 2):
        batches = np.concatenate([order.batch(2 * epoch), order.batch(2 * epoch + 1)])
        np.testing.assert_array_equal(
            batches, Order("train", (100,), 3, epoch).rows_of(0)[:80]
        )


@pytest.mark.parametrize("checks", [2, 20, 1000])
def test_check_rows_and_scored_rows_are_disjoint(tiny, checks):
    source = open_training_data(tiny("airhockey-hit"))
    checked, judged = (
        rows.boundary.start_q
        for rows in (source.checked(checks), source.judged(2000, after=checks))
    )
    assert len(checked) == min(checks, 30)
    assert len(checked) + len(judged) == 60
    assert len(np.unique(np.concatenate([checked, judged]), axis=0)) == 60
    assert len(source.judged(5, after=checks).boundary) == 5


@pytest.mark.slow
def test_the_learned_metric_uses_the_papers_form_of_the_loss(tiny, monkeypatch):
    monkeypatch.setattr(
        "cnpgen.training.prepare.make_projection", lambda *_, **__: None
    )  # expensive, and independent of the form
    source = open_training_data(tiny("heavy-object"))
    for metric, form in (("learned", "paper"), ("ramped", "signed")):
        settings = TrainingSettings(
            hidden=8, layers=1, nodes=16, metric=METRICS[metric]
        )
        run, _ = prepare_run(
            source, loaded_problem_of("heavy-object"), settings, check_rows=2
        )
        assert run.learner.loss.form == form
