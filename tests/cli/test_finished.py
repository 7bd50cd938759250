"""Commands that are repeated, as by a requeued job: the same request ends with 0, another one is refused."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cnpgen.cli.finished import is_finished, record_request, request_file
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans import load_plans
from tests.refusals import is_refused

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: Any, capsys: Any) -> Run:
    """Run a command in a folder; return its exit code and texts."""
    monkeypatch.chdir(tmp_path)

    def call(*words: object) -> tuple[int, str, str]:
        code = main([*map(str, words)])
        text = capsys.readouterr()
        return code, text.out, text.err

    return call


SOLVE = ("solve", "airhockey-hit", "--n", 2, "--seed", 5, "--quiet", "-o", "s.h5")
PLAN = ("plan", "airhockey-hit", "--n", 3, "--seed", 5, "--quiet", "-o", "p.h5")
REFINE = ("refine", "p.h5", "--quiet", "-o", "r.h5", "--max-iterations", 2)
OTHER = {
    "s.h5": ("--tolerance", 1e-2),
    "p.h5": ("--no-time-scaling",),
    "r.h5": ("--tolerance", 1e-2),
}


def test_another_command_does_not_replace_a_finished_result(
    run: Run, tmp_path: Path
) -> None:
    (tmp_path / "p.h5").write_bytes(b"")
    record_request(tmp_path / "p.h5", 1)
    (tmp_path / "t.csv").write_text("t,q\n0,1\n")
    code, _, err = run("import", "t.csv", "--problem", "airhockey", "-o", "p.h5")
    assert code == 2
    assert "p.h5 exists: --force replaces it" in err


@pytest.mark.slow
@pytest.mark.parametrize("words", [SOLVE, PLAN, REFINE], ids=lambda words: words[0])
def test_a_repeated_command_ends_with_0_and_another_request_is_refused(
    run: Run, words: tuple[object, ...]
) -> None:
    if words[0] == "refine":
        run(*PLAN)
    out = str(words[words.index("-o") + 1])
    assert run(*words)[0] in {0, 1}
    before, count = Path(out).read_bytes(), len(load_plans(out))
    assert count in {2, 3}
    code, text, err = run(*words, "--workers", 1) if words[0] != "plan" else run(*words)
    assert (code, text) == (0, f"{out}\n")
    assert err == f"{out} is there already, of the same request\n"
    assert json.loads(run(*words, "--json")[1]) == {"file": out, "already_there": True}
    code, _, err = run(*words, *OTHER[out])
    assert code == 2
    assert "it is of another request, or was changed since" in err
    assert Path(out).read_bytes() == before
    request_file(Path(out)).unlink()
    code, _, err = run(*words)
    assert code == 2
    assert err.endswith(f"{out} exists: --force replaces it, -o names another file\n")
    assert run(*words, "--force")[0] in {0, 1}
    assert run(*words)[0] == 0


def test_a_result_that_was_changed_is_not_finished(tmp_path: Path) -> None:
    out, request = tmp_path / "out.csv", {"rate": 10.0}
    assert not is_finished(out, request, force=False)
    out.write_text("1\n")
    record_request(out, request)
    assert is_finished(out, request, force=False)
    assert not is_finished(out, request, force=True)
    for other in ({"rate": 20.0}, {}):
        with is_refused(UsageError):
            is_finished(out, other, force=False)
    out.write_text("2\n")
    with is_refused(UsageError):
        is_finished(out, request, force=False)
    request_file(out).write_text("[")
    with is_refused(UsageError):
        is_finished(out, request, force=False)


def test_a_folder_is_compared_with_all_its_files(tmp_path: Path) -> None:
    out = tmp_path / "plans"
    (out / "data").mkdir(parents=True)
    (out / "data" / "a").write_text("1")
    record_request(out, 1)
    assert is_finished(out, 1, force=False)
    (out / "data" / "b").write_text("")
    with is_refused(UsageError):
        is_finished(out, 1, force=False)


@pytest.mark.parametrize("kind", ["deep", "pipe", "long"])
def test_a_damaged_request_is_of_no_result(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "p.h5"
    out.write_bytes(b"")
    record_request(out, 1)
    assert is_finished(out, 1, force=False)
    file = request_file(out)
    content = file.read_text()
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.write_text("[" * 4000 if kind == "deep" else content + " " * 5000)
    with is_refused(UsageError):
        is_finished(out, 1, force=False)


def test_a_folder_in_place_of_the_request_is_refused_before_the_work(
    run: Run, tmp_path: Path
) -> None:
    request_file(tmp_path / "s.h5").mkdir()
    for words in (SOLVE, (*SOLVE, "--force")):
        code, _, err = run(*words)
        assert code == 2
        assert ".s.h5.request is a folder" in err
        assert not (tmp_path / "s.h5").exists()
