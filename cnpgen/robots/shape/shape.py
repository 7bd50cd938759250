"""The shape of a robot, as judges and solvers see it: convex pieces, capsules that cover them, pairs of links."""

import hashlib
import json
from collections.abc import Mapping
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
from cnpgen.robots.shape.pairs import LinkPair, find_pairs
from cnpgen.robots.shape.piece import Piece, link_pieces
from cnpgen.robots.shape.srdf import disabled_pairs
from cnpgen.robots.urdf import urdf_tree
from cnpgen.store.files.atomic import write_file

if TYPE_CHECKING:
    import pinocchio as pin

REVISION = 1  # of how capsules and pairs are found: what was kept of another one is not read


@dataclass(frozen=True)
class Shape:
    """The collision geometry of a robot.

    Attributes:
        pieces: Convex pieces, each in the frame of the joint that moves its link.
        joints: Link -> number of the planned joint that moves it, from 1 on; 0 for what stands still.
        capsules: One capsule per link that covers its pieces, likewise.
        pairs: Pairs of links that joints move against each other.
    """

    pieces: tuple[Piece, ...]
    joints: Mapping[str, int]
    capsules: tuple[Capsule, ...]
    pairs: tuple[LinkPair, ...]

    @property
    def moving_pieces(self) -> tuple[Piece, ...]:
        """The pieces that joints move: only these can be kept clear of obstacles."""
        return tuple(piece for piece in self.pieces if self.joints[piece.link])

    @cached_property
    def apart(self) -> tuple[tuple[int, int], ...]:
        """Indices of every two pieces of links that must not touch, pair of links by pair of links."""
        of_link = {link: [i for i, each in enumerate(self.pieces) if each.link == link] for link in self.joints}
        kept = [pair for pair in self.pairs if not pair.left_out]
        return tuple(both for pair in kept for both in product(of_link[pair.first], of_link[pair.second]))

    @property
    def moving_capsules(self) -> tuple[Capsule, ...]:
        """Their capsules."""
        return tuple(capsule for capsule in self.capsules if self.joints[capsule.link])


def load_shape(urdf: str, model: "pin.Model", keep: Path | None) -> Shape:
    """Load the shape that a URDF gives its robot.

    Args:
        urdf: Its text, with the meshes in it (``cnpgen.robots.shape.inline``).
        model: Its Pinocchio model, reduced to the planned joints.
        keep: Folder in which capsules and pairs are kept, since they take some seconds to find; None to keep nothing.

    Raises:
        RecipeError: The URDF has no collision geometry, or some that cannot be read.
    """
    pieces, joints = _placed(link_pieces(urdf), model)
    if not any(joints.values()):
        raise RecipeError(["no link that moves has a <collision> element, so that the robot has no shape"])
    numbers = [REVISION, urdf, list(model.names), list(model.lowerPositionLimit), list(model.upperPositionLimit)]
    name = f"shape-{hashlib.sha256(json.dumps(numbers).encode()).hexdigest()[:32]}.json"
    if keep is not None:
        with suppress(OSError, ValueError, KeyError, TypeError):
            return Shape(pieces, joints, *_read(json.loads((keep / name).read_text(encoding="utf-8")), pieces))
    capsules = tuple(covering_capsule(_of(link, pieces)) for link in joints)
    by_link = {capsule.link: capsule for capsule in capsules}
    pairs = find_pairs(
        model, pieces, by_link, joints=joints, adjacent=_adjacent(urdf, set(joints)), disabled=disabled_pairs(urdf)
    )
    if keep is not None:
        with suppress(MachineError):
            write_file(keep / name, json.dumps(_written(capsules, pairs)))
    return Shape(pieces, joints, capsules, pairs)


def _of(link: str, pieces: tuple[Piece, ...]) -> list[Piece]:
    return [piece for piece in pieces if piece.link == link]


def _placed(pieces: list[Piece], model: "pin.Model") -> tuple[tuple[Piece, ...], dict[str, int]]:
    """Move pieces from the frames of their links to those of the joints that move them."""
    placed, joints = [], {}
    for piece in pieces:
        frame = model.frames[frame_of(model, piece.link)]
        placed.append(piece.moved(np.array(frame.placement.rotation), np.array(frame.placement.translation)))
        joints[piece.link] = int(frame.parentJoint)
    return tuple(placed), joints


def _adjacent(urdf: str, shaped: set[str]) -> frozenset[frozenset[str]]:
    """List the pairs of a link and its nearest ancestor that has a shape."""
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


def _written(capsules: tuple[Capsule, ...], pairs: tuple[LinkPair, ...]) -> dict[str, Any]:
    entries = [asdict(each) | {"first": each.first.tolist(), "second": each.second.tolist()} for each in capsules]
    return {"capsules": entries, "pairs": [asdict(pair) for pair in pairs]}


def _read(content: dict[str, Any], pieces: tuple[Piece, ...]) -> tuple[tuple[Capsule, ...], tuple[LinkPair, ...]]:
    """Return what was kept; a ValueError says that a capsule does not cover its link."""
    capsules = tuple(
        Capsule(**each | {"first": np.array(each["first"]), "second": np.array(each["second"])})
        for each in content["capsules"]
    )
    if not all(covers(capsule, _of(capsule.link, pieces)) for capsule in capsules):
        raise ValueError("a capsule does not cover its link")
    return capsules, tuple(LinkPair(**pair) for pair in content["pairs"])
