"""Documents of JSON and YAML as tables: messages of ROS and MoveIt, lists of rows, and objects of columns.

Every element of a message is read, refused by name, or in the tables of unused elements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.trajectories.trajectory_table import TrajectoryTable
from cnpgen.documents import JsonMapping
from cnpgen.errors import UsageError
from cnpgen.store.files.accounted import (
    Account,
    UnusedElements,
    accounted,
    mark_read,
)

Values = NDArray[Any]

MESSAGE_TIME = "t [s]"  # of formats that define the unit
_POINT_FIELDS = {"positions": "q", "velocities": "dq", "accelerations": "ddq"}
_STATE_FIELDS = {"position": "q", "velocity": "dq"}  # of sensor_msgs/JointState
# Keys of messages that hold messages: plans, action goals and responses of MoveIt.
_NESTING = (
    "joint_trajectory",
    "trajectory",
    "trajectories",
    "planned_trajectory",
    "solution",
    "motion_plan_response",
    "goal",
    "result",
    "response",
)
# Motions of a base, of RobotTrajectory and of FollowJointTrajectory.
_OTHER_POINTS = "multi_dof_joint_trajectory", "multi_dof_trajectory"
_STARTS = "trajectory_start", "start_state"  # moveit_msgs/RobotState
_SUCCESS = 1  # moveit_msgs/MoveItErrorCodes
UNUSED_ELEMENTS = UnusedElements(
    {
        "header": "time of publishing; the points have times of their own",
        "multi_dof_joint_trajectory.joint_names": "it has no points",
        "multi_dof_trajectory.joint_names": "it has no points",
        "header.seq": "number of the message",
        "header.frame_id": "positions of joints have no frame",
        "error_code.message": "text",
        "error_code.source": "text",
        "group_name": "name",
        "planner_id": "name",
        "pipeline_id": "name",
        "planning_time": "of the planner",
        "processing_time": "of the planner",
        "goal_id": "number of the goal",
        "status": "error_code is read",
        "trajectory_start.is_diff": "of the state of the planner",
        "start_state.is_diff": "of the state of the planner",
    },
    {
        "effort": "torques follow from the motion",
        "path_tolerance": "of a controller",
        "goal_tolerance": "of a controller",
        "component_path_tolerance": "of a controller",
        "component_goal_tolerance": "of a controller",
        "goal_time_tolerance": "of a controller",
        "executed_trajectory": "the planned one is read",
        "trajectory_start.multi_dof_joint_state": "scenes place the base",
        "start_state.multi_dof_joint_state": "scenes place the base",
    },
)


def tables_of_document(
    document: Any, place: str, allow_unused: Sequence[str] = ()
) -> list[TrajectoryTable]:
    """Return the trajectories of a message, of a list of messages or rows, or of an object of columns.

    Raises:
        UsageError: The document is none of them, or has an element that is not used
            and not in ``allow_unused``.
    """
    # Every read of the document is counted, so elements that were not read are found.
    account = Account(place, UNUSED_ELEMENTS, allow_unused=allow_unused)
    root = accounted({"": document}, account)
    tables = list(_tables(root[""], place))
    account.finish(root)
    unused = *dict.fromkeys(account.unused), *account.accepted
    return [replace(table, unused=unused) for table in tables]


def _tables(document: Any, place: str) -> Iterator[TrajectoryTable]:
    """Yield the trajectories of a part of a document."""
    if (
        isinstance(document, list)
        and document
        and all(isinstance(entry, dict) for entry in document)
    ):
        # A stream of states is one trajectory; a list of other messages holds one each.
        if is_joint_state(document[0]):
            yield _table_of_states(document, place)
        elif any(key in document[0] for key in ("points", *_NESTING)):
            for index, entry in enumerate(document):
                yield from _tables(entry, f"{place}: [{index}]")
        else:
            yield TrajectoryTable(place, _from_rows(document, place))
    elif isinstance(document, dict) and "points" in document:
        yield _from_message(document, place)
    elif isinstance(document, dict) and (
        key := next((key for key in _NESTING if document.get(key)), None)
    ):
        _check_message(document, place)
        start = _start_of(document, place)
        model = str(document.get("model_id") or "")
        for table in _tables(document[key], f"{place}: {key}"):
            name = model or table.robot_name
            yield replace(table, start=start or table.start, robot_name=name)
            # The first of several begins at the start.
            start = {}
    elif isinstance(document, dict) and any(
        isinstance(values, list) for values in document.values()
    ):
        yield _table_of_columns(document, place)
    else:
        expected = "a JointTrajectory or RobotTrajectory message, a list of rows, or an object of columns"
        raise UsageError(f"{place}: expected {expected}, got {_kind(document)}")


def _table_of_columns(document: JsonMapping, place: str) -> TrajectoryTable:
    """Return the table of an object of columns; single values are columns, too."""
    columns = {}
    for key, values in document.items():
        if isinstance(values, Mapping):
            raise UsageError(f"{place}: {key} is an object, expected a list")
        if key != "joint_names" and values is not None and values != []:
            columns[str(key)] = _array(values, f"{place}: {key}")
    names = document.get("joint_names")
    if names is not None:
        names = _names(names, f"{place}: joint_names")
    return TrajectoryTable(place, columns, tuple(names or ()))


def _check_message(message: JsonMapping, place: str) -> None:
    """Refuse motions of a base, attached objects, and responses of requests that failed."""
    for name in _OTHER_POINTS:
        other = message.get(name)
        if isinstance(other, dict) and other.get("points"):
            raise UsageError(
                f"{place}: {name} has points: the base of the robot must not move"
            )
    for name in _STARTS:
        state = message.get(name)
        if isinstance(state, dict) and state.get("attached_collision_objects"):
            raise UsageError(
                f"{place}: {name} has attached objects: {{scenes}} gives a scene with them",
                remedies={"scenes": None},
            )
    code = message.get("error_code", {"val": _SUCCESS})
    value = code.get("val") if isinstance(code, dict) else code
    if value != _SUCCESS:
        raise UsageError(
            f"{place}: error_code is {value!r:.20}, expected {_SUCCESS}: the request failed"
        )


def _start_of(message: JsonMapping, place: str) -> dict[str, tuple[float, float]]:
    """Return the positions and velocities (nan if unknown) of the joints in the start state of a message."""
    key = next((key for key in _STARTS if message.get(key)), "")
    state = message.get(key)
    joints = state.get("joint_state") if isinstance(state, dict) else None
    if not isinstance(joints, dict) or not joints.get("name"):
        return {}
    where = f"{place}: {key}.joint_state"
    names = _names(joints["name"], f"{where}.name")
    columns: dict[str, list[Any]] = {}
    _append(columns, joints, _STATE_FIELDS, range(len(names)), where)
    unknown = [[math.nan] * len(names)]
    q, dq = (
        _array(columns.get(column, unknown), where)[0].tolist()
        for column in _STATE_FIELDS.values()
    )
    return dict(zip(names, zip(q, dq, strict=True), strict=True))


def is_joint_state(document: Any) -> bool:
    """Return whether a document is a ``sensor_msgs/JointState``."""
    return isinstance(document, dict) and {"name", "position"} <= document.keys()


def _table_of_states(messages: Sequence[Any], place: str) -> TrajectoryTable:
    """Return one trajectory of a stream of ``sensor_msgs/JointState``.

    Joints are found by their names in every message. Times are those of the stamps,
    counted from the first.
    """
    names: list[str] = []
    stamps = []
    columns: dict[str, list[Any]] = {}
    for index, message in enumerate(messages):
        where = f"{place}: [{index}]"
        if not is_joint_state(message):
            raise UsageError(f"{where} is no JointState message as the others are")
        order = _names(message["name"], f"{where}: name")
        names = names or order
        if set(order) != set(names):
            other = sorted(set(order) ^ set(names))[0]
            raise UsageError(
                f"{where}: joint {other!r} is not in every message; the first has {', '.join(names)}"
            )
        header = message.get("header")
        stamp = header.get("stamp") if isinstance(header, dict) else None
        stamps.append(_seconds(stamp, f"{where}.header.stamp"))
        # The order of joints may differ between messages.
        rows = [order.index(name) for name in names]
        _append(columns, message, _STATE_FIELDS, rows, where)
    # Differences of fractions are exact before they become float64.
    t = np.array([float(stamp - stamps[0]) for stamp in stamps])
    if len(t) > 1 and not t.any():
        raise UsageError(f"{place}: all stamps are equal: the messages have no times")
    return _table_of_points(t, columns, names, place)


def _append(
    columns: dict[str, list[Any]],
    point: JsonMapping,
    fields: Mapping[str, str],
    rows: Sequence[int],
    where: str,
) -> None:
    """Append the values of a point, field -> column, in an order of the joints; derivatives may be empty lists."""
    for key, name in fields.items():
        values = point.get(key) or []
        if not values and name != "q" and name not in columns:
            continue
        if not isinstance(values, list) or len(values) != len(rows):
            count = len(values) if isinstance(values, list) else repr(values)[:60]
            raise UsageError(
                f"{where}.{key} must have {len(rows)} values, one per joint, got {count}"
            )
        mark_read(values)
        columns.setdefault(name, []).append([values[row] for row in rows])
    # Efforts are listed as unused, unless they are empty.
    efforts = dict.get(dict(point), "effort") or point.get("effort") or []
    if not isinstance(efforts, list) or len(efforts) not in {0, len(rows)}:
        raise UsageError(
            f"{where}.effort must have {len(rows)} values, one per joint, or none"
        )


def _table_of_points(
    t: Values, columns: Mapping[str, list[Any]], names: Sequence[str], place: str
) -> TrajectoryTable:
    """Return the table of points at times [s], all of which have the same derivatives."""
    for name, rows in columns.items():
        # A derivative that begins at a later point leaves earlier rows empty.
        if len(rows) != len(t):
            raise UsageError(
                f"{place}: {len(t) - len(rows)} of {len(t)} points have no {name}, and others do"
            )
    found = {name: _array(rows, f"{place}: {name}") for name, rows in columns.items()}
    found |= {MESSAGE_TIME: t}
    return TrajectoryTable(place, found, tuple(names), has_units=True)


def _from_rows(rows: Sequence[JsonMapping], place: str) -> dict[str, Values]:
    """Return the columns of a list of objects with the same keys."""
    for index, row in enumerate(rows):
        if row.keys() != rows[0].keys():
            other = sorted(map(str, row.keys() ^ rows[0].keys()))[0]
            raise UsageError(f"{place}: [{index}]: {other!r} is not in every row")
    return {
        str(key): _array([row[key] for row in rows], f"{place}: {key}")
        for key in rows[0]
    }


def _array(values: Any, place: str) -> Values:
    """Return a list, or a single value, as an array of numbers or texts."""
    for entry in values if type(values) is list else [values]:
        mark_read(entry)
    try:
        found = np.array(values)
    except ValueError as error:
        raise UsageError(f"{place}: its rows have different lengths") from error
    # Ragged lists and objects would become arrays of type object.
    if found.dtype.kind not in "biufU":
        raise UsageError(f"{place}: expected numbers, got {values!r:.60}")
    return found


def _from_message(message: JsonMapping, place: str) -> TrajectoryTable:
    """Return the points of a ``trajectory_msgs/JointTrajectory``, of ROS 1 or 2."""
    points = message["points"]
    names = _names(message.get("joint_names"), f"{place}: joint_names")
    if not isinstance(points, list) or not points:
        raise UsageError(
            f"{place}: points must be a list of points, got {points!r:.60}"
        )
    times = []
    columns: dict[str, list[Any]] = {}
    for index, point in enumerate(points):
        where = f"{place}: points[{index}]"
        if not isinstance(point, dict):
            raise UsageError(f"{where} must be an object, got {point!r:.60}")
        stamp = _seconds(point.get("time_from_start"), f"{where}.time_from_start")
        times.append(float(stamp))
        _append(columns, point, _POINT_FIELDS, range(len(names)), where)
    return _table_of_points(np.array(times), columns, names, place)


def _kind(document: Any) -> str:
    """Return the kind of a document of another content."""
    kinds = (dict, "an object of other keys"), (list, "a list of others")
    return next(
        (text for kind, text in kinds if isinstance(document, kind)),
        f"{document!r:.60}",
    )


def _names(names: Any, place: str) -> list[str]:
    """Return the names of joints, all different."""
    if (
        not isinstance(names, list)
        or not all(isinstance(name, str) for name in names)
        or not names
    ):
        raise UsageError(f"{place} must be a list of names, got {names!r:.60}")
    if twice := [name for name in names if names.count(name) > 1]:
        raise UsageError(f"{place}: the joint {twice[0]!r} is there more than once")
    return names


def _seconds(stamp: Any, where: str) -> Fraction:
    """Return a time of ROS 1 (secs, nsecs), ROS 2 (sec, nanosec), or a number [s].

    Fractions keep all digits of times since 1970.
    """
    parts: list[Any] = [stamp, 0]
    if isinstance(stamp, dict):
        parts = [
            stamp.get(first if first in stamp else second, 0)
            for first, second in (("sec", "secs"), ("nanosec", "nsecs"))
        ]
    if all(
        isinstance(part, int | float)
        and not isinstance(part, bool)
        and math.isfinite(part)
        for part in parts
    ) and not (isinstance(stamp, dict) and stamp.get("nanosec", 0) < 0):  # unsigned
        return Fraction(parts[0]) + Fraction(parts[1]) / 10**9
    raise UsageError(
        f"{where} must be a time such as {{sec, nanosec}}, got {stamp!r:.60}"
    )
