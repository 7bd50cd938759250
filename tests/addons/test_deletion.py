"""Every add-on can be deleted: the package, its help and the tests of its neighbours work without its folder."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cnpgen.schema.entry_points import entry_points
from cnpgen.schema.registry import COMMANDS
from tests.test_architecture import ADDONS, PACKAGE, addon, needs

ROOT = PACKAGE.parent
MAIN_JOB = """
make-dataset airhockey-replan --n 60 -o data --workers 1
validate data
train data -o model.h5 --steps 4 --quiet
plan data --model model.h5 --n 2 -o plans.h5
solve data --n 2 -o solved.h5 --workers 1
refine plans.h5 -o refined.h5 --workers 1
evaluate solved.h5 --workers 1
export solved.h5 --to csv -o tables
"""


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the checkout, as far as the package and the tests need it."""
    folder = tmp_path_factory.mktemp("clone")
    for part in ("cnpgen", "problems", "pipelines", "datasets", "tests", "docs"):
        shutil.copytree(
            ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__")
        )
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


@pytest.fixture
def without(clone: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """Return the copy without some add-ons, which are put back after the test."""
    parked = clone / "parked"
    present = clone / "cnpgen" / "addons"
    for name in request.param:
        shutil.move(present / name, parked / name)
    yield clone
    for name in request.param:
        shutil.move(parked / name, present / name)


def run(folder: Path, *words: str, cwd: Path | None = None) -> tuple[int, str, str]:
    """Run the command line of the copy; return exit code, stdout and stderr."""
    code = f"import sys; sys.path.insert(0, {str(folder)!r}); "
    code += "from cnpgen.cli.main import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd or folder,
    )
    return done.returncode, done.stdout, done.stderr


def commands_of(name: str) -> list[str]:
    """Return the commands of an add-on."""
    entries = entry_points()[COMMANDS]
    return [
        entry.name
        for entry in entries
        if addon(entry.module.removeprefix("cnpgen.")) == name and "." not in entry.name
    ]


def lost_with(name: str) -> list[str]:
    """Return the commands that a deletion removes: also those of add-ons that need it."""
    return [
        command
        for other in ADDONS
        if other == name or name in needs(other)
        for command in commands_of(other)
    ]


@pytest.mark.parametrize(
    "without", [(name,) for name in ADDONS], ids=ADDONS, indirect=True
)
def test_without_an_addon_the_others_work_and_its_commands_name_it(
    without: Path, request: pytest.FixtureRequest
) -> None:
    (name,) = (
        name for name in ADDONS if not (without / "cnpgen" / "addons" / name).exists()
    )
    code, text, errors = run(without, "--help")
    assert (code, errors) == (0, "")
    lost = lost_with(name)
    for command in {entry.name for entry in entry_points()[COMMANDS]} - {""}:
        listed = re.search(rf"\n    {command}\s", text) is not None
        assert listed == (command not in lost and "." not in command), command
    for command in lost:
        code, _, errors = run(without, command, "x")
        assert code == 3
        assert errors == (
            f"cnpgen: error: the command {command!r} needs the add-on {name!r},"
            " which this installation lacks: reinstall cnpgen\n"
        )


@pytest.mark.parametrize(
    "without", [("trajectories",)], ids=["trajectories"], indirect=True
)
def test_a_file_that_only_a_missing_addon_reads_names_it(
    without: Path, tmp_path: Path
) -> None:
    (tmp_path / "samples.csv").write_text("t,a\n0,1\n")
    code, _, errors = run(without, "evaluate", "samples.csv", cwd=tmp_path)
    assert code == 3
    assert errors == (
        "cnpgen: error: 'cnpgen evaluate samples.csv' needs the add-on 'trajectories',"
        " which this installation lacks: reinstall cnpgen\n"
    )


@pytest.mark.parametrize("without", [("online",)], ids=["online"], indirect=True)
def test_a_public_name_of_a_missing_addon_is_one_sentence(without: Path) -> None:
    program = (
        f"import sys; sys.path.insert(0, {str(without)!r}); import cnpgen.results; "
    )
    program += (
        "assert 'PlanRuntime' not in cnpgen.results.__all__; cnpgen.results.PlanRuntime"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "cnpgen.errors.MissingAddonError: cnpgen.results.PlanRuntime needs the add-on"
        " 'online', which this installation lacks: reinstall cnpgen"
    )


@pytest.mark.slow
@pytest.mark.parametrize("without", [tuple(ADDONS)], ids=["all"], indirect=True)
def test_without_any_addon_the_main_job_works(without: Path, tmp_path: Path) -> None:
    for line in MAIN_JOB.strip().splitlines():
        code, _, errors = run(without, *line.split(), cwd=tmp_path)
        assert (
            code in {0, 1} if line.startswith(("refine", "evaluate")) else code == 0
        ), errors
        assert "internal error" not in errors, errors
    assert not (tmp_path / "data" / "README.md").exists()
    assert list((tmp_path / "tables").iterdir())


@pytest.mark.extended
@pytest.mark.parametrize(
    "without", [(name,) for name in ADDONS], ids=ADDONS, indirect=True
)
def test_the_tests_of_the_core_pass_without_an_addon(without: Path) -> None:
    folders = ("schema", "store", "kernels", "trajectory", "world", "losses", "refine")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *(f"tests/{name}" for name in folders)],
        capture_output=True,
        text=True,
        check=False,
        cwd=without,
    )
    assert done.returncode == 0, done.stdout[-4000:]
