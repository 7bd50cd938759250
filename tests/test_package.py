"""What is installed: only cnpgen, with its recipes; complete public names; one version everywhere."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import cnpgen

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return zipfile.ZipFile(next(out.glob("*.whl")))


def test_the_wheel_installs_cnpgen_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert tops == {"cnpgen", f"cnpgen-{cnpgen.__version__}.dist-info"}


def test_the_wheel_carries_every_recipe_and_robot(wheel: zipfile.ZipFile) -> None:
    for folder in ("problems", "pipelines", "datasets"):
        for path in (ROOT / folder).rglob("*"):
            if path.is_file():
                assert f"cnpgen/_recipes/{path.relative_to(ROOT).as_posix()}" in wheel.namelist()
    assert "cnpgen/py.typed" in wheel.namelist()


def test_no_code_lives_beside_the_package() -> None:
    for folder in ("problems", "pipelines", "datasets"):
        assert not list((ROOT / folder).rglob("*.py"))


def test_every_public_name_can_be_imported() -> None:
    for name in cnpgen.__all__:
        assert getattr(cnpgen, name) is not None
    assert set(cnpgen.__all__) == set(dir(cnpgen))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'make_datset'"):
        cnpgen.make_datset  # noqa: B018


def test_the_version_is_the_same_everywhere() -> None:
    citation = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.M)
    changelog = re.search(r"^## \[(\d\S*)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert citation is not None
    assert changelog is not None
    assert citation[1] == changelog[1] == cnpgen.__version__
    assert tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dynamic"] == ["version"]
