"""Formats of other projects: what their readers find is the plan, and files of theirs are read."""

import json
import math
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy
import yaml

import cnpgen
from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.plans import Plans, save_plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.join import join_plans
from cnpgen.trajectories import load_trajectories
from tests.conftest import HANGING
from tests.plans.test_plans import draw_plans
from tests.refusals import is_refused

AIRHOCKEY = "airhockey"


@pytest.fixture
def plans() -> Plans:
    return draw_plans(n=3, sample_id=np.array([4, 7, 9]))


def test_the_goal_of_a_controller_is_yaml_of_a_trajectory(
    plans: Plans, tmp_path: Path
) -> None:
    exported = export_plans(plans, tmp_path / "goals", to="ros2-control", rate=100)
    goal = yaml.safe_load(exported.files[1].read_text(encoding="utf-8"))
    assert goal.keys() == {"trajectory"}
    assert goal["trajectory"]["joint_names"] == list(plans.problem.joint_names)
    point = goal["trajectory"]["points"][3]
    assert point.keys() == {
        "positions",
        "velocities",
        "accelerations",
        "time_from_start",
    }
    assert point["time_from_start"] == {"sec": 0, "nanosec": 30_000_000}
    states = plans.states_at(np.minimum(0.03, plans.duration))
    assert np.allclose(
        [point["positions"], point["velocities"]],
        [state[1] for state in states[:2]],
        atol=1e-9,
    )
    loaded = load_trajectories(tmp_path / "goals", AIRHOCKEY)
    assert len(loaded.trajectories) == 3
    assert np.allclose(loaded.trajectories[2].q[-1], plans.boundary.goal_q[2])


def test_a_rate_is_refused_for_splines(
    plans: Plans, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_plans(tmp_path / "plans.h5", plans)
    words = ["export", str(tmp_path / "plans.h5"), "-o", str(tmp_path / "x.hdf5")]
    assert main([*words, "--to", "mpd", "--rate", "100"]) == 2
    assert "--rate has no effect with --to mpd" in capsys.readouterr().err
    assert main([*words, "--to", "mpd"]) == 0
    assert "exported 3 plans\n" in capsys.readouterr().err


def test_path_splines_are_those_of_scipy(plans: Plans, tmp_path: Path) -> None:
    (path,) = export_plans(plans, tmp_path / "splines.hdf5", to="mpd").files
    with h5py.File(path) as file:
        assert file["task_id"][:].tolist() == [4, 7, 9]
        for k in range(3):
            knots, control = file["bspline_params_tt"][k], file["bspline_params_cc"][k]
            spline = scipy.interpolate.BSpline(
                knots, control.T, int(file["bspline_params_k"][k])
            )
            s = np.linspace(0, 1, 50)
            assert np.allclose(spline(s), plans.motion[[k]].at(s[None]).q[0], atol=1e-9)
            assert np.allclose(
                file["sol_path"][k][[0, -1]],
                [plans.boundary.start_q[k], plans.boundary.goal_q[k]],
            )
        assert np.allclose(file["duration"][:], plans.duration)
        assert file.attrs["joint_names"].tolist() == list(plans.problem.joint_names)


def test_joined_plans_have_no_single_spline(plans: Plans, tmp_path: Path) -> None:
    still = cnpgen.make_plans(
        plans.problem,
        plans.boundary,
        path_control_points=plans.path_control_points,
        rate_control_points=plans.rate_control_points,
    )
    with pytest.raises(UsageError):
        export_plans(join_plans(still, still, at=0.0), tmp_path / "x.hdf5", to="mpd")


def test_a_parquet_table_has_fixed_lists_and_reads_back(
    plans: Plans, tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    (path,) = export_plans(
        plans, tmp_path / "plans.parquet", to="parquet", rate=50
    ).files
    table = parquet.read_table(path)
    assert table.schema.field("q").type.list_size == len(plans.problem.joint_names)
    assert sorted(set(table.column("sample_id").to_pylist())) == [4, 7, 9]
    loaded = load_trajectories(path, AIRHOCKEY)
    assert len(loaded.trajectories) == 3
    for k, trajectory in enumerate(loaded.trajectories):
        assert trajectory.ddq is not None
        assert np.allclose(
            trajectory.q,
            plans.motion[[k]].at_times(trajectory.t[None]).q[0],
            atol=1e-12,
        )


@pytest.fixture
def dataset(plans: Plans, tmp_path: Path) -> Path:
    pytest.importorskip("pyarrow")
    (path,) = export_plans(plans, tmp_path / "dataset", to="lerobot", rate=50).files
    return path


def test_a_dataset_of_lerobot_has_the_published_layout(
    plans: Plans, dataset: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == (
        "v3.0",
        50,
        3,
    )
    frames = parquet.ParquetFile(
        dataset / info["data_path"].format(chunk_index=0, file_index=0)
    ).read()
    assert info["features"].keys() == set(frames.column_names)
    assert info["total_frames"] == len(frames)
    n, state = (
        len(plans.problem.joint_names),
        np.array(frames.column("observation.state").to_pylist()),
    )
    action, episode = (
        np.array(frames.column(name).to_pylist())
        for name in ("action", "episode_index")
    )
    environment = np.array(frames.column("observation.environment_state").to_pylist())
    names = info["features"]["observation.environment_state"]["names"]
    assert environment.shape[1] == len(names)
    for k in range(3):
        rows = episode == k
        t = np.arange(rows.sum()) / 50
        states = plans.motion[[k]].at_times(t[None])
        assert np.allclose(
            state[rows], np.concatenate([states.q[0], states.dq[0]], axis=1), atol=1e-5
        )
        assert np.allclose(action[rows][:-1], state[rows][1:, :n], atol=1e-6)
        assert np.allclose(action[rows][-1], plans.boundary.goal_q[k], atol=1e-6)
        assert np.allclose(
            environment[rows][0][:n], plans.boundary.goal_q[k], atol=1e-6
        )
    episodes = (
        parquet.ParquetFile(
            dataset / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
        )
        .read()
        .to_pylist()
    )
    assert [
        row["dataset_to_index"] - row["dataset_from_index"] for row in episodes
    ] == np.bincount(episode).tolist()
    stats = json.loads((dataset / "meta" / "stats.json").read_text())
    assert np.allclose(stats["action"]["mean"], action.mean(axis=0))
    assert np.allclose(
        stats["observation.state"]["q50"], np.quantile(state, 0.5, axis=0)
    )
    assert np.allclose(
        episodes[1]["stats/action/max"], action[episode == 1].max(axis=0)
    )


@pytest.mark.extended
def test_act_of_lerobot_trains_on_an_exported_dataset(
    dataset: Path, tmp_path: Path
) -> None:
    program = shutil.which(
        "lerobot-train"
    )  # of lerobot>=0.4, in an environment of its own
    if program is None:
        pytest.skip("lerobot-train is not on the PATH")
    options = {
        "dataset.repo_id": "lab/hits", "dataset.root": dataset, "output_dir": tmp_path / "out", "policy.type": "act",
        "policy.push_to_hub": "false", "policy.device": "cpu", "policy.chunk_size": 5, "policy.n_action_steps": 5,
        "policy.dim_model": 32, "policy.n_heads": 2, "policy.dim_feedforward": 64, "steps": 2, "log_freq": 1,
        "batch_size": 2, "num_workers": 0, "wandb.enable": "false", "eval_freq": 0, "save_checkpoint": "false",
        "policy.pretrained_backbone_weights": "null",
    }  # fmt: skip
    arguments = [program, *(f"--{name}={value}" for name, value in options.items())]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1"}
    result = subprocess.run(
        arguments,
        capture_output=True,
        text=True,
        env=environment,
        timeout=HANGING,
        check=False,
    )
    assert result.returncode == 0, result.stderr[-2000:]
    losses = [
        float(text)
        for text in re.findall(r"loss:([\d.]+)", result.stdout + result.stderr)
    ]
    assert len(losses) == 2
    assert all(map(math.isfinite, losses))


def test_a_dataset_of_lerobot_is_read(plans: Plans, dataset: Path) -> None:
    loaded = load_trajectories(dataset, AIRHOCKEY)
    assert [label.rsplit(": ", 1)[1] for label in loaded.labels] == [
        f"episode {k}" for k in range(3)
    ]
    for k, trajectory in enumerate(loaded.trajectories):
        assert trajectory.dq is not None
        assert np.allclose(
            trajectory.q, plans.motion[[k]].at_times(trajectory.t[None]).q[0], atol=1e-5
        )


def _set(info: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    return {**info, key: value}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("codebase_version", "v2.1", "expected v3.0"),
        ("features", {}, "does not describe"),
        ("features", 3, "describe"),
    ],
)
def test_other_datasets_of_lerobot_are_refused(
    dataset: Path, key: str, value: Any, message: str
) -> None:
    path = dataset / "meta" / "info.json"
    path.write_text(json.dumps(_set(json.loads(path.read_text()), key, value)))
    with pytest.raises(UsageError, match=message):
        load_trajectories(dataset, AIRHOCKEY)


@pytest.mark.parametrize(
    ("feature", "value", "message"),
    [
        ("observation.environment_state", "a text", "does not describe"),
        ("observation.state", {"names": ["a"]}, "does not describe"),
        ("observation.state", {"shape": [10**12]}, "does not describe"),
        (
            "observation.state",
            {"shape": [3], "names": ["a", "b", "c"]},
            "expected 3 numbers per row",
        ),
    ],
)
def test_damaged_features_of_lerobot_are_refused(
    dataset: Path, feature: str, value: Any, message: str
) -> None:
    path = dataset / "meta" / "info.json"
    info = json.loads(path.read_text())
    path.write_text(
        json.dumps(_set(info, "features", _set(info["features"], feature, value)))
    )
    with pytest.raises(UsageError, match=message):
        load_trajectories(dataset, AIRHOCKEY)


def test_frames_per_second_are_a_whole_number(plans: Plans, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with is_refused(UsageError, argument="rate"):
        export_plans(plans, tmp_path / "dataset", to="lerobot", rate=29.97)


def test_tables_of_parquet_and_hdf5_are_read(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    joints = [f"joint_{k}" for k in range(1, 7)]
    t, q = np.linspace(0, 1, 11), np.linspace(0, 1, 66).reshape(11, 6)
    columns = {
        "time": t,
        **{f"{joint}_position": q[:, k] for k, joint in enumerate(joints)},
        "gripper": np.ones(11),
    }
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    loaded = load_trajectories(tmp_path / "a.parquet", AIRHOCKEY)
    assert np.array_equal(loaded.trajectories[0].q, q)
    assert loaded.ignored == ("gripper",)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["t"], file["q"], file["dq"] = t, q, 2 * q
    trajectory = load_trajectories(tmp_path / "b.h5", AIRHOCKEY).trajectories[0]
    assert trajectory.dq is not None
    assert np.array_equal(trajectory.dq, 2 * q)
    (tmp_path / "c.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(UsageError, match=r"c.parquet is not a Parquet file, or is dam"):
        load_trajectories(tmp_path / "c.parquet", AIRHOCKEY)
