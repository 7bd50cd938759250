"""Allowed collisions, padding and scale of links in MoveIt's scenes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from cnpgen.addons.scene_files.document_values import part, scalar
from cnpgen.documents import Names
from cnpgen.errors import nearest
from cnpgen.problems.scenes.scene_problem import SceneError
from cnpgen.store.files.accounted import MISSPELT, AccountedMapping

MAX_SCALE = 10.0
MAX_PADDING_M = 1.0
ACM = "allowed_collision_matrix"
OCTOMAP = "<octomap>"


def is_true(value: Any, where: str) -> bool:
    """Return a flag of a file, given as a text or a number."""
    text = "false" if value is None else str(value).strip().lower()
    if text in {"true", "yes", "1", "1.0"}:
        return True
    if text in {"false", "no", "0", "0.0", ""}:
        return False
    raise SceneError(f"{where} must be true or false, got {value!r:.60}")


@dataclass(frozen=True)
class AllowedCollisions:
    """Collisions that a scene allows.

    Attributes:
        touching: Object -> links and attached objects that may touch it.
        ignored: Objects of the world that anything may touch.
    """

    touching: Mapping[str, Names]
    ignored: frozenset[str]


def read_allowed_collisions(
    scene: AccountedMapping,
    objects: Collection[str],
    attached: Collection[str],
    place: str,
) -> AllowedCollisions:
    """Return the allowed collisions of the objects of the world, and of attached ones.

    Pairs of two objects of the world never move against each other, and those of links
    are the pairs of the robot's problem. An entry takes precedence over the default of
    a name, and a default of true is refused where they differ.
    """
    matrix = part(scene, ACM, dict, place)
    always, never = _defaults(matrix, place)
    pairs = {*_allowed_pairs(matrix, place)}
    world = [*objects, OCTOMAP]
    names = {str(name) for name in part(matrix, "entry_names", list, place)}
    refused = [f"{name} and all others" for name in always if name in attached]
    # A default of true must not contradict entries of false or other defaults.
    for name in always:
        entries = names - {name} if name in names else set[str]()
        others = sorted(other for other in entries if {name, other} not in pairs)
        refused += [f"true for {name} and false for it and {other}" for other in others]
        refused += [f"true for {name} and false for {other}" for other in never]
        # A name without a contradiction may touch all objects.
        pairs |= {frozenset((name, each)) for each in (*world, *attached)}
    touching = dict[str, list[str]]()
    for pair in sorted(pairs, key=sorted):
        # The object of the world comes first, then the one that is attached.
        rank = {name: (name not in world, name not in attached, name) for name in pair}
        body, *others = sorted(pair, key=rank.__getitem__)
        # Two links are a matter of the robot, and two objects of the world never move.
        if not pair.isdisjoint((*world, *attached)) and not pair.issubset(world):
            touching.setdefault(body, []).extend(others)
    mentioned = names.union(always, never)
    scene.account.unused += _unused_parts(mentioned, world, attached)
    if refused:
        text = "expected pairs, or names without a default of false that all may touch"
        scene.account.refuse(ACM, refused[0], text)
    ignored = frozenset(world) & frozenset(always)
    found = {body: tuple(links) for body, links in touching.items()}
    return AllowedCollisions(found, ignored)


def _unused_parts(
    names: Collection[str], world: Collection[str], attached: Collection[str]
) -> Iterator[str]:
    """Yield the parts of a matrix without effect: pairs of two links or of two objects of the world, and misspelt names."""
    known = {*world, *attached}
    links = sorted({*names}.difference(known))
    for what, part_of in (("links", links), ("objects", {*names}.intersection(world))):
        if len(part_of) > 1:
            yield f"{ACM}.pairs of {what}"
    # A name that is no object may be a link, or a misspelt object.
    for name in links:
        if hint := nearest(name, sorted(known.difference(names)), similarity=MISSPELT):
            yield f"{ACM}.{name}{hint}"


def _defaults(matrix: Any, place: str) -> tuple[list[str], list[str]]:
    """Return the names whose pairs without an entry are allowed, and those whose pairs are checked."""
    names = [str(name) for name in part(matrix, "default_entry_names", list, place)]
    values = part(matrix, "default_entry_values", list, place)
    if len(values) != len(names):
        raise SceneError(f"{place}: {ACM} needs one entry for each name")
    flags = [is_true(value, f"{place}: {ACM}") for value in values]
    pairs = [*zip(names, flags, strict=True)]
    return [name for name, flag in pairs if flag], [
        name for name, flag in pairs if not flag
    ]


def _allowed_pairs(matrix: Any, place: str) -> Iterator[frozenset[str]]:
    """Yield the names of every two bodies that may collide."""
    names = [str(name) for name in part(matrix, "entry_names", list, place)]
    rows = part(matrix, "entry_values", list, place)
    if len(rows) != len(names):
        raise SceneError(f"{place}: {ACM} needs one entry for each name")
    allowed = dict[frozenset[str], bool]()
    for first, row in zip(names, rows, strict=True):
        # robowflex writes the rows as plain lists
        enabled = (
            list(row) if isinstance(row, list) else part(row, "enabled", list, place)
        )
        if len(enabled) != len(names):
            raise SceneError(f"{place}: {ACM} needs one value for each pair")
        for second, value in zip(names, enabled, strict=True):
            flag = is_true(value, f"{place}: {ACM}")
            pair = frozenset({first, second})
            # Both entries of a pair, and those of repeated names.
            if allowed.setdefault(pair, flag) != flag and first != second:
                text = f"{ACM} allows and forbids {first} and {second}"
                raise SceneError(f"{place}: {text}")
    yield from (pair for pair, flag in allowed.items() if flag and len(pair) > 1)


def read_link_sizes(
    scene: AccountedMapping, place: str
) -> tuple[tuple[str, float, float], ...]:
    """Return links with their scale and padding [m], other than 1 and 0."""
    sizes = dict[str, list[float]]()
    neutral = (1.0, 0.0)
    for column, (key, name, most) in enumerate(
        (("link_scale", "scale", MAX_SCALE), ("link_padding", "padding", MAX_PADDING_M))
    ):
        links = set[str]()
        for entry in part(scene, key, list, place):
            link = part(entry, "link_name", str, place)
            value = scalar(entry.get(name), f"{place}: {key} of {link!r}")
            if link in links:
                raise SceneError(f"{place}: {key} has the link {link!r} twice")
            links.add(link)
            if not neutral[column] <= value <= most:
                bounds = f"{neutral[column]:g} to {most:g} for the link {link!r}"
                # Links may grow only, so smaller scales are refused.
                entry.account.refuse(key, value, f"expected {bounds}, as links grow")
            elif value != neutral[column]:
                sizes.setdefault(link, [*neutral])[column] = value
    return tuple((link, scale, padding) for link, (scale, padding) in sizes.items())
