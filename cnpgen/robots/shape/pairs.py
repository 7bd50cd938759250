"""Pairs of links that could collide with each other: found by sampling, as MoveIt's assistant does, or from an SRDF."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.shape.capsule import Capsule
from cnpgen.robots.shape.hull import ball_round, coal_hull
from cnpgen.robots.shape.piece import Piece

if TYPE_CHECKING:
    import pinocchio as pin

Array = NDArray[np.float64]
Names = frozenset[str]

SAMPLES = 10_000  # states; ten times as many gave the same pairs of a Franka Panda
ALWAYS = 0.95  # links that overlap in more of the states are joined there, whatever the URDF says
MISTAKEN = 0.05  # capsules that overlap in more of the states in which the links do not are no use to a solver


@dataclass(frozen=True)
class LinkPair:
    """Two links that joints move against each other.

    Attributes:
        first: The link nearer to the base.
        second: The other one.
        left_out: Why nobody looks at the pair: "adjacent", "always" in contact, "disabled" by an SRDF; else empty.
        colliding: Share of sampled states in which the links overlap; nan for adjacent ones.
        mistaken: Share of the other states in which their capsules do.
    """

    first: str
    second: str
    left_out: str
    colliding: float
    mistaken: float

    @property
    def for_solvers(self) -> bool:
        """Whether solvers keep the capsules of the pair apart; judges look at every pair that is not left out."""
        return not self.left_out and self.colliding > 0 and self.mistaken <= MISTAKEN


def find_pairs(
    model: "pin.Model",
    pieces: Sequence[Piece],
    capsules: Mapping[str, Capsule],
    *,
    joints: Mapping[str, int],
    adjacent: frozenset[Names],
    disabled: frozenset[Names] | None,
) -> tuple[LinkPair, ...]:
    """Find out which pairs of links can collide.

    Args:
        model: The model, reduced to the planned joints; states are drawn between its limits of positions.
        pieces: The links' pieces, in the frames of the joints that move them.
        capsules: Link -> its capsule, likewise.
        joints: Link -> the joint that moves it, as the model counts them; 0 for what nothing moves.
        adjacent: Pairs of links with nothing but links without a shape between them.
        disabled: Pairs that an SRDF disables, None if there is none.
    """
    rotations, positions = _poses(model)
    contact = _Contact(rotations, positions, pieces, joints)
    found = []
    for first, second in combinations(capsules, 2):
        if joints[first] == joints[second]:
            continue
        names = frozenset((first, second))
        if names in adjacent:
            found.append(LinkPair(first, second, "adjacent", np.nan, np.nan))
            continue
        hit = contact.of(first, second)
        ends = [_ends(capsules[link], rotations[joints[link]], positions[joints[link]]) for link in (first, second)]
        near = segment_distances(*ends[0], *ends[1]) < capsules[first].radius + capsules[second].radius
        colliding = float(hit.mean())
        left_out = "disabled" if disabled and names in disabled else "always" if colliding > ALWAYS else ""
        mistaken = float(near[~hit].mean()) if not hit.all() else 1.0
        found.append(LinkPair(first, second, left_out, colliding, mistaken))
    return tuple(found)


def _poses(model: "pin.Model") -> tuple[Array, Array]:
    """Rotations, shape (joints, K, 3, 3), and positions [m], shape (joints, K, 3), of all joints at random states."""
    import pinocchio as pin

    data, random = model.createData(), np.random.default_rng(0)
    states = random.uniform(model.lowerPositionLimit, model.upperPositionLimit, (SAMPLES, model.nq))
    found = np.empty((model.njoints, SAMPLES, 4, 3))
    for k, q in enumerate(states):
        pin.forwardKinematics(model, data, q)
        for joint, pose in enumerate(data.oMi):
            found[joint, k, :3], found[joint, k, 3] = pose.rotation, pose.translation
    return found[:, :, :3], found[:, :, 3]


class _Contact:
    """Asks Coal in which states links overlap."""

    def __init__(self, rotations: Array, positions: Array, pieces: Sequence[Piece], joints: Mapping[str, int]) -> None:
        import coal

        self._rotations, self._positions, self._joints = rotations, positions, joints
        self._of_link: dict[str, list[tuple[Array, float, Any]]] = {}
        for piece in pieces:
            shape = coal_hull(piece.vertices)
            shape.setSweptSphereRadius(piece.radius)
            self._of_link.setdefault(piece.link, []).append((*ball_round(piece.vertices, piece.radius), shape))
        self._request, self._places = coal.CollisionRequest(), (coal.Transform3s(), coal.Transform3s())

    def of(self, first: str, second: str) -> NDArray[np.bool_]:
        """Say in which states two links overlap, shape (K,)."""
        hit = np.zeros(self._positions.shape[1], bool)
        for one, other in product(self._of_link[first], self._of_link[second]):
            spheres = [
                self._rotations[self._joints[link]] @ centre + self._positions[self._joints[link]]
                for link, (centre, _, _) in ((first, one), (second, other))
            ]
            near = np.linalg.norm(spheres[0] - spheres[1], axis=1) < one[1] + other[1]
            for k in np.flatnonzero(near & ~hit):
                hit[k] = self._touch(first, one[2], second, other[2], int(k))
        return hit

    def _touch(self, first: str, one: Any, second: str, other: Any, k: int) -> bool:
        import coal

        for link, place in zip((first, second), self._places, strict=True):
            place.setRotation(self._rotations[self._joints[link], k])
            place.setTranslation(self._positions[self._joints[link], k])
        result = coal.CollisionResult()
        coal.collide(one, self._places[0], other, self._places[1], self._request, result)
        return bool(result.isCollision())


def _ends(capsule: Capsule, rotations: Array, positions: Array) -> tuple[Array, Array]:
    """Both ends of a capsule in the world at K states [m], each of shape (K, 3)."""
    return rotations @ capsule.first + positions, rotations @ capsule.second + positions


def segment_distances(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Distances of the segments from a to b from those from c to d [m], each of shape (K, 3) -> (K,).

    The nearest points are those of the lines, brought into one segment after the other (Ericson 2005, section 5.1.9).
    """
    one, other, between = b - a, d - c, a - c
    aa, bb, ab = (np.einsum("ki,ki->k", x, y) for x, y in ((one, one), (other, other), (one, other)))
    ar, br = (np.einsum("ki,ki->k", x, between) for x in (one, other))
    s = np.clip((ab * br - ar * bb) / np.maximum(aa * bb - ab**2, 1e-18), 0, 1)
    t = np.clip((ab * s + br) / np.maximum(bb, 1e-18), 0, 1)
    s = np.clip((ab * t - ar) / np.maximum(aa, 1e-18), 0, 1)
    return np.asarray(np.linalg.norm(between + s[:, None] * one - t[:, None] * other, axis=1))
