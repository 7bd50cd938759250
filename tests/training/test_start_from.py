"""Runs that start from a model: initial parameters and features are those of the model; other models raise errors."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.inference_pipeline import ViaPoints
from cnpgen.planner.model_file import save_model
from cnpgen.problems.problem_record import record_problem
from cnpgen.store.files.atomic import file_sha256
from cnpgen.training import prepare
from cnpgen.training.train import Trained, train_model
from cnpgen.training.training_rows import prepare_rows as usual
from cnpgen.trajectory.spline_motion import Motion
from tests.conftest import tiny_recipe
from tests.examples.models import SMALL
from tests.examples.plans import PROBLEMS
from tests.refusals import is_refused

STILL = replace(SMALL, learning_rate=1e-12)  # too small to change parameters


@pytest.fixture(scope="module")
def first(
    tiny: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> Trained:
    """A model of replans, trained for a few steps; not to be changed."""
    out = tmp_path_factory.mktemp("first") / "first.h5"
    return train_model(
        tiny("airhockey-replan"), out, steps=5, settings=SMALL, check_rows=1, workers=1
    )


def test_initial_parameters_and_features_are_those_of_the_model(first, tmp_path):
    rows, out = tmp_path / "rows", tmp_path / "next.h5"
    make_dataset(tiny_recipe("airhockey-replan", seed=9), rows, workers=1)
    found = train_model(
        rows,
        out,
        steps=1,
        settings=STILL,
        start_from=first.path,
        check_rows=1,
        workers=1,
    )
    np.testing.assert_allclose(
        found.model.parameters, first.model.parameters, atol=1e-9
    )
    np.testing.assert_array_equal(found.model.features.mean, first.model.features.mean)
    np.testing.assert_array_equal(
        found.model.features.scale, first.model.features.scale
    )
    assert found.model.training["start_from"] == file_sha256(first.path)
    with is_refused(UsageError, argument="force"):
        train_model(rows, out, steps=1, settings=STILL, check_rows=1)


def test_training_rows_use_the_lines_of_the_initial_models_plans(
    first, tmp_path, monkeypatch
):
    corner, seen = (tuple(np.full(6, 0.3).tolist()),), []
    cornered, rows = tmp_path / "cornered.h5", tmp_path / "rows"
    save_model(
        cornered,
        replace(first.model, config=replace(first.model.config, via_points=corner)),
    )
    make_dataset(tiny_recipe("airhockey-replan", seed=9), rows, workers=1)

    def noted(*args: object, **options: object) -> object:
        seen.append((args, options))
        return usual(*args, **options)

    def by_chance(
        via_points: ViaPoints, motion: Motion, obstacle_poses: np.ndarray
    ) -> np.ndarray:
        return 1 + np.sin(1e3 * motion.path[:, 7].sum(axis=1))

    monkeypatch.setattr(prepare, "prepare_rows", noted)
    monkeypatch.setattr(ViaPoints, "violation", by_chance)
    found = train_model(
        rows,
        tmp_path / "n.h5",
        steps=1,
        settings=STILL,
        start_from=cornered,
        check_rows=1,
        workers=1,
    )
    assert found.model.config.via_points == corner
    ((boundary, straight), options) = seen[0]
    some = boundary[:50]
    changed = (options["lines"](some).correction != straight(some).correction).any(
        axis=(1, 2)
    )
    assert changed.any()
    assert not changed.all()


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        (
            "airhockey-replan",
            replace(SMALL, hidden=17),
            "hidden is 16 there and 17 here",
        ),
        (
            "airhockey-replan",
            replace(SMALL, path_scale=1.0),
            "path_scale is 0.5 there and 1.0 here",
        ),
        (
            "airhockey-hit",
            SMALL,
            "zero conditions is () there and ('start_dq', 'start_ddq') here",
        ),
    ],
    ids=["width", "path scale", "zero conditions"],
)
def test_an_initial_model_that_does_not_fit_raises_an_error(
    first, tiny, tmp_path, name, settings, message
):
    with pytest.raises(UsageError, match=re.escape(message)):
        train_model(
            tiny(name),
            tmp_path / "next.h5",
            steps=1,
            settings=settings,
            start_from=first.path,
            check_rows=1,
        )


def test_an_initial_model_for_another_problem_raises_an_error(first, tiny, tmp_path):
    problem, other = PROBLEMS["airhockey"], tmp_path / "other.h5"
    slower = record_problem(
        replace(problem, limits=replace(problem.limits, velocity_scale=0.7))
    )
    save_model(other, replace(first.model, problem=slower))
    with is_refused(UsageError):
        train_model(
            tiny("airhockey-replan"), tmp_path / "next.h5", steps=1, start_from=other
        )
