"""Mesh files that MoveIt's scenes name: the vertices of their hulls take the place of the names."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from cnpgen.addons.scene_files.document_values import vector
from cnpgen.errors import RecipeError
from cnpgen.problems.scenes.scene_problem import SceneError
from cnpgen.robots.shape.inline import corners_of, inline_mesh

PACKAGE = "package://"

_LOG = logging.getLogger(__name__)


def warn_of_unneeded_packages(
    documents: Mapping[Path, Any], packages: Sequence[Path]
) -> None:
    """Warn of folders of packages if no document names a mesh file."""
    if packages and not any(map(_names_a_file, documents.values())):
        _LOG.warning("no scene names a mesh file: the packages are not needed")


def _names_a_file(document: Any) -> bool:
    if isinstance(document, list):
        return any(map(_names_a_file, document))
    if not isinstance(document, dict):
        return False
    return "resource" in document or any(map(_names_a_file, document.values()))


def with_mesh_files(document: Any, scene: Path, packages: Sequence[Path]) -> Any:
    """Return a document whose meshes have vertices in place of a ``resource`` and its scale, ``dimensions``."""
    if isinstance(document, list):
        return [with_mesh_files(entry, scene, packages) for entry in document]
    if not isinstance(document, dict):
        return document
    read = {
        key: with_mesh_files(value, scene, packages) for key, value in document.items()
    }
    if "meshes" in read and isinstance(read["meshes"], list):
        read["meshes"] = [
            _with_vertices(mesh, scene, packages) for mesh in read["meshes"]
        ]
    return read


def _with_vertices(mesh: Any, scene: Path, packages: Sequence[Path]) -> Any:
    name = mesh.get("resource") if isinstance(mesh, dict) else None
    if not name:
        return mesh
    where = f"{scene}: the mesh {str(name)!r:.100}"
    scale = vector(mesh.get("dimensions", [1.0] * 3), "xyz", f"{where}: dimensions")
    if not (np.isfinite(scale).all() and scale.all()):
        raise SceneError(f"{where}: dimensions are its scale, got {scale.tolist()}")
    if mesh.get("vertices") or mesh.get("triangles"):
        raise SceneError(f"{where} has vertices, too: expected one of them")
    try:
        corners = corners_of(
            inline_mesh(_file(str(name), scene, packages, where), scale)
        )
    except RecipeError as error:
        raise SceneError(f"{where}: {error}") from error
    rest = {
        key: value
        for key, value in mesh.items()
        if key not in {"resource", "dimensions"}
    }
    return {**rest, "vertices": corners.tolist()}


def _file(name: str, scene: Path, packages: Sequence[Path], where: str) -> Path:
    """Return a file below the folder of the scene, or below one of the packages."""
    is_package = name.startswith(PACKAGE)
    relative = PurePosixPath(name.removeprefix(PACKAGE))
    names_a_file = bool(relative.parts) and ":" not in str(relative)
    # Absolute paths, drives and parents would leave the given folders.
    if not names_a_file or relative.is_absolute() or ".." in relative.parts:
        raise SceneError(
            f"{where}: expected a path below the folder of the scene or below --packages,"
            " or package://NAME/PATH"
        )
    rest = PurePosixPath(*relative.parts[1:])
    places = [] if is_package else [(scene.parent, scene.parent / relative)]
    # A package may be the folder itself, or lie in it.
    for folder in packages:
        places.append((folder, folder / relative))
        if is_package and folder.name == relative.parts[0]:
            places.append((folder, folder / rest))
    for folder, place in places:
        # links out of the folder are not followed
        if place.is_file() and place.resolve().is_relative_to(folder.resolve()):
            return place
    searched = ", ".join(str(place) for _, place in places) or "no folder"
    raise SceneError(
        f"{where} is missing: give --packages, or packages in Python; searched {searched}"
    )
