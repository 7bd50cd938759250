"""Shape of a robot for judges and solvers: convex parts, covering capsules, link pairs."""

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

from cnpgen.errors import MachineError, RecipeError
from cnpgen.robots.chain import frame_of
from cnpgen.robots.shape.capsule import Capsule, covering_capsule, covers
from cnpgen.robots.shape.convex_part import ConvexPart, link_convex_parts
from cnpgen.robots.shape.link_pairs import LinkPair, find_pairs
from cnpgen.robots.urdf import urdf_tree
from cnpgen.robots.urdf_changes import disabled_pairs
from cnpgen.store.files.atomic import write_file

if TYPE_CHECKING:
    import pinocchio as pin

Capsules = tuple[Capsule, ...]
Pairs = tuple[LinkPair, ...]

SHAPE_REVISION = 1  # of the computation of capsules and pairs; cached results of another revision are ignored


@dataclass(frozen=True)
class Shape:
    """Collision geometry of a robot.

    Attributes:
        convex_parts: Convex parts, each in the frame of the joint that moves its link.
        joints: Link -> number of the planned joint that moves it, counted from 1; 0 for fixed links.
        capsules: One covering capsule per link, in the frame of the joint that moves it.
        pairs: Pairs of links that move relative to each other.
    """

    convex_parts: tuple[ConvexPart, ...]
    joints: Mapping[str, int]
    capsules: Capsules
    pairs: Pairs

    @property
    def moving_convex_parts(self) -> tuple[ConvexPart, ...]:
        """Convex parts of moving links, the only ones that can avoid obstacles."""
        return tuple(part for part in self.convex_parts if self.joints[part.link])

    @cached_property
    def checked_pairs(self) -> tuple[tuple[int, int], ...]:
        """Index pairs of convex parts of links that must not touch, ordered by link pair."""
        of_link = {link: [i for i, each in enumerate(self.convex_parts) if each.link == link] for link in self.joints}
        kept = [pair for pair in self.pairs if not pair.left_out]
        return tuple(both for pair in kept for both in product(of_link[pair.first], of_link[pair.second]))

    @property
    def moving_capsules(self) -> Capsules:
        """Capsules of moving links."""
        return tuple(capsule for capsule in self.capsules if self.joints[capsule.link])


def load_shape(urdf: str, model: "pin.Model", keep: Path | None) -> Shape:
    """Load the shape of a robot from a URDF with inline meshes (``cnpgen.robots.shape.inline``) and its reduced model.

    Capsules and pairs, which take some seconds to compute, are kept in a cache folder, if there is one.
    """
    convex_parts, joints = place_convex_parts(urdf, model)
    if not any(joints.values()):
        raise RecipeError(["no link that moves has a <collision> element, so that the robot has no shape"])

    def compute() -> tuple[Capsules, Pairs]:
        capsules = tuple(covering_capsule(parts_of(link, convex_parts)) for link in joints)
        by_link = {capsule.link: capsule for capsule in capsules}
        adjacent, disabled = _adjacent(urdf, set(joints)), disabled_pairs(urdf)
        return capsules, find_pairs(model, convex_parts, by_link, joints=joints, adjacent=adjacent, disabled=disabled)

    numbers = [SHAPE_REVISION, urdf, list(model.names), list(model.lowerPositionLimit), list(model.upperPositionLimit)]
    return Shape(convex_parts, joints, *cached_capsules(keep, numbers, convex_parts, compute))


def cached_capsules(
    keep: Path | None,
    numbers: list[Any],
    convex_parts: tuple[ConvexPart, ...],
    compute: Callable[[], tuple[Capsules, Pairs]],
) -> tuple[Capsules, Pairs]:
    """Return capsules and link pairs from the cache folder, or compute and store them; without a folder, compute them.

    JSON values determine the result. Capsules must cover the convex parts.
    """
    name = f"shape-{hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:32]}.json"
    if keep is not None:
        with suppress(OSError, ValueError, KeyError, TypeError):
            return _read(json.loads((keep / name).read_text(encoding="utf-8")), convex_parts)
    capsules, pairs = compute()
    if keep is not None:
        with suppress(MachineError):
            write_file(keep / name, json.dumps(_written(capsules, pairs)))
    return capsules, pairs


def parts_of(link: str, convex_parts: tuple[ConvexPart, ...]) -> list[ConvexPart]:
    """Return the convex parts of a link."""
    return [part for part in convex_parts if part.link == link]


def place_convex_parts(urdf: str, model: "pin.Model") -> tuple[tuple[ConvexPart, ...], dict[str, int]]:
    """Return the convex parts of links in the frames of the joints that move them, and link -> index of this joint."""
    placed, joints = [], {}
    for part in link_convex_parts(urdf):
        frame = model.frames[frame_of(model, part.link)]
        placed.append(part.moved(np.array(frame.placement.rotation), np.array(frame.placement.translation)))
        joints[part.link] = int(frame.parentJoint)
    return tuple(placed), joints


def _adjacent(urdf: str, shaped: set[str]) -> frozenset[frozenset[str]]:
    """Return the pairs of a link and its nearest ancestor with a shape."""
    parents = {}
    for joint in urdf_tree(urdf).iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
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


def _written(capsules: Capsules, pairs: Pairs) -> dict[str, Any]:
    entries = [asdict(each) | {"first": each.first.tolist(), "second": each.second.tolist()} for each in capsules]
    return {"capsules": entries, "pairs": [asdict(pair) for pair in pairs]}


def _read(content: dict[str, Any], convex_parts: tuple[ConvexPart, ...]) -> tuple[Capsules, Pairs]:
    """Return cached capsules and pairs; raise ValueError if a capsule does not cover its link."""
    capsules = tuple(
        Capsule(**each | {"first": np.array(each["first"]), "second": np.array(each["second"])})
        for each in content["capsules"]
    )
    if not all(covers(capsule, parts_of(capsule.link, convex_parts)) for capsule in capsules):
        raise ValueError("a capsule does not cover its link")
    return capsules, tuple(LinkPair(**pair) for pair in content["pairs"])
