"""The shape of a robot in words and numbers: its links with their capsules, and its pairs of links."""

import math
from typing import Any

from cnpgen.robots.shape.link_pairs import LinkPair
from cnpgen.robots.shape.shape import Shape

_LEFT_OUT = {
    "adjacent": "ignored: joined by a joint",
    "always": "ignored: always in contact",
    "disabled": "ignored: disabled by the SRDF or by ignored_pairs",
}


def link_rows(shape: Shape) -> list[tuple[str, ...]]:
    """List the links: numbers of convex parts and corners, and the capsule that covers them."""
    head = ("link", "convex parts", "corners", "capsule length [mm]", "radius [mm]", "overhang [mm]", "joint")
    rows: list[tuple[str, ...]] = [head]
    for capsule in shape.capsules:
        parts = [part for part in shape.convex_parts if part.link == capsule.link]
        corners, length = sum(len(part.vertices) for part in parts), math.dist(capsule.first, capsule.second)
        lengths = (f"{1e3 * value:.1f}" for value in (length, capsule.radius, capsule.overhang))
        joint = shape.joints[capsule.link]
        rows.append((capsule.link, str(len(parts)), str(corners), *lengths, str(joint) if joint else "none"))
    return rows


def pair_rows(shape: Shape) -> list[tuple[str, ...]]:
    """List the pairs of links: share of random states in which they collide, and their users."""
    head = ("links", "", "colliding", "false capsule contacts", "checked by")
    return [head, *((pair.first, pair.second, *_shares(pair), _use(pair)) for pair in shape.pairs)]


def _shares(pair: LinkPair) -> tuple[str, str]:
    return ("", "") if math.isnan(pair.colliding) else (f"{pair.colliding:.2%}", f"{pair.mistaken:.2%}")


def _use(pair: LinkPair) -> str:
    if pair.left_out:
        return _LEFT_OUT[pair.left_out]
    return "judges and solvers" if pair.for_solvers else "judges"


def shape_to_dict(shape: Shape) -> dict[str, Any]:
    """Return links and pairs for JSON, in SI units."""
    capsules = [
        {
            "link": each.link,
            "joint": shape.joints[each.link],
            "convex_parts": sum(part.link == each.link for part in shape.convex_parts),
            "capsule": {"first": each.first.tolist(), "second": each.second.tolist(), "radius": each.radius},
            "overhang": each.overhang,
        }
        for each in shape.capsules
    ]
    pairs = [
        {
            "links": [pair.first, pair.second],
            "left_out": pair.left_out,
            "colliding": None if math.isnan(pair.colliding) else pair.colliding,
            "mistaken": None if math.isnan(pair.mistaken) else pair.mistaken,
            "for_solvers": pair.for_solvers,
        }
        for pair in shape.pairs
    ]
    return {"links": capsules, "pairs": pairs}
