"""Link geometry of a robot together with the held object, for collisions between the two."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cnpgen.errors import RecipeError, nearest
from cnpgen.robots.chain import Chain
from cnpgen.robots.robot_spec import HeldObject
from cnpgen.robots.shape.capsule import Capsule, covering_capsule
from cnpgen.robots.shape.convex_part import ConvexPart
from cnpgen.robots.shape.hull import CUBE, Array
from cnpgen.robots.shape.link_pairs import ALWAYS_FRACTION, LinkContact, LinkPair, body_of_part, sample_poses
from cnpgen.robots.shape.shape import (
    SHAPE_REVISION,
    Capsules,
    Pairs,
    Shape,
    cached_capsules,
    parts_of,
    place_convex_parts,
)

if TYPE_CHECKING:
    import pinocchio as pin

Size = tuple[float, float, float]

HELD_OBJECT = "held object"  # takes the place of a link's name
SAMPLED_HELD_STATES = 2000  # states in which the object and the links are compared


def load_held_shape(urdf: str, model: "pin.Model", held: HeldObject, tip_frame: int, keep: Path | None) -> Shape:
    """Load the link geometry for collisions with the held object, for a URDF with inline meshes and its reduced model.

    A cache folder keeps capsules and pairs; None for no cache.

    Returns:
        The convex parts of all links that may not touch the object, then the object; a capsule and a pair for each of
        these links. Links that the joint of the tip moves do not move relative to the object and are omitted.
    """
    convex_parts, joints = place_convex_parts(urdf, model)
    if not joints:
        raise RecipeError(
            ["no link has a <collision> element, so that contacts with the held object cannot be checked"]
        )
    for link in held.touch_links:
        if link not in joints:
            raise RecipeError([f"object.touch_links: no link {link!r} has collision geometry{nearest(link, joints)}"])
    tip = model.frames[tip_frame]
    carrier = int(tip.parentJoint)
    checked = [link for link in joints if link not in held.touch_links and joints[link] != carrier]
    box = _box(held.size, np.array(tip.placement.rotation), np.array(tip.placement.translation))
    parts = (*(part for part in convex_parts if part.link in checked), box)
    joints = {link: joints[link] for link in checked} | {HELD_OBJECT: carrier}

    def compute() -> tuple[Capsules, Pairs]:
        capsules = tuple(covering_capsule(parts_of(link, parts)) for link in checked)
        return capsules, _compare(model, parts, capsules, joints)

    numbers = [SHAPE_REVISION, urdf, list(model.names), list(model.lowerPositionLimit), list(model.upperPositionLimit)]
    numbers += [HELD_OBJECT, list(held.size), list(held.touch_links), tip.placement.homogeneous.tolist()]
    capsules, pairs = cached_capsules(keep, numbers, parts, compute)
    if fixed := [pair.first for pair in pairs if pair.colliding > ALWAYS_FRACTION]:
        text = f"the held object overlaps {', '.join(fixed)} in nearly all of {SAMPLED_HELD_STATES:,} random states"
        raise RecipeError([f"object.touch_links: {text}: name the links that may touch it"])
    return Shape(parts, joints, capsules, pairs)


def with_held_object(shape: Shape, held: Shape | None, chain: Chain, size: Size) -> Shape:
    """Return the link geometry of a robot with the held object, of these edge lengths [m], as a further link.

    The tip of the chain is its center. Pairs of the held shape are added; None for no pairs with the object.
    """
    box, half = _box(size, chain.tip_rotation, chain.tip_translation), np.array(size) / 2
    widest = int(np.argmax(half))
    axis, radius = half[widest] * chain.tip_rotation[:, widest], float(np.linalg.norm(np.delete(half, widest)))
    capsule = Capsule(HELD_OBJECT, chain.tip_translation - axis, chain.tip_translation + axis, radius, overhang=radius)
    joints = {**shape.joints, HELD_OBJECT: len(chain.joints)}
    pairs = () if held is None else held.pairs
    return Shape((*shape.convex_parts, box), joints, (*shape.capsules, capsule), (*shape.pairs, *pairs))


def _box(size: Size, rotation: Array, translation: Array) -> ConvexPart:
    return ConvexPart(HELD_OBJECT, CUBE * np.array(size)).moved(rotation, translation)


def _compare(
    model: "pin.Model", parts: tuple[ConvexPart, ...], capsules: Capsules, joints: dict[str, int]
) -> tuple[LinkPair, ...]:
    """Compare the object with all links and their capsules in random states."""
    names = {capsule.link: f"capsule of {capsule.link}" for capsule in capsules}
    covers = [ConvexPart(names[each.link], np.array([each.first, each.second]), each.radius) for each in capsules]
    all_joints = joints | {name: joints[link] for link, name in names.items()}
    poses = sample_poses(model, SAMPLED_HELD_STATES)
    contact = LinkContact(poses, map(body_of_part, [*parts, *covers]), all_joints)
    return tuple(
        LinkPair.from_samples(link, HELD_OBJECT, "", contact.of(link, HELD_OBJECT), contact.of(name, HELD_OBJECT))
        for link, name in names.items()
    )
