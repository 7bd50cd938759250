"""Inputs that once ended in neither a result nor a CnpgenError, each as small as it could be made."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.plans import PlanStatus, load_plans, save_plans
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import screen
from cnpgen.store.blueprint import load_blueprint, shards
from cnpgen.store.files.documents import save_document
from cnpgen.store.record import load_record
from tests.examples.plan_files import plans_of
from tests.examples.plans import load as stored_plan
from tests.examples.store import dataset  # noqa: F401 - a fixture


def rewritten(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads(path.read_text(encoding="utf-8"))
    del document["self_sha256"]
    change(document)
    save_document(path, document)


@pytest.mark.parametrize("value", [[], {}, [1], {"a": 1}], ids=str)
def test_a_list_or_a_table_where_a_number_is_expected(dataset: Path, value: Any) -> None:  # noqa: F811
    task = shards(load_blueprint(dataset))[0]
    rewritten(dataset / task.sidecar, lambda record: record.update(seconds=value))
    with pytest.raises(DatasetError, match="seconds must be a number, got"):
        load_record(dataset, task)


def test_a_rate_whose_differences_are_infinite(tmp_path: Path) -> None:
    plans = plans_of(stored_plan("hit"), stored_plan("hit"))
    plans.rate_control_points[1, 5] = -1e308
    save_plans(tmp_path / "plans.h5", plans)
    found = load_plans(tmp_path / "plans.h5")
    assert screen(found).tolist() == [PlanStatus.UNKNOWN, PlanStatus.NOT_FORWARD]
    assert evaluate_plans(found, workers=1).valid.tolist() == [True, False]
    assert np.isfinite(found.duration[0])
