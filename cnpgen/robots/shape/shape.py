"""Shape of a robot for judges and solvers: convex parts, covering capsules and link pairs; the held object."""

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Vector3
from cnpgen.documents import JsonObject
from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.chain import Chain, frame_of
from cnpgen.robots.robot_spec import HeldObject
from cnpgen.robots.shape.capsule import Capsule, covering_capsule, covers
from cnpgen.robots.shape.convex_part import ConvexPart, link_convex_parts
from cnpgen.robots.shape.hull import CUBE
from cnpgen.robots.shape.link_pairs import (
    ALWAYS_FRACTION,
    LinkContact,
    LinkPair,
    body_of_part,
    find_pairs,
    sample_poses,
)
from cnpgen.robots.urdf import urdf_tree
from cnpgen.robots.urdf_changes import disabled_pairs
from cnpgen.store.files.cache_entry import read_entry, write_entry

if TYPE_CHECKING:
    import pinocchio as pin

Capsules = tuple[Capsule, ...]
Pairs = tuple[LinkPair, ...]
Parts = tuple[ConvexPart, ...]

# Of the computation of capsules and pairs; cached results of another revision are
# ignored.
SHAPE_REVISION = 1
# Entries of the package for the robots of shipped problems, so that their first use
# computes nothing; ``tests/kernels/make_shipped_tapes.py`` writes them.
SHIPPED = Path(__file__).with_name("shipped")
HELD_OBJECT = "held object"  # takes the place of a link's name
SAMPLED_HELD_STATES = 2000  # states in which the object and the links are compared


@dataclass(frozen=True)
class Shape:
    """Collision geometry of a robot.

    Attributes:
        convex_parts: Convex parts, each in the frame of the joint that moves its link.
        joints: Link -> number of the planned joint that moves it, counted from 1; 0 for
            fixed links.
        capsules: One covering capsule per link, in the frame of the joint that moves
            it.
        pairs: Pairs of links that move relative to each other.
    """

    convex_parts: Parts
    joints: Mapping[str, int]
    capsules: Capsules
    pairs: Pairs

    @property
    def moving_convex_parts(self) -> Parts:
        """Convex parts of moving links, the only ones that can avoid obstacles."""
        return tuple(part for part in self.convex_parts if self.joints[part.link])

    @cached_property
    def checked_pairs(self) -> tuple[tuple[int, int], ...]:
        """Index pairs of convex parts of links that must not touch, ordered by link pair."""
        of_link = {
            link: [i for i, each in enumerate(self.convex_parts) if each.link == link]
            for link in self.joints
        }
        kept = [pair for pair in self.pairs if not pair.left_out]
        return tuple(
            both
            for pair in kept
            for both in product(of_link[pair.first], of_link[pair.second])
        )

    @property
    def moving_capsules(self) -> Capsules:
        """Capsules of moving links."""
        return tuple(capsule for capsule in self.capsules if self.joints[capsule.link])


def load_shape(urdf: str, model: "pin.Model", keep: Path | None) -> Shape:
    """Load the shape of a robot from a URDF with inline meshes (``cnpgen.robots.shape.inline``) and its reduced model.

    Capsules and pairs, which take some seconds to compute, are kept in a cache folder,
    if there is one.
    """
    convex_parts, joints = place_convex_parts(urdf, model)
    if not any(joints.values()):
        raise RecipeError(
            [
                "no link that moves has a <collision> element, so that the robot has no shape"
            ]
        )

    def compute() -> tuple[Capsules, Pairs]:
        capsules = tuple(
            covering_capsule(_parts_of(link, convex_parts)) for link in joints
        )
        by_link = {capsule.link: capsule for capsule in capsules}
        adjacent = _adjacent(urdf, set(joints))
        disabled = disabled_pairs(urdf)
        return capsules, find_pairs(
            model,
            convex_parts,
            by_link,
            joints=joints,
            adjacent=adjacent,
            disabled=disabled,
        )

    return Shape(
        convex_parts,
        joints,
        *_cached(keep, [urdf, *_joints_of(model)], convex_parts, compute),
    )


def _joints_of(model: "pin.Model") -> list[list[Any]]:
    """Return the names and the position limits of joints, on which capsules and pairs depend."""
    return [
        list(model.names),
        list(model.lowerPositionLimit),
        list(model.upperPositionLimit),
    ]


def _cached(
    keep: Path | None,
    numbers: list[Any],
    convex_parts: Parts,
    compute: Callable[[], tuple[Capsules, Pairs]],
) -> tuple[Capsules, Pairs]:
    """Return capsules, which must cover the parts, and pairs: shipped, from a cache folder, or computed and stored.

    The JSON values determine the result.
    """
    name = f"shape-{hashlib.sha256(json.dumps([SHAPE_REVISION, *numbers]).encode()).hexdigest()[:32]}.json"
    for folder in (SHIPPED, keep):
        if folder is not None and (entry := read_entry(folder / name)) is not None:
            with suppress(ValueError, KeyError, TypeError, RecursionError):
                # The cache is not trusted: capsules must cover the parts, or they are
                # computed again.
                return _read(json.loads(entry), convex_parts)
    capsules, pairs = compute()
    if keep is not None:
        write_entry(keep / name, json.dumps(_written(capsules, pairs)).encode())
    return capsules, pairs


def _parts_of(link: str, convex_parts: Parts) -> list[ConvexPart]:
    """Return the convex parts of a link."""
    return [part for part in convex_parts if part.link == link]


def place_convex_parts(urdf: str, model: "pin.Model") -> tuple[Parts, dict[str, int]]:
    """Return the convex parts of links in the frames of the joints that move them, and link -> index of this joint."""
    placed = []
    joints = {}
    for part in link_convex_parts(urdf):
        frame = model.frames[frame_of(model, part.link)]
        placed.append(
            part.moved(
                np.array(frame.placement.rotation),
                np.array(frame.placement.translation),
            )
        )
        joints[part.link] = int(frame.parentJoint)
    return tuple(placed), joints


def _adjacent(urdf: str, shaped: set[str]) -> frozenset[frozenset[str]]:
    """Return the pairs of a link and its nearest ancestor with a shape."""
    parents = {}
    for joint in urdf_tree(urdf).iter("joint"):
        parent = joint.find("parent")
        child = joint.find("child")
        if parent is not None and child is not None:
            parents[child.get("link", "")] = parent.get("link", "")
    found = set()
    for link in shaped:
        above = parents.get(link)
        while above is not None and above not in shaped:
            above = parents.get(above)
        if above is not None:
            found.add(frozenset((link, above)))
    return frozenset(found)


def _written(capsules: Capsules, pairs: Pairs) -> JsonObject:
    entries = [
        asdict(each) | {"first": each.first.tolist(), "second": each.second.tolist()}
        for each in capsules
    ]
    return {"capsules": entries, "pairs": [asdict(pair) for pair in pairs]}


def _read(content: JsonObject, convex_parts: Parts) -> tuple[Capsules, Pairs]:
    """Return cached capsules and pairs.

    Raise ValueError if a capsule does not cover its link.
    """
    capsules = tuple(
        Capsule(
            **each
            | {"first": np.array(each["first"]), "second": np.array(each["second"])}
        )
        for each in content["capsules"]
    )
    if not all(
        covers(capsule, _parts_of(capsule.link, convex_parts)) for capsule in capsules
    ):
        raise ValueError("a capsule does not cover its link")
    return capsules, tuple(LinkPair(**pair) for pair in content["pairs"])


def load_held_shape(
    urdf: str, model: "pin.Model", held: HeldObject, tip_frame: int, keep: Path | None
) -> Shape:
    """Load the link geometry for collisions with the held object, for a URDF with inline meshes and its reduced model.

    A cache folder keeps capsules and pairs; None for no cache.

    Returns:
        The convex parts of all links that may not touch the object, then the object; a
        capsule and a pair for each of these links. Links that the joint of the tip
        moves do not move relative to the object and are omitted.
    """
    convex_parts, joints = place_convex_parts(urdf, model)
    if not joints:
        text = "no link has a <collision> element, so that contacts with the held object cannot be checked"
        raise RecipeError([text])
    for link in held.touch_links:
        if link not in joints:
            text = f"no link {link!r} has collision geometry{nearest(link, joints)}"
            raise RecipeError([f"object.touch_links: {text}"])
    tip = model.frames[tip_frame]
    carrier = int(tip.parentJoint)
    pose = tip.placement
    moving = (link for link in joints if joints[link] != carrier)
    checked = [link for link in moving if link not in held.touch_links]
    box = _box(held.size, np.array(pose.rotation), np.array(pose.translation))
    parts = (*(part for part in convex_parts if part.link in checked), box)
    joints = {link: joints[link] for link in checked} | {HELD_OBJECT: carrier}

    def compute() -> tuple[Capsules, Pairs]:
        capsules = tuple(covering_capsule(_parts_of(link, parts)) for link in checked)
        return capsules, _compare(model, parts, capsules, joints)

    about = [HELD_OBJECT, list(held.size), list(held.touch_links)]
    about.append(pose.homogeneous.tolist())
    capsules, pairs = _cached(keep, [urdf, *_joints_of(model), *about], parts, compute)
    if fixed := [pair.first for pair in pairs if pair.colliding > ALWAYS_FRACTION]:
        text = f"the held object overlaps {', '.join(fixed)} in nearly all of {SAMPLED_HELD_STATES:,} random states"
        raise RecipeError(
            [f"object.touch_links: {text}: name the links that may touch it"]
        )
    return Shape(parts, joints, capsules, pairs)


def with_held_object(
    shape: Shape, held: Shape | None, chain: Chain, size: Vector3
) -> Shape:
    """Return the link geometry of a robot with the held object, of these edge lengths [m], as a further link.

    The tip of the chain is its center. Pairs of the held shape are added; None for no
    pairs with the object.
    """
    box = _box(size, chain.tip_rotation, chain.tip_translation)
    half = np.array(size) / 2
    # The capsule along the longest edge has the smallest radius: half the diagonal
    # across.
    widest = int(np.argmax(half))
    axis = half[widest] * chain.tip_rotation[:, widest]
    radius = float(np.linalg.norm(np.delete(half, widest)))
    capsule = Capsule(
        HELD_OBJECT,
        chain.tip_translation - axis,
        chain.tip_translation + axis,
        radius,
        overhang=radius,
    )
    joints = {**shape.joints, HELD_OBJECT: len(chain.joints)}
    pairs = () if held is None else held.pairs
    return Shape(
        (*shape.convex_parts, box),
        joints,
        (*shape.capsules, capsule),
        (*shape.pairs, *pairs),
    )


def _box(size: Vector3, rotation: Array, translation: Array) -> ConvexPart:
    return ConvexPart(HELD_OBJECT, CUBE * np.array(size)).moved(rotation, translation)


def _compare(
    model: "pin.Model", parts: Parts, capsules: Capsules, joints: dict[str, int]
) -> tuple[LinkPair, ...]:
    """Compare the object with all links and their capsules in random states."""
    names = {capsule.link: f"capsule of {capsule.link}" for capsule in capsules}
    covers = [
        ConvexPart(names[each.link], np.array([each.first, each.second]), each.radius)
        for each in capsules
    ]
    all_joints = joints | {name: joints[link] for link, name in names.items()}
    poses = sample_poses(model, SAMPLED_HELD_STATES)
    contact = LinkContact(poses, map(body_of_part, [*parts, *covers]), all_joints)
    return tuple(
        LinkPair.from_samples(
            link,
            HELD_OBJECT,
            "",
            contact.of(link, HELD_OBJECT),
            contact.of(name, HELD_OBJECT),
        )
        for link, name in names.items()
    )
