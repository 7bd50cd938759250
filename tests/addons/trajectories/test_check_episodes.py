"""Checks of recorded episodes: planted faults are found, healthy recordings pass, and only facts exclude."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.addons.trajectories.arm_registry import VENDOR, _registry, find_arm
from cnpgen.cli.main import main
from tests.refusals import assert_said

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

FPS = 30
COMMON_ARMS = (
    *("panda", "fr3", "ur3e", "ur5e", "ur10e", "ur16e", "ur20", "xarm6", "xarm7"),
    *("iiwa7", "iiwa14", "kinova_gen3", "viperx", "so100_follower", "so101"),
)
SO_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
STEP = 2 * np.pi / 4096


def write_lerobot(
    folder: Path,
    episodes: list[np.ndarray],
    actions: list[np.ndarray] | None = None,
    *,
    robot: str = "so101_follower",
    names: tuple[str, ...] = SO_JOINTS,
    times: list[np.ndarray] | None = None,
) -> Path:
    """Write a dataset of LeRobot v3 with one file of frames, as LeRobot lays it out."""
    count = len(names)
    features: dict[str, Any] = {
        key: {
            "dtype": "float32",
            "shape": [count],
            "names": [f"{n}.pos" for n in names],
        }
        for key in ("observation.state", "action")
    }
    info = {
        "codebase_version": "v3.0",
        "robot_type": robot,
        "fps": FPS,
        "total_episodes": len(episodes),
        "features": features,
    }
    (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    frames = [np.arange(len(q)) for q in episodes]
    table = {
        "timestamp": np.concatenate(times or [f / FPS for f in frames]).astype(
            np.float32
        ),
        "frame_index": np.concatenate(frames),
        "episode_index": np.repeat(range(len(episodes)), [len(q) for q in episodes]),
    }
    for key, values in (
        ("observation.state", episodes),
        ("action", actions or episodes),
    ):
        rows = np.concatenate(values).astype(np.float32)
        table[key] = pyarrow.FixedSizeListArray.from_arrays(rows.ravel(), count)
    parquet.write_table(
        pyarrow.table(table), folder / "data" / "chunk-000" / "file-000.parquet"
    )
    lengths = {
        "episode_index": list(range(len(episodes))),
        "length": [len(q) for q in episodes],
        "tasks": [["move"]] * len(episodes),
    }
    # LeRobot writes a row group per ten episodes.
    parquet.write_table(
        pyarrow.table(lengths),
        folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet",
        row_group_size=10,
    )
    return folder


def motion(seed: int, joints: int = 5, seconds: float = 6.0) -> np.ndarray:
    """Return a motion of at most 1.5 rad/s at the frames [rad], with encoder steps."""
    random = np.random.default_rng(seed)
    t = np.arange(int(seconds * FPS)) / FPS
    rates = random.uniform(0.5, 2.0, joints)
    q = 1.5 / rates * np.sin(rates * t[:, None] + random.uniform(0, 6, joints)) * 0.7
    return np.asarray(np.round(q / STEP) * STEP)


def check(capsys: pytest.CaptureFixture[str], *words: Any) -> tuple[int, Any]:
    code = main(["check-episodes", *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out)


def jumped(q: np.ndarray) -> np.ndarray:
    q = q.copy()
    q[90, 1] += 2.0
    return q


def in_degrees_from(q: np.ndarray) -> np.ndarray:
    return np.asarray(np.where(np.arange(len(q))[:, None] >= 90, np.degrees(q), q))


def without_a_number(q: np.ndarray) -> np.ndarray:
    q = q.copy()
    q[50, 2] = np.nan
    return q


@pytest.mark.parametrize(
    ("fault", "check_name", "joint"),
    [
        (jumped, "velocity", "shoulder_lift"),
        (in_degrees_from, "velocity", None),
        (without_a_number, "numbers", "elbow_flex.pos"),
    ],
)
def test_planted_faults_exclude_their_episodes_alone(
    fault: Any,
    check_name: str,
    joint: str | None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    episodes = [motion(seed) for seed in range(20)]
    for index in range(0, 20, 4):
        episodes[index] = fault(episodes[index])
    folder = write_lerobot(tmp_path / "set", episodes)
    code, found = check(capsys, folder, "--unit", "rad")
    assert code == 1
    assert found["counts"] == {"PASS": 15, "REVIEW": 0, "EXCLUDE": 5}
    assert found["kept"] == [str(k) for k in range(20) if k % 4]
    first = found["episodes"][0]["findings"][0]
    assert first["check"] == check_name
    assert joint is None or first["joint"] == joint
    assert main(["check-episodes", str(folder), "--unit", "rad"]) == 1
    out = capsys.readouterr().out
    assert "--dataset.episodes='[1, 2, 3, 5" in out
    assert "delete_episodes --operation.episode_indices '[0, 4, 8, 12, 16]'" in out
    assert "limits of so101: vendor" in out


def test_without_a_unit_only_checks_without_units_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_lerobot(tmp_path / "set", [jumped(motion(0))])
    code, found = check(capsys, folder)
    assert code == 0
    assert "unit" in found["episodes"][0]["not_run"]["limits"]
    assert "not recorded" in found["episodes"][0]["not_run"]["clock"]
    assert main(["check-episodes", str(folder)]) == 0
    assert "set: 1 episode: 1 PASS" in capsys.readouterr().out


def test_a_calibration_gives_normalized_values_their_scale(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    q, half = jumped(motion(0)), 1000 * STEP  # -100 to 100 are 2000 steps
    folder = write_lerobot(tmp_path / "set", [100 * q / half])
    ranges = {joint: {"range_min": 1048, "range_max": 3048} for joint in SO_JOINTS}
    path = tmp_path / "arm.json"
    path.write_text(json.dumps(ranges))
    code, found = check(capsys, folder, "--calibration", path)
    assert code == 1
    assert found["episodes"][0]["findings"][0]["joint"] == "shoulder_lift"
    path.write_text(json.dumps(ranges | {"wrist_roll": {"range_min": 5}}))
    assert main(["check-episodes", str(folder), "--calibration", str(path)]) == 2
    assert_said(capsys.readouterr().err)


def test_rounding_alone_is_for_review_and_a_stated_noise_excludes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = find_arm("panda")
    q = motion(3, joints=7) + np.array([0, 0, 0, -1.5, 0, 1.8, 0])
    q[60, 0] += 0.8
    folder = write_lerobot(tmp_path / "set", [q], robot="franka", names=arm.joints)
    code, found = check(capsys, folder)
    assert (code, found["episodes"][0]["result"]) == (0, "REVIEW")
    assert "rounding alone" in found["episodes"][0]["findings"][0]["basis"]
    code, found = check(capsys, folder, "--noise", "1e-3")
    assert (code, found["episodes"][0]["result"]) == (1, "EXCLUDE")
    levels = {f["check"]: f["level"] for f in found["episodes"][0]["findings"]}
    assert levels["velocity"] == "EXCLUDE"
    assert levels.get("acceleration", "REVIEW") == "REVIEW"


def test_a_step_that_a_late_frame_explains_is_for_review(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    q = motion(0)
    q[90:, 1] += (
        0.6  # 18 rad/s by the nominal times, 2.4 rad/s with a frame that is late
    )
    t = np.arange(len(q)) / FPS + np.random.default_rng(0).uniform(0, 1e-3, len(q))
    for times, result in ((None, "REVIEW"), ([t], "EXCLUDE")):
        folder = write_lerobot(tmp_path / result, [q], times=times)
        _, found = check(capsys, folder, "--unit", "rad")
        assert found["episodes"][0]["result"] == result
    _, found = check(
        capsys, tmp_path / "REVIEW", "--unit", "rad", "--time-jitter", "0.01"
    )
    assert found["episodes"][0]["result"] == "EXCLUDE"  # by a stated jitter


def test_a_fast_part_of_many_frames_is_for_review_with_nominal_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    q = np.zeros((180, 5))
    # 6 rad/s for half a second: within the limit of 4.7 if every second frame is late.
    q[:, 2] = 6.0 * np.clip(np.arange(180) / FPS - 2.0, 0, 0.5)
    folder = write_lerobot(tmp_path / "set", [q])
    code, found = check(capsys, folder, "--unit", "rad")
    assert code == 0
    (finding,) = [
        each for each in found["episodes"][0]["findings"] if each["check"] == "velocity"
    ]
    assert finding["level"] == "REVIEW"
    assert finding["joint"] == "elbow_flex"


def test_actions_never_exclude_for_their_derivatives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    targets = np.where(np.arange(180)[:, None] % 30 < 15, -1.5, 1.5) * np.ones(5)
    folder = write_lerobot(tmp_path / "set", [motion(0)], [targets])
    code, found = check(capsys, folder, "--unit", "rad")
    assert (code, found["counts"]["PASS"]) == (0, 1)


def test_times_that_go_back_and_a_frozen_state_are_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t = np.arange(180) / FPS + np.random.default_rng(0).uniform(0, 5e-3, 180)
    back = t.copy()
    back[100] = back[98]
    still = motion(1)
    still[60:] = still[60]
    folder = write_lerobot(
        tmp_path / "set", [motion(0), still], [motion(0), motion(1)], times=[back, t]
    )
    code, found = check(capsys, folder, "--unit", "rad")
    assert code == 1
    first, second = found["episodes"]
    assert first["findings"][0]["check"] == "times"
    assert "frozen" in {finding["check"] for finding in second["findings"]}
    assert second["result"] == "REVIEW"
    assert "clock" not in second["not_run"]


def test_episodes_of_hdf5_and_csv_are_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    h5py = pytest.importorskip("h5py")
    arm = find_arm("panda")
    good = motion(3, joints=7) + np.array([0, 0, 0, -1.5, 0, 1.8, 0])
    bad = good.copy()
    bad[60, 4] += 0.8
    path = tmp_path / "demo.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": FPS}})
        for index, q in enumerate((good, bad)):
            data[f"demo_{index}/obs/robot0_joint_pos"] = q
    joints = ",".join(map(str, range(7)))
    words = "--arm", "panda", "--noise", "1e-3"
    code, found = check(capsys, path, *words, "--joints", joints)
    assert code == 1
    assert [episode["result"] for episode in found["episodes"]] == ["PASS", "EXCLUDE"]
    assert found["episodes"][1]["findings"][0]["joint"] == "joint5"
    assert main(["check-episodes", str(path), "--key", "obs/none"]) == 2
    assert_said(capsys.readouterr().err)
    folder = tmp_path / "tables"
    folder.mkdir()
    for name, q in (("a", good), ("b", bad)):
        table = np.column_stack([np.arange(len(q)) / FPS, q])
        head = ",".join(["t", *arm.joints])
        np.savetxt(
            folder / f"{name}.csv", table, delimiter=",", header=head, comments=""
        )
    code, found = check(capsys, folder, *words)
    assert [episode["result"] for episode in found["episodes"]] == ["PASS", "EXCLUDE"]
    code, found = check(capsys, folder, *words, "--episodes", "0")
    assert (code, len(found["episodes"])) == (0, 1)
    assert main(["check-episodes", str(folder), *words, "--episodes", "7"]) == 2
    assert_said(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["nowhere/at-all"], "is not there"),
        (["FOLDER", "--arm", "pandaa"], "is not a known arm"),
        (["FOLDER", "--joints", "1,2"], "must have 5 names"),
        (["FOLDER", "--unit", "rad", "--joints", "a,b,c,d,e"], "there is no joint 'a'"),
        (["FOLDER", "--noise", "1,2,3"], "one number"),
        (["FOLDER", "--episodes", "a"], "must be numbers"),
    ],
)
def test_wrong_arguments_are_refused(
    words: list[str],
    text: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = write_lerobot(tmp_path / "set", [motion(0)])
    chosen = [str(folder) if word == "FOLDER" else word for word in words]
    assert main(["check-episodes", *chosen]) == 2
    assert text in capsys.readouterr().err


def test_a_damaged_description_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_lerobot(tmp_path / "set", [motion(0)])
    (folder / "meta" / "info.json").write_text("{}")
    assert main(["check-episodes", str(folder)]) == 2
    assert_said(capsys.readouterr().err)


def test_every_limit_of_the_registry_has_a_basis_and_a_source() -> None:
    for name, data in _registry().items():
        arm = find_arm(name)
        assert arm.limits, name
        for limit in arm.limits.values():
            assert limit.basis in {VENDOR, "urdf"}
            assert len(limit.source) > 20
            assert limit.lower.shape == limit.upper.shape == (len(arm.joints),)
            assert (limit.lower < limit.upper).all()
        assert (arm.noise is None) == (not arm.noise_source)
        assert name in data["names"]


ARM_MODEL = """
<mujoco><option timestep="0.002"/><worldbody>
<geom type="plane" size="2 2 .1" pos="0 0 -0.05"/>{links}</worldbody>
<actuator>{motors}</actuator></mujoco>
"""
MOTOR_TORQUE, MOTOR_SPEED = 3.0, 4.5  # N m at rest, and no-load speed [rad/s]


def recorded_arm(seed: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Simulate a servo arm that follows jumping targets, and record it as a loaded program does.

    The recorder sleeps between frames and is late by exponential times; servos have
    backlash and encoder steps; the arm touches the floor.
    """
    mujoco = pytest.importorskip("mujoco")
    axes, links, tail = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0"), "", ""
    for index, axis in enumerate(axes):
        links += (
            f'<body pos="0 0 {0.06 if index else 0.02}"><joint name="j{index}" axis="{axis}" '
            f'range="-100 100" damping="{MOTOR_TORQUE / MOTOR_SPEED}" armature="0.02"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 .06" size=".02" mass=".12"/>'
        )
        tail += "</body>"
    motors = "".join(
        f'<position joint="j{k}" kp="20" forcerange="-{MOTOR_TORQUE} {MOTOR_TORQUE}"/>'
        for k in range(5)
    )
    model = mujoco.MjModel.from_xml_string(
        ARM_MODEL.format(links=links + tail, motors=motors)
    )
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    states, actions, play = [], [], np.zeros(5)
    due, target = 0.0, np.zeros(5)
    while len(states) < seconds * FPS:
        if random.random() < 0.004:
            target = random.uniform(-1.5, 1.5, 5)
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
        half_gap = np.radians(0.5)  # of the gears, on either side of the encoder
        play = np.clip(play, data.qpos - half_gap, data.qpos + half_gap)
        if data.time >= due:
            states.append(np.round(play / STEP) * STEP)
            actions.append(target.copy())
            late = min(random.exponential(2e-3), 12e-3)
            due = max(due + 1 / FPS, data.time) if late < 8e-3 else data.time + 1 / FPS
            due += 0.2 * late
    return np.array(states), np.array(actions)


@pytest.mark.slow
def test_healthy_recordings_of_a_simulated_arm_are_never_excluded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    recorded = [recorded_arm(seed, 10.0) for seed in range(12)]
    states, actions = ([pair[k] for pair in recorded] for k in range(2))
    fastest = max(float(np.abs(np.diff(q, axis=0)).max()) * FPS for q in states)
    assert fastest > 1.0  # the arm moves fast
    folder = write_lerobot(tmp_path / "set", states, actions)
    code, found = check(capsys, folder, "--unit", "rad")
    assert code == 0, found
    assert found["counts"]["EXCLUDE"] == 0


@pytest.mark.parametrize("name", COMMON_ARMS)
def test_all_common_arms_are_known_and_limit_velocities(name: str) -> None:
    arm = find_arm(name)
    limit = arm.limits["velocity"]
    # Outside, a unit was mistaken.
    assert (limit.upper > 1.2).all()
    assert (limit.upper < 7).all()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--unit", "deg"], "--unit is for columns without a unit"),
        (["--rate", "10"], "--rate is for data without times"),
        (["--key", "q"], "--key is for HDF5 files"),
        (["--calibration", "a.json", "--unit", "deg"], "--unit is not for values"),
    ],
)
def test_names_and_units_in_the_heads_of_tables_are_read(
    tmp_path: Path, options: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    t = np.linspace(0, 2, 201)
    q = np.rad2deg(0.2 * np.sin(t)[:, None] + np.array([0, 0, 0, -2, 0, 2, 0.8]))
    head = ["t [ms]", *(f"q panda_joint{k} [deg]" for k in range(1, 8))]
    rows = np.column_stack([1e3 * t, q, np.full_like(q, 9)])
    head += [f"dq panda_joint{k} [deg/s]" for k in range(1, 8)]
    folder = tmp_path / "csv"
    folder.mkdir()
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (folder / "a.csv").write_text("\n".join([",".join(head), *lines]))
    words = ["check-episodes", str(folder), "--arm", "panda"]
    assert main(words) == 0
    assert "1 PASS, 0 REVIEW, 0 EXCLUDE" in capsys.readouterr().out
    assert main([*words, *options]) == 2
    assert text in capsys.readouterr().err
    (folder / "a.csv").write_text(
        "\n".join([",".join(head).replace("deg", "rad"), *lines])
    )
    main(words)
    assert "joint4: at most -115 rad" in capsys.readouterr().out
    (folder / "a.csv").write_text(
        "\n".join([",".join(head).replace("[deg]", "[furlong]"), *lines])
    )
    assert main(words) == 2
    assert_said(capsys.readouterr().err)


def test_options_of_an_arm_need_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.csv").write_text("t,a\n0,0\n1,0\n2,0\n")
    assert main(["check-episodes", str(tmp_path), "--joints", "a"]) == 2
    assert "--joints needs --arm" in capsys.readouterr().err
