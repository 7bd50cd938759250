"""The commands that print the figures of README and docs again."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]
NOT_QUOTED = {
    "common",
    "figures",
    "loader_methods",
    "pinocchio_scipy",
    "process_memory",
    "refiner_problems",
    "train_proposals",
}
NOT_QUOTED |= {
    "ipopt",
    "numpy_transcription",
    "slsqp",
}  # parts of benchmarks/refiner.py
# Parts of benchmarks/chunks.py, drives.py and episodes.py.
NOT_QUOTED |= {"chunk_baselines", "chunk_loop", "drive_plant", "episode_programs"}


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    specification = importlib.util.spec_from_file_location(
        "figures", ROOT / "benchmarks" / "figures.py"
    )
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    monkeypatch.setitem(sys.modules, "figures", module)
    specification.loader.exec_module(module)
    return module


def test_every_script_with_figures_is_quoted_and_its_options_exist(
    figures: ModuleType,
) -> None:
    commands = figures.quoted_commands()
    scripts = {Path(command.text.split()[0]).stem for command in commands} - {"cnpgen"}
    assert scripts >= {
        path.stem for path in (ROOT / "benchmarks").glob("*.py")
    } - NOT_QUOTED - {"puck_contact"}
    for command in commands:
        script, *words = command.text.split()
        known = (
            ROOT
            / (
                "cnpgen/addons/benchmark/benchmark_command.py"
                if script == "cnpgen"
                else script
            )
        ).read_text()
        options = {word for word in words if word.startswith("--")} - {"--json"}
        assert all(f'"{option}"' in known for option in options), command.text
    suites = [
        command.text.split()[2]
        for command in commands
        if command.text.startswith("cnpgen")
    ]
    assert {"hits-81", "heavy-100", "replans-200", "clutter"} <= set(suites)
    assert len({command.file_name for command in commands}) == len(commands)


def test_outputs_are_kept_and_commands_without_their_files_skipped(
    figures: ModuleType, tmp_path: Path
) -> None:
    in_challenge = figures.QuotedCommand(
        "a", "benchmarks/challenge_mallet.py air_hockey_challenge"
    )
    assert figures.run(in_challenge, tmp_path, None, 1.0).startswith("skipped")
    assert in_challenge.arguments(tmp_path, tmp_path)[2] == str(tmp_path)
    for text in (
        "benchmarks/trajectories.py FILE --import",
        "benchmarks/your_arm.py --gaps --urdf a=FILE:tip",
    ):
        assert figures.QuotedCommand("a", text).arguments(tmp_path, tmp_path) is None
    suite = figures.QuotedCommand("a", "cnpgen benchmark hits-81 --simulate")
    assert suite.arguments(tmp_path, None)[1:] == [
        *(
            "-m",
            "cnpgen",
            "benchmark",
            "hits-81",
            "--simulate",
            "-o",
            str(tmp_path / "work" / "hits-81"),
        )
    ]
    failing = figures.QuotedCommand("a", "benchmarks/common.py.missing")
    assert figures.run(failing, tmp_path, None, 60.0) == "failed: exit code 2"
    assert not (tmp_path / failing.file_name).exists()
    (tmp_path / failing.file_name).write_text("kept")
    assert figures.run(failing, tmp_path, None, 60.0) == "kept"


def test_the_script_lists_its_commands() -> None:
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / "figures.py"),
        "--list",
        "--pages",
        "loss",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "loss: benchmarks/loss.py" in done.stdout.splitlines()


def test_the_comparison_of_planners_plans_for_at_most_twelve_hours(
    figures: ModuleType,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limited = figures.QuotedCommand(
        "a", "cnpgen benchmark hits-81 --simulate --time-limit 9s --planners a b --json"
    )
    assert limited.planning_bound() == pytest.approx(2 * 81 * 10 / 3600)
    assert figures.QuotedCommand("a", "benchmarks/loss.py").planning_bound() is None
    counts = {
        "hits-81": 81,
        "hits-110": 110,
        "heavy-100": 100,
        "replans-200": 200,
        "clutter": 200,
        "replan": 24,
        "online": 24,
    }
    monkeypatch.setattr(
        "cnpgen.addons.benchmark.suite.load_suite",
        lambda name: SimpleNamespace(problems=lambda: (range(counts[name]), None)),
    )
    figures.print_list(figures.quoted_commands(["planners"]))
    *_, last = capsys.readouterr().out.splitlines()
    assert 5 < float(last.split()[-4]) <= 12


def test_the_tables_of_the_comparison_are_those_of_the_archived_results() -> None:
    command = [sys.executable, str(ROOT / "benchmarks" / "planner_tables.py")]
    printed = (
        subprocess.run(command, capture_output=True, text=True, check=True)
        .stdout.strip()
        .split("\n\n")
    )
    page = (ROOT / "docs" / "benchmarks" / "planners.md").read_text(encoding="utf-8")
    assert {table.split(" | ")[0] for table in printed} >= {
        "| hits-81",
        "| heavy-100",
        "| replans-200",
        "| clutter",
    }
    assert [table.partition("\n")[0] for table in printed if table not in page] == []


def test_the_table_of_ablations_is_that_of_the_archived_results(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    ablations = importlib.import_module("ablations")
    results = ablations.read(
        ROOT / "benchmarks" / "results" / "ablations.jsonl"
    ).values()
    rows = ablations.rows_of(list(results))
    lines = [
        "| " + " | ".join(ablations.cells(row)) + " |"
        for row in ablations.differing(rows)
    ]
    page = (ROOT / "docs" / "benchmarks" / "ablations.md").read_text(encoding="utf-8")
    assert 15 <= len(lines) < len(rows)
    assert [line for line in lines if line not in page] == []


@pytest.mark.parametrize(
    "name",
    ["airhockey-hit-2048-seed1", "heavy-object-2048-seed1", "heavy-object-128-seed1"],
)
def test_logs_of_the_published_method_print_the_figures_of_the_page(name: str) -> None:
    log = ROOT / "benchmarks" / "results" / "paper" / f"{name}.jsonl"
    command = [sys.executable, str(ROOT / "benchmarks" / "paper.py"), str(log)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    page = (ROOT / "docs" / "benchmarks" / "paper.md").read_text(encoding="utf-8")
    *_, strict, _, by_rules, _, duration = printed.split()
    assert f"{duration} s" in page
    assert f"{strict} %" in page
    assert f"{by_rules} %" in page
