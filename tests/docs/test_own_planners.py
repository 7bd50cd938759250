"""The example planners train, plan and save."""

import runpy
import sys
from pathlib import Path

import pytest

from cnpgen.make.make_dataset import make_dataset
from cnpgen.plans import load_plans

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


@pytest.fixture(scope="module")
def hits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(
        "airhockey-hit", tmp_path_factory.mktemp("hits"), n=2000, workers=1, force=True
    ).folder


@pytest.mark.parametrize("framework", ["torch", "jax"])
def test_a_few_steps_of_an_example_make_smooth_plans(
    hits: Path,
    framework: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip(framework)
    plans = tmp_path / "plans.h5"
    script = EXAMPLES / f"own_planner_{framework}.py"
    arguments = [str(hits), "--steps", "100", "--problems", "20", "-o", str(plans)]
    monkeypatch.setattr(sys, "argv", [str(script), *arguments])
    runpy.run_path(str(script), run_name="__main__")
    lines = capsys.readouterr().out
    assert "100 steps" in lines
    assert "of 20 valid" in lines
    assert (
        load_plans(plans).duration.mean() < 1.2
    )  # the first plans take 1.5 s, those of a trained planner 0.5 s
