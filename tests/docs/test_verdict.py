"""The documentation of verdicts lists exactly the keys of the JSON."""

import re
from pathlib import Path
from typing import Any

from cnpgen.judges.plans import Reason
from cnpgen.plans.evaluate import evaluate_plans
from tests.examples.plan_files import plans_of
from tests.examples.plans import load

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "verdict-format.md"


def documented(after: str) -> set[str]:
    """Return the keys in the first column of the first table after a text."""
    page = PAGE.read_text(encoding="utf-8")
    table = re.search(r"\| key \|.*?\n\n", page[page.index(after) :] + "\n\n", re.S)
    assert table
    return {
        key
        for row in table[0].splitlines()[2:]
        if row
        for key in re.findall(r"`([^`]+)`", row.split("|")[1])
    }


def test_every_key_is_documented() -> None:
    plan = load("dragging")
    evaluation = evaluate_plans(plans_of(plan), tracking_error=0.0)
    (verdict,) = evaluation.rows()
    margin: dict[str, Any] = verdict["worst"]
    assert documented("\n## JSON") == {"file", "verdicts", *evaluation.summary()}
    assert documented("\nA verdict has these keys") == set(verdict)
    assert documented("\nA margin describes") == set(margin)
    for name in (
        "mean",
        "median",
        "p95",
        "max",
        "violating_plans",
        "worst_plan",
        "finished",
        "broken",
    ):
        assert f"`{name}`" in PAGE.read_text(encoding="utf-8")
    assert set(evaluation.summary()["conditions"]["tilt"]) == {
        "violating_plans",
        "worst_plan",
        *margin,
    }


def test_every_metric_and_reason_is_documented() -> None:
    for label in ("hit", "transport"):
        for name in load(label).judged().metrics.to_dict():
            assert f"| `{name}` |" in PAGE.read_text(encoding="utf-8")
    for reason in Reason:
        assert f"`{reason}`" in PAGE.read_text(encoding="utf-8")
