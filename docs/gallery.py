"""Make the interactive pages and dataset cards of the gallery: python docs/gallery.py FOLDER (extras `view`, `plot`).

    python docs/gallery.py build/site/gallery              # the pages, as the site does
    python docs/gallery.py build/gallery --pictures        # also docs/images/gallery-*.png, by Chromium

Every page has fixed seeds. Pages whose robot belongs to an extra that is not installed are left out (extra `robots`).
"""

import argparse
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import cnpgen
from cnpgen.addons.view.page import page_of
from cnpgen.addons.view.view_scene import scene_of_plans
from cnpgen.cli.copy_command import copied_texts
from cnpgen.errors import CnpgenError
from cnpgen.plans import Plans, open_problem
from cnpgen.plans.join import concatenate
from cnpgen.problems.load_robot import load_robot
from cnpgen.recipes import load_pipeline
from cnpgen.store.dataset_plot import plot_dataset
from cnpgen.store.inspection import inspect_dataset

IMAGES = Path(__file__).parent / "images"
SEED = 11
CARDS = {
    "airhockey-hit": 3_000,
    "airhockey-replan": 3_000,
    "heavy-object": 3_000,
}  # dataset -> rows of its picture
PICTURE_SIZE = (1000, 620)  # of a page in the browser [pixels]
CLUTTER = """
[[obstacle]]
name = "wall"
x = "[30, 70] cm"
y = "[-5, 5] cm"
top = "40 cm"

[[obstacle]]
name = "ball"
kind = "sphere"
position = "[70, 25, 75] cm"
radius = "8 cm"

[[obstacle]]
name = "pole"
kind = "cylinder"
position = "[80, -25, 50] cm"
radius = "4 cm"
length = "100 cm"

[[obstacle]]
name = "beam"
kind = "box"
position = "[45, 0, 125] cm"
size = "[10, 80, 8] cm"
"""


@dataclass(frozen=True)
class Entry:
    """A page of the gallery.

    Attributes:
        title: Title of the page.
        plans: Returns plans and their titles.
        robots: Whether the extra ``robots`` is needed; its meshes are drawn.
        frame: Frame of the picture.
    """

    title: str
    plans: Callable[[], tuple[Plans, list[str]]]
    robots: bool = False
    frame: int = 130


def solved(recipe: str | Path, count: int, seed: int = SEED) -> Plans:
    """Solve the first problems of a recipe."""
    return cnpgen.solve_plans(
        cnpgen.draw_boundary_problems(recipe, count, seed=seed), workers=1
    ).plans


def of_recipe(recipe: str, count: int) -> Callable[[], tuple[Plans, list[str]]]:
    """Return plans of a recipe, with their numbers as titles."""
    return lambda: (
        solved(recipe, count),
        [f"{recipe}, problem {number}" for number in range(count)],
    )


def clutter() -> tuple[Plans, list[str]]:
    """Solve problems of the heavy object among further obstacles."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in copied_texts(
            load_pipeline("heavy-object"), "clutter"
        ).items():
            (Path(folder) / name).write_text(
                text + (CLUTTER if name == "problem.toml" else ""), encoding="utf-8"
            )
        plans = solved(Path(folder) / "pipeline.toml", 3)
    return plans, [
        f"heavy object among six obstacles, problem {number}"
        for number in range(len(plans))
    ]


def comparison() -> tuple[Plans, list[str]]:
    """Plan one hit in three ways: by the network, by the network and the refiner, and without an initial guess."""
    problems = cnpgen.draw_boundary_problems("airhockey-hit", 1, seed=SEED)
    planned = cnpgen.Planner("airhockey-hit").plan_batch(problems.boundary)
    refined = cnpgen.refine_plans(planned, workers=1).plans
    solution = cnpgen.solve_plans(problems, workers=1).plans
    shared = planned.columns.keys() & solution.columns.keys()
    parts = [
        replace(part, columns={name: part.columns[name] for name in shared})
        for part in (planned, refined, solution)
    ]
    plans = concatenate(parts)
    names = (
        "shipped planner",
        "shipped planner, then refined",
        "solved without an initial guess",
    )
    titles = [
        f"{name}: {1e3 * time:.0f} ms"
        for name, time in zip(names, plans.duration, strict=True)
    ]
    return plans, titles


ENTRIES = {
    "hit": Entry("hits", of_recipe("airhockey-pucks", 4)),
    "transport": Entry("transports", of_recipe("heavy-object", 4)),
    "cup": Entry("a Franka Panda with a cup", of_recipe("panda-cup", 3), robots=True),
    "wipe": Entry("a UR5 that wipes", of_recipe("ur5-wipe", 3), robots=True),
    "clutter": Entry("a transport among obstacles", clutter),
    "comparison": Entry("three planners, one hit", comparison),
}


def available() -> list[str]:
    """Return the names of the pages that can be made here."""
    has_robots = has_viewer = find_spec("meshcat") is not None
    try:
        load_robot(cnpgen.load_problem("panda-cup"))
    except CnpgenError:
        has_robots = False
    return [
        name
        for name, entry in ENTRIES.items()
        if has_viewer and (has_robots or not entry.robots)
    ]


def write_page(name: str, folder: Path) -> Path:
    """Write a page of the gallery."""
    plans, titles = ENTRIES[name].plans()
    problem, robot = open_problem(plans.problem)
    verdicts = cnpgen.evaluate_plans(plans, workers=1).verdicts
    scene = scene_of_plans(
        problem, robot, plans, titles, verdicts, with_meshes=ENTRIES[name].robots
    )
    path = folder / f"{name}.html"
    path.write_text(page_of(scene), encoding="utf-8")
    return path


def write_card(name: str, folder: Path) -> Path:
    """Draw the picture of a dataset card."""
    path = folder / f"{name}.png"
    with tempfile.TemporaryDirectory() as rows:
        made = cnpgen.make_dataset(name, Path(rows) / "rows", n=CARDS[name], workers=1)
        plot_dataset(inspect_dataset(made.folder), path)
    return path


def write_gallery(folder: Path) -> list[Path]:
    """Write all pages and cards that can be made here."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = [write_page(name, folder) for name in available()]
    cards = (
        [write_card(name, folder) for name in CARDS] if find_spec("matplotlib") else []
    )
    return [*pages, *cards]


def take_picture(page: Path, out: Path, frame: int) -> None:
    """Take a picture of a page with Chromium."""
    from PIL import Image

    browser = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if browser is None:
        raise SystemExit("pictures need Chromium")
    with tempfile.TemporaryDirectory() as profile:
        shot = Path(profile) / "shot.png"
        flags = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--use-angle=swiftshader",
            f"--screenshot={shot}",
        ]
        flags += [
            "--enable-unsafe-swiftshader",
            f"--user-data-dir={profile}",
            "--virtual-time-budget=8000",
        ]
        size = "--window-size={},{}".format(*PICTURE_SIZE)
        subprocess.run(
            [browser, *flags, size, f"{page.absolute().as_uri()}#time={frame}"],
            check=True,
            capture_output=True,
        )
        Image.open(shot).convert("RGB").save(out, optimize=True)


def main() -> None:
    """Write the gallery into a folder."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--pictures", action="store_true", help="also take the pictures of the pages"
    )
    arguments = parser.parse_args()
    for path in write_gallery(arguments.folder):
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
        if arguments.pictures and path.suffix == ".html":
            take_picture(
                path, IMAGES / f"gallery-{path.stem}.png", ENTRIES[path.stem].frame
            )


if __name__ == "__main__":
    np.seterr(all="ignore")
    main()
