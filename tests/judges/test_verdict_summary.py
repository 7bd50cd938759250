"""Summaries of verdicts: counts, averages, JSON."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.judges.plans import (
    Margin,
    Metrics,
    Reason,
    Verdict,
    judge,
    summarize_verdicts,
)
from tests.examples.plans import joined, load, perturbed


def verdicts_of_hits() -> list[Verdict]:
    plan = load("hit")
    return judge(
        *joined(plan, perturbed(plan, 0.05), plan.changed(rate=-plan.motion.rate), plan)
    )


def test_a_summary_counts_and_averages():
    verdicts = verdicts_of_hits()
    summary = summarize_verdicts(verdicts)
    assert (summary["plans"], summary["valid"], summary["valid_ratio"]) == (4, 2, 0.5)
    assert summary["finished"] == 3
    assert summary["reasons"]["ok"] == 2
    assert summary["reasons"]["rate not positive"] == 1
    assert summary["metrics_of_valid"]["duration_s"]["mean"] == pytest.approx(
        verdicts[0].metrics.duration
    )
    assert summary["metrics_of_paper_valid"]["duration_s"]["mean"] == pytest.approx(
        verdicts[0].metrics.duration
    )
    assert summary["metrics_of_all"]["z_error_mm_s"]["max"] == pytest.approx(
        1e3 * verdicts[1].metrics.z_error
    )
    worst = summary["conditions"]["table height"]
    assert (worst["violating_plans"], worst["worst_plan"]) == (1, 1)
    json.dumps(summary, allow_nan=False)


def test_a_summary_without_verdicts_is_empty():
    summary = summarize_verdicts([])
    assert summary["plans"] == 0
    assert summary["valid_ratio"] is None
    assert summary["metrics_of_valid"] == {}


def test_a_verdict_converts_to_json():
    document = json.loads(
        json.dumps(load("dragging").judged().to_dict(), allow_nan=False)
    )
    assert document["valid"] is False
    assert document["reason"] == "object in collision"
    assert document["worst"]["name"] == "object contact"
    assert document["worst"]["part"] == "pedestal-2"
    assert document["worst"]["violation"] == pytest.approx(0.00305, abs=2e-5)
    assert set(document["margins"]) >= {
        "boundary velocity",
        "joint torque",
        "robot clearance",
        "tilt",
    }


def test_all_reasons_print_as_plain_texts():
    verdicts = verdicts_of_hits()
    kinds = {type(verdict.reason) for verdict in verdicts}
    assert kinds == {Reason, str}, "reasons of constraints and of the enumeration"
    for verdict in verdicts:
        text = str(verdict.reason)
        assert (
            repr(verdict.reason),
            f"{verdict.reason}",
            f"{verdict.reason!r:.4}",
        ) == (
            repr(text),
            text,
            repr(text)[:4],
        )
    assert str([*Reason]) == str([str(reason) for reason in Reason])


def test_the_text_of_a_verdict_is_short():
    valid, perturbed_one, backwards, _ = verdicts_of_hits()
    assert (repr(valid), str(valid)) == ("<Verdict: valid>", "valid")
    assert str(perturbed_one) == f"{perturbed_one.reason} ({perturbed_one.worst})"
    assert repr(backwards) == "<Verdict: rate not positive>"


def test_the_text_of_a_margin_has_violation_bound_and_time():
    margin = Margin(
        "joint velocity",
        "joint velocity limit",
        "rad/s",
        "joint_4",
        1.1,
        1.0,
        0.1,
        0.002,
        0.25,
        0.5,
    )
    assert (
        str(margin)
        == "joint velocity joint_4: 0.1 rad/s outside 1 (tolerance 0.002) at t = 0.2500 s, s = 0.5000"
    )
    assert margin.severity == pytest.approx(50)
    assert "within" in str(replace(margin, violation=-0.1))
    assert replace(margin, violation=np.inf).to_dict()["violation"] is None
    assert Metrics().to_dict() == {}
