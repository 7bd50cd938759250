"""Errors name arguments as Python does in Python, and as options on the command line."""

import pickle
from pathlib import Path

import h5py
import pytest

from cnpgen.cli.main import main, shell_spelling
from cnpgen.errors import CnpgenError, DatasetError, RecipeError, UsageError
from cnpgen.training.train import check_beside
from tests.refusals import assert_said, is_refused

OPTIONS = ("force", "workers", "learning_rate", "other_rows", "out", "problem")


@pytest.mark.parametrize(
    ("error", "python", "shell"),
    [
        (
            UsageError("{force} replaces it", remedies={"force": True}),
            "force=True replaces it",
            "--force replaces it",
        ),
        (
            UsageError(
                "choose another {out}, or replace it with {force}",
                remedies={"out": None, "force": True},
            ),
            "choose another out=, or replace it with force=True",
            "choose another --out, or replace it with --force",
        ),
        (
            UsageError(
                "try a smaller {learning_rate}", remedies={"learning_rate": None}
            ),
            "try a smaller learning_rate=",
            "try a smaller --learning-rate",
        ),
        (
            UsageError("run with {workers}", remedies={"workers": 2}),
            "run with workers=2",
            "run with --workers 2",
        ),
        (
            UsageError("{discard} does", remedies={"discard": True}),
            "discard=True does",
            "--force does",
        ),
        (
            UsageError("{other} plans", remedies={"other": True}),
            "other=True plans",
            "--other-rows plans",
        ),
        (
            DatasetError(
                "{allow_incomplete} does without", remedies={"allow_incomplete": True}
            ),
            "allow_incomplete=True does without",
            "allow_incomplete=True does without",  # this command has no such option
        ),
        (
            UsageError("must be an integer, got 'a'", argument="workers"),
            "workers must be an integer, got 'a'",
            "--workers must be an integer, got 'a'",
        ),
        (
            UsageError("/runs/workers=3 exists: {x}"),
            "/runs/workers=3 exists: {x}",
            "/runs/workers=3 exists: {x}",
        ),
    ],
)
def test_arguments_of_a_message_become_options_of_the_command(
    error: CnpgenError, python: str, shell: str
) -> None:
    assert str(error) == python
    assert error.text(shell_spelling(OPTIONS)) == shell


@pytest.mark.parametrize(
    "error",
    [
        UsageError("needs {force}", argument="out", remedies={"force": True}),
        RecipeError(["a: b", "c: d"]),
        UsageError(),
    ],
)
def test_errors_keep_their_argument_and_remedies_when_pickled(
    error: CnpgenError,
) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert (type(copy), str(copy), copy.argument, copy.remedies) == (
        type(error),
        str(error),
        error.argument,
        error.remedies,
    )


def test_python_and_the_command_line_name_the_same_arguments(
    tmp_path: Path, tiny: object, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model.h5"
    out.with_suffix(".jsonl").write_text("mine")
    with is_refused(UsageError, argument="out"):
        check_beside(out)
    assert (
        main(["train", str(tiny("airhockey-hit")), "-o", str(out), "--steps", "1"]) == 2
    )  # type: ignore[operator]
    assert (
        "choose another --out, or replace it with --force\n" in capsys.readouterr().err
    )


def test_the_command_line_names_its_option_for_a_file_without_a_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in (
            "start_q",
            "start_dq",
            "start_ddq",
            "goal_q",
            "goal_dq",
            "path_control_points",
        ):
            file[name] = [[0.0]]
        file["rate_control_points"] = [[1.0]]
    assert main(["evaluate", str(tmp_path / "a.h5")]) == 2
    assert_said(capsys.readouterr().err)
