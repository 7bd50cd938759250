"""``cnpgen export``: what is written can be read back, what cannot be written is named, nothing is overwritten."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.cli.main import main
from cnpgen.plans import PlanStatus, save_plans
from cnpgen.robots.obstacle import Obstacle
from cnpgen.scenes import SceneProblem, scene_plans
from tests.examples.plan_files import garbage, plans_of
from tests.examples.plans import load
from tests.examples.shaped_robot import SELF, write_problem
from tests.plans.test_plans import draw_plans

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Run:
    """Run ``cnpgen export`` in an empty folder and return (exit code, stdout, stderr)."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")

    def call(*words: Any) -> tuple[int, str, str]:
        code = main(["export", *map(str, words)])
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def hits(tmp_path: Path) -> Path:
    save_plans(
        tmp_path / "hits.h5", plans_of(*[load("hit")] * 4, sample_id=[10, 11, 12, 11])
    )
    return tmp_path / "hits.h5"


def test_an_unknown_format_is_refused_with_all_known_ones(run: Run, hits: Path) -> None:
    code, _, err = run(hits, "--to", "cvs")
    assert code == 2
    assert (
        "unknown exporter 'cvs' (did you mean 'csv'?); known: npz, csv, joint-trajectory"
        in err
    )


def test_an_archive_is_named_after_the_file_and_its_name_is_the_output(
    run: Run, hits: Path
) -> None:
    code, out, err = run(hits, "--to", "npz", "--rate", "100Hz")
    assert (code, out) == (0, "hits.npz\n")
    assert err == "exported 4 plans at 100 Hz\n"
    with np.load("hits.npz") as data:
        assert data["plan"].tolist() == [0, 1, 2, 3]
        np.testing.assert_allclose(np.diff(data["plan_00000_t"])[:-1], 0.01)
        np.testing.assert_allclose(
            data["plan_00003_q"][-1], load("hit").boundary.goal_q[0], atol=1e-12
        )


def test_a_message_is_what_ros_expects_of_a_joint_trajectory(
    run: Run, hits: Path
) -> None:
    plan = load("hit")
    code, out, _ = run(hits, "--to", "joint-trajectory", "--rate", 250, "--plan", "1")
    assert (code, out) == (0, "hits-joint-trajectory\n")
    (path,) = Path("hits-joint-trajectory").glob("*.json")
    assert path.name == "plan_00001.json"
    message = json.loads(path.read_text(encoding="utf-8"))
    assert message["joint_names"] == list(plan.problem.robot.joints)
    points = message["points"]
    assert all(
        len(point["positions"])
        == len(point["velocities"])
        == len(point["accelerations"])
        == 6
        for point in points
    )
    assert points[0]["time_from_start"] == {"sec": 0, "nanosec": 0}
    assert points[1]["time_from_start"] == {"sec": 0, "nanosec": 4_000_000}
    last = points[-1]["time_from_start"]
    assert last["sec"] + 1e-9 * last["nanosec"] == pytest.approx(
        plan.motion.duration()[0], abs=1e-9
    )
    np.testing.assert_allclose(
        points[-1]["velocities"], plan.boundary.goal_dq[0], atol=1e-9
    )


def test_plans_are_chosen_by_index_or_by_sample(run: Run, hits: Path) -> None:
    assert run(hits, "--to", "csv", "-o", "a", "--plan", "0,2-3")[0] == 0
    assert sorted(path.name for path in Path("a").glob("*.csv")) == [
        f"plan_0000{index}.csv" for index in (0, 2, 3)
    ]
    assert run(hits, "--to", "csv", "-o", "b", "--sample", "11")[0] == 0
    assert sorted(path.name for path in Path("b").glob("*.csv")) == [
        "plan_00001.csv",
        "plan_00003.csv",
    ]
    assert run(hits, "--to", "csv", "-o", "c", "--sample", "10", "--plan", "3")[0] == 0
    assert sorted(path.name for path in Path("c").glob("*.csv")) == [
        "plan_00000.csv",
        "plan_00003.csv",
    ]


def test_what_is_there_is_replaced_only_by_force(run: Run, hits: Path) -> None:
    for form, out in (("npz", "x.npz"), ("csv", "x")):
        words = (hits, "--to", form, "-o", out, "--plan", 0)
        assert run(*words)[0] == 0
        before = [
            path.read_bytes() for path in sorted(Path().rglob("*")) if path.is_file()
        ]
        code, _, err = run(*words, "--rate", 10)
        assert code == 2
        assert err == (
            f"cnpgen: error: {out} exists: --force replaces it, -o names another file"
            " (it is of another request, or was changed since)\n"
        )
        assert [
            path.read_bytes() for path in sorted(Path().rglob("*")) if path.is_file()
        ] == before
        code, text, err = run(*words)  # a repeated job
        assert (code, text) == (0, f"{out}\n")
        assert err == f"{out} is there already, of the same request\n"
        assert run(*words, "--rate", 10, "--force")[0] == 0
        assert [
            path.read_bytes() for path in sorted(Path().rglob("*")) if path.is_file()
        ] != before


def test_a_plan_that_is_not_there_is_named_before_the_place_is_looked_at(
    run: Run, hits: Path
) -> None:
    assert run(hits, "--to", "csv", "--plan", 0)[0] == 0
    assert run(hits, "--to", "joint-trajectory", "--plan", 0)[0] == 0  # elsewhere
    code, _, err = run(hits, "--to", "csv", "--plan", "0,7")
    assert (code, err) == (
        2,
        "cnpgen: error: there is no plan 7: 4 plans, numbered from 0\n",
    )


def test_plans_that_are_known_not_to_be_valid_are_exported_with_a_warning(
    run: Run, tmp_path: Path
) -> None:
    plans = draw_plans(n=14)
    status = np.where(np.arange(14) == 3, PlanStatus.VALID, PlanStatus.INVALID).astype(
        np.uint8
    )
    save_plans(tmp_path / "bad.h5", replace(plans, status=status))
    code, _, err = run(tmp_path / "bad.h5", "--to", "npz", "--rate", 50)
    text = "not valid by their status ('cnpgen evaluate' reports why): plans 0, 1, 2, 4, 5, 6, 7, 8, 9, 10 and 3 more"
    assert (code, err.splitlines()[0]) == (0, f"cnpgen: warning: {text}")
    _, _, err = run(
        tmp_path / "bad.h5", "--to", "npz", "--rate", 50, "--plan", "3", "--force"
    )
    assert "warning" not in err


def test_plans_with_their_own_obstacles_are_exported_with_a_note(
    run: Run, hits: Path, tmp_path: Path
) -> None:
    problem = cnpgen.load_problem(write_problem(tmp_path, obstacles="", more=SELF))
    ball = Obstacle(name="ball", kind="sphere", position=(-0.5, -0.3, 0.5), radius=0.1)
    scene = SceneProblem(
        name="one", obstacles=(ball,), start_q=np.zeros(4), goal_q=np.full((1, 4), 0.1)
    )
    plans = scene_plans(problem, [scene])
    plans.path_control_points[:], plans.rate_control_points[:] = 0.0, 1.0
    save_plans(tmp_path / "scenes.h5", plans)
    note = "the output lacks the obstacles of the plans"
    assert note in run(tmp_path / "scenes.h5", "--to", "csv", "-o", tmp_path / "out")[2]
    assert note not in run(hits, "--to", "csv", "-o", tmp_path / "hits")[2]


def test_a_place_in_a_folder_that_does_not_exist_is_refused(
    run: Run, hits: Path
) -> None:
    code, _, err = run(hits, "--to", "npz", "-o", "no/where.npz")
    assert (code, err) == (
        2,
        f"cnpgen: error: {Path('no/where.npz')} must be in a folder that exists\n",
    )
    assert not Path("no").exists()


def test_a_file_without_the_suffix_of_its_format_is_refused(
    run: Run, hits: Path
) -> None:
    code, _, err = run(hits, "--to", "npz", "-o", "out")
    assert code == 2
    assert "expected out.npz" in err
    assert not Path("out").exists()


def test_an_empty_folder_is_free(run: Run, hits: Path) -> None:
    Path("empty").mkdir()
    assert run(hits, "--to", "csv", "-o", "empty", "--plan", 0)[0] == 0
    code, out, _ = run(hits, "--to", "npz", "-o", "empty", "--plan", 0)
    assert (code, out) == (0, f"{Path('empty') / 'plans.npz'}\n")


def test_plans_that_cannot_be_sampled_are_named_and_the_others_written(
    run: Run, tmp_path: Path
) -> None:
    cases = garbage()
    save_plans(tmp_path / "garbage.h5", plans_of(*(plan for plan, _ in cases.values())))
    code, out, err = run(tmp_path / "garbage.h5", "--to", "csv", "--rate", 50)
    assert (code, out) == (1, "garbage-csv\n")
    *left_out, last = err.splitlines()
    assert (
        "cnpgen: left out: plan 1 (sample 1): a boundary condition or a control point is not a finite number"
        in left_out
    )
    assert (
        "cnpgen: left out: plan 2 (sample 2): the rate ds/dt is not positive throughout"
        in err
    )
    assert (
        last == f"exported {len(cases) - len(left_out)} plans of {len(cases)} at 50 Hz"
    )
    written = {path.name for path in Path("garbage-csv").glob("*.csv")}
    assert {"plan_00000.csv", "plan_00009.csv", "plan_00010.csv"} <= written
    assert len(written) == len(cases) - len(left_out)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "--to"),
        (
            ("--to", "yaml"),
            "unknown exporter 'yaml'; known: npz, csv, joint-trajectory",
        ),
        (
            ("--to", "csv", "--rate", "0"),
            "expected a rate above 0, such as 1000 or 1000Hz; got '0'",
        ),
        (("--to", "csv", "--rate", "1ms"), "expected a rate above 0"),
        (("--to", "csv", "--rate", "1e7"), "at most 1e+06 Hz"),
        (
            ("--to", "csv", "--plan", "3-1"),
            "expected whole numbers such as 0,3,10-12; got '3-1'",
        ),
        (("--to", "csv", "--plan", "one"), "expected whole numbers"),
        (
            ("--to", "csv", "--plan", "4"),
            "there is no plan 4: 4 plans, numbered from 0",
        ),
        (("--to", "csv", "--sample", "3"), "has no plan of sample 3"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(
    run: Run, hits: Path, words: tuple[str, ...], message: str
) -> None:
    code, out, err = run(hits, *words)
    assert (code, out) == (2, "")
    assert message in err
    assert len(err.splitlines()) == 1
    assert list(Path().iterdir()) == []


def test_a_damaged_file_is_one_line(run: Run, hits: Path) -> None:
    hits.write_bytes(hits.read_bytes()[:3000])
    code, out, err = run(hits, "--to", "npz")
    assert (code, out) == (1, "")
    assert "damaged or cut off" in err
    assert len(err.splitlines()) == 1


def test_a_folder_has_the_plans_of_one_export(run: Run, hits: Path) -> None:
    assert run(hits, "--to", "csv", "-o", "out")[0] == 0
    assert len(list(Path("out").glob("plan_*.csv"))) > 1
    assert run(hits, "--to", "csv", "-o", "out", "--plan", "0", "--force")[0] == 0
    assert [path.name for path in Path("out").glob("plan_*")] == ["plan_00000.csv"]
