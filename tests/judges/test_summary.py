"""Many verdicts in one: counts, averages, JSON."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cnpgen.judges.plans import Margin, Metrics, Reason, Verdict, judge, summarise
from tests.examples.plans import bent, joined, load


def verdicts_of_hits() -> list[Verdict]:
    plan = load("hit")
    return judge(*joined(plan, bent(plan, 0.05), plan.changed(rate=-plan.motion.rate), plan))


def test_a_summary_counts_and_averages():
    verdicts = verdicts_of_hits()
    summary = summarise(verdicts)
    assert (summary["plans"], summary["valid"], summary["valid_ratio"]) == (4, 2, 0.5)
    assert summary["finished"] == 3
    assert summary["reasons"]["ok"] == 2
    assert summary["reasons"]["rate not positive"] == 1
    assert summary["metrics_of_valid"]["duration_s"]["mean"] == pytest.approx(verdicts[0].metrics.duration)
    assert summary["metrics_of_paper_valid"]["duration_s"]["mean"] == pytest.approx(verdicts[0].metrics.duration)
    assert summary["metrics_of_all"]["z_error_mm_s"]["max"] == pytest.approx(1e3 * verdicts[1].metrics.z_error)
    worst = summary["conditions"]["table height"]
    assert (worst["plans_out"], worst["worst_plan"]) == (1, 1)
    json.dumps(summary, allow_nan=False)


def test_a_summary_of_nothing_is_empty():
    summary = summarise([])
    assert summary["plans"] == 0
    assert summary["valid_ratio"] is None
    assert summary["metrics_of_valid"] == {}


def test_a_verdict_is_told_as_json():
    told = json.loads(json.dumps(load("dragging").judged().to_dict(), allow_nan=False))
    assert told["valid"] is False
    assert told["reason"] == "object in collision"
    assert told["worst"]["name"] == "object contact"
    assert told["worst"]["part"] == "pedestal-2"
    assert told["worst"]["excess"] == pytest.approx(0.00305, abs=2e-5)
    assert set(told["margins"]) >= {"boundary velocity", "joint torque", "robot clearance", "tilt"}


def test_a_reason_prints_in_the_same_way_whatever_it_is():
    verdicts = verdicts_of_hits()
    kinds = {type(verdict.reason) for verdict in verdicts}
    assert kinds == {Reason, str}, "a reason of a constraint and others"
    for verdict in verdicts:
        text = str(verdict.reason)
        assert (repr(verdict.reason), f"{verdict.reason}", f"{verdict.reason!r:.4}") == (
            repr(text),
            text,
            repr(text)[:4],
        )
    assert str([*Reason]) == str([str(reason) for reason in Reason])


def test_a_verdict_is_written_in_few_words():
    right, bent_one, backwards, _ = verdicts_of_hits()
    assert (repr(right), str(right)) == ("<Verdict: valid>", "valid")
    assert str(bent_one) == f"{bent_one.reason} ({bent_one.worst})"
    assert repr(backwards) == "<Verdict: rate not positive>"


def test_a_margin_tells_value_bound_and_time():
    margin = Margin("joint velocity", "joint velocity limit", "rad/s", "joint_4", 1.1, 1.0, 0.1, 0.002, 0.25, 0.5)
    assert str(margin) == "joint velocity joint_4: 0.1 rad/s beyond 1 (0.002 allowed) at t = 0.2500 s, s = 0.5000"
    assert margin.severity == pytest.approx(50)
    assert "within" in str(replace(margin, excess=-0.1))
    assert replace(margin, excess=np.inf).to_dict()["excess"] is None
    assert Metrics().to_dict() == {}
