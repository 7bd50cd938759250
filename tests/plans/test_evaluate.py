"""Whole sets of plans: the verdict of each, whatever is beside it and however many processes there are."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest

import cnpgen.plans.evaluate
from cnpgen.errors import UsageError
from cnpgen.judges.plans import Verdict, judge
from cnpgen.plans import PlanStatus, load_plans, save_plans
from cnpgen.plans.evaluate import evaluate_plans
from tests.examples.plan_files import garbage, plans_of
from tests.examples.plans import joined, load, perturbed
from tests.refusals import is_refused


def told(verdicts: Iterable[Verdict]) -> list[dict[str, Any]]:
    """Verdicts as JSON, in which what does not apply is left out: nan equals nothing."""
    return [verdict.to_dict() for verdict in verdicts]


def test_verdicts_are_those_of_judge() -> None:
    plans = [load("transport"), load("dragging"), perturbed(load("transport"), 0.02)]
    found = evaluate_plans(plans_of(*plans))
    assert told(found.verdicts) == told(judge(*joined(*plans)))
    assert found.valid.tolist() == [True, False, False]
    assert found.step == 1e-3


def test_garbage_gets_an_honest_verdict_and_a_status_and_changes_nothing_beside_it() -> (
    None
):
    cases = garbage()
    found = evaluate_plans(plans_of(*(plan for plan, _ in cases.values())))
    assert [str(verdict.reason) for verdict in found.verdicts] == [
        reason for _, reason in cases.values()
    ]
    status = {
        "ok": PlanStatus.VALID,
        "not finite": PlanStatus.NOT_FINITE,
        "rate not positive": PlanStatus.NOT_FORWARD,
    }
    assert found.status.tolist() == [
        status.get(reason, PlanStatus.INVALID) for _, reason in cases.values()
    ]
    first, last = told(found.verdicts)[0], told(found.verdicts)[-1]
    assert first == last


@pytest.mark.parametrize("end", ["start", "goal"])
def test_plans_in_memory_and_in_a_file_get_one_verdict_where_a_tip_position_was_changed(
    tmp_path: Path, end: str
) -> None:
    """A start_xyz too high by 5 cm would raise the pedestal below it into the object: the joints count, both ways."""
    right = plans_of(load("transport"), load("transport"))
    moved = right.columns[f"{end}_xyz"] + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.05]])
    changed = replace(right, columns={**right.columns, f"{end}_xyz": moved})
    said = f"{end}_xyz of 1 plan is not where {end}_q puts the tip .the first is plan 1, 0.05 m off."
    with pytest.warns(RuntimeWarning, match=f"^{said}: the joint positions are used"):
        in_memory = evaluate_plans(changed)
    save_plans(tmp_path / "changed.h5", changed)
    with pytest.warns(RuntimeWarning, match=f"changed.h5: {said}"):
        in_file = evaluate_plans(load_plans(tmp_path / "changed.h5"))
    assert (
        told(in_memory.verdicts)
        == told(in_file.verdicts)
        == told(evaluate_plans(right).verdicts)
    )
    assert in_memory.valid.all()
    np.testing.assert_allclose(
        in_memory.plans.columns[f"{end}_xyz"], right.columns[f"{end}_xyz"], atol=1e-12
    )
    assert evaluate_plans(right).plans is right


@pytest.mark.slow
def test_processes_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cnpgen.plans.evaluate, "PLANS_PER_VERDICT_TASK", 3)
    plans = plans_of(*(plan for plan, _ in garbage().values()))
    counts: list[int] = []
    one, two = (
        evaluate_plans(plans, workers=workers, progress=counts.append)
        for workers in (1, 2)
    )
    assert json.dumps([*one.rows()]) == json.dumps([*two.rows()])
    assert counts == 2 * [3, 3, 3, 2]


def test_a_file_is_judged_as_the_plans_that_were_saved(tmp_path: Path) -> None:
    plans = plans_of(load("hit"), perturbed(load("hit"), 0.05), sample_id=[7, 9])
    save_plans(tmp_path / "plans.h5", plans)
    found = evaluate_plans(load_plans(tmp_path / "plans.h5"))
    assert told(found.verdicts) == told(evaluate_plans(plans).verdicts)
    assert [row["sample_id"] for row in found.rows()] == [7, 9]


def test_tolerances_of_another_problem_file_count(tmp_path: Path) -> None:
    plan = load("hit")
    save_plans(tmp_path / "plans.h5", plans_of(plan))
    strict = plan.with_constraint("Table", tolerance=1e-6).problem
    assert not evaluate_plans(
        load_plans(tmp_path / "plans.h5", problem=strict)
    ).valid.any()


def test_no_plans_have_no_verdicts() -> None:
    found = evaluate_plans(plans_of(load("hit"))[:0])
    assert found.verdicts == ()
    assert found.valid.shape == found.status.shape == (0,)
    assert found.summary()["valid_ratio"] is None


@pytest.mark.parametrize(
    "arguments", [{"step": 0.0}, {"step": np.nan}, {"step": "1ms"}, {"workers": 0}]
)
def test_arguments_that_make_no_sense_are_refused(arguments: dict[str, Any]) -> None:
    with is_refused(UsageError, argument=ANY):
        evaluate_plans(plans_of(load("hit")), **arguments)


def test_a_status_can_be_kept_with_the_plans(tmp_path: Path) -> None:
    plans = plans_of(load("hit"), perturbed(load("hit"), 0.05))
    judged = replace(plans, status=evaluate_plans(plans).status)
    save_plans(tmp_path / "judged.h5", judged)
    assert load_plans(tmp_path / "judged.h5").status.tolist() == [
        PlanStatus.VALID,
        PlanStatus.INVALID,
    ]
