"""Scenes of a batch of candidates: obstacles as stored, grasps, and bodies for compiled collision checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.arrays import Array, Integers
from cnpgen.kernels.collision.body_arrays import Bodies, primitive_bodies
from cnpgen.pipelines.scene_family import Layout
from cnpgen.robots.observation.primitives import KINDS, table_primitives
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.cylinder_shape import CylinderShape
from cnpgen.robots.scene import make_scene_table, scene_poses
from cnpgen.store.scene_table import SceneTable

_PRISM_FACTOR = 1 / CylinderShape.radius_share


@dataclass(frozen=True, eq=False)
class BatchScenes:
    """S scenes of a batch of candidates.

    Attributes:
        table: Their obstacles, in the stored float type; ``scene_ids`` are the indices
            in the batch.
        poses: Poses and sizes of the problem's obstacles in each scene
            (``Scene.poses``), shape (S, width).
        grasp_count: Number of grasps, shape (S,); further entries are padding.
        grasp_position: Positions of the tip [m], shape (S, G, 3).
        grasp_approach: Unit vectors of the approaches, shape (S, G, 3).
        grasp_tilt: Largest angles from the approach [rad], shape (S, G).
    """

    table: SceneTable
    poses: Array
    grasp_count: Integers
    grasp_position: Array
    grasp_approach: Array
    grasp_tilt: Array

    def __len__(self) -> int:
        return len(self.table)

    @cached_property
    def bodies(self) -> tuple[Bodies, Array]:
        """Bodies, shape (S, O), and bounding boxes, shape (S, 16, O padded), as of ``obstacle_bodies``."""
        scenes = table_primitives(self.table)
        # Of a cylinder that contains the prism of judges.
        scenes.sizes[scenes.kinds == KINDS.index("cylinder"), 0] *= _PRISM_FACTOR
        bodies, _, boxes = primitive_bodies(scenes, 0)
        return bodies, boxes


def batch_scenes(
    layouts: Sequence[Layout],
    families: Sequence[int],
    obstacles: Sequence[Obstacle],
    capacity: int,
    dtype: str,
) -> BatchScenes:
    """Return scenes of a batch with at most ``capacity`` obstacles each, in the stored float type."""
    table = make_scene_table(
        [layout.obstacles for layout in layouts], families, capacity
    ).astype(dtype)
    count = np.array([len(layout.grasps) for layout in layouts], np.int64)
    # Scenes have different numbers of grasps; further entries are padding.
    real = np.arange(max(count.max(initial=0), 1)) < count[:, None]
    flat = [grasp for layout in layouts for grasp in layout.grasps]
    position, approach, tilt = (
        np.zeros((*real.shape, *tail)) for tail in ((3,), (3,), ())
    )
    # A unit vector as padding, so that nothing divides by zero.
    approach[..., 2] = 1.0
    if flat:
        position[real] = [grasp.position for grasp in flat]
        approach[real] = [grasp.approach for grasp in flat]
        tilt[real] = [grasp.tilt for grasp in flat]
    return BatchScenes(
        table, scene_poses(obstacles, table), count, position, approach, tilt
    )
