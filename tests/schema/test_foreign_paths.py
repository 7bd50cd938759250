"""Paths of PYTHONPATH and LD_LIBRARY_PATH with other builds of libraries, and the messages that name them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.schema.foreign_paths import (
    REMEDY,
    foreign_path_hint,
    import_errors_with_hint,
)
from tests.refusals import is_refused


@pytest.fixture
def ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set both variables to a folder like that of a ROS distribution, after one with other modules only."""
    (tmp_path / "ros" / "pinocchio").mkdir(parents=True)
    (tmp_path / "other" / "rclpy").mkdir(parents=True)
    (tmp_path / "other" / "rclpy" / "__init__.py").touch()
    text = "raise ImportError('libboost_python312.so: cannot open it')"
    (tmp_path / "ros" / "pinocchio" / "__init__.py").write_text(text)
    (tmp_path / "ros" / "libcoal.so.3").touch()
    paths = f"{tmp_path / 'other'}{os.pathsep}{tmp_path / 'ros'}"
    for variable in ("PYTHONPATH", "LD_LIBRARY_PATH"):
        monkeypatch.setenv(variable, paths)
    return tmp_path / "ros"


def test_only_paths_with_libraries_of_cnpgen_are_named(ros: Path) -> None:
    assert foreign_path_hint() == (
        f"PYTHONPATH names {ros}, which has pinocchio;"
        f" LD_LIBRARY_PATH names {ros}, which has coal: {REMEDY}"
    )


def test_there_is_no_hint_without_foreign_paths(
    ros: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ros.parent / "other"))
    monkeypatch.delenv("LD_LIBRARY_PATH")
    assert foreign_path_hint() == ""
    with is_refused(ImportError), import_errors_with_hint():
        raise ImportError("broken")


def test_an_import_error_of_a_public_name_has_the_hint_once(ros: Path) -> None:
    with (
        pytest.raises(ImportError, match=f"^broken; PYTHONPATH names {ros}") as caught,
        import_errors_with_hint(),
        import_errors_with_hint(),
    ):
        raise ImportError("broken")
    assert str(caught.value).count(REMEDY) == 1


def test_commands_name_the_path_and_the_remedy(ros: Path, tmp_path: Path) -> None:
    command = "solve airhockey-hit --n 1 -o out.h5", "doctor"
    for words in command:
        done = subprocess.run(
            [sys.executable, "-m", "cnpgen", *words.split()],
            capture_output=True,
            text=True,
            check=False,
            cwd=tmp_path,
        )
        assert done.returncode == 3, done.stderr
        assert f"PYTHONPATH names {ros}, which has pinocchio" in done.stderr
        assert REMEDY in done.stderr
        assert "Traceback" not in done.stderr
