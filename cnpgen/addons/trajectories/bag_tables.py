"""Bags of ROS as tables: streams of joint states and messages of trajectories (package ``rosbags``).

Messages are those of MCAP and SQLite files of ROS 2, with or without their folder, and
of bags of ROS 1. They become mappings, which are read as those of JSON are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.trajectories.load_options import LoadOptions
from cnpgen.addons.trajectories.message_tables import tables_of_document
from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable
from cnpgen.errors import UsageError, either, listed, nearest, requires_extra

BAG_SUFFIXES = (".mcap", ".db3", ".bag")
BAG_METADATA = "metadata.yaml"  # of a folder of ROS 2
STATES = "JointState"
# Of packages sensor_msgs, trajectory_msgs, moveit_msgs and control_msgs; the names of
# actions are those of ROS 1.
MESSAGE_TYPES = (
    STATES,
    "JointTrajectory",
    "RobotTrajectory",
    "DisplayTrajectory",
    "MotionPlanResponse",
    "MoveGroupActionResult",
    "ExecuteTrajectoryActionGoal",
    "FollowJointTrajectoryActionGoal",
    "FollowJointTrajectoryGoal",
    "FollowJointTrajectory_Goal",
    "FollowJointTrajectory_SendGoal_Request",
)
MAX_MESSAGES = 1_000_000  # of a topic
MAX_TOPICS = 8  # topics in messages


def is_bag_folder(path: Path) -> bool:
    """Return whether a folder is a bag of ROS 2."""
    return (path / BAG_METADATA).is_file() and any(
        each.suffix in BAG_SUFFIXES or each.suffix == ".zstd" for each in path.iterdir()
    )


def has_bags(path: Path) -> bool:
    """Return whether a path is a bag, or a folder with bags."""
    files = path.iterdir() if path.is_dir() else [path]
    return any(file.suffix.lower() in BAG_SUFFIXES for file in files)


def read_bag(path: Path, options: LoadOptions) -> Iterator[TrajectoryTable]:
    """Yield the trajectories of a bag: one of all joint states of a topic, or one of every other message.

    Raises:
        UsageError: The bag is damaged, has no trajectories, or has several topics of
            them and ``options.topic`` names none.
        MissingExtraError: The package ``rosbags`` is not installed.
    """
    topic, kind, messages, others = _read_topic(path, options.topic)
    place = f"{path}: {topic}"
    # A stream of states is one trajectory, another message is one or holds some.
    parts = [(messages, place)]
    if kind != STATES:
        several = len(messages) > 1
        parts = [
            (message, f"{place}: [{index}]" if several else place)
            for index, message in enumerate(messages)
        ]
    unused = tuple(f"topic {name}" for name in others)
    tables = [
        table
        for document, where in parts
        for table in tables_of_document(document, where, options.allow_unused)
    ]
    for table in tables:
        yield replace(table, unused=(*table.unused, *unused))


def _read_topic(
    path: Path, stated: str | None
) -> tuple[str, str, list[Any], list[str]]:
    """Return a topic with trajectories, the type of its messages, these, and the names of the other topics."""
    with requires_extra("bags", "rosbags"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    # Bags of SQLite have no definitions before ROS 2 Jazzy.
    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        with AnyReader([path], default_typestore=store) as bag:
            topic, count = _topic(path, bag, stated)
            others = sorted({each.topic for each in bag.connections} - {topic})
            connections = [each for each in bag.connections if each.topic == topic]
            messages = [
                _plain(bag.deserialize(content, connection.msgtype))
                for connection, _, content in bag.messages(connections)
            ]
    except UsageError:
        raise
    except Exception as error:
        # Readers of damaged files raise errors of any kind.
        raise UsageError(
            f"{path} is not a bag, or is damaged: {error!r:.200}"
        ) from error
    if len(messages) != count:
        raise UsageError(
            f"{path} states {count:,} messages of {topic}, and holds {len(messages):,}"
        )
    return topic, _kind(connections[0]), messages, others


def _topic(path: Path, bag: Any, stated: str | None) -> tuple[str, int]:
    """Return the stated topic, or the only one with trajectories, and its number of messages."""
    known = {
        each.topic: _kind(each)
        for each in bag.connections
        if _kind(each) in MESSAGE_TYPES and each.msgcount
    }
    if stated is not None and stated not in known:
        raise UsageError(
            f"{path} has no trajectories in the topic {stated!r}, only in"
            f" {listed(list(known), MAX_TOPICS) or 'none'}{nearest(stated, known)}",
            concerns="topic",
        )
    if not known:
        topics = sorted({f"{each.topic} ({each.msgtype})" for each in bag.connections})
        raise UsageError(
            f"{path} has no trajectories, only {listed(topics, MAX_TOPICS) or 'no messages'};"
            f" expected messages of type {either(MESSAGE_TYPES)}"
        )
    if stated is None and len(known) > 1:
        texts = [f"{topic} ({kind})" for topic, kind in sorted(known.items())]
        raise UsageError(
            f"{path} has several topics with trajectories, {listed(texts, MAX_TOPICS)}: {{topic}} names one",
            remedies={"topic": min(known)},
        )
    topic = stated or next(iter(known))
    count = sum(each.msgcount for each in bag.connections if each.topic == topic)
    if count > MAX_MESSAGES:
        raise UsageError(
            f"{path}: {topic} has {count:,} messages, expected at most {MAX_MESSAGES:,}"
        )
    return topic, count


def _kind(connection: Any) -> str:
    """Return the name of a type without its package."""
    return str(connection.msgtype).rpartition("/")[2]


def _plain(value: Any) -> Any:
    """Return a message as mappings, lists and numbers."""
    if is_dataclass(value):
        return {
            entry.name: _plain(getattr(value, entry.name))
            for entry in fields(value)
            # Definitions of rosbags have constants and names that are no values.
            if not entry.name.startswith("__")
        }
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return value
