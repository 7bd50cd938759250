"""``cnpgen train`` and ``cnpgen plan``: what they write, print and refuse."""

import json
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import load_model
from cnpgen.plans import load_plans
from cnpgen.plans.format import PlanStatus
from tests.conftest import HANGING, columns_of, some

SMALL = [
    "--steps",
    "40",
    "--hidden",
    "16",
    "--layers",
    "2",
    "--batch-size",
    "32",
    "--check",
    "2",
    "--workers",
    "1",
]


@pytest.fixture(scope="module")
def trained(tiny, tmp_path_factory) -> Path:
    """A small model of the hits, made by the command."""
    path = tmp_path_factory.mktemp("trained") / "hits.h5"
    assert (
        main(["train", str(tiny("airhockey-hit")), "-o", str(path), *SMALL, "--quiet"])
        == 0
    )
    return path


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """Learning curves are not drawn: that takes longer than so short a training."""
    monkeypatch.setattr("cnpgen.training.log.plot_curve", lambda *_: None)


def failing(capsys, words: list[str]) -> tuple[int, str]:
    code = main(words)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err
    return code, captured.err


def test_train_writes_a_model_its_log_and_a_picture_and_prints_the_path(
    tiny, tmp_path, capsys
):
    path = tmp_path / "hits.h5"
    assert main(["train", str(tiny("airhockey-hit")), "-o", str(path), *SMALL]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{path}\n"
    said = " ".join(captured.err.split())
    for word in (
        "training",
        "valid",
        "terms / budgets x weights: joint-position",
        "learning rate",
        "is kept",
    ):
        assert word in said
    assert max(map(len, captured.err.splitlines())) <= 100
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert len(path.with_suffix(".jsonl").read_text().splitlines()) >= 40
    training = load_model(path).training
    assert training["command"] == (
        "cnpgen train airhockey-hit -o hits.h5 --steps 40 --hidden 16 --layers 2 --batch-size 32 --check 2"
    )
    assert training["score"]["plans"] == 58  # those that models were not compared by
    assert training["dataset"]["rows"] == {"train": 600, "validation": 60}


@pytest.mark.slow
def test_a_run_that_was_killed_before_its_picture_was_drawn_draws_it_when_it_is_started_again(
    tiny, tmp_path, capsys, monkeypatch
):
    path, command = (
        tmp_path / "hits.h5",
        ["train", str(tiny("airhockey-hit")), "-o", str(tmp_path / "hits.h5"), *SMALL],
    )
    with monkeypatch.context() as patch:
        patch.setattr(
            "cnpgen.cli.train_command._draw",
            lambda _: (_ for _ in ()).throw(KeyboardInterrupt),
        )
        assert main(command) == 130
    before = path.read_bytes()
    assert not path.with_suffix(".png").exists()
    assert main(command) == 0
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert path.read_bytes() == before


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("often", some([0, 100], 0, "slow"))
def test_rows_that_are_seen_too_often_are_spoken_of(
    tiny, tmp_path, capsys, monkeypatch, often
):
    monkeypatch.setattr("cnpgen.cli.train_command.OFTEN", often)
    assert (
        main(
            ["train", str(tiny("airhockey-hit")), "-o", str(tmp_path / "m.h5"), *SMALL]
        )
        == 0
    )
    assert ("a planner from more rows is better" in capsys.readouterr().err) == (
        often == 0
    )


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_batches_of_more_rows_than_there_are_are_spoken_of(tiny, tmp_path, capsys):
    words = ["train", str(tiny("airhockey-hit")), "-o", str(tmp_path / "m.h5")]
    few = ["2" if word == "40" else word for word in SMALL]  # steps
    large = ["5000" if word == "32" else word for word in few]  # rows of a batch
    said = re.compile(
        r"every step takes all ([\d,]+) rows: there are no 5,000 for a batch"
    )
    assert main([*words, *large]) == 0
    found = said.search(capsys.readouterr().err)
    assert found
    assert int(found[1]) == len(columns_of(tiny("airhockey-hit"), "train")["start_q"])
    assert main([*words, *few, "--force"]) == 0
    assert "every step takes all" not in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_checkpoint_of_another_run_is_a_wrong_argument(
    tiny, tmp_path, capsys, monkeypatch
):
    words = ["train", str(tiny("airhockey-hit")), "-o", str(tmp_path / "m.h5"), *SMALL]
    with monkeypatch.context() as patch:
        patch.setattr(
            "cnpgen.training.checkpoint.Checkpoints.remove", lambda self: None
        )
        assert main(words) == 0
    capsys.readouterr()
    code, text = failing(capsys, [*words, "--seed", "3"])
    assert code == 2
    assert "is of another run, it differs in settings.seed (0, now 3)" in text


@pytest.mark.slow
def test_a_finished_model_is_not_trained_again(trained, tiny, capsys):
    words, before = (
        ["train", str(tiny("airhockey-hit")), "-o", str(trained)],
        trained.read_bytes(),
    )
    assert main([*words, *SMALL]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{trained}\n"
    assert "already trained: 40 steps" in captured.err
    code, text = failing(capsys, [*words, *SMALL, "--seed", "3"])
    assert code == 2
    assert "is another model, it differs in settings.seed (0, now 3)" in text
    assert trained.read_bytes() == before


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_how_a_model_is_trained_is_said_by_options_and_kept_in_it(tiny, tmp_path):
    path = tmp_path / "m.h5"
    chosen = [
        "--growth",
        "3",
        "--learning-rate",
        "2e-3",
        "--seed",
        "7",
        "--metric",
        "bounded",
        "--quiet",
    ]
    chosen += [
        "--margin",
        "joint-velocity=0.97",
        "--margin",
        "table=1",
        "--expected-time",
        "reach",
        "--rate-bias",
        "-0.1",
        "--time-parametrized",
        "--within-limits",
    ]
    assert (
        main(["train", str(tiny("airhockey-hit")), "-o", str(path), *SMALL, *chosen])
        == 0
    )
    settings = load_model(path).training["settings"]
    assert (settings["learning_rate"], settings["seed"]) == (2e-3, 7)
    assert (settings["metric"]["kind"], settings["metric"]["growth"]) == (
        "learned",
        3.0,
    )
    assert (settings["margins"], settings["rate_bias"]) == (
        {"joint-velocity": 0.97, "table": 1.0},
        -0.1,
    )
    config = load_model(path).config
    assert (config.expected_time, config.time_parametrized, config.within_limits) == (
        "reach",
        True,
        True,
    )
    options = (
        "--rate-bias -0.1 --expected-time reach --within-limits --time-parametrized --batch-size 32"
        " --learning-rate 0.002 --seed 7 --metric bounded --growth 3.0 --margin joint-velocity=0.97 --margin table=1"
    )
    assert f"{options} --check 2" in load_model(path).training["command"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "what"),
    [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")],
)
def test_an_interrupted_training_says_that_the_same_command_goes_on(
    tiny, tmp_path, number, code, what
):
    words = [
        "train",
        str(tiny("airhockey-hit")),
        "-o",
        str(tmp_path / "m.h5"),
        *SMALL[2:],
        "--steps",
        "1e5",
        "--quiet",
    ]
    command = [sys.executable, "-m", "cnpgen", *words]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        log = tmp_path / "m.jsonl"
        while not (log.exists() and log.read_text()) and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(getattr(signal, number))
        out, err = process.communicate(timeout=HANGING)
    kept = f"{tmp_path / 'm.checkpoint'} keeps the run, run the same command again to go on"
    assert (process.returncode, out, err) == (code, "", f"cnpgen: {what}: {kept}\n")
    assert (tmp_path / "m.checkpoint").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_command_in_a_model_is_the_one_that_was_given(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tiny("airhockey-hit"))
    path = tmp_path / "my model.h5"
    assert (
        main(
            [
                "train",
                ".",
                "-o",
                str(path),
                *SMALL,
                "--learning-rate",
                "0.00123456789",
                "--quiet",
            ]
        )
        == 0
    )
    command = load_model(path).training["command"]
    assert command.startswith("cnpgen train airhockey-hit -o 'my model.h5' --steps 40")
    assert "--learning-rate 0.00123456789 " in command
    again = [
        "--steps",
        "2",
        "--hidden",
        "16",
        "--layers",
        "2",
        "--check",
        "2",
        "--from",
        str(path),
        "--quiet",
    ]
    assert main(["train", ".", "-o", str(tmp_path / "next.h5"), *again]) == 0
    command = load_model(tmp_path / "next.h5").training["command"]
    assert command.startswith(
        "cnpgen train airhockey-hit -o next.h5 --from 'my model.h5' --steps 2 --hidden 16"
    )


def test_growth_that_changes_nothing_is_refused(tiny, tmp_path, capsys):
    words = [
        "train",
        str(tiny("airhockey-hit")),
        "-o",
        str(tmp_path / "m.h5"),
        "--metric",
        "fixed",
        "--growth",
        "500",
    ]
    code, text = failing(capsys, words)
    assert code == 2
    assert "--growth changes nothing with --metric fixed" in text


@pytest.mark.parametrize(
    "words",
    [
        ["--metric", "paper"],
        ["--learning-rate", "inf"],
        ["--growth", "inf"],
        ["--margin", "joint-velocity"],
        ["--margin", "joint-velocity=1.2"],
        ["--steps", "0"],
        ["--steps", "5", "--epochs", "2"],
        ["--learning-rate", "-1"],
        ["--preset", "article"],
        ["--gamma", "0.1"],
        ["--metric", "fixed", "--budget-factor", "0.1"],
        ["--features", "paper", "--keep", "first"],
        ["--path-control-points", "5"],
    ],
)
def test_train_refuses_what_cannot_be_meant(tiny, tmp_path, capsys, words):
    code, text = failing(
        capsys,
        ["train", str(tiny("airhockey-hit")), "-o", str(tmp_path / "m.h5"), *words],
    )
    assert code == 2
    assert text.count("\n") == 1


def test_plans_of_a_dataset_are_for_its_rows(trained, tiny, tmp_path, capsys):
    out, folder = tmp_path / "plans.h5", tiny("airhockey-hit")
    assert main(["plan", str(folder), "--model", str(trained), "-o", str(out)]) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{out}\n"
    assert "60 plans in" in captured.err
    plans, rows = load_plans(out, problem="airhockey"), columns_of(folder, "validation")
    np.testing.assert_array_equal(plans.boundary.goal_q, rows["goal_q"])
    np.testing.assert_array_equal(plans.sample_id, rows["sample_id"])
    np.testing.assert_array_equal(plans.columns["hit_speed"], rows["hit_speed"])
    assert main(["evaluate", str(out), "--json"]) in {0, 1}
    assert json.loads(capsys.readouterr().out)["plans"] == 60


def test_plans_are_replaced_only_by_force(trained, tiny, tmp_path, capsys):
    out = tmp_path / "plans.h5"
    words = [
        "plan",
        str(tiny("airhockey-hit")),
        "--model",
        str(trained),
        "-o",
        str(out),
        "--n",
        "3",
        "--json",
    ]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["file"], found["plans"]) == (str(out), 3)
    code, text = failing(capsys, [*words, "--first", "1"])
    assert code == 2
    assert "--force replaces it" in text
    assert main(words) == 0  # of the same request
    assert main([*words, "--first", "1", "--force"]) == 0


def test_refined_plans_are_those_of_the_refine_command(trained, tiny, tmp_path, capsys):
    folder, quiet = str(tiny("airhockey-hit")), ["--quiet", "--workers", "1"]
    plan = ["plan", folder, "--model", str(trained), "--n", "4"]
    assert main([*plan, "-o", str(tmp_path / "p.h5"), "--refine", *quiet]) == 0
    assert main([*plan, "-o", str(tmp_path / "raw.h5")]) == 0
    assert (
        main(["refine", str(tmp_path / "raw.h5"), "-o", str(tmp_path / "r.h5"), *quiet])
        == 0
    )
    found, expected = load_plans(tmp_path / "p.h5"), load_plans(tmp_path / "r.h5")
    np.testing.assert_array_equal(
        found.path_control_points, expected.path_control_points
    )
    np.testing.assert_array_equal(
        found.rate_control_points, expected.rate_control_points
    )
    assert (found.status == PlanStatus.VALID).all()
    assert not (tmp_path / "p.h5.part").exists()


def test_refining_goes_on_where_it_was_interrupted(
    trained, tiny, tmp_path, capsys, monkeypatch
):
    words = [
        "plan",
        str(tiny("airhockey-hit")),
        "--model",
        str(trained),
        "-o",
        str(tmp_path / "p.h5"),
        "--n",
        "4",
    ]
    seen = []

    def interrupted(_meter, plans: int) -> None:
        seen.append(plans)
        if len(seen) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("cnpgen.cli.terminal.Meter.__call__", interrupted)
        code, text = failing(capsys, [*words, "--refine", "--workers", "1"])
    assert code == 130
    assert (
        "p.h5.part keeps all finished problems; run the same command again to resume"
        in text
    )
    assert main([*words, "--refine", "--workers", "1"]) == 0
    assert "4 plans, 2 exist already" in capsys.readouterr().err
    assert len(load_plans(tmp_path / "p.h5")) == 4


@pytest.mark.parametrize(
    "words", [["--workers", "2"], ["--objective", "jerk"], ["--tolerance", "1e-4"]]
)
def test_options_of_refining_are_not_ignored_without_it(
    trained, tiny, tmp_path, capsys, words
):
    plan = [
        "plan",
        str(tiny("airhockey-hit")),
        "--model",
        str(trained),
        "-o",
        str(tmp_path / "p.h5"),
        *words,
    ]
    code, text = failing(capsys, plan)
    assert code == 2
    assert f"{words[0]} needs --refine" in text


def test_some_rows_of_another_split_can_be_chosen(trained, tiny, tmp_path):
    out, folder = tmp_path / "plans.h5", tiny("airhockey-hit")
    words = ["plan", str(folder), "--model", str(trained), "-o", str(out), "--quiet"]
    assert main([*words, "--split", "train", "--first", "10", "--n", "5"]) == 0
    np.testing.assert_array_equal(load_plans(out).sample_id, np.arange(10, 15))


def test_a_file_of_boundary_conditions_is_planned_for_and_what_it_lacks_is_at_rest(
    trained, tiny, tmp_path
):
    rows, path, out = (
        columns_of(tiny("airhockey-hit")),
        tmp_path / "problems.h5",
        tmp_path / "plans.h5",
    )
    with h5py.File(path, "w") as file:
        for name in ("start_q", "goal_q", "goal_dq"):
            file[name] = rows[name][:7]
    assert (
        main(["plan", str(path), "--model", str(trained), "-o", str(out), "--quiet"])
        == 0
    )
    found = load_plans(out)
    np.testing.assert_array_equal(found.boundary.goal_dq, rows["goal_dq"][:7])
    np.testing.assert_array_equal(found.boundary.start_dq, 0)
    again = tmp_path / "again.h5"  # a file of plans holds boundary conditions, too
    assert (
        main(["plan", str(out), "--model", str(trained), "-o", str(again), "--quiet"])
        == 0
    )
    np.testing.assert_array_equal(
        load_plans(again).path_control_points, found.path_control_points
    )


def test_a_shard_is_refused_as_its_folder_is_and_planned_for_with_other_rows(
    trained, tiny, tmp_path, capsys
):
    shard, out = (
        tiny("airhockey-replan") / "train" / "shard-00000.h5",
        tmp_path / "p.h5",
    )
    words = ["plan", str(shard), "--model", str(trained), "-o", str(out)]
    code, text = failing(capsys, words)
    assert code == 1
    assert "drawn in another way" in text
    assert (
        "start_dq was zero in every row" in failing(capsys, [*words, "--other-rows"])[1]
    )
    shard = tiny("airhockey-hit") / "train" / "shard-00001.h5"
    assert (
        main(["plan", str(shard), "--model", str(trained), "-o", str(out), "--quiet"])
        == 0
    )
    assert load_plans(out).sample_id[0] == 250


def test_what_a_model_cannot_plan_for_is_refused_before_kernels_are_made(
    trained, tiny, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(
        "cnpgen.planner.planner.Planner.__init__",
        lambda *_, **__: pytest.fail("kernels were made"),
    )
    words = [
        "plan",
        str(tiny("heavy-object")),
        "--model",
        str(trained),
        "-o",
        str(tmp_path / "p.h5"),
    ]
    assert "plans for 'airhockey'" in failing(capsys, words)[1]


@pytest.mark.parametrize("name", ["plans.txt", "plans", "nowhere/plans.h5"])
def test_plans_go_to_a_file_that_ends_as_models_do(
    trained, tiny, tmp_path, capsys, name
):
    words = [
        "plan",
        str(tiny("airhockey-hit")),
        "--model",
        str(trained),
        "-o",
        str(tmp_path / name),
    ]
    code, text = failing(capsys, words)
    assert code == 2
    assert "in a folder that exists" in text


def test_a_dataset_of_another_problem_is_refused_with_what_differs(
    trained, tiny, tmp_path, capsys
):
    words = [
        "plan",
        str(tiny("heavy-object")),
        "--model",
        str(trained),
        "-o",
        str(tmp_path / "p.h5"),
    ]
    code, text = failing(capsys, words)
    assert code == 1
    assert "plans for 'airhockey'" in text
    assert "is of 'heavy-object'" in text
    assert "they differ in" in text
    assert (
        "train a model for it ('cnpgen train'), or plan without a model ('cnpgen solve')"
        in text
    )


def test_rows_that_are_drawn_in_another_way_are_refused_unless_they_are_meant(
    trained, tiny, tmp_path, capsys
):
    folder, out = tiny("airhockey-replan"), tmp_path / "p.h5"
    words = ["plan", str(folder), "--model", str(trained), "-o", str(out)]
    code, text = failing(capsys, words)
    assert code == 1
    assert "drawn in another way" in text
    assert "--other-rows" in text
    code, text = failing(
        capsys, [*words, "--other-rows"]
    )  # they move, and the model was trained at rest
    assert code == 2
    assert "start_dq was zero in every row" in text


def test_a_truncated_model_an_unknown_one_and_a_file_that_is_none_are_one_line_each(
    trained, tiny, tmp_path, capsys
):
    cut = Path(shutil.copy(trained, tmp_path / "cut.h5"))
    cut.write_bytes(cut.read_bytes()[:2000])
    folder, rest = str(tiny("airhockey-hit")), ["-o", str(tmp_path / "p.h5")]
    for model, code, word in (
        (str(cut), 1, "cut off"),
        ("airhockey-hot", 2, "unknown model"),
        ("x.h5", 2, "not there"),
    ):
        found, text = failing(capsys, ["plan", folder, "--model", model, *rest])
        assert (found, text.count("\n")) == (code, 1)
        assert word in text


def test_problems_that_are_not_there_are_a_wrong_argument(trained, tmp_path, capsys):
    words = [
        "plan",
        str(tmp_path / "nowhere"),
        "--model",
        str(trained),
        "-o",
        str(tmp_path / "p.h5"),
    ]
    code, text = failing(capsys, words)
    assert code == 2
    assert "nowhere is neither a folder nor a file, dataset or pipeline" in text


def test_options_of_rows_are_not_taken_for_a_file(trained, tmp_path, capsys):
    (tmp_path / "p.h5").write_bytes(b"")
    words = [
        "plan",
        str(tmp_path / "p.h5"),
        "--model",
        str(trained),
        "-o",
        str(tmp_path / "o.h5"),
        "--split",
        "train",
    ]
    code, text = failing(capsys, words)
    assert code == 2
    assert "--split needs the folder of a dataset, got a file" in text


def test_a_file_without_goals_or_of_another_problem_is_an_error(
    trained, tmp_path, capsys
):
    path = tmp_path / "p.h5"
    words = ["plan", str(path), "--model", str(trained), "-o", str(tmp_path / "o.h5")]
    with h5py.File(path, "w") as file:
        file["start_q"] = np.zeros((2, 6))
    assert "lacks goal_q" in failing(capsys, words)[1]
    with h5py.File(path, "w") as file:
        file["start_q"], file["goal_q"] = np.zeros((2, 7)), np.zeros((2, 7))
    assert "must have shape (6,) or (N, 6)" in failing(capsys, words)[1]
    with h5py.File(path, "w") as file:
        file["start_q"], file["goal_q"] = np.zeros((2, 6)), np.zeros((2, 6))
        file.attrs["problem_sha256"] = "0" * 64
    assert "another problem than the model" in failing(capsys, words)[1]


def test_a_recipe_is_planned_with_the_model_of_its_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["plan", "airhockey-hit", "--n", "6", "--seed", "5"]) == 0
    assert capsys.readouterr().out == "airhockey-hit-plans.h5\n"
    plans, problems = (
        load_plans(tmp_path / "airhockey-hit-plans.h5"),
        draw_boundary_problems("airhockey-hit", 6, seed=5),
    )
    np.testing.assert_array_equal(plans.boundary.goal_dq, problems.boundary.goal_dq)
    assert np.isfinite(plans.duration).all()


def test_a_copied_recipe_is_planned_with_a_named_model(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["copy", "airhockey-hit", "mine"]) == 0
    capsys.readouterr()
    plan = ["plan", "mine/dataset.toml", "--n", "3"]
    assert failing(capsys, plan)[0] == 2
    assert main([*plan, "--model", "airhockey-hit", "--quiet"]) == 0
    assert len(load_plans(tmp_path / "dataset-plans.h5")) == 3
    capsys.readouterr()
    text = (tmp_path / "mine" / "pipeline.toml").read_text()
    (tmp_path / "mine" / "pipeline.toml").write_text(
        text.replace("full_speed = 0.5", "full_speed = 0.7")
    )
    assert (
        "drawn in another way"
        in failing(capsys, [*plan, "--model", "airhockey-hit", "-o", "b.h5"])[1]
    )
    assert (
        main(
            [*plan, "--model", "airhockey-hit", "-o", "b.h5", "--other-rows", "--quiet"]
        )
        == 0
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["airhockey-hit"],
            "--n is required: the number of fresh problems of the recipe airhockey-hit",
        ),
        (
            ["airhockey-hit", "--n", "2", "--split", "train"],
            "--split needs the folder of a dataset",
        ),
        (
            ["airhockey-pucks", "--n", "2"],
            "the following arguments are required: --model",
        ),
        (
            ["heavy-object", "--n", "2", "--model", "airhockey-hit"],
            "the model plans for 'airhockey'",
        ),
        (
            ["somewhere", "-o", "x.h5"],
            "somewhere is neither a folder nor a file, dataset or pipeline",
        ),
    ],
)
def test_recipes_that_cannot_be_planned_are_refused(
    words, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    code, text = failing(capsys, ["plan", *words])
    assert code in {1, 2}
    assert message in text
