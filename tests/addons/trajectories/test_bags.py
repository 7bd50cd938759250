"""Bags of ROS that rosbags writes: joint states, trajectories and goals are read back, or refused by name."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.cli.main import main
from cnpgen.errors import UsageError
from cnpgen.trajectories import LoadOptions, load_trajectories
from tests.addons.trajectories.test_table_columns import BACKWARDS, DQ, Q, T
from tests.refusals import is_refused

rosbag2 = pytest.importorskip("rosbags.rosbag2")
rosbag1 = pytest.importorskip("rosbags.rosbag1")
typesys = pytest.importorskip("rosbags.typesys")

STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
STORE1 = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
STATES, PLAN = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"
FIRST_NS = 1_700_000_000_123_456_789
STORAGES = {"mcap": "MCAP", "db3": "SQLITE3"}

Messages = dict[str, tuple[str, list[Any]]]  # topic -> type and messages


def of(kind: str, **values: Any) -> Any:
    return STORE.types[kind](**values)


def header(nanoseconds: int) -> Any:
    sec, nanosec = divmod(nanoseconds, 10**9)
    stamp = of("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return of("std_msgs/msg/Header", stamp=stamp, frame_id="")


def states(orders: Sequence[Sequence[int]]) -> tuple[str, list[Any]]:
    """Joint states at T whose joints have another order in every message."""
    messages = [
        of(
            STATES,
            header=header(FIRST_NS + round(1e9 * T[k])),
            name=[f"joint_{i + 1}" for i in order],
            position=Q[k, list(order)],
            velocity=DQ[k, list(order)],
            effort=np.array([]),
        )
        for k, order in enumerate(orders)
    ]
    return STATES, messages


def trajectory(q: np.ndarray = Q) -> Any:
    points = [
        of(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            positions=q[k, ::-1].copy(),
            velocities=DQ[k, ::-1].copy(),
            accelerations=np.array([]),
            effort=np.array([]),
            time_from_start=of(
                "builtin_interfaces/msg/Duration", sec=0, nanosec=round(1e9 * T[k])
            ),
        )
        for k in range(len(T))
    ]
    return of(PLAN, header=header(0), joint_names=BACKWARDS, points=points)


def write(path: Path, topics: Messages, storage: str) -> Path:
    """Write a bag whose messages arrive 3 ms late."""
    plugin = rosbag2.StoragePlugin[STORAGES[storage]]
    with rosbag2.Writer(path, version=9, storage_plugin=plugin) as bag:
        for topic, (kind, messages) in topics.items():
            connection = bag.add_connection(topic, kind, typestore=STORE)
            for k, message in enumerate(messages):
                arrival = FIRST_NS + 3_000_000 + k * 11_000_000
                bag.write(connection, arrival, STORE.serialize_cdr(message, kind))
    return path


def shuffled() -> list[list[int]]:
    random = np.random.default_rng(3)
    return [random.permutation(6).tolist() for _ in T]


@pytest.mark.parametrize("storage", STORAGES)
def test_joint_states_have_their_stamps_and_any_order_of_joints(
    tmp_path: Path, storage: str
) -> None:
    folder = write(tmp_path / "bag", {"/joint_states": states(shuffled())}, storage)
    (file,) = folder.glob(f"*.{storage}")
    for path in (folder, file):
        (found,) = load_trajectories(path, "airhockey").trajectories
        assert np.allclose(found.t, T, rtol=0, atol=1e-12)
        assert np.array_equal(found.q, Q)
        assert np.array_equal(found.dq, DQ)


@pytest.mark.parametrize("storage", STORAGES)
def test_every_message_of_a_trajectory_is_one(tmp_path: Path, storage: str) -> None:
    messages = PLAN, [trajectory(), trajectory(Q + 0.01)]
    path = write(tmp_path / "bag", {"/plan": messages}, storage)
    loaded = load_trajectories(path, "airhockey")
    assert [label.rpartition(" ")[2] for label in loaded.labels] == ["[0]", "[1]"]
    first, second = loaded.trajectories
    assert np.array_equal(first.q, Q)
    assert np.array_equal(first.dq, DQ)
    assert np.array_equal(second.q, Q + 0.01)


def test_one_of_several_topics_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    topics = {"/joint_states": states(shuffled()), "/plan": (PLAN, [trajectory()])}
    path = write(tmp_path / "bag", topics, "mcap")
    with is_refused(UsageError, argument="topic"):
        load_trajectories(path, "airhockey")
    with is_refused(UsageError, argument="topic"):
        load_trajectories(path, "airhockey", options=LoadOptions(topic="/plam"))
    np.savez(tmp_path / "rows.npz", t=T, q=Q)
    with is_refused(UsageError, argument="topic"):
        load_trajectories(
            tmp_path / "rows.npz", "airhockey", options=LoadOptions(topic="/plan")
        )
    given = ["--problem", "airhockey", "--topic", "/plan"]
    assert main(["evaluate", str(path), *given]) in {0, 1}
    assert "not used: topic /joint_states" in capsys.readouterr().err


def test_bags_without_trajectories_or_times_are_refused(tmp_path: Path) -> None:
    text = of("std_msgs/msg/String", data="x")
    path = write(tmp_path / "a", {"/text": ("std_msgs/msg/String", [text])}, "mcap")
    with is_refused(UsageError, argument="path"):
        load_trajectories(path, "airhockey")
    kind, messages = states(shuffled())
    for message in messages:
        message.header.stamp.sec = message.header.stamp.nanosec = 0
    path = write(tmp_path / "b", {"/joint_states": (kind, messages)}, "db3")
    with is_refused(UsageError, argument="path"):
        load_trajectories(path, "airhockey")
    (tmp_path / "damaged.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(UsageError, match=r"damaged.mcap is not a bag, or is damaged: "):
        load_trajectories(tmp_path / "damaged.mcap", "airhockey")


def test_a_bag_has_as_many_messages_as_it_states(tmp_path: Path) -> None:
    path = write(tmp_path / "a", {"/plan": (PLAN, [trajectory()])}, "mcap")
    metadata = path / "metadata.yaml"
    text = metadata.read_text()
    assert "message_count: 1\n" in text
    metadata.write_text(text.replace("message_count: 1\n", "message_count: 2\n"))
    with is_refused(UsageError, argument="path"):
        load_trajectories(path, "airhockey")


def test_bags_of_ros_1_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    with rosbag1.Writer(path) as bag:
        connection = bag.add_connection("/joint_states", STATES, typestore=STORE1)
        for k in range(len(T)):
            sec, nanosec = divmod(FIRST_NS + round(1e9 * T[k]), 10**9)
            message = STORE1.types[STATES](
                header=STORE1.types["std_msgs/msg/Header"](
                    seq=k,
                    stamp=STORE1.types["builtin_interfaces/msg/Time"](
                        sec=sec, nanosec=nanosec
                    ),
                    frame_id="",
                ),
                name=BACKWARDS,
                position=Q[k, ::-1].copy(),
                velocity=DQ[k, ::-1].copy(),
                effort=np.array([]),
            )
            content = STORE1.serialize_ros1(message, STATES)
            bag.write(connection, FIRST_NS + k, content)
    (found,) = load_trajectories(path, "airhockey").trajectories
    assert np.array_equal(found.q, Q)
    assert np.allclose(found.t, T, rtol=0, atol=1e-12)


GOAL = """
control_msgs/JointTolerance[] path_tolerance
trajectory_msgs/JointTrajectory trajectory
builtin_interfaces/Duration goal_time_tolerance
"""
TOLERANCE = "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"


def test_goals_of_actions_are_read_and_their_tolerances_listed(tmp_path: Path) -> None:
    kind = "control_msgs/msg/FollowJointTrajectoryGoal"
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for text, name in ((TOLERANCE, "control_msgs/msg/JointTolerance"), (GOAL, kind)):
        if name not in store.types:
            store.register(typesys.get_types_from_msg(text, name))
    tolerance = store.types["control_msgs/msg/JointTolerance"](
        name="joint_1", position=0.1, velocity=0.0, acceleration=0.0
    )
    goal = store.types[kind](
        path_tolerance=[tolerance],
        trajectory=trajectory(),
        goal_time_tolerance=of("builtin_interfaces/msg/Duration", sec=1, nanosec=0),
    )
    plugin = rosbag2.StoragePlugin.MCAP
    with rosbag2.Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as bag:
        connection = bag.add_connection("/goal", kind, typestore=store)
        bag.write(connection, FIRST_NS, store.serialize_cdr(goal, kind))
    loaded = load_trajectories(tmp_path / "bag", "airhockey")
    assert np.array_equal(loaded.trajectories[0].q, Q)
    unused = {name.rpartition(".")[2] for name in loaded.ignored}
    assert unused == {"path_tolerance", "goal_time_tolerance"}
