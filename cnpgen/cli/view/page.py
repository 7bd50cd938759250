"""A scene as one page of HTML that needs nothing else: MeshCat's viewer, the scene's numbers, and what moves them."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.cli.view.view_bodies import Body
from cnpgen.cli.view.view_scene import ViewScene
from cnpgen.errors import requires_extra

_NOTES = {
    "meshes": "",
    "pieces": "drawn as judges see it: the convex pieces of its collision geometry",
    "line": "drawn as the line through its joints' origins that stands for it",
}
_DIGITS = 4  # of shares of limits


def page_of(scene: ViewScene, *, stamp: str = "") -> str:
    """Write a scene as a page.

    Args:
        scene: The scene.
        stamp: Of the files behind it, for a page that is loaded again when the server has another one.

    Raises:
        MissingExtraError: MeshCat is not installed.
    """
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    data = json.dumps(_content(scene) | {"stamp": stamp}, separators=(",", ":")).replace("<", "\\u003c")
    before, between = template.split("/*VIEWER*/")
    return before + _viewer() + between.replace("/*DATA*/", data)


def _viewer() -> str:
    """Return MeshCat's viewer, three.js in it, as a script."""
    from importlib.metadata import distribution

    with requires_extra("view", "MeshCat's viewer"):
        path = Path(str(distribution("meshcat").locate_file("meshcat/viewer/dist/main.min.js")))
        return path.read_text(encoding="utf-8")


def _content(scene: ViewScene) -> dict[str, Any]:
    """Return a scene for JSON, arrays as base64 of their bytes."""
    low, high = _extent(scene)
    return {
        "title": scene.title,
        "note": _NOTES[scene.kind],
        "labels": scene.labels,
        "times": scene.times.tolist(),
        "joints": scene.joints,
        "joints_and_tip": scene.poses.shape[1],
        "poses": _packed(scene.poses.transpose(0, 1, 3, 2), "<f4"),
        "robot": [_body(each, smooth=scene.kind != "pieces") for each in scene.robot],
        "capsules": [_body(each, smooth=True) for each in scene.capsules],
        "world": [_body(each) for each in scene.world],
        "path": [_body(each, smooth=True) for each in scene.path],
        "held": [_body(each) for each in scene.held],
        "centre": ((low + high) / 2).tolist(),
        "size": float(np.linalg.norm(high - low)),
        "curves": [{"name": name, "shares": share.round(_DIGITS).tolist()} for name, share in scene.shares.items()],
    }


def _body(body: Body, *, smooth: bool = False) -> dict[str, Any]:
    arrays = {"corners": _packed(body.corners, "<f4"), "triangles": _packed(body.triangles, "<u4")}
    return {"name": body.name, "joint": body.joint, "smooth": smooth, **arrays}


def _packed(values: NDArray[Any], dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode()


def _extent(scene: ViewScene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest corner of the robot at its first and its last frame [m], shape (3,) each."""
    ends: Sequence[int] = (0, len(scene.labels) - 1)
    points = [
        body.corners @ scene.poses[k, body.joint, :3, :3].T + scene.poses[k, body.joint, :3, 3]
        for body in (*scene.robot, *scene.held)
        for k in ends
    ]
    every = np.concatenate(points)
    return every.min(axis=0), every.max(axis=0)
