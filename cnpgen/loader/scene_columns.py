"""Columns of the scene of each sample, expanded from the scenes of a shard."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.scene import scene_poses
from cnpgen.robots.solid import pose_width
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import parse, stored_values
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SceneTable

OBSTACLE_POSES = "obstacle_poses"


def problem_obstacles(spec: DatasetSpec) -> tuple[Obstacle, ...]:
    """Return the obstacles of the problem of a dataset with scenes, those that samples place included; else none."""
    if not spec.scene_obstacles:
        return ()
    tables = spec.recipe["pipeline"]["problem"]["obstacle"]
    given = [{key: value for key, value in table.items() if value is not None} for table in tables]
    with stored_values():
        parsed = [parse(Obstacle, table, where=RecipeLocation("obstacle"), mistakes=[]) for table in given]
    return tuple(obstacle for obstacle in parsed if obstacle is not None)


def scene_fields(spec: DatasetSpec) -> tuple[Field, ...]:
    """Return the fields of the scene of each sample; empty for a dataset without scenes.

    ``obstacle_poses`` has the layout of the problem's obstacles (``cnpgen.robots.solid``). The others are the arrays of
    the shards, flattened: ``obstacle_position`` has shape (N, 3 O).
    """
    if not spec.scene_obstacles:
        return ()
    text = "poses and sizes of the problem's obstacles in the scene"
    width = pose_width(problem_obstacles(spec))
    return (Field(OBSTACLE_POSES, "m", text, width, role="context", frame="world"), *spec.scene_fields)


@dataclass(frozen=True, eq=False)
class SceneColumn:
    """A field of the scenes of the rows of a shard; indexing computes the values of the selected rows only.

    The index of the scene of each row has shape (rows,).
    """

    name: str
    table: SceneTable
    index: NDArray[np.intp]
    obstacles: Sequence[Obstacle]
    dtype: np.dtype[Any]

    def __getitem__(self, rows: Any) -> NDArray[Any]:
        """Return the values of rows, shape (k, width) or (k,)."""
        index = self.index[rows]
        scenes, place = np.unique(index, return_inverse=True)
        chosen = self.table[scenes]
        if self.name == OBSTACLE_POSES:
            return scene_poses(self.obstacles, chosen).astype(self.dtype)[place]
        values: NDArray[Any] = getattr(chosen, self.name)[place]
        return values.reshape(len(index), -1) if values.ndim > 1 else values
