"""A scene as one page of HTML without external files: MeshCat's viewer, the numbers of the scene, and a script."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.cli.view.view_bodies import Body
from cnpgen.cli.view.view_scene import View, ViewScene
from cnpgen.errors import requires_extra
from cnpgen.judges.plans.condition_curves import ConditionCurve
from cnpgen.robots.robot import Robot

_NOTES = {
    "meshes": "",
    "convex parts": "drawn with the convex parts of its collision geometry",
    "line": "drawn as the line through its joints' origins",
}
SHARE_DIGITS = 4  # of shares of limits
CURVE_DIGITS = 5  # significant ones of conditions
_PROBE = 0.5  # joint displacement from which the axis of a joint is computed


def page_of(scene: ViewScene, *, stamp: str = "") -> str:
    """Write a scene as a page; a served one reloads when the server has another stamp of the files behind it.

    Raises:
        MissingExtraError: MeshCat is not installed.
    """
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    data = json.dumps(_content(scene) | {"stamp": stamp}, separators=(",", ":")).replace("<", "\\u003c")
    before, between = template.split("/*VIEWER*/")
    return before + _viewer() + between.replace("/*DATA*/", data)


def _viewer() -> str:
    """Return MeshCat's viewer, which includes three.js, as a script."""
    from importlib.metadata import distribution

    with requires_extra("view", "MeshCat's viewer"):
        path = Path(str(distribution("meshcat").locate_file("meshcat/viewer/dist/main.min.js")))
        return path.read_text(encoding="utf-8")


def _content(scene: ViewScene) -> dict[str, Any]:
    """Return a scene for JSON, arrays as base64 of their bytes."""
    low, high = _extent(scene)
    return {
        "note": _NOTES[scene.kind],
        "joints": _joints(scene.robot),
        "tip": _matrix(scene.robot.model.frames[scene.robot.tip_frame].placement.homogeneous),
        "joints_and_tip": scene.views[0].poses.shape[1],
        "robot": [_body(body, smooth=scene.kind != "convex parts") for body in scene.bodies],
        "capsules": [_body(body, smooth=True) for body in scene.capsules],
        "held": [_body(body) for body in scene.held],
        "mallet": [_body(body) for body in scene.mallet],
        "triad": [_body(body, smooth=True) for body in scene.triad],
        "centre": ((low + high) / 2).tolist(),
        "size": float(np.linalg.norm(high - low)),
        "views": [_view(view) for view in scene.views],
        "first_row": scene.first_row,
        "n_rows": scene.n_rows,
    }


def _view(view: View) -> dict[str, Any]:
    return {
        "title": view.title,
        "labels": view.labels,
        "times": view.times.tolist(),
        "q": _packed(view.q.T, "<f4"),
        "poses": _packed(view.poses.transpose(0, 1, 3, 2), "<f4"),
        "world": [_body(body) for body in view.world],
        "path": [_body(body, smooth=True) for body in view.path],
        "curves": [{"name": name, "shares": share.round(SHARE_DIGITS).tolist()} for name, share in view.shares.items()],
        "conditions": [_condition(curve) for curve in view.conditions],
        "verdict": view.verdict,
    }


def _condition(curve: ConditionCurve) -> dict[str, Any]:
    """Return a curve; bounds that do not exist are None."""
    return {
        "name": curve.label,
        "unit": curve.unit,
        "parts": curve.parts,
        "values": [_rounded(values) for values in curve.values],
        "lower": _rounded(curve.lower) if np.isfinite(curve.lower).all() else None,
        "upper": _rounded(curve.upper) if np.isfinite(curve.upper).all() else None,
        "tolerance": curve.tolerance,
        "violated": np.flatnonzero(curve.violated).tolist(),
        "points": None if curve.points is None else _packed(curve.points, "<f4"),
        "pairs": curve.pairs,
    }


def _rounded(values: NDArray[np.float64]) -> list[float | None]:
    """Return values with ``CURVE_DIGITS`` significant digits, None for those that are not finite."""
    return [float(f"{value:.{CURVE_DIGITS}g}") if np.isfinite(value) else None for value in values.tolist()]


def _joints(robot: Robot) -> list[dict[str, Any]]:
    """Return placements, axes and limits of the planned joints, from which the page computes poses."""
    import pinocchio as pin

    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, np.full(robot.n, _PROBE))
    joints = []
    for index, name in enumerate(robot.joint_names):
        placement = model.jointPlacements[index + 1]
        twist = pin.log6(placement.actInv(data.liMi[index + 1])).vector / _PROBE  # linear, then angular
        joints.append(
            {
                "name": name,
                "placement": _matrix(placement.homogeneous),
                "twist": twist.round(12).tolist(),
                "low": float(robot.position_lower[index]),
                "high": float(robot.position_upper[index]),
            }
        )
    return joints


def _matrix(matrix: NDArray[np.float64]) -> list[float]:
    """Return a matrix by columns, as three.js reads it."""
    return [float(value) for value in matrix.T.ravel()]


def _body(body: Body, *, smooth: bool = False) -> dict[str, Any]:
    arrays = {"corners": _packed(body.corners, "<f4"), "triangles": _packed(body.triangles, "<u4")}
    return {"name": body.name, "joint": body.joint, "smooth": smooth, **arrays}


def _packed(values: NDArray[Any], dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode()


def _extent(scene: ViewScene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the box around the robot at the ends of the first view [m], shape (3,) each."""
    view = scene.views[0]
    points = [
        body.corners @ view.poses[k, body.joint, :3, :3].T + view.poses[k, body.joint, :3, 3]
        for body in (*scene.bodies, *scene.held)
        for k in (0, len(view.labels) - 1)
    ]
    corners = np.concatenate(points)
    return corners.min(axis=0), corners.max(axis=0)
