"""Refinement of sets of plans: independent plans, any number of processes, resumable runs; commands."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.make_dataset import make_dataset
from cnpgen.plans import PlanStatus, load_plans, save_plans
from cnpgen.plans.boundary_problems import load_boundary_problems
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_plans import refine_plans, solve_plans
from cnpgen.refine.task import Outcome
from tests.conftest import HANGING, some
from tests.examples.plan_files import remove_checksum
from tests.refusals import is_refused

N, HITS = 13, 16
SOME_PLANS_BYTES = 6_000  # of a journal: some plans, but not all


@pytest.fixture(scope="module")
def problems() -> Plans:
    return draw_boundary_problems("airhockey-replan", N, seed=5)


@pytest.fixture(scope="module")
def solved(problems: Plans) -> Plans:
    return refine_plans(problems, workers=1).plans


@pytest.fixture(scope="module")
def hits() -> Plans:
    return refine_plans(draw_boundary_problems("airhockey-hit", HITS), workers=1).plans


def same(one: Plans, other: Plans) -> bool:
    return np.array_equal(
        one.path_control_points, other.path_control_points
    ) and np.array_equal(one.rate_control_points, other.rate_control_points)


def test_solved_plans_are_valid_by_their_status_and_by_evaluate(solved: Plans) -> None:
    assert (solved.status == PlanStatus.VALID).all()
    assert evaluate_plans(solved).valid.all()


def test_solving_ignores_existing_plans(problems: Plans, solved: Plans) -> None:
    slow = replace(solved, rate_control_points=0.5 * solved.rate_control_points)
    assert same(solve_plans(slow, workers=1).plans, solved)
    assert not same(refine_plans(slow, workers=1).plans, solved)
    with is_refused(UsageError, argument="problems"):
        solve_plans("airhockey-hit")  # type: ignore[arg-type]


def test_the_repr_of_a_refinement_is_one_line(problems: Plans) -> None:
    begun = time.perf_counter()
    found = refine_plans(problems[:2], workers=1)
    passed = time.perf_counter() - begun
    assert 0 < found.times.passed <= passed
    assert found.times.computing > 0
    assert found.summary()["seconds"] == found.times.rounded()
    outcomes = {result.outcome.name.lower() for result in found.results}
    text = repr(found)
    assert text.startswith("<2 plans of 'airhockey' refined, 2 valid: ")
    assert all(outcome in text for outcome in outcomes)
    assert len(text) < 120
    assert "\n" not in text


@pytest.mark.slow
def test_neither_workers_nor_the_order_of_the_plans_change_anything(
    problems: Plans, solved: Plans
) -> None:
    shuffled = np.random.default_rng(0).permutation(N)
    again = refine_plans(problems[shuffled], workers=2).plans
    assert same(again[np.argsort(shuffled)], solved)


def test_plans_refined_again_are_not_worse(solved: Plans) -> None:
    again = refine_plans(solved, workers=1)
    assert again.valid.all()
    assert (
        again.plans.columns["refine_objective"]
        <= solved.columns["refine_objective"] + 1e-12
    ).all()


def test_invalid_plans_do_not_change_the_others(problems: Plans, solved: Plans) -> None:
    path, rate = (
        problems.path_control_points.copy(),
        problems.rate_control_points.copy(),
    )
    path[1], rate[1] = 40.0, 1.0
    rate[2] = -1.0
    boundary = replace(problems.boundary, goal_q=problems.boundary.goal_q.copy())
    boundary.goal_q[3] = np.nan
    found = refine_plans(
        replace(
            problems,
            path_control_points=path,
            rate_control_points=rate,
            boundary=boundary,
        )
    )
    assert found.plans.status[3] == PlanStatus.NOT_FINITE
    assert np.delete(found.valid, 3).all()
    others = np.delete(np.arange(N), [1, 2, 3])
    assert same(found.plans[others], solved[others])


@pytest.mark.parametrize("size", [1e3, 1e30, 1e160, 1e300])
def test_huge_boundary_conditions_do_not_change_the_other_plans(
    problems: Plans, solved: Plans, size: float
) -> None:
    few, b = problems[np.arange(3)], problems.boundary[:3]
    huge = replace(
        b,
        start_q=b.start_q * [[size], [1], [1]],
        goal_dq=b.goal_dq * [[1], [1], [size]],
    )
    with pytest.warns(
        RuntimeWarning,
        match="start_xyz of 1 plan is not where start_q puts the tip .the first is plan 0",
    ):
        found = refine_plans(replace(few, boundary=huge), workers=1)
    assert found.valid.tolist() == [False, True, False]
    assert same(found.plans[np.array([1])], solved[np.array([1])])


def test_boundary_conditions_that_violate_a_limit_get_one_attempt_and_the_reason(
    problems: Plans,
) -> None:
    few, b = problems[np.arange(2)], problems.boundary[:2]
    _, robot = open_problem(problems.problem)
    faster = b.goal_dq * (
        1.02 / np.max(np.abs(b.goal_dq) / robot.velocity_limit, axis=1, keepdims=True)
    )
    found = refine_plans(replace(few, boundary=replace(b, goal_dq=faster)), workers=1)
    assert [result.outcome for result in found.results] == [Outcome.UNSOLVED] * 2
    assert {result.reason for result in found.results} == {"joint velocity limit"}
    # of the coarse level alone
    one_level = RefineOptions().max_iterations
    assert max(result.iterations for result in found.results) <= one_level
    for verdict in evaluate_plans(found.plans).verdicts:
        velocity = verdict.margins["joint velocity"]
        unavoidable = 0.02 * abs(velocity.bound)  # at the goal
        assert velocity.violation >= unavoidable * (1 - 1e-6)


def test_two_threads_give_the_same_plans_as_one() -> None:
    transports = [
        draw_boundary_problems("heavy-object", 2, seed=seed) for seed in (3, 4)
    ]
    serial = [refine_plans(problems, workers=1).plans for problems in transports]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(2):
            parallel = list(
                pool.map(
                    lambda problems: refine_plans(problems, workers=1).plans, transports
                )
            )
            assert all(
                same(one, other) for one, other in zip(parallel, serial, strict=True)
            )


def test_an_input_plan_far_out_of_bounds_is_not_used(
    problems: Plans, solved: Plans
) -> None:
    few = solved[:3]
    far = refine_plans(
        replace(few, path_control_points=few.path_control_points + 10), workers=1
    )
    assert same(far.plans, few)


def test_input_plans_that_take_days_are_not_used(
    problems: Plans, solved: Plans
) -> None:
    some = slice(0, 3)
    few = solved[some]
    days = refine_plans(
        replace(few, rate_control_points=1e-6 * few.rate_control_points), workers=1
    )
    assert days.input_plans.duration.min() > 86_400
    assert same(days.plans, few)


def test_an_interrupted_run_resumes(
    problems: Plans, solved: Plans, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(_plans: int, _valid: int) -> None:
        raise KeyboardInterrupt

    journal, begun = tmp_path / "journal", []
    with pytest.raises(KeyboardInterrupt):
        refine_plans(problems, workers=1, journal=journal, progress=stop)
    found = refine_plans(
        problems,
        workers=1,
        journal=journal,
        begin=lambda *numbers: begun.append(numbers),
    )
    assert begun == [(N, 1)]
    assert same(found.plans, solved)
    with is_refused(UsageError, argument="discard"):
        refine_plans(
            problems, workers=1, journal=journal, options=RefineOptions(tolerance=2e-3)
        )
    with is_refused(UsageError, argument="discard"):
        refine_plans(
            solved, workers=1, journal=journal, options=RefineOptions(weight=2.0)
        )
    with monkeypatch.context() as patch:
        patch.setattr("cnpgen.refine.refine_plans.__version__", "99.0")
        with pytest.raises(UsageError, match=r"differs in version .*, now '99.0'"):
            refine_plans(problems, workers=1, journal=journal)


def test_without_iterations_a_plan_is_only_scaled_in_time(solved: Plans) -> None:
    assert refine_plans(solved, options=RefineOptions(max_iterations=0)).valid.all()
    task = draw_boundary_problems("heavy-object", 1)
    plan = refine_plans(task).plans
    for factor in (1.05, 2.0):
        fast = replace(plan, rate_control_points=factor * plan.rate_control_points)
        found = refine_plans(fast, options=RefineOptions(max_iterations=0))
        assert [result.outcome for result in found.results] == [Outcome.TIME_SCALED]
        np.testing.assert_allclose(
            found.plans.path_control_points, fast.path_control_points, atol=1e-12
        )
        assert plan.duration[0] <= found.plans.duration[0] < 1.02 * plan.duration[0]
    (line,) = refine_plans(task, options=RefineOptions(max_iterations=0)).results
    assert (line.valid, line.iterations) == (False, 0)


@pytest.mark.slow
def test_a_plan_whose_objective_still_decreased_at_the_iteration_limit_is_not_converged(
    problems: Plans,
) -> None:
    few = problems[:4]
    found = refine_plans(
        few, options=RefineOptions(objective="jerk", max_iterations=25), workers=1
    )
    converged = refine_plans(
        found.plans,
        options=RefineOptions(objective="jerk", max_iterations=400),
        workers=1,
    )
    by_outcome = {
        outcome: [i for i in range(4) if found.results[i].outcome is outcome]
        for outcome in Outcome
    }
    assert by_outcome[Outcome.NOT_CONVERGED]
    for i in by_outcome[Outcome.NOT_CONVERGED]:
        assert found.results[i].valid
        assert converged.results[i].cost < found.results[i].cost
    assert {result.outcome for result in converged.results} <= {
        Outcome.SOLVED,
        Outcome.SOLVED_FINE,
    }


def test_a_valid_plan_with_a_negative_rate_control_point_is_not_worse_afterwards(
    tmp_path: Path,
) -> None:
    plan = refine_plans(draw_boundary_problems("heavy-object", 1, seed=5)).plans
    rate = 0.6 * plan.rate_control_points
    rate[0, 4] = -0.005
    negative = replace(plan, rate_control_points=rate)
    assert evaluate_plans(negative).valid.all()
    for options in (RefineOptions(max_iterations=0), RefineOptions()):
        found = refine_plans(negative, options=options)
        assert found.valid.all()
        assert found.plans.duration[0] <= negative.duration[0] + 1e-9


@pytest.mark.parametrize("objective", some(["jerk", "effort"], 1, "slow"))
def test_another_objective_reduces_its_metric(
    problems: Plans, solved: Plans, objective: str
) -> None:
    few = np.arange(4)
    found = refine_plans(
        problems[few], options=RefineOptions(objective=objective, weight=1.0)
    ).plans
    before, after = (evaluate_plans(plans).verdicts for plans in (solved[few], found))
    assert all(verdict.valid for verdict in after)
    assert np.mean([getattr(v.metrics, objective) for v in after]) < np.mean(
        [getattr(v.metrics, objective) for v in before]
    )


def test_drawn_problems_depend_on_the_seed_and_are_in_no_split(tmp_path: Path) -> None:
    some, more = (
        draw_boundary_problems("airhockey-hit", 5, seed=3),
        draw_boundary_problems("airhockey-hit", 9, seed=3),
    )
    np.testing.assert_array_equal(more.boundary.start_q[:5], some.boundary.start_q)
    made = make_dataset("airhockey-hit", tmp_path / "hits", n=40, seed=3, workers=1)
    train = load_boundary_problems(made.folder, split="train")
    assert not np.isin(some.boundary.start_q[:, 0], train.boundary.start_q[:, 0]).any()
    rows = load_boundary_problems(made.folder, split="validation", start=1, n=2)
    assert rows.sample_id.tolist() == [1, 2]
    with is_refused(UsageError, argument="split"):
        load_boundary_problems(made.folder, split="trian")
    with is_refused(UsageError, argument="n"):
        load_boundary_problems(made.folder, split="validation", n=1000)
    with is_refused(UsageError, argument="n"):
        draw_boundary_problems("airhockey-hit", 0)
    with is_refused(UsageError, argument="n"):
        draw_boundary_problems("airhockey-replan", 2.5)  # type: ignore[arg-type]
    with is_refused(UsageError, argument="seed"):
        draw_boundary_problems("airhockey-replan", 1, seed=-1)
    with is_refused(UsageError, argument="start"):
        load_boundary_problems(made.folder, start=1.0)  # type: ignore[arg-type]


def test_plans_of_a_folder_are_named_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_dataset(
        "airhockey-hit", tmp_path / "hits-0.1.0", n=20, workers=1
    ).folder
    for place, source in ((tmp_path, "hits-0.1.0"), (folder, ".")):
        monkeypatch.chdir(place)
        assert main(["solve", source, "--split", "train", "--n", "1", "--quiet"]) == 0
        assert capsys.readouterr().out.strip() == "hits-0.1.0-plans.h5"


def test_ctrl_c_during_explanations_keeps_finished_plans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    problem, out = draw_boundary_problems("airhockey-hit", 1), tmp_path / "out.h5"
    fast = replace(problem.boundary, goal_dq=5.0 * problem.boundary.goal_dq)
    save_plans(tmp_path / "hard.h5", replace(problem, boundary=fast))
    command = ["refine", str(tmp_path / "hard.h5"), "-o", str(out), "--explain"]
    with monkeypatch.context() as patch:
        patch.setattr("cnpgen.refine.proof.explain.explain_failure", stop)
        assert main(command) == 130
    assert "run the same command again" in capsys.readouterr().err
    assert [path.name for path in sorted(tmp_path.iterdir())] == [
        "hard.h5",
        "out.h5.part",
    ]
    assert main(command) == 1
    checked, begun, explaining, *summary = capsys.readouterr().err.splitlines()
    assert checked.endswith("hard.h5: the file's checksum is right")
    assert begun.endswith("1 plan, 1 exist already")
    assert explaining == "explaining: 1 plan"
    assert "infeasible" in " ".join(summary)
    assert [path.name for path in sorted(tmp_path.iterdir())] == [
        ".out.h5.request",
        "hard.h5",
        "out.h5",
    ]


def test_solve_and_refine_write_files_that_are_valid_by_evaluate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plans.h5"
    assert (
        main(
            ["solve", "airhockey-hit", "--n", "3", "--out", str(out), "--workers", "1"]
        )
        == 0
    )
    captured = capsys.readouterr()
    assert captured.out.strip() == str(out)
    assert re.search(
        r"3 plans valid in [\d.]+ s \([\d.]+ s preparing and compiling, [\d.]+ s computing, [\d.]+ s waiting\);",
        captured.err,
    )
    assert main(["refine", str(out), "--json", "--quiet"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["seconds"]["computing"] > 0
    assert (
        summary["plans"],
        summary["valid"],
        summary["not_valid"],
        summary["checksum"],
    ) == (3, 3, [], "right")
    assert main(["evaluate", summary["file"]]) == 0
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == [
        "plans-refined.h5",
        "plans.h5",
    ]
    capsys.readouterr()
    assert main(["refine", str(remove_checksum(out)), "--json", "--force"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["checksum"] == "none"
    assert f"{out}: the file has no checksum\n" in captured.err


def test_no_file_is_replaced_without_force(
    problems: Plans, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "plans.h5"
    save_plans(file, problems[:1])
    before = file.read_bytes()
    assert main(["refine", str(file), "-o", str(file)]) == 2
    assert "plans.h5 exists: --force replaces it" in capsys.readouterr().err
    assert file.read_bytes() == before
    assert main(["refine", str(file), "-o", str(file), "--force"]) == 0
    assert load_plans(file).status.tolist() == [PlanStatus.VALID]


def test_invalid_plans_are_listed_and_the_exit_code_is_1(
    problems: Plans, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    boundary = replace(problems.boundary, goal_dq=problems.boundary.goal_dq.copy())
    boundary.goal_dq[1] = 9.0
    save_plans(tmp_path / "hard.h5", replace(problems, boundary=boundary)[:2])
    assert (
        main(["refine", str(tmp_path / "hard.h5"), "-o", str(tmp_path / "out.h5")]) == 1
    )
    text = capsys.readouterr().err
    assert "1 of 2 plans valid" in text
    assert (
        "plan 1 (sample 1): boundary" in text
        or "plan 1 (sample 1): joint velocity limit" in text
    )
    assert load_plans(tmp_path / "out.h5").status.tolist() == [
        PlanStatus.VALID,
        PlanStatus.INVALID,
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["solve", "airhockey-hit"], "--n is required"),
        (
            ["solve", "airhockey-hit", "--n", "2", "--split", "train"],
            "--split needs the folder",
        ),
        (["solve", "airhokey-hit", "--n", "2"], "did you mean 'airhockey-hit'"),
        (["refine", "nowhere.h5"], "nowhere.h5"),
        (
            ["solve", "airhockey-hit", "--n", "2", "-o", "."],
            "must be a file that ends in .h5, in a folder that exists",
        ),
        (
            ["solve", "airhockey-hit", "--n", "2", "-o", "no/where.h5"],
            "must be a file that ends in .h5, in a folder that exists",
        ),
        (
            ["solve", "airhockey-hit", "--n", "2", "--tolerance", "2"],
            "--tolerance must be above 0 and below 1",
        ),
        (
            ["solve", "airhockey-hit", "--n", "2", "--weight", "-1"],
            "--weight must not be negative",
        ),
    ],
)
def test_invalid_arguments_are_reported_in_one_line_without_leaving_files(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    lines = [
        line
        for line in capsys.readouterr().err.splitlines()
        if line.startswith("cnpgen: error")
    ]
    assert len(lines) == 1
    assert message in lines[0]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
@pytest.mark.parametrize("number", some([signal.SIGKILL, signal.SIGTERM]))
def test_a_killed_solve_keeps_finished_plans(
    number: int, hits: Plans, tmp_path: Path
) -> None:
    out = tmp_path / "plans.h5"
    words = [
        sys.executable,
        "-m",
        "cnpgen",
        "solve",
        "airhockey-hit",
        "--n",
        str(HITS),
        "-o",
        str(out),
        "--workers",
        "2",
    ]
    process = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"TERM": "dumb"},
    )
    journal = out.with_name("plans.h5.part")
    while (
        not (journal.exists() and journal.stat().st_size > SOME_PLANS_BYTES)
        and process.poll() is None
    ):
        time.sleep(0.02)
    process.send_signal(number)
    process.communicate(timeout=HANGING)
    assert not out.exists()
    assert journal.stat().st_size > SOME_PLANS_BYTES
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "exist already" in done.stderr
    assert same(load_plans(out), hits)
    assert not journal.exists()


@pytest.mark.parametrize(
    "options", [{"tolerance": 1e-4}, {"deadline": 0.1}, {"stay_within": 0.1}]
)
def test_options_of_iterations_are_refused_without_iterations(
    options: dict[str, float],
) -> None:
    (name,) = options
    with pytest.raises(UsageError, match=f"{name} has no effect with 0 iterations"):
        RefineOptions(max_iterations=0, **options)
