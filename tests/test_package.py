"""Installed files: only cnpgen, with its recipes; complete public names; one version everywhere."""

import ast
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Callable
from email.parser import Parser
from pathlib import Path
from typing import Any

import pytest

import cnpgen
from cnpgen.addons.benchmark.planners import (
    cbirrt,
    drake,
    rrtconnect,
    ruckig,
    sscbirrt,
)
from cnpgen.addons.benchmark.simulator import rendering
from cnpgen.addons.benchmark.simulator.execute import load_mujoco
from cnpgen.addons.clusters.clusters import joined
from cnpgen.addons.hub.publish import upload_files
from cnpgen.addons.manual.completion import complete_words
from cnpgen.addons.trajectories.trajectory_tables import read_trajectory_tables
from cnpgen.addons.view import page
from cnpgen.cli.main import build_parser
from cnpgen.errors import MissingExtraError
from cnpgen.kernels.c_library import VARIANTS
from cnpgen.kernels.compiler import find_compiler
from cnpgen.loader.dataset import make_frame
from cnpgen.loader.load import load_dataset
from cnpgen.machine.versions import DOCUMENTATION_URL
from cnpgen.store.files.figure_file import new_figure
from tests.refusals import is_refused

ROOT = Path(__file__).parents[1]


STRAY = (  # files that do not belong to the package
    "datasets/models/experiment.h5",
    "datasets/models/airhockey-hit.h5.checkpoint",
    "datasets/rows.csv",
    "pipelines/airhockey-hit.toml.orig",
    "problems/airhockey/mesh.stl",
    "cnpgen/notes.txt",
    "docs/notes.txt",
)


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel of a copy of the repository with files that do not belong to the package."""
    pytest.importorskip("build")
    pytest.importorskip("hatchling")
    copy, out = tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("wheel")
    for name in ("cnpgen", "problems", "pipelines", "datasets", "docs"):
        shutil.copytree(
            ROOT / name,
            copy / name,
            ignore=shutil.ignore_patterns("__pycache__", "built"),
        )
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    for name in STRAY:
        (copy / name).write_text("stray")
    command = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--no-isolation",
        "--outdir",
        str(out),
        str(copy),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return zipfile.ZipFile(next(out.glob("*.whl")))


def test_the_wheel_installs_cnpgen_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    top_level = {name.split("/")[0] for name in wheel.namelist()}
    assert top_level == {"cnpgen", f"cnpgen-{cnpgen.__version__}.dist-info"}


def test_the_wheel_carries_every_recipe_and_robot(wheel: zipfile.ZipFile) -> None:
    for folder in ("problems", "pipelines", "datasets"):
        for path in (ROOT / folder).rglob("*"):
            if path.is_file():
                assert (
                    f"cnpgen/_recipes/{path.relative_to(ROOT).as_posix()}"
                    in wheel.namelist()
                )
    assert "cnpgen/py.typed" in wheel.namelist()
    pages = {
        f"cnpgen/_recipes/{path.relative_to(ROOT).as_posix()}"
        for path in (ROOT / "docs").rglob("*.md")
        if ROOT / "docs" / "examples" not in path.parents
    }
    assert pages == {
        name for name in wheel.namelist() if name.startswith("cnpgen/_recipes/docs/")
    }
    # pyproject.toml lists the data of the package one by one.
    files = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "cnpgen").rglob("*")
        if path.is_file() and path.suffix != ".pyc" and path.parent.name != "built"
    }
    assert files >= {
        "cnpgen/refine/solver/step.c",
        "cnpgen/addons/trajectories/arms.toml",
    }
    assert files - set(wheel.namelist()) == set()


def test_the_wheel_has_no_stray_files(wheel: zipfile.ZipFile) -> None:
    shipped = {name.removeprefix("cnpgen/_recipes/") for name in wheel.namelist()}
    assert not shipped.intersection(STRAY)
    built = {name for name in shipped if name.startswith("cnpgen/kernels/built/")}
    tracked = (
        path
        for folder in ("cnpgen", "problems", "pipelines", "datasets", "docs")
        for path in (ROOT / folder).rglob("*")
    )
    expected = {
        path.relative_to(ROOT).as_posix()
        for path in tracked
        if path.is_file() and path.suffix != ".pyc"
    }
    assert {name for name in shipped - built if ".dist-info/" not in name} <= expected


def test_the_wheel_has_compiled_c_code_if_there_is_a_compiler(
    wheel: zipfile.ZipFile,
) -> None:
    built = [
        name.rpartition("/")[2]
        for name in wheel.namelist()
        if name.startswith("cnpgen/kernels/built/")
    ]
    (tag,) = re.findall(
        r"^Tag: (.*)$",
        wheel.read(f"cnpgen-{cnpgen.__version__}.dist-info/WHEEL").decode(),
        re.MULTILINE,
    )
    if find_compiler() is None or platform.machine() not in VARIANTS:
        assert built == []
        assert tag == "py3-none-any"
        return
    names = "hull_rows", "observe", "step", "time_parametrization"
    variants = VARIANTS[platform.machine()]
    expected = [f"{name}-{one.name}" for name in names for one in variants]
    assert sorted(name.rpartition("-")[0] for name in built) == sorted(expected)
    assert tag.startswith("py3-none-")
    assert tag != "py3-none-any"


INSTALLED = """
import cnpgen, sys
from importlib.metadata import entry_points, version
from cnpgen.schema.catalogue import recipes_root
assert cnpgen.__file__.startswith(sys.argv[1]), cnpgen.__file__
assert recipes_root().is_relative_to(sys.argv[1]), recipes_root()
for name in cnpgen.__all__:
    getattr(cnpgen, name)
for name in cnpgen.recipes.list_recipes("dataset"):
    recipe = cnpgen.recipes.load_dataset_recipe(name)
    if not name.startswith(("panda", "ur5")):  # whose robots an extra installs
        assert recipe.pipeline.problem.urdf_path.is_relative_to(sys.argv[1])
(script,) = entry_points(group="console_scripts", name="cnpgen")
assert callable(script.load())
from cnpgen.cli.docs_command import docs_folder, list_pages
assert docs_folder().is_relative_to(sys.argv[1]) and len(list_pages()) > 30
print(version("cnpgen"), len(cnpgen.recipes.list_recipes("dataset")))
"""


@pytest.mark.slow
def test_what_the_wheel_installs_works_by_itself(
    wheel: zipfile.ZipFile, tmp_path: Path
) -> None:
    """Unpacked elsewhere, away from the repository: names, recipes, version, script."""
    site, home = tmp_path / "site", tmp_path / "home"
    wheel.extractall(site)
    home.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-c", INSTALLED, str(site)]
    done = subprocess.run(
        command, cwd=home, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    shipped = len(list((ROOT / "datasets").glob("*.toml")))
    assert done.stdout.split() == [cnpgen.__version__, str(shipped)]


def test_every_library_that_is_imported_is_a_declared_dependency(
    wheel: zipfile.ZipFile,
) -> None:
    imported = set()
    for path in (ROOT / "cnpgen").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.split(".")[0])
    (metadata,) = [
        name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")
    ]
    declared = (
        Parser().parsestr(wheel.read(metadata).decode()).get_all("Requires-Dist") or []
    )
    libraries = {re.split(r"[^A-Za-z0-9_.-]", text)[0] for text in declared}
    others = imported - set(sys.stdlib_module_names) - {"cnpgen"}
    assert {
        {"pinocchio": "pin", **NAMES_IN_THE_INDEX}.get(name, name) for name in others
    } <= libraries


def test_what_the_default_run_of_the_tests_leaves_out_is_run_before_a_change_lands() -> (
    None
):
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
        "tool"
    ]["pytest"]["ini_options"]
    assert settings["addopts"][-2:] == ["-m", "not slow and not extended"]
    assert {text.partition(":")[0] for text in settings["markers"]} == {
        "quick",
        "slow",
        "extended",
    }
    command, script = "-m 'slow and not extended'", ROOT / ".ci" / "run"
    assert command in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert not script.exists() or command in script.read_text(
        encoding="utf-8"
    )  # a source distribution has none


def test_no_code_lives_beside_the_package() -> None:
    for folder in ("problems", "pipelines", "datasets"):
        assert not list((ROOT / folder).rglob("*.py"))


def test_every_public_name_can_be_imported() -> None:
    for name in cnpgen.__all__:
        assert getattr(cnpgen, name) is not None
    assert set(cnpgen.__all__) == set(dir(cnpgen))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with is_refused(AttributeError):
        cnpgen.make_datset  # noqa: B018


def test_the_version_and_the_address_are_the_same_everywhere() -> None:
    citation = re.search(
        r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.M
    )
    changelog = re.search(
        r"^## \[(\d\S*)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M
    )
    assert citation is not None
    assert changelog is not None
    assert citation[1] == changelog[1] == cnpgen.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    assert project["dynamic"] == ["version", "urls"]
    urls = dict(
        entry.split(", ")
        for entry in importlib.metadata.metadata("cnpgen").get_all("Project-URL", [])
    )
    named = {"Homepage", "Documentation", "Changelog"} if DOCUMENTATION_URL else set()
    assert urls.keys() == named
    assert all(url.startswith(DOCUMENTATION_URL) for url in urls.values())
    sources = [
        path
        for pattern in ("*.toml", "cnpgen/**/*.py", "docs/**/*.md")
        for path in ROOT.glob(pattern)
    ]
    holders = [
        path.name
        for path in sources
        if "cnpgen.example.org" in path.read_text(encoding="utf-8")
    ]
    assert holders == []  # no address that nobody answers


def bridge(framework: str, name: str) -> Callable[[], object]:
    """Return a function that loads a name of the bridge of a framework as if for the first time."""

    def load() -> object:
        bridges = (
            f"cnpgen.addons.frameworks.{framework}",
            f"cnpgen.interop.{framework}",
        )
        for module in list(sys.modules):
            if module in bridges or module.startswith(f"{bridges[0]}."):
                del sys.modules[module]
        return getattr(importlib.import_module(bridges[1]), name)

    return load


def cluster(name: str) -> None:
    with joined(name, None, 1):
        pass


def frame(library: str) -> Any:
    return make_frame({}, (), library=library)


def trajectories(suffix: str) -> object:
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
        return read_trajectory_tables(Path(file.name))


OPTIONAL = {  # package that cnpgen imports -> extra that installs it, function that needs it
    "torch": ("torch", bridge("torch", "to_torch")),
    "jax": ("jax", bridge("jax", "to_jax")),
    "matplotlib": ("plot", lambda: new_figure(1, 1)),
    "mujoco": ("benchmark", load_mujoco),
    "imageio": ("benchmark", rendering._imageio),
    "ompl": ("benchmark", cbirrt.load_ompl),
    "toppra": ("benchmark", rrtconnect.load_toppra),
    "ruckig": ("benchmark", ruckig.load_ruckig),
    "sscbirrt": ("planners", sscbirrt.load_sscbirrt),
    "pydrake": ("planners", drake.load_drake),
    "meshcat": ("view", page._viewer),
    "distributed": ("dask", lambda: cluster("dask")),
    "ray": ("ray", lambda: cluster("ray")),
    "polars": ("polars", lambda: frame("polars")),
    "pandas": ("pandas", lambda: frame("pandas")),
    "pyarrow": ("parquet", lambda: trajectories(".parquet")),
    "yaml": ("ros", lambda: trajectories(".yaml")),
    "rosbags": ("bags", lambda: trajectories(".mcap")),
    "lerobot": ("lerobot", bridge("lerobot", "ChunkStep")),
    "argcomplete": ("completion", lambda: complete_words(build_parser([]))),
    "fsspec": ("hub", lambda: load_dataset("memory://hits")),
    "huggingface_hub": (
        "hub",
        lambda: upload_files(Path(), [], "user/name", private=False),
    ),
}
NAMES_IN_THE_INDEX = {
    "yaml": "pyyaml",
    "pydrake": "drake",
    "huggingface_hub": "huggingface-hub",
}
BY_NAME = {"meshcat", "polars", "pandas"}  # loaded by name, without an import statement
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]


@pytest.mark.parametrize("package", OPTIONAL)
def test_the_error_without_an_optional_package_names_its_extra(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(name: str) -> Any:
        raise importlib.metadata.PackageNotFoundError(name)

    extra, use = OPTIONAL[package]
    parts = [name for name in sys.modules if name.partition(".")[0] == package]
    for name in (package, *parts):
        monkeypatch.setitem(sys.modules, name, None)
    for name in [name for name in sys.modules if name.startswith("cnpgen.interop.")]:
        monkeypatch.setitem(
            sys.modules, name, sys.modules[name]
        )  # put back after the test
    for function in ("version", "distribution"):
        monkeypatch.setattr(importlib.metadata, function, without)
    with pytest.raises(
        MissingExtraError, match=rf"pip install 'cnpgen\[{extra}\]'"
    ) as caught:
        use()
    assert caught.value.exit_code == 3
    assert any(
        re.match(rf"{NAMES_IN_THE_INDEX.get(package, package)}\b", requirement)
        for requirement in SETTINGS["optional-dependencies"][extra]
    )


def test_the_list_of_optional_packages_is_complete() -> None:
    imported = {
        name.partition(".")[0]
        for file in (ROOT / "cnpgen").rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in (
            [node.module]
            if isinstance(node, ast.ImportFrom)
            else [alias.name for alias in node.names]
        )
    }
    required = {
        re.split(r"[^\w-]", requirement)[0] for requirement in SETTINGS["dependencies"]
    }
    required |= {"pinocchio", "cnpgen"}  # pinocchio is installed by `pin`
    assert imported - required - sys.stdlib_module_names == OPTIONAL.keys() - BY_NAME


CITATION_KEYS = (
    "cff-version",
    "message",
    "title",
    "abstract",
    "type",
    "authors",
    "version",
    "license",
    "keywords",
)


def test_the_citation_names_the_project_and_the_release() -> None:
    yaml = pytest.importorskip("yaml")
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    citation = yaml.safe_load(text)
    wanted = (*CITATION_KEYS, "date-released")
    assert [key for key in wanted if not citation.get(key)] == []
    assert citation["references"][0]["authors"][0]["family-names"] == "Kicki"
    assert "#" not in text


METADATA = (
    "Name",
    "Version",
    "Summary",
    "License-Expression",
    "Requires-Python",
    "Author",
    "Keywords",
)


def test_the_metadata_of_the_wheel_are_complete(wheel: zipfile.ZipFile) -> None:
    (name,) = [
        name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")
    ]
    metadata = Parser().parsestr(wheel.read(name).decode())
    assert [key for key in METADATA if not metadata.get(key)] == []
    assert metadata["Version"] == cnpgen.__version__
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert metadata.get_payload().startswith("# cnpgen")
    assert "License :: " not in str(
        metadata.get_all("Classifier")
    )  # replaced by the license expression


def _install_command() -> str:
    """Return the install command of the README."""
    (block,) = re.findall(
        r"<!-- install -->\n```bash\n(.*?)```",
        (ROOT / "README.md").read_text(encoding="utf-8"),
        re.S,
    )
    return str(block).strip()


@pytest.mark.extended
def test_the_release_is_built_and_the_install_command_of_the_readme_works_with_its_wheel(
    tmp_path: Path,
) -> None:
    pytest.importorskip("build")
    source, dist, home = tmp_path / "source", tmp_path / "dist", tmp_path / "home"
    ignored = shutil.ignore_patterns(
        "__pycache__", ".git", ".venv", ".*_cache", "build", "dist", "shared"
    )
    shutil.copytree(ROOT, source, ignore=ignored)
    home.mkdir()
    _checked(
        [
            sys.executable,
            "-m",
            "build",
            "--no-isolation",
            "--outdir",
            str(dist),
            str(source),
        ],
        home,
    )
    (built,), (archive,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    assert built.name.startswith(f"cnpgen-{cnpgen.__version__}-py3-none-")
    assert archive.name == f"cnpgen-{cnpgen.__version__}.tar.gz"
    if importlib.util.find_spec("twine"):
        _checked(
            [
                sys.executable,
                "-m",
                "twine",
                "check",
                "--strict",
                str(built),
                str(archive),
            ],
            home,
        )
    command = _install_command()
    assert "'.[plot]'" in command
    if not _has_index(home):
        pytest.skip("no package index")
    _checked(
        [
            "bash",
            "-euo",
            "pipefail",
            "-c",
            command.replace("'.[plot]'", f"'{built}[plot]'"),
        ],
        home,
    )
    assert (home / "airhockey-replan-v1" / "manifest.json").is_file()
    script = str(home / ".venv" / "bin" / "cnpgen")
    assert "airhockey-hit" in _checked([script, "list"], home)
    assert _checked([script, "docs", "releases"], home).startswith("# Releases")
    _checked([script, "validate", "airhockey-replan-v1"], home)


def _checked(command: list[str], folder: Path) -> str:
    """Run a command without the repository on the path; return its output."""
    environment = {
        name: value for name, value in os.environ.items() if name != "PYTHONPATH"
    }
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def _has_index(folder: Path) -> bool:
    """Return whether pip reaches a package index."""
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--dest",
        str(folder / "probe"),
        "joblib",
    ]
    return (
        subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode
        == 0
    )
