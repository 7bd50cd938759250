"""Notices of the library while a command runs: once, on stderr, and not at all if it is to be quiet."""

import logging
from pathlib import Path
from typing import Any, NoReturn

import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans import save_plans
from tests.examples.plan_files import plans_of
from tests.examples.plans import load

CHECKED = "FOLDER/plans.h5: the file's checksum is right"


@pytest.mark.parametrize(
    ("options", "lines"),
    [((), [CHECKED, "cnpgen: building it"]), (("--quiet",), []), (("-q",), [])],
)
def test_what_is_said_for_every_kernel_is_printed_once_per_command(
    options: tuple[str, ...],
    lines: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def refine(*_: Any, **__: Any) -> NoReturn:
        for name in (
            "cnpgen.kernels.code_cache",
            "cnpgen.kernels.code_cache",
            "cnpgen.kernels.c_library",
        ):
            logging.getLogger(name).info("building it")
        raise UsageError("enough")

    monkeypatch.setattr("cnpgen.refine.refine_plans.refine_plans", refine)
    save_plans(tmp_path / "plans.h5", plans_of(load("hit")))
    assert main(["refine", str(tmp_path / "plans.h5"), *options]) == 2
    said = capsys.readouterr().err.replace(str(tmp_path), "FOLDER")
    assert said.splitlines() == [*lines, "cnpgen: error: enough"]
