"""A sampled plan as ROS 2's message ``trajectory_msgs/JointTrajectory``, in JSON that YAML readers understand, too."""

import json
import re
from typing import Any

from cnpgen.export.sampled import Sampled

# YAML 1.1, which ROS's tools read, takes 1e-05 for a text: a number needs a point before its exponent.
_WITHOUT_POINT = re.compile(r"(?<![\d.])(\d+)(?=e[+-])")


def joint_trajectory(sampled: Sampled, joints: tuple[str, ...]) -> str:
    """Write a message, one point per line.

    Positions, velocities and accelerations are given, efforts are not; the time of the header is 0: begin at once.
    """
    rows = zip(sampled.t, sampled.q.tolist(), sampled.dq.tolist(), sampled.ddq.tolist(), strict=True)
    points = ",\n    ".join(json.dumps(_point(*row)) for row in rows)
    header = json.dumps({"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""})
    names = json.dumps(joints)
    points = _WITHOUT_POINT.sub(r"\1.0", points)
    return f'{{\n  "header": {header},\n  "joint_names": {names},\n  "points": [\n    {points}\n  ]\n}}\n'


def _point(t: float, q: list[float], dq: list[float], ddq: list[float]) -> dict[str, Any]:
    sec, nanosec = divmod(round(t * 1e9), 10**9)
    stamp = {"sec": sec, "nanosec": nanosec}
    return {"positions": q, "velocities": dq, "accelerations": ddq, "effort": [], "time_from_start": stamp}
