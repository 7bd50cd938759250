"""``cnpgen benchmark``: what it lists, prints and writes."""

import json
from pathlib import Path

import pytest

from cnpgen.cli.main import main
from tests.examples.installed import installed_kind
from tests.refusals import assert_said


def test_the_list_names_suites_planners_and_plants(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["benchmark", "--list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {"hits-81", "hits-110", "heavy-100"} <= found["suites"].keys()
    assert {"cnpgen", "cnpgen+refine", "solve", "trajopt", "aqp"} <= found[
        "planners"
    ].keys()
    assert list(found["plants"]) == ["nominal", "heavier", "delayed"]
    assert (
        found["fields"]["aqp.acceleration"]
        == "largest acceleration of the mallet up to the hit (default 8.0 m/s^2)"
    )
    assert found["fields"]["trajopt.iterations"].endswith("(default 100)")


def test_the_list_says_of_a_planner_that_cannot_be_imported_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with installed_kind(tmp_path, "mine", "no_such_module:Mine", monkeypatch):
        assert main(["benchmark", "--list", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert "No module named 'no_such_module'" in found["planners"]["mine"]
    assert "cnpgen" in found["planners"]


@pytest.mark.slow
def test_a_short_benchmark_of_all_planners(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    planners = ["cnpgen", "cnpgen+refine", "solve", "trajopt", "aqp"]
    options = [
        "-o",
        str(tmp_path / "results"),
        "--n",
        "1",
        "--simulate",
        "--workers",
        "1",
    ]
    assert (
        main(["benchmark", "hits-81", "--planners", *planners, *options, "--json"]) == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert found["problems"] == 1
    for name in planners:
        assert found["planners"]["nominal"][name]["ratios"]["scored"]["count"] == 1, (
            name
        )
    assert (tmp_path / "results" / "report.html").is_file()
    assert (
        main(["benchmark", "hits-81", "--planners", *planners, *options]) == 0
    )  # from what is there
    out = capsys.readouterr().out
    assert "nominal plant" in out
    assert "(paper: 92.59 %)" in out


@pytest.mark.parametrize(
    "name", ["results.csv", "tables.tex", "report.html", "success-planned.pdf"]
)
def test_reports_replace_no_files_of_other_origin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (tmp_path / name).write_text("mine")
    (tmp_path / ".env").write_text("kept")
    words = ["benchmark", "replan", "--n", "1", "--planners", "cnpgen"]
    assert main([*words, "-o", str(tmp_path)]) == 2
    assert_said(capsys.readouterr().err)
    assert {path.name for path in tmp_path.iterdir()} == {name, ".env"}
    assert (tmp_path / name).read_text() == "mine"


def test_mistakes_are_said_in_a_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark"]) == 2
    assert_said(capsys.readouterr().err)
    assert (
        main(["benchmark", "hits-81", "--plant", "heavier", "-o", str(tmp_path)]) == 2
    )
    assert_said(capsys.readouterr().err)
    assert main(["benchmark", "hits-81", "--video", "-o", str(tmp_path)]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["benchmark", "hits-81", "--set", "trajopt", "-o", str(tmp_path)]) == 2
    assert_said(capsys.readouterr().err)
    command = [
        "benchmark",
        "hits-81",
        "--planners",
        "trajopt",
        "-o",
        str(tmp_path),
        "--set",
    ]
    assert main([*command, "trajopt.iteration=5"]) == 2
    assert_said(capsys.readouterr().err)
    assert (
        main(["benchmark", "hits-81", "--plane-tolerance", "20 s", "-o", str(tmp_path)])
        == 2
    )
    assert_said(capsys.readouterr().err)
