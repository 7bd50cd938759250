"""Minimal inputs that formerly caused neither a result nor a CnpgenError."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.errors import DatasetError
from cnpgen.plans import PlanStatus, load_plans, save_plans
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import screen
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.inspection import inspect_dataset
from cnpgen.store.shard_record import load_record
from tests.examples.documents import rewritten
from tests.examples.plan_files import plans_of
from tests.examples.plans import load as stored_plan
from tests.examples.store import dataset  # noqa: F401 - a fixture


@pytest.mark.parametrize("value", [[], {}, [1], {"a": 1}], ids=str)
def test_a_list_or_a_table_where_a_number_is_expected(dataset: Path, value: Any) -> None:  # noqa: F811
    task = shards(load_dataset_spec(dataset))[0]
    rewritten(dataset / task.sidecar, lambda record: record.update(seconds=value))
    with pytest.raises(DatasetError, match="seconds must be a number, got"):
        load_record(dataset, task)


def test_a_histogram_with_one_bin_more_than_those_of_other_shards(dataset: Path) -> None:  # noqa: F811
    task = shards(load_dataset_spec(dataset))[0]
    rewritten(
        dataset / task.sidecar, lambda record: record["statistics"]["clearance"]["histogram"]["counts"][0].append(0)
    )
    (problem,) = inspect_dataset(dataset).summary.problems
    assert "a histogram must have shape (1, 64), got (1, 65)" in problem


@pytest.mark.parametrize("planned", [True, False])
def test_a_link_with_the_name_of_a_fixed_joint(tmp_path: Path, planned: bool) -> None:
    problem = load_problem("airhockey")
    shutil.copytree(problem.path.parent, tmp_path / "airhockey")
    path = tmp_path / "airhockey" / problem.robot.urdf
    joint = "joint_1" if planned else "joint_7"
    path.write_text(path.read_text(encoding="utf-8").replace('"link_3"', f'"{joint}"'), encoding="utf-8")
    robot = load_robot(load_problem(tmp_path / "airhockey" / "problem.toml"))
    assert robot.capsule_axes == load_robot(problem).capsule_axes


def test_a_rate_whose_differences_are_infinite(tmp_path: Path) -> None:
    plans = plans_of(stored_plan("hit"), stored_plan("hit"))
    plans.rate_control_points[1, 5] = -1e308
    save_plans(tmp_path / "plans.h5", plans)
    found = load_plans(tmp_path / "plans.h5")
    assert screen(found).tolist() == [PlanStatus.UNKNOWN, PlanStatus.NOT_FORWARD]
    assert evaluate_plans(found, workers=1).valid.tolist() == [True, False]
    assert np.isfinite(found.duration[0])
