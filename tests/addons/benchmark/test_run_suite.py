"""Resumed runs; planners that crash, time out or return invalid results."""

import csv
import json
import os
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.addons.benchmark.benchmark_options import BenchmarkOptions
from cnpgen.addons.benchmark.benchmark_planner import Setting
from cnpgen.addons.benchmark.benchmark_report import (
    benchmark_values,
    distribution_figure,
    save_benchmark_figures,
    save_benchmark_report,
    success_figure,
    success_over_time,
)
from cnpgen.addons.benchmark.process import (
    Ending,
    PlannerProcess,
    PlanningOutcome,
    cpu_time_of,
)
from cnpgen.addons.benchmark.result_tables import (
    csv_text,
    failure_summaries,
    markdown_text,
    notes,
    save_benchmark_tables,
    table_rows,
)
from cnpgen.addons.benchmark.results_file import (
    answer_from_dict,
    answer_to_dict,
    open_results,
)
from cnpgen.addons.benchmark.run_suite import Benchmark, run_benchmark
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.errors import DatasetError, UsageError
from cnpgen.schema.catalogue import list_recipes
from tests.conftest import some
from tests.examples.example_robots import needs_robots
from tests.examples.grouped import grouped
from tests.examples.installed import installed_kind
from tests.refusals import is_refused

UNRELIABLE = """
import os, time
from dataclasses import dataclass
import numpy as np
from cnpgen.benchmark import Trajectory
from cnpgen.addons.benchmark.benchmark_planner import BenchmarkPlanner
from cnpgen.addons.benchmark.planners.own_planners import ShippedNetwork
from cnpgen.addons.benchmark.suite import load_suite

@dataclass(frozen=True)
class Unreliable(BenchmarkPlanner):
    "Fails differently on every problem."

    def prepare(self, setting):
        good, others = ShippedNetwork().prepare(setting), load_suite("hits-81").problems()[0]
        actions = {
            0: lambda problem: os._exit(1),
            1: good,
            2: lambda problem: "garbage",
            3: lambda problem: 1 / 0,
            4: lambda problem: None,
            5: lambda problem: time.sleep(1000),
            6: good,
            7: lambda problem: Trajectory(np.array([0, 1.0]), np.zeros((2, 3))),
            8: lambda problem: problem,
            9: lambda problem: Trajectory(np.array([0, 1e4]), np.zeros((2, 6))),
            10: lambda problem: good(others[50]),
            11: lambda problem: type("Mine", (Trajectory,), {})([0, 1.0], np.zeros((2, 6))),
            12: lambda problem: print("{not json") or Trajectory(np.array([0, 1.0]), np.full((2, 6), 1e8)),
        }
        return lambda problem: actions[int(problem.sample_id[0])](problem)
"""


@pytest.fixture
def unreliable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A planner of an installed package."""
    (tmp_path / "unreliable.py").write_text(UNRELIABLE, encoding="utf-8")
    with installed_kind(tmp_path, "unreliable", "unreliable:Unreliable", monkeypatch):
        yield "unreliable"


@pytest.mark.slow
def test_a_failure_of_a_planner_affects_only_its_own_problem(
    unreliable: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("cnpgen.addons.benchmark.process.STOP_MARGIN_S", 0.5)
    benchmark = run_benchmark(
        "hits-81",
        tmp_path / "results",
        planners=[unreliable],
        n=13,
        options=BenchmarkOptions(time_limit=0.2),
    )
    rows = benchmark.results[unreliable]
    endings = [row["ending"] for row in rows]
    assert endings[:7] == [
        "crashed",
        "planned",
        "failed",
        "failed",
        "no plan",
        "out of time",
        "planned",
    ]
    assert endings[7:] == ["failed", *["planned"] * 5]
    assert capfd.readouterr().out == ""  # output of planners does not mix with results
    assert rows[7]["error"] == "the problem has 6 joints, its answer 3"
    assert [row["verdict"]["reason"] for row in rows[8:]] == [
        "not finite",
        "too long",
        *["boundary conditions"] * 3,
    ]
    assert "garbage" in rows[2]["error"]
    assert "ZeroDivisionError" in rows[3]["error"]
    assert [row["answer"] is not None for row in rows[:7]] == [
        False,
        True,
        False,
        False,
        False,
        False,
        True,
    ]
    assert failure_summaries(benchmark)[-1] == (
        "unreliable: 5 of 7 plans not valid by the verdict: boundary conditions 3, not finite 1, too long 1"
    )


@pytest.mark.parametrize("failure", some(["os._exit(1)", "1 / 0"], 1, "slow"))
def test_a_planner_that_cannot_be_prepared_affects_only_its_own_rows(
    unreliable: str, failure: str, tmp_path: Path
) -> None:
    text = (tmp_path / "unreliable.py").read_text(encoding="utf-8")
    (tmp_path / "unreliable.py").write_text(
        text.replace("good, others =", f"{failure}\n        good, others ="),
        encoding="utf-8",
    )
    benchmark = run_benchmark(
        "hits-81", tmp_path / "results", planners=[unreliable, "cnpgen"], n=2
    )
    assert [row["ending"] for row in benchmark.results[unreliable]] == ["crashed"] * 2
    assert [row["ending"] for row in benchmark.results["cnpgen"]] == ["planned"] * 2
    messages = {
        "1 / 0": "ZeroDivisionError: division by zero",
        "os._exit(1)": "its process ended or was not ready in time",
    }
    assert failure_summaries(benchmark) == [
        f"unreliable: 2 of 2 crashed, problem 0: before the first problem: {messages[failure]}"
    ]


@pytest.mark.slow
def test_a_report_omits_the_image_of_a_damaged_line(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    run_benchmark(
        "hits-81", tmp_path, planners=["cnpgen"], n=1, plants=["nominal"], workers=1
    )
    file = tmp_path / "cnpgen.jsonl"
    head, planned, *others = map(json.loads, file.read_text().splitlines())
    planned["answer"]["path_control_points"] = [
        row[:3] for row in planned["answer"]["path_control_points"]
    ]
    file.write_text("".join(json.dumps(row) + "\n" for row in (head, planned, *others)))
    benchmark = run_benchmark(
        "hits-81",
        tmp_path,
        planners=["cnpgen"],
        n=1,
        plants=["nominal", "heavier"],
        workers=1,
    )
    failure = benchmark.results["cnpgen"][0]["executed"]["heavier"]["failure"]
    assert failure.startswith(
        "path_control_points has 3 joints, but 'airhockey' plans 6"
    )
    report = save_benchmark_report(benchmark, tmp_path / "report.html").read_text()
    assert "cnpgen, problem 0: no image: path_control_points has 3 joints" in report
    assert "1 of 1 (20.7 to 100 %)" in report
    assert "CNP-B, has in the paper: " in report


@pytest.mark.slow
def test_a_report_uses_the_next_answer_if_the_first_cannot_be_executed(
    tmp_path: Path,
) -> None:
    pytest.importorskip("mujoco")
    first = run_benchmark("hits-81", tmp_path, planners=["cnpgen"], n=2)
    file = tmp_path / "cnpgen.jsonl"
    lines = file.read_text().splitlines()
    broken = first.results["cnpgen"][0]
    broken["answer"]["rate_control_points"][0] = None
    file.write_text("\n".join([lines[0], json.dumps(broken), *lines[2:]]) + "\n")
    benchmark = run_benchmark(
        "hits-81", tmp_path, planners=["cnpgen"], n=2, plants=["nominal"], workers=1
    )
    assert (
        "cannot be executed"
        in benchmark.results["cnpgen"][0]["executed"]["nominal"]["failure"]
    )
    report = save_benchmark_report(benchmark, tmp_path / "report.html").read_text()
    assert "cnpgen, problem 1" in report or "No images" in report


@pytest.mark.slow
def test_a_run_resumes_and_adds_executions_and_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    first = run_benchmark("hits-81", tmp_path, planners=["cnpgen"], n=2)
    file = tmp_path / "cnpgen.jsonl"
    text = file.read_text()
    file.write_text(text + text.splitlines()[-1][:100])  # cut off by an interruption
    activities: list[str] = []
    second = run_benchmark(
        "hits-81",
        tmp_path,
        planners=["cnpgen"],
        n=3,
        plants=["nominal"],
        workers=1,
        progress=lambda *a: activities.append(a[0]),
    )
    assert activities == ["cnpgen plans", *["cnpgen, nominal plant"] * 3]
    assert file.read_text().startswith(text)
    assert (
        second.results["cnpgen"][0]["planning_s"]
        == first.results["cnpgen"][0]["planning_s"]
    )
    assert all(row["executed"]["nominal"]["scored"] for row in second.results["cnpgen"])
    third = run_benchmark(
        "hits-81", tmp_path, planners=["cnpgen"], n=3, plants=["nominal"], workers=1
    )
    assert third.results == second.results
    monkeypatch.setattr("cnpgen.addons.benchmark.benchmark_report.MAX_FILM_FRAMES", 3)
    report = save_benchmark_report(
        third, tmp_path / "report.html", video=True
    ).read_text()
    assert ": 100 %, planning time" in report
    assert "<svg" in report
    assert (
        "src='data:video/mp4;base64," in report
        or "No images: this machine cannot draw" in report
    )
    assert not re.search("(src|href)=['\"](?!data:|#)", report)
    assert [file.name for file in sorted(tmp_path.iterdir())] == [
        "cnpgen.jsonl",
        "report.html",
        "runs.json",
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "engine",
    [
        "loky",
        *(pytest.param(name, marks=pytest.mark.extended) for name in ("dask", "ray")),
    ],
)
@pytest.mark.filterwarnings("default")  # of dask and ray
def test_parallel_planners_return_the_results_of_one(
    tmp_path: Path, engine: str
) -> None:
    pytest.importorskip({"loky": "joblib", "dask": "distributed"}.get(engine, engine))
    (serial,) = run_benchmark(
        "hits-81", tmp_path / "serial", planners=["cnpgen"], n=3
    ).results.values()
    (parallel,) = run_benchmark(
        "hits-81",
        tmp_path / "parallel",
        planners=["cnpgen"],
        n=3,
        workers=2,
        options=BenchmarkOptions(engine=engine),
    ).results.values()
    assert [row["planners_at_once"] for row in parallel] == [2] * 3
    for key in ("problem", "answer", "verdict"):
        assert [row[key] for row in parallel] == [row[key] for row in serial]


@pytest.mark.slow
def test_results_of_another_run_are_refused(tmp_path: Path) -> None:
    run_benchmark("hits-81", tmp_path, planners=["cnpgen"], n=1)
    with is_refused(UsageError, argument="force"):
        run_benchmark("hits-110", tmp_path, planners=["cnpgen"], n=1)
    run_benchmark("hits-110", tmp_path, planners=["cnpgen"], n=1, force=True)
    assert (
        json.loads((tmp_path / "cnpgen.jsonl").read_text().splitlines()[0])["suite"]
        == "hits-110"
    )


PLANNED = {
    "problem": 0,
    "ending": "planned",
    "planning_s": 1.0,
    "planning_cpu_s": 1.0,
    "error": "",
    "answer": None,
}
ANSWER = {"degree": 7, "path_control_points": [[0.0]], "rate_control_points": [1.0]}


@pytest.mark.parametrize(
    ("row", "text"),
    [
        ([], "the document must be a table, got a list of 0"),
        ({}, "problem is missing"),
        ({"problem": "0"}, "problem must be a whole number"),
        ({"problem": 0, "ending": "planned"}, "planning_s is missing"),
        ({**PLANNED, "planning_s": "x"}, "planning_s must be a finite number, got 'x'"),
        (
            {**PLANNED, "planning_s": "inf"},
            "planning_s must be a finite number, got 'inf'",
        ),
        (
            {**PLANNED, "planning_cpu_s": 1e999},
            "planning_cpu_s must be a finite number, got inf",
        ),
        ({**PLANNED, "answer": {"t": [0.0]}}, "q is missing"),
        (
            {**PLANNED, "answer": {**ANSWER, "rate_control_points": "x"}},
            "rate_control_points must be a list, got 'x'",
        ),
        ({**PLANNED, "answer": ANSWER}, "verdict is missing"),
        ({"problem": 0, "executed": 5}, "executed must be a table, got 5"),
        (
            {"problem": 0, "executed": {"nominal": {"puck_speed_m_s": "x"}}},
            "puck_speed_m_s must be a finite number",
        ),
        (
            {"problem": 0, "executed": {"nominal": {"hit_time_s": "nan"}}},
            "hit_time_s must be a finite number",
        ),
    ],
)
def test_an_invalid_line_is_named(tmp_path: Path, row: Any, text: str) -> None:
    open_results(tmp_path / "a.jsonl", {}).file.close()
    with (tmp_path / "a.jsonl").open("a") as file:
        file.write(json.dumps(row) + "\n")
    with pytest.raises(
        DatasetError,
        match=rf"a.jsonl is damaged: line 2: {re.escape(text)}.*; delete that line",
    ):
        open_results(tmp_path / "a.jsonl", {})


def test_deeply_nested_lines_are_ignored_and_a_pipe_is_refused(tmp_path: Path) -> None:
    open_results(tmp_path / "a.jsonl", {}).file.close()
    with (tmp_path / "a.jsonl").open("a") as file:
        file.write("[" * 100_000 + "\n")
    results = open_results(tmp_path / "a.jsonl", {})
    assert results.rows == {}
    results.file.close()
    os.mkfifo(tmp_path / "b.jsonl")
    with is_refused(UsageError, argument="path"):
        open_results(tmp_path / "b.jsonl", {})


def test_mistakes_are_reported_before_any_work(tmp_path: Path) -> None:
    with is_refused(UsageError, argument="planners"):
        run_benchmark("hits-81", tmp_path, planners=["cnpgn"])
    for old, new in {"cnp-b": "cnpgen", "cnp-b+refine": "cnpgen+refine"}.items():
        with pytest.raises(
            UsageError,
            match=rf"unknown planner '{re.escape(old)}' \(its name is now '{re.escape(new)}'\)",
        ):
            run_benchmark("hits-81", tmp_path, planners=[old])
    with is_refused(UsageError, argument="plants"):
        run_benchmark("hits-81", tmp_path, planners=["cnpgen"], plants=["lighter"])
    with is_refused(UsageError, argument="time_limit"):
        run_benchmark(
            "hits-81",
            tmp_path,
            planners=["cnpgen"],
            options=BenchmarkOptions(time_limit=0),
        )
    for tolerance in (-1e-3, float("inf"), True):
        with is_refused(UsageError, argument="plane_tolerance"):
            run_benchmark(
                "hits-81",
                tmp_path,
                planners=["cnpgen"],
                options=BenchmarkOptions(plane_tolerance=tolerance),
            )
    assert list(tmp_path.iterdir()) == []


def test_an_unsuitable_planner_is_reported_as_not_applicable(tmp_path: Path) -> None:
    benchmark = run_benchmark("heavy-100", tmp_path, planners=["cnpgen", "aqp"], n=2)
    assert [row["ending"] for row in benchmark.results["aqp"]] == ["not applicable"] * 2
    assert failure_summaries(benchmark) == [
        "aqp: 2 of 2 not applicable, problem 0: aqp plans hits on a table with up to 7 joints,"
        " 'heavy-object' is another problem"
    ]
    rows = {head: cells for head, *cells in table_rows(benchmark, "")}
    assert rows["applicability"] == ["", "not applicable"]
    assert rows["a plan was found"] == ["2 of 2 (34.2 to 100 %)", ""]
    on_a_plant = {head: cells for head, *cells in table_rows(benchmark, "nominal")}
    assert on_a_plant["applicability"] == ["not executed", "not applicable"]


@pytest.mark.parametrize(
    "suite", ["hits-81", "heavy-100", pytest.param("clutter", marks=needs_robots)]
)
def test_tables_have_only_what_applies_to_their_suite(suite: str) -> None:
    problems = load_suite(suite).problems(1)[0]
    row = {"answer": None, "ending": "no plan", "error": "", "problem": 0}
    row |= {"planning_s": 1.0, "planning_cpu_s": 1.0}
    benchmark = Benchmark(load_suite(suite), problems, None, {"some": [row]})
    heads = [head for head, *_ in table_rows(benchmark, "")]
    has_rules = suite != "clutter"
    assert ("planned motion valid by the paper's rules" in heads) == has_rules
    head = csv_text(benchmark).partition("\n")[0].split(",")
    assert ("paper_valid" in head) == has_rules
    assert "valid" in head
    text = markdown_text(benchmark)
    assert ("A hit succeeds if" in text) == (suite == "hits-81")


def test_answers_are_read_back_exactly(tmp_path: Path) -> None:
    problem = load_suite("hits-81").problems(1)[0]
    trajectory = Trajectory(
        np.array([0.0, 1 / 3]), problem.boundary.start_q[[0, 0]] / 3
    )
    results = open_results(tmp_path / "a.jsonl", {})
    verdict = {
        "valid": False,
        "paper": {"valid": False, "finished": False},
        "metrics": {},
        "value_over_bound": {},
    }
    results.append(
        {**PLANNED, "answer": answer_to_dict(trajectory), "verdict": verdict}
    )
    results.file.close()
    reread = open_results(tmp_path / "a.jsonl", {})
    reread.file.close()
    read = answer_from_dict(problem, reread.rows[0]["answer"])
    assert isinstance(read, Trajectory)
    assert (read.q == trajectory.q).all()
    assert (read.t == trajectory.t).all()
    assert read.dq is None


RANDOM = """
import os, subprocess, sys, time
from dataclasses import dataclass
import numpy as np
from cnpgen.benchmark import BenchmarkPlanner, Trajectory
from cnpgen.plugins import field

@dataclass(frozen=True)
class Random(BenchmarkPlanner):
    "Draws a goal; it can start a child that outlives it."

    child: str = field("file that the child touches after the time limit", default="")

    def prepare(self, setting):
        def plan(problem):
            if self.child:
                program = f"import time; time.sleep(3); open({self.child!r}, 'w')"
                subprocess.Popen([sys.executable, "-c", program], start_new_session=True)
                time.sleep(1000)
            return Trajectory(np.array([0, 1.0]), setting.random(problem).normal(size=(2, 6)))
        return plan
"""


def drawn(
    folder: Path, name: str, indices: slice = slice(None), **options: Any
) -> list[Any]:
    options["planners"] = [name]
    rows = grouped(run_benchmark, BenchmarkOptions, "hits-81", folder, **options)
    rows = rows.results[name]
    return [row["answer"]["q"] for row in rows[indices]]


@pytest.fixture
def random(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "random_planner.py").write_text(RANDOM, encoding="utf-8")
    with installed_kind(tmp_path, "random", "random_planner:Random", monkeypatch):
        yield "random"


def test_every_problem_has_its_own_random_numbers(random: str, tmp_path: Path) -> None:
    whole = drawn(tmp_path / "whole", random, n=3)
    drawn(tmp_path / "resumed", random, n=1)
    assert drawn(tmp_path / "resumed", random, n=3) == whole
    assert drawn(tmp_path / "seed", random, n=3, seed=1) != whole
    repeated = drawn(tmp_path / "repeated", random, n=3, repeat=2)
    assert repeated[:3] == whole
    assert len({str(answer) for answer in repeated}) == 6
    with is_refused(UsageError, argument="force"):
        run_benchmark(
            "hits-81",
            tmp_path / "whole",
            planners=[random],
            n=1,
            options=BenchmarkOptions(seed=1),
        )


def test_earlier_answers_are_discarded_on_request(random: str, tmp_path: Path) -> None:
    drawn(tmp_path / "results", random, n=3)
    file = tmp_path / "results" / "random.jsonl"
    head, *lines = file.read_text().splitlines()
    changed = {**json.loads(lines[0]), "planning_s": 77.0}
    file.write_text("\n".join([head, json.dumps(changed), *lines[1:]]) + "\n")
    kept = run_benchmark(
        "hits-81", tmp_path / "results", planners=[random], n=1
    ).results[random]
    assert [row["planning_s"] == 77.0 for row in kept] == [True, False, False]
    again = run_benchmark(
        "hits-81",
        tmp_path / "results",
        planners=[random],
        n=1,
        options=BenchmarkOptions(replan=True),
    ).results[random]
    assert len(again) == 1
    assert again[0]["planning_s"] < 77.0


def test_fields_of_planners_in_a_suite_are_those_of_its_runs_unless_the_command_sets_others(
    tmp_path: Path,
) -> None:
    suite, text = (
        tmp_path / "hits-81.toml",
        list_recipes("suite")["hits-81"].read_text(encoding="utf-8"),
    )
    suite.write_text(
        f'{text}[planners.aqp]\nacceleration = "300 cm/s^2"\nanchor_time = "700 ms"\n',
        encoding="utf-8",
    )
    parameters = {"aqp": {"anchor_time": 0.6}}
    run_benchmark(suite, tmp_path / "out", planners=["aqp"], parameters=parameters, n=1)
    head = json.loads((tmp_path / "out" / "aqp.jsonl").read_text().splitlines()[0])
    assert head["parameters"] == {"acceleration": 3.0, "anchor_time": 0.6}
    suite.write_text(
        text, encoding="utf-8"
    )  # the problems are the same, so other planners extend the results
    assert list(
        run_benchmark(suite, tmp_path / "out", planners=["ruckig"], n=1).results
    ) == ["ruckig", "aqp"]


def test_other_parameters_of_a_planner_are_another_run(tmp_path: Path) -> None:
    few = run_benchmark(
        "hits-81",
        tmp_path,
        planners=["trajopt"],
        n=1,
        parameters={"trajopt": {"iterations": 3}},
    )
    head = json.loads((tmp_path / "trajopt.jsonl").read_text().splitlines()[0])
    assert head["parameters"] == {"iterations": 3}
    with is_refused(UsageError, argument="force"):
        run_benchmark("hits-81", tmp_path, planners=["trajopt"], n=1)
    more = run_benchmark(
        "hits-81",
        tmp_path,
        planners=["trajopt"],
        n=1,
        parameters={"trajopt": {"iterations": 6}},
        force=True,
    )
    assert more.results["trajopt"][0]["answer"] != few.results["trajopt"][0]["answer"]
    with is_refused(UsageError, argument="parameters"):
        run_benchmark(
            "hits-81",
            tmp_path,
            planners=["trajopt"],
            n=1,
            parameters={"trajopt": {"iterations": 0}},
        )
    with is_refused(UsageError, argument="parameters"):
        run_benchmark(
            "hits-81", tmp_path, planners=["trajopt"], n=1, parameters={"aqp": {}}
        )


def test_children_of_a_planner_end_with_its_time_limit(
    random: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, touched = tmp_path / "random_planner.py", tmp_path / "touched"
    module.write_text(
        module.read_text().replace('default=""', f"default={str(touched)!r}")
    )
    monkeypatch.setattr("cnpgen.addons.benchmark.process.STOP_MARGIN_S", 0.2)
    start = time.monotonic()
    (row,) = run_benchmark(
        "hits-81",
        tmp_path / "results",
        planners=[random],
        n=1,
        options=BenchmarkOptions(time_limit=0.5),
    ).results[random]
    assert row["ending"] == "out of time"
    assert time.monotonic() - start < 60
    time.sleep(3.5)
    assert not touched.exists()


def test_an_answer_after_the_time_limit_does_not_count() -> None:
    process = PlannerProcess(
        "cnpgen", Setting(load_suite("hits-81").problems(1)[0].problem, time_limit=1.0)
    )
    late = PlanningOutcome(Ending.PLANNED, {"t": []}, seconds=1.001)
    assert process._in_time(late).ending == "out of time"
    assert process._in_time(late).answer is None
    in_time = PlanningOutcome(Ending.PLANNED, {"t": []}, seconds=0.999)
    assert process._in_time(in_time) is in_time


def test_a_stopped_planner_has_the_cpu_time_that_it_used(
    unreliable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cnpgen.addons.benchmark.process.STOP_MARGIN_S", 0.2)
    module = tmp_path / "unreliable.py"
    module.write_text(
        module.read_text().replace("time.sleep(1000)", "sum(1 for _ in iter(int, 1))")
    )
    problems, _ = load_suite("hits-81").problems(6)
    process = PlannerProcess(
        unreliable, Setting(problems.problem, "airhockey-hit", time_limit=2.0)
    )
    outcome = process.plan(problems[5])
    assert outcome.ending is Ending.OUT_OF_TIME
    assert 0 < outcome.cpu_seconds < 1.1 * outcome.seconds
    assert cpu_time_of(os.getpid()) >= time.process_time()


def test_a_report_covers_the_folder_and_nothing_else(
    random: str, tmp_path: Path
) -> None:
    folder = tmp_path / "results"
    run_benchmark("hits-81", folder, planners=["cnpgen"], n=3)
    benchmark = run_benchmark(
        "hits-81",
        folder,
        planners=[random],
        n=2,
        options=BenchmarkOptions(reference="cnpgen"),
    )
    assert {name: len(rows) for name, rows in benchmark.results.items()} == {
        random: 2,
        "cnpgen": 3,
    }
    assert len(benchmark.problems) == 3
    assert [run.planners for run in benchmark.runs] == [("cnpgen",), (random,)]
    save_benchmark_tables(benchmark, folder)
    lines = (folder / "results.csv").read_text().splitlines()
    assert lines[0].startswith("suite,suite_version,planner,")
    csv_rows = list(csv.DictReader(lines))
    assert [(row["planner"], row["problem"]) for row in csv_rows] == [
        (random, "0"), (random, "1"), ("cnpgen", "0"), ("cnpgen", "1"), ("cnpgen", "2"),
    ]  # fmt: skip
    assert (
        float(csv_rows[2]["planning_ms"])
        == 1e3 * benchmark.results["cnpgen"][0]["planning_s"]
    )
    for name in ("tables.md", "tables.tex"):
        text = (folder / name).read_text()
        for needed in (
            benchmark.runs[-1].date,
            benchmark.runs[-1].processor,
            "seed 0",
            "numpy",
        ):
            assert needed in text, (name, needed)
    assert "| planned | random | cnpgen |" in (folder / "tables.md").read_text()
    latex = (folder / "tables.tex").read_text()
    assert re.search(r"^planner & a plan was found & .*\\\\$", latex, re.MULTILINE)
    assert re.findall(r"^(random|cnpgen) & 2 of 2|^(cnpgen) & 3 of 3", latex, re.M)
    assert r"\label{tab:hits-81}" in latex
    assert r"\caption{" in latex
    bare = re.sub(r"^%.*$|\{!\}\{%$", "", latex, flags=re.M)
    assert re.search(r"(?<!\\)%", bare) is None
    with is_refused(UsageError, argument="reference"):
        run_benchmark(
            "hits-81",
            folder,
            planners=[random],
            n=1,
            options=BenchmarkOptions(reference="solve"),
        )
    head = json.loads((folder / "random.jsonl").read_text().splitlines()[0])
    (folder / "other.jsonl").write_text(
        json.dumps(head | {"suite": "heavy-100"}) + "\n"
    )
    with is_refused(UsageError, argument="force"):
        run_benchmark("hits-81", folder, planners=[random], n=1)
    run_benchmark("hits-81", folder, planners=[random], n=1, force=True)
    assert not (folder / "other.jsonl").exists()
    (folder / "notes.jsonl").write_text('{"mine": 1}\n')  # not results of a benchmark
    run_benchmark("hits-81", folder, planners=[random], n=1, force=True)
    assert (folder / "notes.jsonl").read_text() == '{"mine": 1}\n'


def test_figures_have_success_over_planning_time_and_suitable_axes(
    random: str, tmp_path: Path
) -> None:
    benchmark = run_benchmark("hits-81", tmp_path, planners=["cnpgen", random], n=3)
    for row, seconds in zip(benchmark.results["cnpgen"], (0.3, 0.1, 0.2), strict=True):
        row["planning_cpu_s"] = seconds
    benchmark.results["cnpgen"][2]["verdict"]["valid"] = False
    values = benchmark_values(benchmark, "")
    times, ratios = success_over_time(values["cnpgen"], "valid")
    np.testing.assert_allclose(times, [100.0, 300.0])
    np.testing.assert_allclose(ratios, [1 / 3, 2 / 3])
    axes = success_figure(values, "").axes[0]
    assert axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "cnpgen (67 %)",
        "random (0 %)",
    ]
    scales = {
        axes.get_title(): axes.get_yscale() for axes in distribution_figure(values).axes
    }
    assert scales["planning time, CPU [ms]"] == "log"
    assert scales["motion time [s]"] == "linear"
    paths = save_benchmark_figures(benchmark, tmp_path / "new" / "figures")
    assert [path.name for path in paths] == [
        "success-planned.pdf",
        "distributions-planned.pdf",
    ]
    assert all(path.read_bytes().startswith(b"%PDF") for path in paths)


def test_a_damaged_record_of_runs_is_named(tmp_path: Path) -> None:
    (tmp_path / "runs.json").write_text('[{"date": 5}]')
    with is_refused(DatasetError):
        run_benchmark("hits-81", tmp_path, planners=["cnpgen"], n=1)


def test_tables_name_the_planners_whose_inner_loops_are_in_python() -> None:
    suite = load_suite("hits-81")
    benchmark = Benchmark(
        suite, suite.problems(1)[0], None, {"aqp": [], "cnpgen": [], "cbirrt": []}
    )
    (note,) = (note for note in notes(benchmark) if "Python" in note and "C++" in note)
    assert note.startswith("aqp, cbirrt: inner loops in Python")
    assert not any(
        "C++" in note for note in notes(replace(benchmark, results={"cnpgen": []}))
    )
