"""Every block in the README and the docs runs as it is shown."""

import configparser
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from cnpgen.cli.docs_command import rendered_pages
from cnpgen.make.make_dataset import make_dataset
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.world.path import PathWorld
from cnpgen.world.world import World
from tests.conftest import HANGING
from tests.docs.test_site import PARTS
from tests.examples import example_robots

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = [
    README,
    *sorted(
        page for page in (ROOT / "docs").rglob("*.md") if page not in rendered_pages()
    ),
]
PLUG_INS = ROOT / "docs" / "how-to" / "plug-ins.md"
RUNNABLE = {"bash", "python", "toml"}
MAX_DIFFERENCE = 0.02  # mean over the pixels of a picture, of 1


def output_blocks() -> ModuleType:
    """Load docs/outputs.py."""
    spec = importlib.util.spec_from_file_location(
        "outputs", ROOT / "docs" / "outputs.py"
    )
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


outputs = output_blocks()


def blocks(page: Path) -> list[tuple[dict[str, str], str, str]]:
    """Return (markers, language, text) of the fenced blocks of a page."""
    found = []
    for marks, language, text in outputs.BLOCK.findall(
        page.read_text(encoding="utf-8")
    ):
        pairs = re.findall(r"<!-- (\w+)(?:: (\S+))? -->", marks)
        found.append((dict(pairs), language, text))
    return found


def environment(folder: Path) -> dict[str, str]:
    binaries = Path(sys.executable).parent
    paths = [str(folder / "src"), os.environ.get("PYTHONPATH", "")]
    return {
        **os.environ,
        "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(path for path in paths if path),
        "MPLBACKEND": "Agg",
        **outputs.TERMINAL,
    }


def run(command: list[str], folder: Path, code: int = 0) -> str:
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=HANGING,
        check=False,
    )
    assert done.returncode == code, f"{command}\n{done.stdout}"
    return done.stdout


def test_every_block_says_what_it_is() -> None:
    for page in PAGES:
        for marks, language, text in blocks(page):
            assert language in RUNNABLE | {""}, (
                f"{page.name}: {language!r} cannot be run: {text[:60]}"
            )
            assert language != "toml" or "file" in marks, (
                f"{page.name}: a TOML block must be a file: {text[:60]}"
            )


@pytest.fixture(scope="session")
def needed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Prepare the files that a marked block needs: a small dataset of hits."""
    return make_dataset(
        "airhockey-hit", tmp_path_factory.mktemp("needed") / "hits", n=400, workers=1
    ).folder


@cache
def can_draw() -> bool:
    """Return whether MuJoCo is installed and draws without a screen."""
    program = (
        "from cnpgen.addons.benchmark.simulator.execute import load_mujoco as load\n"
        "load().Renderer(load().MjModel.from_xml_string('<mujoco/>')).close()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=False
    )
    return done.returncode == 0


def runs_here(marks: dict[str, str]) -> bool:
    """Return whether this machine has what a block needs; .ci/run or the extended run has the rest."""
    return not (
        ("library" in marks and find_spec(marks["library"]) is None)
        or ("display" in marks and not can_draw())
        or ("robots" in marks and example_robots.folder() is None)
        or ("program" in marks and shutil.which(marks["program"]) is None)
        # .ci/run runs these two in fresh environments.
        or "install" in marks
        or "test" in marks
    )


def shown(page: Path) -> Iterator[tuple[dict[str, str], str, str]]:
    """List the blocks of a page that can be run here, each with its output blocks."""
    runs = False
    for marks, language, text in blocks(page):
        runs = runs if "output" in marks else runs_here(marks)
        if runs:
            yield marks, language, text


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_blocks_of_a_page_run_in_order(
    page: Path, needed: Path, tmp_path: Path
) -> None:
    printed = ""
    for marks, language, text in shown(page):
        if "output" in marks:
            assert outputs.absent_lines(text, printed) == [], printed
            continue
        if "needs" in marks and not (tmp_path / marks["needs"]).exists():
            shutil.copytree(needed, tmp_path / marks["needs"])
        if "file" in marks:
            path = tmp_path / marks["file"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        elif language == "bash":
            printed = run(["bash", "-euo", "pipefail", "-c", text], tmp_path)
        elif language == "python":
            printed = run([sys.executable, "-c", text], tmp_path)
    for drawn, picture in outputs.drawn_pictures(page, tmp_path):
        imread = pytest.importorskip("matplotlib.image").imread
        now, before = (imread(path)[..., :3] for path in (drawn, picture))
        assert now.shape == before.shape, picture
        difference = np.abs(now - before).mean()
        assert difference < MAX_DIFFERENCE, f"{picture}: run docs/outputs.py"


def test_an_output_block_shows_lines_of_the_output_in_their_order() -> None:
    printed = "valid 3 of 8\nmotion time  0.42 s\n-----\nend\n"
    assert outputs.absent_lines("valid 5 of 8\n...\nend\n", printed) == []
    assert outputs.absent_lines("valid 5 of 9\ninvalid 2\n", printed) == ["invalid 2"]
    assert outputs.absent_lines("end\nvalid 3 of 8\n", printed) == ["valid 3 of 8"]
    assert outputs.renewed("motion time 0.5 s\n...\n", printed) == (
        "motion time  0.42 s\n...\n"
    )


WRITTEN = {
    "bash": re.compile(r"(?:-o|--out|--plot|--image|>) ([\w.-]+)"),
    "python": re.compile(
        r'(?:save_plans\("|make_dataset\("[\w-]+", "|File\("(?=[^"]+", "w"))([\w.-]+)'
    ),
}


def test_no_two_pages_write_the_same_file_so_that_all_can_run_in_one_folder() -> None:
    pages: dict[str, set[str]] = {}
    for page in PAGES:
        for marks, language, text in blocks(page):
            if language in WRITTEN and not {"install", "test"} & marks.keys():
                for name in WRITTEN[language].findall(text):
                    pages.setdefault(Path(name).stem, set()).add(page.name)
    assert len(pages) > 15
    assert {name: names for name, names in pages.items() if len(names) > 1} == {}


@pytest.mark.slow
def test_the_plug_in_of_the_docs_works_when_installed(tmp_path: Path) -> None:
    files = {
        marks["file"]: text for marks, _, text in blocks(PLUG_INS) if "file" in marks
    }
    source = tmp_path / "src"
    source.mkdir()
    (source / "my_hockey.py").write_text(files["src/my_hockey.py"], encoding="utf-8")
    install(source, tomllib.loads(files["pyproject.toml"])["project"])
    shipped = ROOT / "problems" / "airhockey"
    problem = (shipped / "problem.toml").read_text(encoding="utf-8")
    problem = problem.replace('urdf = "', f'urdf = "{shipped}/')
    problem += '\n[[constraint]]\nuse = "keep-out"\nx = "1.0 m"\ny = "0 m"\nradius = "10 cm"\ntolerance = "1 mm"\n'
    pipeline = (ROOT / "pipelines" / "airhockey-hit.toml").read_text(encoding="utf-8")
    pipeline = pipeline.replace('problem = "airhockey"', 'problem = "./problem.toml"')
    pipeline += '\n[[stage]]\nuse = "slow-hits"\nmax_speed = "1 m/s"\n'
    (tmp_path / "problem.toml").write_text(problem, encoding="utf-8")
    (tmp_path / "slow.toml").write_text(pipeline, encoding="utf-8")

    assert all(
        name in run(["cnpgen", "list"], tmp_path)
        for name in ("slow-hits", "keep-out", "json-lines")
    )
    run(
        [
            "cnpgen",
            "solve",
            "airhockey-hit",
            "--n",
            "2",
            "-o",
            "plans.h5",
            "--workers",
            "1",
        ],
        tmp_path,
    )
    run(
        ["cnpgen", "export", "plans.h5", "--to", "json-lines", "--rate", "50"], tmp_path
    )
    assert len((tmp_path / "plans.jsonl").read_text(encoding="utf-8").splitlines()) == 2
    run(
        [
            "cnpgen",
            "make-dataset",
            "slow.toml",
            "--n",
            "300",
            "--workers",
            "1",
            "--out",
            "slow",
        ],
        tmp_path,
    )
    run(["cnpgen", "validate", "slow", "--deep", "--workers", "1"], tmp_path)
    rejected = run(["cnpgen", "inspect", "slow"], tmp_path)
    assert "hit too fast" in rejected
    assert "in the circle" in rejected

    code = (source / "my_hockey.py").read_text(encoding="utf-8")
    (source / "my_hockey.py").write_text(
        code.replace("<= self.max_speed,", "<= 0.5 * self.max_speed,"), encoding="utf-8"
    )
    changed = run(["cnpgen", "validate", "slow", "--regenerate", "1"], tmp_path, code=1)
    assert "made with other versions: the code of its plug-ins has changed" in changed

    (
        source / "my_hockey-1.0.dist-info" / "entry_points.txt"
    ).unlink()  # as if it were not installed
    run(["cnpgen", "validate", "slow"], tmp_path)
    lost = run(["cnpgen", "validate", "slow", "--deep"], tmp_path, code=3)
    assert (
        "stage 'slow-hits' comes from the package 'my-hockey', which is not installed"
        in lost
    )
    assert (
        "constraint 'keep-out' comes from the package 'my-hockey', which is not installed"
        in lost
    )


def test_the_constraint_of_the_docs_is_measured_along_a_path_as_at_single_states() -> (
    None
):
    files = {
        marks["file"]: text for marks, _, text in blocks(PLUG_INS) if "file" in marks
    }
    module: dict[str, Any] = {"__name__": "my_hockey"}
    exec(compile(files["src/my_hockey.py"], "my_hockey.py", "exec"), module)
    keep_out = module["KeepOut"](x=1.0, y=0.0, radius=0.1, tolerance=1e-3)
    problem = load_problem("airhockey")
    robot = load_robot(problem)
    q = np.linspace(robot.home, 0.5 * robot.home, 20).T
    path, world, still = (
        PathWorld(robot, problem.obstacle, problem.object_size),
        World(robot, problem.obstacle, problem.object_size),
        np.zeros((robot.n, 20)),
    )
    path.set_path(q, still, still, np.zeros(0))
    (along,) = keep_out.measured(path)
    single = []
    for state in q.T.copy():
        world.set_state(state, still[:, 0], still[:, 0], np.zeros(0))
        single.append(keep_out.measured(world)[0].g[0])
    np.testing.assert_allclose(along.g[0], single, rtol=1e-12)
    assert np.ptp(single) > 0.01


def install(folder: Path, project: dict[str, object]) -> None:
    """Do what pip does for entry points: write the metadata beside the module."""
    info = (
        folder
        / f"{str(project['name']).replace('-', '_')}-{project['version']}.dist-info"
    )
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    entry_points = configparser.ConfigParser(delimiters=("=",))
    entry_points.read_dict(project["entry-points"])  # type: ignore[arg-type]
    with (info / "entry_points.txt").open("w", encoding="utf-8") as file:
        entry_points.write(file)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    titles = re.findall(r"^#+ +(.+?) *$", text, re.M)
    return {
        re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles
    }


LINKED = sorted({*PAGES, *ROOT.glob("*.md")})


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.name)
def test_what_a_page_links_to_is_there(page: Path) -> None:
    text = re.sub(
        r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.S
    )
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", link):
            continue
        file, _, anchor = link.partition("#")
        target = page.parent / file if file else page
        assert target.exists(), f"{page.name} links to {link}"
        top, *below = target.resolve().relative_to(ROOT).parts
        assert top in PARTS or not below, (
            f"{page.name} links to {link}, which is not on the site: write its name only"
        )
        assert not anchor or anchor in anchors(target), (
            f"{page.name} links to {link}; there are {anchors(target)}"
        )


def test_every_page_can_be_reached_from_the_readme() -> None:
    seen, waiting = set[Path](), [README]
    while waiting:
        page = waiting.pop()
        if page in seen or page.suffix != ".md":
            continue
        seen.add(page)
        links = re.findall(r"\]\(([^)\s#:]+)[^)]*\)", page.read_text(encoding="utf-8"))
        waiting += [
            path for link in links if (path := (page.parent / link).resolve()).is_file()
        ]
    assert {*PAGES} <= seen, (
        f"nothing links to {[page.name for page in {*PAGES} - seen]}"
    )


def test_no_page_has_a_placeholder_left() -> None:
    for page in PAGES:
        for line in page.read_text(encoding="utf-8").splitlines():
            assert not re.search(r"^[A-Z]{4,}$|@[A-Z]+@", line), f"{page.name}: {line}"
