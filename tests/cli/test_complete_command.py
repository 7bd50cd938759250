"""``cnpgen complete``: a table in, a file of problems out that other commands take; reasons, exit codes."""

import json

import numpy as np

from cnpgen.cli.main import main
from cnpgen.plans.plan_file import load_plans
from tests.refusals import assert_said

TABLE = "goal_xyz.x,goal_xyz.y,hit_angle\n1.0,0.1,0.0\n3.0,0.0,0.1\n1.1,-0.2,0.2\n"


def test_a_table_becomes_problems_that_solve_refine_and_plan_take(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pucks.csv").write_text(TABLE, encoding="utf-8")
    assert main(["complete", "airhockey-replan", "pucks.csv", "-o", "problems.h5"]) == 0
    out, err = capsys.readouterr()
    assert out == "problems.h5\n"
    assert "2 of 3 tasks completed" in err
    assert "1 no hitting configuration: task 1" in err
    for command in (["solve"], ["refine"], ["plan", "--model", "airhockey-replan"]):
        assert main([*command, "problems.h5", "-o", f"{command[0]}.h5", "--quiet"]) == 0
        np.testing.assert_array_equal(load_plans(f"{command[0]}.h5").sample_id, [0, 2])


def test_what_is_there_is_replaced_only_with_force(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pucks.csv").write_text(TABLE, encoding="utf-8")
    (tmp_path / "problems.h5").write_bytes(b"")
    command = [
        "complete",
        "airhockey-replan",
        "pucks.csv",
        "-o",
        "problems.h5",
        "--json",
    ]
    assert main(command) == 2
    assert_said(capsys.readouterr().err)
    assert main([*command, "--force"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["without_answer"] == [
        {"task": 1, "reason": "no hitting configuration"}
    ]
    assert (facts["file"], facts["tasks"], facts["completed"]) == ("problems.h5", 3, 2)


def test_the_exit_code_says_that_no_task_has_an_answer_or_what_is_wrong(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "far.csv").write_text("goal_xyz.x,goal_xyz.y\n3,0\n", encoding="utf-8")
    (tmp_path / "wrong.csv").write_text(
        "goal_xyz.x,goal_xyz.y,hit_angel\n1,0,0\n", encoding="utf-8"
    )
    assert main(["complete", "airhockey-replan", "far.csv", "-o", "problems.h5"]) == 1
    assert not (tmp_path / "problems.h5").exists()
    assert main(["complete", "airhockey-replan", "wrong.csv", "-o", "problems.h5"]) == 1
    assert "did you mean 'hit_angle'?" in capsys.readouterr().err
    assert (
        main(["complete", "airhockey-replan", "nothing.csv", "-o", "problems.h5"]) == 2
    )
    assert (
        main(["complete", "airhockey", "far.csv", "-o", "problems.h5"]) == 1
    )  # a problem takes poses of the tip
    assert "far.csv lacks goal_xyz.z" in capsys.readouterr().err
