"""Allowed collisions, padding and scale of links in MoveIt's scenes."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from cnpgen.problems.scenes.scene_problem import SceneError
from cnpgen.problems.scenes.yaml_document import part, scalar
from cnpgen.store.files.accounted import AccountedMapping, mark_read

ACM = "allowed_collision_matrix"


def is_true(value: Any, where: str) -> bool:
    """Return a flag of a file, given as a text or a number."""
    text = "false" if value is None else str(value).strip().lower()
    if text in {"true", "yes", "1", "1.0"}:
        return True
    if text in {"false", "no", "0", "0.0", ""}:
        return False
    raise SceneError(f"{where} must be true or false, got {value!r:.60}")


def check_allowed_collisions(
    scene: AccountedMapping, objects: Collection[str], place: str
) -> None:
    """Refuse pairs with an object that may collide; those of links are the pairs of the robot's problem."""
    matrix = part(scene, ACM, dict, place)
    names = [str(name) for name in part(matrix, "entry_names", list, place)]
    rows = part(matrix, "entry_values", list, place)
    defaults = [str(name) for name in part(matrix, "default_entry_names", list, place)]
    values = part(matrix, "default_entry_values", list, place)
    if len(rows) != len(names) or len(values) != len(defaults):
        raise SceneError(f"{place}: {ACM} needs one entry for each name")
    known, allowed = {*objects, "<octomap>"}, list[str]()
    for first, row in zip(names, rows, strict=True):
        # robowflex writes the rows as plain lists
        enabled = (
            list(row) if isinstance(row, list) else part(row, "enabled", list, place)
        )
        if len(enabled) != len(names):
            raise SceneError(f"{place}: {ACM} needs one value for each pair")
        allowed += [
            f"{first} and {second}"
            for second, value in zip(names, enabled, strict=True)
            if is_true(value, f"{place}: {ACM}") and known & {first, second}
        ]
    allowed += [
        f"{name} and all others"
        for name, value in zip(defaults, values, strict=True)
        if is_true(value, f"{place}: {ACM}")
    ]
    if names or defaults:
        scene.account.unused.append(ACM)
    if allowed:
        scene.account.refuse(
            ACM, allowed[0], "allowed collisions of objects are not supported"
        )
    mark_read(matrix)


def check_padding(scene: AccountedMapping, place: str) -> None:
    """Refuse links with a padding other than 0 or a scale other than 1."""
    for key, entry_key, neutral in (
        ("link_padding", "padding", 0.0),
        ("link_scale", "scale", 1.0),
    ):
        for entry in part(scene, key, list, place):
            link = part(entry, "link_name", str, place)
            value = scalar(entry.get(entry_key), f"{place}: {key} of {link!r}")
            if value != neutral:
                entry.account.refuse(
                    key,
                    value,
                    f"expected {neutral:g} for the link {link!r}: links keep their"
                    " sizes, enlarge the objects instead",
                )
