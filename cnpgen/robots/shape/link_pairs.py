"""Link pairs that can collide, determined by sampling as in MoveIt's setup assistant, or read from an SRDF."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.robots.shape.capsule import Capsule
from cnpgen.robots.shape.convex_part import ConvexPart
from cnpgen.robots.shape.hull import ball_round, coal_hull

if TYPE_CHECKING:
    import pinocchio as pin

Names = frozenset[str]

SAMPLED_STATES = 10_000  # ten times as many gave the same pairs for a Franka Panda
# Links that overlap in a larger fraction of the states are treated as connected.
ALWAYS_FRACTION = 0.95
# Maximum fraction of collision-free states in which the capsules of a usable pair
# overlap.
MAX_CAPSULE_ERROR_FRACTION = 0.05


@dataclass(frozen=True)
class LinkPair:
    """Two links that move relative to each other.

    Attributes:
        first: Link nearer to the base.
        second: Other link.
        left_out: Reason to ignore the pair, "adjacent", "always" (in contact) or
            "disabled" (by an SRDF); or empty.
        colliding: Fraction of sampled states in which the links overlap; nan for
            adjacent links.
        mistaken: Fraction of the other states in which the capsules overlap.
    """

    first: str
    second: str
    left_out: str
    colliding: float
    mistaken: float

    @classmethod
    def from_samples(
        cls, first: str, second: str, left_out: str, hit: Mask, near: Mask
    ) -> "LinkPair":
        """Return a pair from masks of the sampled states in which the links, and their capsules, overlap."""
        mistaken = float(near[~hit].mean()) if not hit.all() else 1.0
        return cls(first, second, left_out, float(hit.mean()), mistaken)

    @property
    def for_solvers(self) -> bool:
        """Whether solvers use the capsules of the pair.

        Judges check every pair that is not left out.
        """
        return (
            not self.left_out
            and self.colliding > 0
            and self.mistaken <= MAX_CAPSULE_ERROR_FRACTION
        )


def find_pairs(
    model: "pin.Model",
    convex_parts: Sequence[ConvexPart],
    capsules: Mapping[str, Capsule],
    *,
    joints: Mapping[str, int],
    adjacent: frozenset[Names],
    disabled: frozenset[Names] | None,
) -> tuple[LinkPair, ...]:
    """Determine the link pairs that can collide, at random states within the position limits of a reduced model.

    Convex parts and covering capsules are in the frames of the joints that move the
    links; ``joints`` are indices, 0 for fixed links. Adjacent links have only links
    without a shape between them. An SRDF may disable pairs.
    """
    # A fixed seed: pairs must be the same on every machine.
    rotations, positions = sample_poses(model, SAMPLED_STATES)
    contact = LinkContact(
        (rotations, positions), map(body_of_part, convex_parts), joints
    )
    found = []
    for first, second in combinations(capsules, 2):
        # Links of one joint do not move relative to each other.
        if joints[first] == joints[second]:
            continue
        names = frozenset((first, second))
        if names in adjacent:
            found.append(LinkPair(first, second, "adjacent", np.nan, np.nan))
            continue
        hit = contact.of(first, second)
        ends = [
            _ends(capsules[link], rotations[joints[link]], positions[joints[link]])
            for link in (first, second)
        ]
        reach = capsules[first].radius + capsules[second].radius
        near = segment_distances(*ends[0], *ends[1]) < reach
        left_out = "always" if hit.mean() > ALWAYS_FRACTION else ""
        if disabled and names in disabled:
            left_out = "disabled"
        found.append(LinkPair.from_samples(first, second, left_out, hit, near))
    return tuple(found)


def sample_poses(model: "pin.Model", count: int) -> tuple[Array, Array]:
    """Return ``joint_poses`` at random states within the position limits.

    Fewer states are the first of more.
    """
    random = np.random.default_rng(0)
    return joint_poses(
        model,
        random.uniform(
            model.lowerPositionLimit, model.upperPositionLimit, (count, model.nq)
        ),
    )


def joint_poses(model: "pin.Model", states: Array) -> tuple[Array, Array]:
    """Return rotations, shape (joints, K, 3, 3), and positions [m], shape (joints, K, 3), of all joints at K states."""
    import pinocchio as pin

    data = model.createData()
    poses = np.empty((model.njoints, len(states), 4, 3))
    for k, q in enumerate(states):
        pin.forwardKinematics(model, data, q)
        for joint, pose in enumerate(data.oMi):
            poses[joint, k, :3] = pose.rotation
            poses[joint, k, 3] = pose.translation
    return poses[:, :, :3], poses[:, :, 3]


@dataclass(frozen=True)
class CollisionBody:
    """Collision geometry of Coal in the frame of a joint, with a ball that contains it.

    Attributes:
        center: Center of the ball [m], shape (3,).
        radius: Radius of the ball [m].
        geometry: Geometry of Coal.
        placement: Pose of the geometry in the frame of the joint, a transform of Coal;
            None for the identity.
    """

    center: Array
    radius: float
    geometry: Any
    placement: Any = None


def body_of_part(part: ConvexPart) -> tuple[str, CollisionBody]:
    """Return the link and the collision body of a convex part."""
    hull = coal_hull(part.vertices)
    hull.setSweptSphereRadius(part.radius)
    return part.link, CollisionBody(*ball_round(part.vertices, part.radius), hull)


class LinkContact:
    """Collision checks of links with Coal at K states.

    Args:
        poses: Rotations and positions [m] of the joints, as ``sample_poses`` returns
            them.
        bodies: Links and their bodies, in the frames of the joints that move them.
        joints: Link -> index of the joint that moves it.
    """

    def __init__(
        self,
        poses: tuple[Array, Array],
        bodies: Iterable[tuple[str, CollisionBody]],
        joints: Mapping[str, int],
    ) -> None:
        import coal

        (self._rotations, self._positions), self._joints = poses, joints
        self._of_link: dict[str, list[CollisionBody]] = {}
        for link, body in bodies:
            self._of_link.setdefault(link, []).append(body)
        self._request = coal.CollisionRequest()
        self._places = (coal.Transform3s(), coal.Transform3s())

    def of(self, first: str, second: str, *, among: Mask | None = None) -> Mask:
        """Return a mask of the states, among all or those of a mask, in which two links overlap, shape (K,)."""
        hit = np.zeros(self._positions.shape[1], bool)
        # Balls first: only states in which they overlap need Coal.
        for one, other in product(self._of_link[first], self._of_link[second]):
            centers = [
                self._rotations[self._joints[link]] @ body.center
                + self._positions[self._joints[link]]
                for link, body in ((first, one), (second, other))
            ]
            near = (
                np.linalg.norm(centers[0] - centers[1], axis=1)
                < one.radius + other.radius
            )
            # Once two parts overlap, the links do; further parts need only the other
            # states.
            for k in np.flatnonzero(
                near & ~hit if among is None else near & ~hit & among
            ):
                hit[k] = self._touch((first, one), (second, other), int(k))
        return hit

    def _touch(
        self,
        first: tuple[str, CollisionBody],
        second: tuple[str, CollisionBody],
        k: int,
    ) -> bool:
        import coal

        poses = []
        for (link, body), place in zip((first, second), self._places, strict=True):
            place.setRotation(self._rotations[self._joints[link], k])
            place.setTranslation(self._positions[self._joints[link], k])
            poses.append(place if body.placement is None else place * body.placement)
        result = coal.CollisionResult()
        coal.collide(
            first[1].geometry,
            poses[0],
            second[1].geometry,
            poses[1],
            self._request,
            result,
        )
        return bool(result.isCollision())


def _ends(capsule: Capsule, rotations: Array, positions: Array) -> tuple[Array, Array]:
    """Return both ends of a capsule in the world at K states [m], each of shape (K, 3)."""
    return rotations @ capsule.first + positions, rotations @ capsule.second + positions


def segment_distances(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return the distances between segments a to b and c to d [m], shape (K,), for ends of shape (K, 3).

    The closest points of the lines are clamped to one segment after the other (Ericson
    2005, section 5.1.9).
    """
    one = b - a
    other = d - c
    between = a - c
    aa, bb, ab = (
        np.einsum("ki,ki->k", x, y)
        for x, y in ((one, one), (other, other), (one, other))
    )
    ar, br = (np.einsum("ki,ki->k", x, between) for x in (one, other))
    # Minimize |r + s u - t v|^2; parallel segments keep s = 0 and t follows.
    s = np.clip((ab * br - ar * bb) / np.maximum(aa * bb - ab**2, 1e-18), 0, 1)
    t = np.clip((ab * s + br) / np.maximum(bb, 1e-18), 0, 1)
    s = np.clip((ab * t - ar) / np.maximum(aa, 1e-18), 0, 1)
    return np.asarray(
        np.linalg.norm(between + s[:, None] * one - t[:, None] * other, axis=1)
    )
