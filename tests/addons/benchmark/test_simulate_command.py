"""``cnpgen simulate``: what it prints, its exit codes, its pictures."""

import json
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from cnpgen.cli.main import main
from cnpgen.plans import make_plans, save_plans
from tests.examples.plans import load
from tests.refusals import assert_said

pytestmark = pytest.mark.skipif(not find_spec("mujoco"), reason="needs mujoco")


@pytest.fixture(scope="module")
def carried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = load("transport")
    plans = make_plans(
        plan.problem,
        plan.boundary,
        path_control_points=plan.motion.path,
        rate_control_points=plan.motion.rate,
    )
    file = tmp_path_factory.mktemp("plans") / "carried.h5"
    save_plans(file, plans)
    return file


def test_a_plan_that_does_its_task_exits_with_0(
    carried: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", str(carried), "--workers", "1", "--list"]) == 0
    out = capsys.readouterr().out
    assert "executed by the nominal plant" in out
    assert "1 of 1  100.00%" in out
    assert "plan 0: success" in out


def test_json_says_what_came_of_every_plan(
    carried: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            ["simulate", str(carried), "--workers", "1", "--json", "--plant", "heavier"]
        )
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert found["format"] == "cnpgen-simulation"
    assert (found["plant"], found["plans"], found["success"]) == ("heavier", 1, 1)
    (row,) = found["executed"]
    assert row["finished"] is True
    assert row["vertical_error_rad_s"] == found["medians"]["vertical_error_rad_s"]


def test_a_hit_that_does_not_score_exits_with_1(tmp_path: Path) -> None:
    plan = load("hit")  # 0.2 rad off
    plans = make_plans(
        plan.problem,
        plan.boundary,
        path_control_points=plan.motion.path,
        rate_control_points=plan.motion.rate,
    )
    save_plans(tmp_path / "hit.h5", plans)
    assert main(["simulate", str(tmp_path / "hit.h5"), "--workers", "1"]) == 1


def test_pictures_are_drawn_or_the_reason_is_said_after_the_results(
    carried: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture, film = tmp_path / "end.png", tmp_path / "film.gif"
    code = main(
        [
            "simulate",
            str(carried),
            "--workers",
            "1",
            "--image",
            str(picture),
            "--video",
            str(film),
        ]
    )
    shown = capsys.readouterr()
    assert "executed by the nominal plant" in shown.out
    if code == 3:
        assert "cannot draw without a screen" in shown.err
        return
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert film.read_bytes().startswith(b"GIF")


def test_without_ffmpeg_there_is_no_film_and_the_reason_is_said(
    carried: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "cnpgen.addons.benchmark.simulator.rendering.FILM_TAIL_S", -0.99
    )
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    monkeypatch.setitem(sys.modules, "av", None)
    assert (
        main(
            [
                "simulate",
                str(carried),
                "--workers",
                "1",
                "--video",
                str(tmp_path / "film.mp4"),
            ]
        )
        == 3
    )
    said = capsys.readouterr().err
    assert (
        "pip install 'cnpgen[benchmark]'" in said
        or "cannot draw without a screen" in said
    )


def test_mistakes_are_said_in_a_line(
    carried: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", str(carried), "--plan", "3"]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["simulate", str(carried), "--plan", "3", "--image", "a.png"]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["simulate", str(carried), "--image", "end.jpg"]) == 2
    assert_said(capsys.readouterr().err)
