"""Errors name arguments as Python does where Python raised them, and options where a shell asked."""

from pathlib import Path

import h5py
import pytest

from cnpgen.cli.main import main
from cnpgen.cli.shell import in_shell
from cnpgen.errors import UsageError
from cnpgen.training.files import check_beside

OPTIONS = ("force", "workers", "learning_rate", "other_rows", "out", "problem")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("force=True replaces it", "--force replaces it"),
        ("choose another out=, or replace it with force=True", "choose another --out, or replace it with --force"),
        ("try a smaller learning_rate=", "try a smaller --learning-rate"),
        ("run with workers=2", "run with --workers 2"),
        ("discard=True throws them away", "--force throws them away"),
        ("other=True plans for them (out=)", "--other-rows plans for them (--out)"),
        ("allow_incomplete=True does without", "allow_incomplete=True does without"),  # this command has no such option
        ("DatasetRecipe(problem='x', out=[1])", "DatasetRecipe(problem='x', out=[1])"),
        ("OMP_workers=3, problem=a.toml", "OMP_workers=3, problem=a.toml"),
        ("/data/workers=3 and runs/workers=3/set are there", "/data/workers=3 and runs/workers=3/set are there"),
    ],
)
def test_arguments_that_the_command_has_are_told_as_options(text: str, said: str) -> None:
    assert in_shell(text, OPTIONS) == said


def test_what_was_typed_is_repeated_as_it_was() -> None:
    text = "workers=3 is not empty: choose another out="
    assert in_shell(text, OPTIONS, ["-o", "workers=3"]) == "workers=3 is not empty: choose another --out"


def test_python_and_the_shell_are_told_the_same_in_their_own_words(
    tmp_path: Path, tiny: object, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model.h5"
    out.with_suffix(".jsonl").write_text("mine")
    with pytest.raises(UsageError, match=r"no training log: out= names another model, force=True replaces it$"):
        check_beside(out)
    assert main(["train", str(tiny("airhockey-hit")), "-o", str(out), "--steps", "1"]) == 2  # type: ignore[operator]
    assert "no training log: --out names another model, --force replaces it\n" in capsys.readouterr().err


def test_the_shell_is_told_its_option_for_a_file_without_a_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "path_control_points"):
            file[name] = [[0.0]]
        file["rate_control_points"] = [[1.0]]
    assert main(["evaluate", str(tmp_path / "a.h5")]) == 1
    assert "does not say its problem: set its attribute 'problem' to a name or a file, or pass --problem" in (
        capsys.readouterr().err
    )
