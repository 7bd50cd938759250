"""Checks of folders that LeRobot's own library has written."""

import json
import multiprocessing
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.cli.main import main
from tests.addons.trajectories.test_check_episodes import (
    FPS,
    SO_JOINTS,
    STEP,
    in_degrees_from,
    jumped,
    motion,
    without_a_number,
)

pytest.importorskip("lerobot")

pytestmark = pytest.mark.slow

MAX_START_S = 120  # of a process that simulates an arm


def record(folder: Path, episodes: list[tuple[np.ndarray, np.ndarray]]) -> Path:
    """Write states and actions [rad] by LeRobot's own library."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = [f"{joint}.pos" for joint in SO_JOINTS]
    feature = {"dtype": "float32", "shape": (len(names),), "names": names}
    dataset = LeRobotDataset.create(
        "test/arm",
        FPS,
        {"observation.state": feature, "action": feature},
        root=folder,
        robot_type="so101_follower",
        use_videos=False,
    )
    for states, actions in episodes:
        for state, action in zip(states, actions, strict=True):
            dataset.add_frame(
                {
                    "observation.state": state.astype(np.float32),
                    "action": action.astype(np.float32),
                    "task": "move",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return folder


def check(capsys: pytest.CaptureFixture[str], folder: Path) -> tuple[int, Any]:
    code = main(["check-episodes", str(folder), "--unit", "rad", "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_planted_faults_are_found_in_a_folder_of_lerobot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    states = [motion(seed) for seed in range(12)]
    faults = {1: jumped, 4: in_degrees_from, 6: without_a_number}
    for index, fault in faults.items():
        states[index] = fault(states[index])
    folder = record(tmp_path / "set", [(q, q) for q in states])
    code, found = check(capsys, folder)
    assert code == 1
    assert found["arm"] == "so101"
    excluded = [e["episode"] for e in found["episodes"] if e["result"] == "EXCLUDE"]
    assert excluded == [str(index) for index in faults]
    assert found["counts"]["REVIEW"] == 0
    # LeRobot loads the episodes that are kept, by the option that the output names.
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    kept = [int(name) for name in found["kept"]]
    loaded = LeRobotDataset("test/arm", root=folder, episodes=kept)
    assert loaded.num_frames == sum(len(states[index]) for index in kept)


def simulate(position: Any, target: Any, done: Any, seed: int) -> None:
    """Run a servo arm of MuJoCo in real time; its leader jumps, and the arm touches the floor."""
    import mujoco

    from tests.addons.trajectories.test_check_episodes import (
        ARM_MODEL,
        MOTOR_SPEED,
        MOTOR_TORQUE,
    )

    damping, links, tail = MOTOR_TORQUE / MOTOR_SPEED, "", ""
    for index, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0")):
        links += (
            f'<body pos="0 0 {0.06 if index else 0.02}"><joint name="j{index}"'
            f' axis="{axis}" range="-100 100" damping="{damping}" armature="0.02"/>'
            '<geom type="capsule" fromto="0 0 0 0 0 .06" size=".02" mass=".12"/>'
        )
        tail += "</body>"
    motors = "".join(
        f'<position joint="j{k}" kp="20" forcerange="-{MOTOR_TORQUE} {MOTOR_TORQUE}"/>'
        for k in range(5)
    )
    text = ARM_MODEL.format(links=links + tail, motors=motors)
    model = mujoco.MjModel.from_xml_string(text)
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    play, half_gap = np.zeros(5), np.radians(0.5)
    start = time.perf_counter()
    while not done.value:
        if random.random() < 0.004:
            target[:] = random.uniform(-1.5, 1.5, 5)
        data.ctrl[:] = target[:]
        mujoco.mj_step(model, data)
        play = np.clip(play, data.qpos - half_gap, data.qpos + half_gap)
        position[:] = np.round(play / STEP) * STEP  # as the encoder reads it
        ahead = start + data.time - time.perf_counter()
        time.sleep(max(ahead, 0.0))
        # After a delay, the arm goes on in real time: it never catches up.
        start -= min(ahead, 0.0)


def busy(done: Any) -> None:
    """Load a processor core."""
    while not done.value:
        sum(range(10_000))


def recorded(seed: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Record an arm that another process simulates, by a loop that sleeps between frames, under load."""
    context = multiprocessing.get_context("spawn")
    position, target = context.Array("d", 5), context.Array("d", 5)
    done = context.Value("b", 0)
    workers = [context.Process(target=simulate, args=(position, target, done, seed))]
    workers += [context.Process(target=busy, args=(done,)) for _ in range(2)]
    for worker in workers:
        worker.start()
    states, actions = [], []
    try:
        # Under load a process takes seconds to start: until then the arm is frozen.
        ready = time.perf_counter() + MAX_START_S
        while not any(target[:]):
            assert time.perf_counter() < ready
            time.sleep(0.1)
        while len(states) < seconds * FPS:
            start = time.perf_counter()
            states.append(position[:])
            actions.append(target[:])
            time.sleep(max(1 / FPS - (time.perf_counter() - start), 0.0))
    finally:
        done.value = 1
        for worker in workers:
            worker.join(20)
    return np.array(states), np.array(actions)


def test_recordings_by_a_sleeping_loop_under_load_are_never_excluded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco")
    episodes = [recorded(seed, 8.0) for seed in range(4)]
    fastest = max(np.abs(np.diff(states, axis=0)).max() * FPS for states, _ in episodes)
    assert fastest > 1.0  # the arm moves fast
    code, found = check(capsys, record(tmp_path / "set", episodes))
    assert code == 0, found
    assert found["counts"]["EXCLUDE"] == 0
