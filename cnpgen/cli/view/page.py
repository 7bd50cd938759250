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


def page_of(scene: ViewScene, *, stamp: str = "") -> str:
    """Write a scene as a page; a served one reloads when the server has another stamp of the files behind it.

    Raises:
        MissingExtraError: MeshCat is not installed.
    """
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    content = vars(scene) | {"stamp": stamp}
    data = json.dumps(content, default=_encoded, separators=(",", ":")).replace("<", "\\u003c")
    before, between = template.split("/*VIEWER*/")
    return before + _viewer() + between.replace("/*DATA*/", data)


def _viewer() -> str:
    """Return MeshCat's viewer, which includes three.js, as a script."""
    from importlib.metadata import distribution

    with requires_extra("view", "MeshCat's viewer"):
        path = Path(str(distribution("meshcat").locate_file("meshcat/viewer/dist/main.min.js")))
        return path.read_text(encoding="utf-8")


def _encoded(value: View | Body | NDArray[Any]) -> Any:
    """Return an object for JSON; arrays as base64 of their bytes, with 4 bytes per number."""
    if isinstance(value, np.ndarray):
        dtype = "<f4" if value.dtype.kind == "f" else "<u4"
        return base64.b64encode(np.ascontiguousarray(value, dtype).tobytes()).decode()
    return vars(value)
