"""``cnpgen evaluate``: what it prints, what it exits with, and what it says of files that are not plans."""

import json
import random
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.plans import Plans, save_plans
from cnpgen.problems.problem_file import restore_problem
from cnpgen.problems.problem_record import record_problem
from tests.examples.plan_files import garbage, plans_of, remove_checksum
from tests.examples.plans import load, perturbed

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``cnpgen evaluate`` and return (exit code, stdout, stderr)."""

    def call(*words: Any) -> tuple[int, str, str]:
        code = main(["evaluate", *map(str, words)])
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[Plans], Path]:
    def save(plans: Plans) -> Path:
        save_plans(tmp_path / "plans.h5", plans)
        return tmp_path / "plans.h5"

    return save


def one_line(stderr: str) -> str:
    (line,) = stderr.splitlines()
    assert line.startswith("cnpgen: error: ")
    return line


# What is printed


@pytest.mark.parametrize("label", ["hit", "transport"])
def test_a_file_of_valid_plans_is_a_yes(
    run: Run, saved: Callable[[Plans], Path], label: str
) -> None:
    file = saved(plans_of(load(label), load(label)))
    code, out, err = run(file)
    assert (code, err) == (0, "")
    assert re.search(r"^  valid +2 of 2 +100\.00%$", out, re.M)
    assert "2 plans of " in out
    assert "not valid because" not in out


def test_what_is_not_valid_is_counted_by_reason_with_the_worst_place(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    code, out, _ = run(saved(plans_of(*(plan for plan, _ in garbage().values()))))
    assert code == 1
    assert re.search(r"^  valid +3 of 11 +27\.27%$", out, re.M)
    reasons = out.partition("not valid because")[2].split("\n\n")[0]
    assert re.search(r"^  rate not positive +3  plan 2$", reasons, re.M)
    torque = re.search(
        r"^  joint torque limit +1  (.*)\n +(.*at t = .*)", reasons, re.M
    )
    assert torque
    text = r"plan 8: joint torque joint_\d: \S+ N m outside \S+ \(tolerance \S+\) at t = .*"
    assert re.fullmatch(text, f"{torque[1]} {torque[2]}")
    assert (
        sum(
            int(number)
            for number in re.findall(r"^  \S.*?  +(\d+)  plan", reasons, re.M)
        )
        == 8
    )


@pytest.mark.parametrize("limited", [False, True])
def test_the_largest_jerk_is_shown_if_the_problem_limits_jerks(
    run: Run, tmp_path: Path, limited: bool
) -> None:
    plans = plans_of(load("hit"))
    if limited:
        content = plans.problem.content
        content = content | {"constraint": [*content["constraint"], {"use": "joint-jerk", "tolerance": 0.005}]}  # fmt: skip
        plans = replace(plans, problem=record_problem(restore_problem(content, plans.problem.urdf, tmp_path)))  # fmt: skip
    save_plans(tmp_path / "plans.h5", plans)
    _, out, _ = run(tmp_path / "plans.h5", "--list")
    assert ("largest jerk [x limit]" in out) == limited
    assert (" jerk " in out.partition("plan  sample")[2]) == limited


def test_metrics_and_margins_are_those_of_the_verdict(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    plan = load("dragging")
    _, out, _ = run(saved(plans_of(plan)))
    verdict = plan.judged()
    figures = {
        line[:26].strip(): line[26:].split()
        for line in out.splitlines()
        if line.startswith("  ")
    }
    assert figures["motion time [s]"] == [
        "-",
        "-",
        "-",
        "-",
        *2 * [f"{verdict.metrics.duration:.4f}"],
    ]
    assert (
        figures["vertical error [rad s]"][-1] == f"{verdict.metrics.vertical_error:.4f}"
    )
    worst = verdict.margins["object contact"]
    (line,) = [
        line for line in out.splitlines() if line.startswith("  object contact ")
    ]
    assert line.split()[2:] == [
        "1",
        "-",
        f"{worst.violation:.2e}",
        "1.0e-03",
        "m",
        "0",
        f"{worst.time:.4f}",
        worst.part,
    ]
    assert worst.part in {"pedestal-1", "pedestal-2"}
    margin = verdict.margins["joint position"]
    (line,) = [line for line in out.splitlines() if line.startswith("  joint position")]
    assert line.split()[2:5] == ["0", f"{-margin.violation:.2e}", "-"]


def test_plans_are_listed_a_line_each_those_that_are_not_valid_first(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    hit = load("hit")
    plans = plans_of(
        hit,
        perturbed(hit, 0.05),
        hit.changed(rate=-hit.motion.rate),
        hit,
        sample_id=[30, 31, 32, 33],
    )
    _, out, _ = run(saved(plans), "--list")
    head, *lines = out.splitlines()[-5:]
    assert head.split()[:3] == ["plan", "sample", "verdict"]
    assert [line.split()[:2] for line in lines] == [
        ["1", "31"],
        ["2", "32"],
        ["0", "30"],
        ["3", "33"],
    ]
    assert "  rate not positive  " in lines[1]
    assert "  ok  " in lines[2]
    assert "z [mm s]" in head


def test_json_is_complete(run: Run, saved: Callable[[Plans], Path]) -> None:
    plan = load("hit")
    file = saved(plans_of(plan, plan.changed(rate=-plan.motion.rate)))
    code, out, err = run(file, "--json", "--step", "2ms")
    assert (code, err) == (1, "")
    found = json.loads(out)
    assert (found["format"], found["format_version"]) == ("cnpgen-evaluation", 2)
    assert (found["file"], found["problem"], found["step_s"]) == (
        str(file),
        "airhockey",
        0.002,
    )
    assert (found["plans"], found["valid"]) == (2, 1)
    verdict = plan.judged(step=2e-3).to_dict()
    assert found["verdicts"][0] == {"plan": 0, "sample_id": 0, **verdict}
    assert found["verdicts"][1]["reason"] == "rate not positive"
    assert len(out.splitlines()[-4:]) == 4  # one plan is one line


@pytest.mark.parametrize(
    "words",
    [("evaluate",), ("evaluate", "--json"), ("refine",), ("export", "--to", "npz")],
)
def test_a_file_without_plans_is_the_same_error_for_every_command(
    saved: Callable[[Plans], Path],
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
) -> None:
    file = saved(plans_of(load("hit"))[:0])
    assert main([words[0], str(file), *words[1:]]) == 1
    out, err = capsys.readouterr()
    assert (out, one_line(err)) == ("", f"cnpgen: error: no plans in {file}")
    assert [path.name for path in file.parent.iterdir()] == ["plans.h5"]


def test_a_motion_that_is_too_long_is_told_how_long_one_may_take(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    plan = load("transport")
    assert run(saved(plans_of(plan.changed(rate=plan.motion.rate / 180))))[0] == 0
    code, out, _ = run(
        saved(plans_of(plan.changed(rate=plan.motion.rate / 1800))),
        "--list",
        "--step",
        "10ms",
    )
    assert code == 1
    text = "2.41e+03 s are more than 2,000 s"
    assert f"plan 0: {text}" in " ".join(out.split())
    assert out.splitlines()[-1].endswith(text)


def test_numbers_of_garbage_do_not_burst_the_table(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    plan = load("hit")
    path = plan.motion.path.copy()
    path[0, 7] = 1e300
    code, out, err = run(
        saved(plans_of(plan.changed(path=path), perturbed(plan, 1e5))), "--list"
    )
    assert (code, err) == (1, "")
    assert max(map(len, out.splitlines())) < 240


def test_the_goal_is_where_the_joints_put_the_tip_whatever_a_column_says(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    file = saved(plans_of(load("hit"), load("hit")))
    with h5py.File(remove_checksum(file), "a") as content:
        content["goal_xyz"][1] += [0.3, 0.0, 0.0]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code, out, err = run(file)
    said = "goal_xyz of 1 plan is not where goal_q puts the tip (the first is plan 1, 0.3 m off)"
    assert (code, err) == (
        0,
        f"cnpgen: warning: {file}: {said}: the joint positions are used\n",
    )
    assert re.search(r"^  at the goal by the paper's rules +2 of 2 ", out, re.M)


def test_processes_change_not_a_byte(
    run: Run, saved: Callable[[Plans], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cnpgen.plans.evaluate.PLANS_PER_VERDICT_TASK", 4)
    file = saved(plans_of(*(plan for plan, _ in garbage().values())))
    assert run(file, "--json", "--workers", 1) == run(file, "--json", "--workers", 2)


def test_a_finer_step_evaluates_more_times(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    file = saved(plans_of(load("hit")))
    samples = [
        json.loads(run(file, "--json", "--step", step)[1])["verdicts"][0]["samples"]
        for step in ("1e-3", "5e-4")
    ]
    assert samples[1] > 1.5 * samples[0]


def test_a_tracking_error_widens_the_margins_of_positions(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    plan = load("transport")
    file = saved(plans_of(plan))
    code, out, _ = run(file, "--tracking-error", "2deg", "--json")
    (verdict,) = json.loads(out)["verdicts"]
    expected = plan.judged(tracking_error=np.deg2rad(2))
    assert (code, verdict["valid"]) == (1, expected.valid) == (1, False)
    assert json.loads(out)["tracking_error_rad"] == [pytest.approx(np.deg2rad(2))]
    code, out, _ = run(file, "--tracking-error", ",".join(["0"] * 7))
    assert code == 0
    for value, error in (
        ("-1deg", "expected angles"),
        ("2 deg of", "expected angles"),
        ("1deg,1deg", "one per joint"),
    ):
        code, _, err = run(file, f"--tracking-error={value}")
        assert code == 2
        assert error in err


def test_the_problem_that_is_given_decides_and_must_be_the_same(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    file = saved(plans_of(load("hit")))
    assert run(file, "--problem", "airhockey")[0] == 0
    code, out, err = run(file, "--problem", "heavy-object")
    assert (code, out) == (1, "")
    assert (
        "has plans of problem 'airhockey', not of 'heavy-object': they differ in"
        in one_line(err)
    )
    assert "did you mean 'airhockey'" in run(file, "--problem", "airhocky")[2]


# The picture


@pytest.mark.slow
def test_the_first_plan_that_is_not_valid_is_drawn(
    run: Run, saved: Callable[[Plans], Path], tmp_path: Path
) -> None:
    hit = load("hit")
    file = saved(
        plans_of(hit, hit.changed(rate=-hit.motion.rate), perturbed(hit, 0.1), hit)
    )
    code, _, err = run(file, "--plot", tmp_path / "plan.png")
    assert code == 1
    assert f"drawn: plan 2 in {tmp_path / 'plan.png'}" in err
    assert (tmp_path / "plan.png").stat().st_size > 10_000
    _, _, err = run(file, "--plot", tmp_path / "plan.svg", "--plan", 3)
    assert "drawn: plan 3" in err
    assert "sample 3: valid" in re.sub(
        r"<!-- | -->", "", (tmp_path / "plan.svg").read_text()
    )


def test_a_plan_file_may_have_any_suffix(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    file = saved(plans_of(load("hit")))
    code, _, stderr = run(file.rename(file.with_suffix(".plans")))
    assert (code, stderr) == (0, "")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--plan", "0"), "--plan needs --plot"),
        (
            ("--plot", "x.png", "--plan", "1"),
            "has no plan 1: 1 plan, numbered from 0",
        ),
        (("--plot", "x.gif"), "ends in .png, .pdf or .svg"),
        (("--step", "0"), "expected a time above 0, such as 0.001 or 1ms; got '0'"),
        (("--step", "5"), "the time step must be above 0 and at most 0.01 s, got 5 s"),
        (("--step", "1 Hz"), "expected a time above 0"),
        (("--step", "soon"), "expected a time above 0"),
        (("--workers", "0"), "at least 1"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(
    run: Run, saved: Callable[[Plans], Path], words: tuple[str, ...], message: str
) -> None:
    code, out, err = run(saved(plans_of(load("hit"))), *words)
    assert (code, out) == (2, "")
    assert message in one_line(err)


def test_what_cannot_be_drawn_is_told_after_the_verdicts(
    run: Run, saved: Callable[[Plans], Path], tmp_path: Path
) -> None:
    hit = load("hit")
    code, out, err = run(
        saved(plans_of(hit.changed(rate=-hit.motion.rate))),
        "--plot",
        tmp_path / "plan.png",
    )
    assert code == 1
    assert "rate not positive" in out
    assert "none of the plans can be drawn" in one_line(err)


# Files that are none


def test_cut_off_and_foreign_files_are_one_line(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    file = saved(plans_of(load("hit")))
    content = file.read_bytes()
    for name, changed, expected, message in (
        ("cut.h5", content[: len(content) // 2], 1, "cut.h5 is damaged or cut off"),
        ("text.h5", b"hello", 2, "text.h5 is a text file, expected a file of plans"),
        (
            "empty.h5",
            b"",
            1,
            "empty.h5 is not an HDF5 file, or its beginning is damaged: it is empty",
        ),
    ):
        other = file.with_name(name)
        other.write_bytes(changed)
        code, out, err = run(other)
        assert (code, out) == (expected, "")
        assert message in one_line(err)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"goal_dq": None}, "lacks goal_dq"),
        ({"start_q": np.zeros((2, 7))}, "start_q must have shape (1, 6)"),
        (
            {"path_control_points": np.zeros((1, 15, 7))},
            "has 7 joints, but 'airhockey' plans 6",
        ),
        (
            {"rate_control_points": np.zeros((1, 5))},
            "rate_control_points must have shape (1, R) with R > 7",
        ),
        (
            {"rate_control_points": np.array([[b"x"] * 20])},
            "rate_control_points must hold numbers, got |S1",
        ),
    ],
)
def test_fields_of_wrong_shapes_are_one_line(
    run: Run, saved: Callable[[Plans], Path], change: dict[str, Any], message: str
) -> None:
    file = saved(plans_of(load("hit")))
    with h5py.File(remove_checksum(file), "a") as content:
        for name, values in change.items():
            del content[name]
            if values is not None:
                content[name] = values
    code, out, err = run(file)
    assert (code, out) == (1, "")
    assert message in one_line(err)
    assert str(file) in err


def test_whatever_bits_are_damaged_there_is_a_verdict_or_one_line(
    run: Run, saved: Callable[[Plans], Path]
) -> None:
    file = saved(plans_of(load("hit")))
    content, draws = file.read_bytes(), random.Random(3)
    codes = []
    for _ in range(60):
        changed = bytearray(content)
        for _ in range(draws.choice([1, 3, 30])):
            changed[draws.randrange(len(changed))] = draws.randrange(256)
        file.write_bytes(changed)
        code, out, err = run(file)
        assert code in (0, 1)
        assert (out == "") == (err != "")
        assert not err or one_line(err)
        codes.append(code)
    assert {0, 1} <= {*codes}
