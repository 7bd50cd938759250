"""Convex parts of an arm's links, chosen by the free space that they reject, and pairs in permanent contact."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

from cnpgen.addons.init.hull_gap import GAP_STATES, HullGap, PairGap, measure_hull_gap
from cnpgen.documents import Names
from cnpgen.errors import listed
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.shape.inline import mesh_links
from cnpgen.robots.shape.link_pairs import LinkPair
from cnpgen.robots.urdf import read_urdf
from cnpgen.robots.urdf_changes import with_collision_geometry

# Fraction of the free states that convex parts may reject without further
# decomposition.
MAX_GAP = 0.01
MAX_PAIR_GAP = 1e-3  # of a pair whose links are not decomposed further
LARGE_PAIR_GAP = 0.02  # of a pair that a note names
# Maximum numbers of convex parts of a mesh, in the order in which they are tried.
PART_COUNTS = 4, 8, 16
# Of the sampled states, below which pairs in contact are ignored.
MIN_FREE_FRACTION = 0.01
MAX_IGNORED_PAIRS = 20
# Of the random states, from which on a note names a pair.
LARGE_COLLIDING_FRACTION = 0.1
MAX_LISTED_PAIRS = 6  # of a note


@dataclass(frozen=True)
class LinkOverlaps:
    """A problem with decomposed links and ignored pairs, with the gaps of the hulls and the parts, and notes."""

    problem: Problem
    hulls: HullGap
    parts: HullGap
    notes: Names


def resolve_overlaps(problem: Problem) -> LinkOverlaps:
    """Decompose the links whose hulls reject much free space, and ignore pairs in contact if no state is free."""
    hulls = _gap(problem)
    problem, parts = _decompose(problem, hulls)
    problem, parts, contacts = _ignore_contacts(problem, parts)
    shape = load_robot(problem).shape
    ignored = problem.robot.ignored_pairs
    # Problems of ``init`` have the geometry of the URDF.
    assert shape is not None
    contacts += _pair_notes(shape.pairs, {*map(frozenset, ignored)})
    problem = replace(
        problem, robot=replace(problem.robot, hull_gap=round(parts.fraction, 4))
    )
    return LinkOverlaps(
        problem, hulls, parts, (*_gap_notes(problem, hulls, parts), *contacts)
    )


def _gap(problem: Problem) -> HullGap:
    """Measure the gap of a problem's convex parts."""
    robot = load_robot(problem)
    path = problem.urdf_path
    assert robot.shape is not None
    return measure_hull_gap(
        _urdf(problem), path, problem.packages, model=robot.model, shape=robot.shape
    )


def _urdf(problem: Problem) -> str:
    """Return the URDF that names its mesh files, with the collision elements of the problem."""
    spec = problem.robot
    return with_collision_geometry(
        read_urdf(problem.urdf_path), spec.visual_links, spec.skipped_meshes
    )


def _decompose(problem: Problem, gap: HullGap) -> tuple[Problem, HullGap]:
    """Decompose links, into more parts each time, until the gap is small."""
    meshes = mesh_links(_urdf(problem))
    chosen: list[str] = []
    for count in PART_COUNTS:
        if gap.fraction <= MAX_GAP and not gap.hidden:
            break
        large = [
            *gap.hidden,
            *takewhile(lambda pair: pair.rejected > MAX_PAIR_GAP, gap.pairs),
        ]
        links = dict.fromkeys(
            link
            for pair in large
            for link in (pair.first, pair.second)
            if link in meshes
        )
        chosen = list(dict.fromkeys([*chosen, *links]))
        if not links:
            break
        print(
            f"cnpgen: decomposing {', '.join(chosen)} into at most {count} convex parts each",
            file=sys.stderr,
        )
        robot = replace(problem.robot, convex_parts=count, decomposed=tuple(chosen))
        problem = replace(problem, robot=robot)
        gap = _gap(problem)
    return problem, gap


def _ignore_contacts(
    problem: Problem, gap: HullGap
) -> tuple[Problem, HullGap, list[str]]:
    """Ignore the pairs that overlap most often until some sampled states are free."""
    ignored: list[PairGap] = []
    while (
        gap.accepted < MIN_FREE_FRACTION * GAP_STATES
        and len(ignored) < MAX_IGNORED_PAIRS
    ):
        # The pair that overlaps in most states blocks the most free space.
        ignored.append(max(gap.pairs, key=lambda pair: pair.parts))
        pairs = tuple((pair.first, pair.second) for pair in ignored)
        problem = replace(problem, robot=replace(problem.robot, ignored_pairs=pairs))
        gap = _gap(problem)
    notes = [
        f"ignored, since otherwise no state is free of collisions: {_overlap(pair)}"
        for pair in ignored
    ]
    return problem, gap, notes


def _pair_notes(
    pairs: Sequence[LinkPair], ignored: set[frozenset[str]]
) -> Iterator[str]:
    """Yield sentences about pairs in permanent contact, pairs that collide often, and pairs that an SRDF disables."""
    if always := [pair for pair in pairs if pair.left_out == "always"]:
        names = "; ".join(f"{pair.first}, {pair.second}" for pair in always)
        yield f"not checked, since they are always in contact: {names}"
    often = [
        pair
        for pair in pairs
        if not pair.left_out and pair.colliding > LARGE_COLLIDING_FRACTION
    ]
    if often:
        remedy = (
            "if that is impossible, pass --srdf or name the pair in 'ignored_pairs'"
        )
        yield f"these links collide in many states: {_shares(often)}; {remedy}"
    disabled = [
        pair for pair in pairs if pair.left_out == "disabled" and pair.colliding > 0
    ]
    if missed := [
        pair for pair in disabled if frozenset((pair.first, pair.second)) not in ignored
    ]:
        yield f"the SRDF disables links that collide, and these collisions are not noticed: {_shares(missed)}"


def _shares(pairs: list[LinkPair]) -> str:
    """List pairs with their fractions of the random states, the largest first."""
    pairs = sorted(pairs, key=lambda pair: -pair.colliding)
    return listed(
        [f"{pair.first} and {pair.second} ({pair.colliding:.1%})" for pair in pairs],
        most=MAX_LISTED_PAIRS,
    )


def _overlap(pair: PairGap) -> str:
    shares = f"their convex parts overlap in {pair.parts:.1%} of the random states, their meshes in {pair.meshes:.1%}"
    return f"{pair.first}, {pair.second} ({shares})"


def _gap_notes(problem: Problem, hulls: HullGap, parts: HullGap) -> list[str]:
    """Report the gaps before and after the decomposition."""
    if not mesh_links(read_urdf(problem.urdf_path)):
        return []
    text = f"free space: convex hulls of the meshes reject {hulls.fraction:.2%} of the states that the meshes accept"
    if problem.robot.decomposed:
        text += f", the convex parts {parts.fraction:.2%}; decomposed: {', '.join(problem.robot.decomposed)}"
    notes = [text]
    for pair in takewhile(lambda pair: pair.rejected > LARGE_PAIR_GAP, parts.pairs):
        rejected = (
            f"the pair {pair.first}, {pair.second} rejects {pair.rejected:.2%} of them"
        )
        notes.append(
            f"{rejected}: finer convex parts of its links or 'ignored_pairs' would accept them"
        )
    if parts.hidden:
        hidden = "; ".join(map(_overlap, parts.hidden))
        notes.append(
            f"not checked, although their meshes are not always in contact: {hidden}"
        )
    return notes
