"""Unusual surroundings: a Turkish locale, clocks that jump, many workers, long arms, and names that are code."""

import csv
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from shutil import which

import numpy as np
import psutil
import pytest

from cnpgen.addons.benchmark.benchmark_report import save_benchmark_report
from cnpgen.addons.benchmark.result_tables import csv_text
from cnpgen.addons.benchmark.run_suite import Benchmark
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.loader.load import load_dataset
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.format import PlanStatus
from cnpgen.plans.plan_file import load_plans, save_plans
from cnpgen.plans.plans import make_plans, screen
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import Scene
from cnpgen.trajectories import load_trajectories
from cnpgen.trajectory.boundary import boundary_of
from cnpgen.validate.validate_dataset import validate_dataset
from tests.examples.chains import chain
from tests.examples.loader import ALL, ids, make
from tests.examples.plan_files import plans_of
from tests.examples.plans import load as stored_plan
from tests.examples.tiny_datasets import digests, make_tiny

CODE = "<script>alert(1)</script>"
N_WORKERS, N_EPOCHS = 8, 20
LONG_ARM = 12  # joints
N_PLANS, N_FILES = 100_000, 10_000
DAY_S = 86400.0

IN_TURKISH = """
import locale, sys
import numpy as np
locale.setlocale(locale.LC_ALL, "tr_TR.UTF-8")
assert locale.format_string("%.1f", 0.5) == "0,5"
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.plan_file import load_plans, save_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
robot = load_robot(load_problem("airhockey"))
plans = load_plans("plans.h5")
save_plans("turkish.h5", plans)
export_plans(plans, "turkish", to="csv", rate=100.0)
print(evaluate_plans(plans, workers=1).valid.tolist(), repr(robot.model.lowerPositionLimit[0]))
"""


@pytest.fixture(scope="module")
def turkish(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Make a locale with a comma in numbers and a dotless i; return the environment."""
    if which("localedef") is None:
        pytest.skip("needs localedef")
    folder = tmp_path_factory.mktemp("locales")
    made = subprocess.run(
        ["localedef", "-i", "tr_TR", "-f", "UTF-8", str(folder / "tr_TR.UTF-8")],
        capture_output=True,
        check=False,
    )
    if not (folder / "tr_TR.UTF-8" / "LC_NUMERIC").exists():
        pytest.skip(f"needs the source of the locale tr_TR: {made.stderr[-200:]!r}")
    return {**os.environ, "LOCPATH": str(folder), "LC_ALL": "tr_TR.UTF-8"}


@pytest.mark.slow
def test_numbers_and_names_are_the_same_in_a_turkish_locale(
    turkish: dict[str, str], tmp_path: Path
) -> None:
    plans = plans_of(stored_plan("hit"), stored_plan("hit"))
    save_plans(tmp_path / "plans.h5", plans)
    export_plans(plans, tmp_path / "english", to="csv", rate=100.0)
    done = subprocess.run(
        [sys.executable, "-c", IN_TURKISH],
        cwd=tmp_path,
        env=turkish,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    lower = load_robot(load_problem("airhockey")).model.lowerPositionLimit[0]
    assert done.stdout.strip() == f"[True, True] {lower!r}"
    assert (tmp_path / "turkish.h5").read_bytes() == (
        tmp_path / "plans.h5"
    ).read_bytes()
    for path in sorted((tmp_path / "english").glob("*.csv")):
        other = tmp_path / "turkish" / path.name
        assert other.read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_a_dataset_is_the_same_although_the_clock_jumps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = digests(make_tiny(tmp_path / "steady").folder)
    jumps: Iterator[float] = cycle([0.0, -400 * DAY_S, 400 * DAY_S, -DAY_S])
    steady = time.time
    monkeypatch.setattr(time, "time", lambda: steady() + next(jumps))
    made = make_tiny(tmp_path / "jumping")
    assert digests(made.folder) == expected
    assert validate_dataset(made.folder, workers=1).ok
    for path in made.folder.rglob("*"):
        # Of a file server whose clock is a day ahead.
        os.utime(path, (steady() + DAY_S, steady() + DAY_S))
    assert digests(make_tiny(tmp_path / "jumping").folder) == expected


def read_epochs(folder: Path, seed: int) -> tuple[list[list[int]], int]:
    """Read epochs of a dataset; return the ids of each, sorted, and the open files at the end."""
    batches = load_dataset(folder).batches(
        5, fields=("start_q", "sample_id"), seed=seed
    )
    epochs = [
        sorted(row for batch in batches for row in batch["sample_id"].tolist())
        for _ in range(N_EPOCHS)
    ]
    opened = [file.path for file in psutil.Process().open_files()]
    return epochs, sum(path.startswith(str(folder)) for path in opened)


@pytest.mark.slow
def test_many_workers_read_every_row_once_in_each_of_many_epochs(
    tmp_path: Path,
) -> None:
    folder = make(tmp_path / "set", shard_size=8)
    every = sorted(
        row for rows in ids(load_dataset(folder).batches(5, fields=ALL)) for row in rows
    )
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(N_WORKERS, mp_context=context) as pool:
        results = list(pool.map(read_epochs, [folder] * N_WORKERS, range(N_WORKERS)))
    for epochs, n_open_files in results:
        assert epochs == [every] * N_EPOCHS
        assert n_open_files == 0
    assert not multiprocessing.active_children()


def test_plans_of_an_arm_of_twelve_joints_are_judged_stored_and_exported(
    tmp_path: Path,
) -> None:
    record = record_problem(chain(tmp_path, LONG_ARM, jerk=False))
    robot = open_problem(record)[1]
    assert robot.n == LONG_ARM
    goal = robot.home + 0.3
    still = np.zeros_like(goal)
    boundary = boundary_of(LONG_ARM, robot.home, still, still, goal, still)
    spec = open_problem(record)[0].trajectory
    shares = np.clip(np.linspace(-0.5, 1.5, spec.path_control_points), 0.0, 1.0)
    path = robot.home + shares[:, None] * (goal - robot.home)
    verdicts = []
    for duration in (10.0, 0.1):
        rate = np.full((1, spec.rate_control_points), 1 / duration)
        plans = make_plans(
            record, boundary, path_control_points=path[None], rate_control_points=rate
        )
        save_plans(tmp_path / f"{duration}.h5", plans)
        verdicts += evaluate_plans(load_plans(tmp_path / f"{duration}.h5")).verdicts
    assert [verdict.valid for verdict in verdicts] == [True, False]
    export_plans(plans, tmp_path / "tables", to="csv", rate=100.0)
    (table,) = (tmp_path / "tables").glob("*.csv")
    head = table.read_text(encoding="utf-8").partition("\n")[0]
    assert all(f" j{k} [" in head for k in range(1, LONG_ARM + 1))


@pytest.mark.slow
def test_a_file_of_many_plans_is_stored_selected_and_screened(tmp_path: Path) -> None:
    plans = plans_of(*[stored_plan("hit")] * 10)
    many = plans[np.arange(N_PLANS) % 10]
    save_plans(tmp_path / "plans.h5", many)
    found = load_plans(tmp_path / "plans.h5")
    assert len(found) == N_PLANS
    np.testing.assert_array_equal(
        found.path_control_points[-1], plans.path_control_points[-1]
    )
    assert (screen(found) == PlanStatus.UNKNOWN).all()
    assert evaluate_plans(found[[0, N_PLANS - 1]]).valid.all()


@pytest.mark.slow
def test_a_folder_of_many_files_is_read_in_the_order_of_its_names(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "tables"
    folder.mkdir()
    for k in range(N_FILES):
        rows = "".join(f"{t},{k * 1e-6},0,0,0,0,0\n" for t in (0.0, 0.1, 0.2))
        text = f"t,{','.join(f'joint_{j}' for j in range(1, 7))}\n{rows}"
        (folder / f"{k:05d}.csv").write_text(text, encoding="utf-8")
    found = load_trajectories(folder, "airhockey").trajectories
    assert len(found) == N_FILES
    first = [trajectory.q[0, 0] for trajectory in found]
    np.testing.assert_allclose(first, np.arange(N_FILES) * 1e-6)


def test_cells_of_results_are_no_formulas() -> None:
    suite = load_suite("hits-81")
    row = {"answer": None, "ending": "no plan", "error": "=HYPERLINK(1)", "problem": 0}
    row |= {"planning_s": 1.0, "planning_cpu_s": 1.0}
    rows = {"=1+1": [row], "@x": [row], "plain": [row]}
    text = csv_text(Benchmark(suite, suite.problems(1)[0], None, rows))
    cells = [cell for line in csv.reader(text.splitlines()) for cell in line]
    assert not any(cell.startswith(("=", "+", "@", "-")) for cell in cells)
    assert {"'=1+1", "'@x", "plain", "'=HYPERLINK(1)"} <= set(cells)


def test_names_are_texts_in_reports_and_notebooks(tmp_path: Path) -> None:
    suite = load_suite("hits-81")
    row = {"answer": None, "ending": "failed", "error": CODE, "problem": 0}
    row |= {"planning_s": 1.0, "planning_cpu_s": 1.0}
    benchmark = Benchmark(suite, suite.problems(1)[0], None, {CODE: [row]})
    page = save_benchmark_report(benchmark, tmp_path / "report.html")
    plans = plans_of(stored_plan("transport"))
    scene = Scene(
        tuple(_named(each) for each in plans.scene.obstacles), plans.scene.poses
    )
    folder = make(tmp_path / "<script>alert(1)<")
    pages = {
        "report": page.read_text(encoding="utf-8"),
        "scene": scene._repr_html_(),
        "dataset": load_dataset(folder)._repr_html_(),
    }
    for name, text in pages.items():
        assert "<script" not in text, name
    assert "&lt;script&gt;alert(1)" in pages["report"]
    assert "&lt;script&gt;alert(1)" in pages["scene"]


def _named(obstacle: Obstacle) -> Obstacle:
    return replace(obstacle, name=CODE)
