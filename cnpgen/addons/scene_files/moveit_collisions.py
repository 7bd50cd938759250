"""Allowed collisions, padding and scale of links in MoveIt's scenes."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from cnpgen.problems.scenes.scene_problem import SceneError
from cnpgen.problems.scenes.yaml_document import part, scalar
from cnpgen.store.files.accounted import AccountedMapping, mark_read

ACM, OCTOMAP = "allowed_collision_matrix", "<octomap>"


def is_true(value: Any, where: str) -> bool:
    """Return a flag of a file, given as a text or a number."""
    text = "false" if value is None else str(value).strip().lower()
    if text in {"true", "yes", "1", "1.0"}:
        return True
    if text in {"false", "no", "0", "0.0", ""}:
        return False
    raise SceneError(f"{where} must be true or false, got {value!r:.60}")


def read_allowed_collisions(
    scene: AccountedMapping,
    objects: Collection[str],
    attached: Collection[str],
    place: str,
) -> dict[str, tuple[str, ...]]:
    """Return attached object -> links that may touch it.

    Pairs of two objects of the world never move against each other, and those of links
    are the pairs of the robot's problem. Other pairs with an object are refused.
    """
    matrix = part(scene, ACM, dict, place)
    defaults = [str(name) for name in part(matrix, "default_entry_names", list, place)]
    values = part(matrix, "default_entry_values", list, place)
    if len(values) != len(defaults):
        raise SceneError(f"{place}: {ACM} needs one entry for each name")
    world, touching = {*objects, OCTOMAP}, dict[str, tuple[str, ...]]()
    refused = [
        f"{name} and all others"
        for name, value in zip(defaults, values, strict=True)
        if is_true(value, f"{place}: {ACM}")
    ]
    for pair in _allowed_pairs(matrix, place):
        bodies, links = pair & {*attached}, pair - world - {*attached}
        if len(bodies) == 1 and len(links) == 1:
            (body,) = bodies
            touching[body] = (*touching.get(body, ()), *links)
        elif (pair & world and not pair <= world) or len(bodies) == 2:
            refused.append(" and ".join(sorted(pair)))
    if matrix:
        scene.account.unused.append(ACM)
    if refused:
        text = "expected pairs of links, of an attached object and a link, or of two objects"
        scene.account.refuse(ACM, refused[0], text)
    mark_read(matrix)
    return touching


def _allowed_pairs(matrix: Any, place: str) -> Iterator[frozenset[str]]:
    """Yield the names of every two bodies that may collide."""
    names = [str(name) for name in part(matrix, "entry_names", list, place)]
    rows = part(matrix, "entry_values", list, place)
    if len(rows) != len(names):
        raise SceneError(f"{place}: {ACM} needs one entry for each name")
    for first, row in zip(names, rows, strict=True):
        # robowflex writes the rows as plain lists
        enabled = (
            list(row) if isinstance(row, list) else part(row, "enabled", list, place)
        )
        if len(enabled) != len(names):
            raise SceneError(f"{place}: {ACM} needs one value for each pair")
        for second, value in zip(names, enabled, strict=True):
            if is_true(value, f"{place}: {ACM}") and first != second:
                yield frozenset({first, second})


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
