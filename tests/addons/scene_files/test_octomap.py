"""Octomaps become boxes that contain their occupied cells, whatever the encoding."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.addons.scene_files.octomap import DEPTH, decoded_cells
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.scenes import SceneError, SceneProblem, load_scenes
from tests.refusals import is_refused

RESOLUTION = 0.05
Tree = dict[int, Any] | bool  # children by their index, or a leaf: occupied or free


def tree_of(
    occupied: set[tuple[int, int, int]], free: set[tuple[int, int, int]]
) -> Tree:
    """Return the octree of cells of the finest level, by the bits of their coordinates from the highest on."""
    root: dict[int, Any] = {}
    for cells, value in ((occupied, True), (free, False)):
        for x, y, z in cells:
            node = root
            for level in range(DEPTH - 1, -1, -1):
                child = (x >> level & 1) | (y >> level & 1) << 1 | (z >> level & 1) << 2
                if level == 0:
                    node[child] = value
                else:
                    node = node.setdefault(child, {})
    return root


def binary(node: dict[int, Any]) -> bytes:
    """Encode an inner node as OctoMap's writeBinaryNode does: 01 is free, 10 occupied, 11 an inner node."""
    bits, below = 0, b""
    for child in range(8):
        value = node.get(child)
        if isinstance(value, dict):
            bits |= 3 << 2 * child
            below += binary(value)
        elif value is not None:
            bits |= (2 if value else 1) << 2 * child
    return struct.pack("<H", bits) + below


def full(node: Tree) -> bytes:
    """Encode a node as OctoMap's writeNodesRecurs does."""
    if isinstance(node, bool):
        return struct.pack("<fB", 0.85 if node else -0.4, 0)
    mask = sum(1 << child for child in node)
    return struct.pack("<fB", 0.85, mask) + b"".join(
        full(node[child]) for child in sorted(node)
    )


def random_tree(seed: int) -> tuple[set[tuple[int, int, int]], Tree]:
    random = np.random.default_rng(seed)
    center = 1 << DEPTH - 1
    cells = {
        tuple(cell) for cell in (center + random.integers(6, 14, (40, 3))).tolist()
    }
    others = {
        tuple(cell) for cell in (center + random.integers(-4, 6, (30, 3))).tolist()
    }
    return cells, tree_of(cells, others - cells)


@pytest.mark.parametrize("is_binary", [True, False])
def test_both_encodings_are_decoded(is_binary: bool) -> None:
    cells, tree = random_tree(3)
    assert isinstance(tree, dict)
    data = binary(tree) if is_binary else full(tree)
    found = decoded_cells(data, is_binary=is_binary, where="here")
    assert {cell[:3] for cell in found} == cells
    assert {cell[3] for cell in found} == {1}


def scene_with(folder: Path, octomap: dict[str, Any], **others: Any) -> SceneProblem:
    content = {
        "world": {
            "collision_objects": [],
            "octomap": {
                "header": {"frame_id": "world"},
                "origin": {"position": [0.1, 0.2, 0], "orientation": [0, 0, 0, 1]},
                "octomap": {"id": "OcTree", "resolution": RESOLUTION} | octomap,
            },
        },
        "start_state": {"joint_state": {"name": ["a"], "position": [0]}},
        "goal_constraints": [
            {"joint_constraints": [{"joint_name": "a", "position": 1}]}
        ],
    } | others
    (folder / "scene.yaml").write_text(json.dumps(content))
    (scene,) = load_scenes(folder / "scene.yaml")
    return scene


@pytest.mark.parametrize("seed", range(3))
def test_boxes_contain_the_occupied_cells_and_little_else(
    tmp_path: Path, seed: int
) -> None:
    cells, tree = random_tree(seed)
    assert isinstance(tree, dict)
    data = [byte - 256 if byte > 127 else byte for byte in binary(tree)]
    scene = scene_with(tmp_path, {"binary": True, "data": data})
    solids = solids_of(scene.obstacles, place_obstacles(scene.obstacles))
    low, high = (
        np.array([getattr(each, name) for each in solids]) for name in ("low", "high")
    )
    corner = (np.array(sorted(cells)) - (1 << DEPTH - 1)) * RESOLUTION + [0.1, 0.2, 0]
    inside = (low - 1e-9 <= corner[:, None]) & (
        corner[:, None] + RESOLUTION <= high + 1e-9
    )
    assert inside.all(axis=2).any(axis=1).all()
    volume = np.prod(high - low, axis=1).sum()
    assert volume == pytest.approx(len(cells) * RESOLUTION**3, rel=1e-6)


def test_leaves_above_the_finest_level_are_boxes_of_their_size(tmp_path: Path) -> None:
    # twelve inner nodes: child 7, then child 0, down to an occupied leaf of 2^3 cells
    node: Tree = True
    for child in [0] * 12 + [7]:
        node = {child: node}
    assert isinstance(node, dict)
    scene = scene_with(tmp_path, {"binary": True, "data": list(binary(node))})
    (box,) = scene.obstacles
    np.testing.assert_allclose(box.size, [8 * RESOLUTION] * 3)
    np.testing.assert_allclose(box.position, np.array([0.1, 0.2, 0]) + 4 * RESOLUTION)


@pytest.mark.parametrize(
    ("octomap", "text"),
    [
        ({"binary": True, "data": [1, 2, 3]}, "it ends after 2 of 3 bytes"),
        ({"binary": True, "data": [3, 0]}, "it is cut off at byte 2"),
        ({"binary": False, "data": [0, 0, 0]}, "it is cut off at byte 0"),
        ({"binary": True, "data": [3, 0] * 40}, "more than 16 levels"),
        ({"binary": True, "data": [0.5, 2]}, "data must be bytes"),
        ({"binary": True, "data": [300, 2]}, "data must be bytes"),
        ({"id": "ColorOcTree", "data": [1]}, "id must be OcTree, got 'ColorOcTree'"),
        ({"resolution": 0, "data": [1]}, "resolution must be 0.001 to 1 m, got 0"),
        ({"resolution": "nan", "data": [1]}, "resolution must be"),
        ({"binary": True, "data": [2, 0]}, "reaches 1.64e\\+03 m from its origin"),
    ],
)
def test_damaged_octomaps_are_refused(
    tmp_path: Path, octomap: dict[str, Any], text: str
) -> None:
    with pytest.raises(SceneError, match=f"octomap.*{text}"):
        scene_with(tmp_path, octomap)


def test_an_octomap_without_data_is_none(tmp_path: Path) -> None:
    assert not scene_with(tmp_path, {"data": []}).obstacles


@pytest.mark.parametrize("key", ["dat", "occupancy"])
def test_an_unknown_key_of_an_octomap_without_data_is_refused(
    tmp_path: Path, key: str
) -> None:
    with is_refused(SceneError, argument="allow_unused"):
        scene_with(tmp_path, {"data": [], key: [1]})
