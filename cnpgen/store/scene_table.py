"""Scenes of a shard: each scene once, in arrays that are padded to the largest number of obstacles.

Every sample has the ``scene_id`` of its scene: the ``sample_id`` of the first sample in
it. ``scene_ids`` ascends, so ``numpy.searchsorted(scene_ids, scene_id)`` returns the
index of the scene of each sample.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from cnpgen.arrays import AnyArray, Indices, Integers
from cnpgen.documents import JsonObject
from cnpgen.errors import DatasetError
from cnpgen.store.field import Field

SCENE_ID = "scene_id"
# Column of a sample or plan with its obstacles, instead of the problem's.
OBSTACLE_POSES = "obstacle_poses"
OBSTACLE_KINDS = ("box", "sphere", "cylinder", "capsule")  # index: the code of a kind
NO_OBSTACLE = -1  # kind of the entries that pad a scene
_KINDS_TEXT = f"{NO_OBSTACLE} for none; " + ", ".join(
    f"{code} {kind}" for code, kind in enumerate(OBSTACLE_KINDS)
)
_SIZES_TEXT = "edge lengths of a box; otherwise radius, length along the z axis (0 for a sphere), and 0"


@dataclass(frozen=True)
class SceneArray:
    """Description of one array of a scene table; its convention is the order of the values, or their code.

    ``per_obstacle`` is the number of values of each obstacle, 0 for one value; None for
    one value of each scene.
    """

    name: str
    unit: str
    long_name: str
    dtype: str
    per_obstacle: int | None = None
    convention: str = ""

    def shape(self, scenes: int, obstacles: int) -> tuple[int, ...]:
        """Return the shape for S scenes with up to O obstacles."""
        if self.per_obstacle is None:
            return (scenes,)
        return (
            (scenes, obstacles, self.per_obstacle)
            if self.per_obstacle
            else (scenes, obstacles)
        )

    def field(self, obstacles: int) -> Field:
        """Return the field of its values for one sample, flattened."""
        width = (
            0 if self.per_obstacle is None else obstacles * max(self.per_obstacle, 1)
        )
        return Field(
            self.name,
            self.unit,
            self.long_name,
            width,
            role="context",
            dtype=self.dtype,
        )


SCENE_ARRAYS = (
    SceneArray(
        "scene_ids",
        "1",
        "IDs of the scenes: sample_id of their first samples, ascending",
        "int64",
    ),
    SceneArray("scene_family", "1", "family of each scene", "int64"),
    SceneArray(
        "obstacle_count",
        "1",
        "number of obstacles of each scene; further entries are padding",
        "int64",
    ),
    SceneArray("obstacle_kind", "1", "kind of each obstacle", "int64", 0, _KINDS_TEXT),
    SceneArray("obstacle_size", "m", "sizes of each obstacle", "float", 3, _SIZES_TEXT),
    SceneArray(
        "obstacle_position", "m", "center of each obstacle", "float", 3, "x, y, z"
    ),
    SceneArray(
        "obstacle_quaternion",
        "1",
        "rotation of each obstacle's axes",
        "float",
        4,
        "w, x, y, z",
    ),
)


@dataclass(frozen=True, eq=False)
class SceneTable:
    """S scenes with up to O obstacles each; the names of the attributes are those of ``SCENE_ARRAYS``.

    Attributes:
        scene_ids: IDs, ascending, shape (S,).
        scene_family: Indices of their families, shape (S,).
        obstacle_count: Numbers of obstacles, shape (S,).
        obstacle_kind: Codes of the kinds, index in ``OBSTACLE_KINDS`` or
            ``NO_OBSTACLE``, shape (S, O).
        obstacle_size: Sizes [m], shape (S, O, 3): edge lengths of a box; radius, length
            and 0 of a cylinder or of a capsule without its round ends; radius and zeros
            of a sphere.
        obstacle_position: Centers in the frame of the robot's base [m], shape (S, O,
            3).
        obstacle_quaternion: Quaternions (w, x, y, z) of length 1, shape (S, O, 4).
    """

    scene_ids: Integers
    scene_family: Integers
    obstacle_count: Integers
    obstacle_kind: Integers
    obstacle_size: AnyArray
    obstacle_position: AnyArray
    obstacle_quaternion: AnyArray

    def __len__(self) -> int:
        return len(self.scene_ids)

    def __getitem__(self, scenes: AnyArray | slice) -> SceneTable:
        """Select scenes by indices, a mask or a slice."""
        return SceneTable(**{name: values[scenes] for name, values in self.arrays()})

    def arrays(self) -> Iterator[tuple[str, AnyArray]]:
        """Yield names and arrays, in stored order."""
        return ((item.name, getattr(self, item.name)) for item in fields(self))

    def rows_of(self, scene_id: Integers) -> Indices:
        """Return the index of the scene of each of N samples, shape (N,).

        An unknown scene ID raises DatasetError.
        """
        # scene_ids ascend; an ID above the last one is compared with the last scene and
        # refused.
        rows = np.minimum(
            np.searchsorted(self.scene_ids, scene_id), max(len(self) - 1, 0)
        )
        if len(scene_id) and (
            not len(self) or (self.scene_ids[rows] != scene_id).any()
        ):
            raise DatasetError("the scene_id of a sample is not among the scene_ids")
        return rows

    def astype(self, dtype: str) -> SceneTable:
        """Return the scenes in the stored types of a dataset with a float type."""
        stored = {"float": np.dtype(dtype).newbyteorder("<"), "int64": np.dtype("<i8")}
        kinds = {item.name: item.dtype for item in SCENE_ARRAYS}
        return SceneTable(
            **{
                name: np.ascontiguousarray(values, stored[kinds[name]])
                for name, values in self.arrays()
            }
        )


def concatenate_scenes(tables: Sequence[SceneTable]) -> SceneTable:
    """Return the scenes of several tables in one; all must have the same capacity."""
    names = [item.name for item in SCENE_ARRAYS]
    return SceneTable(
        **{
            name: np.concatenate([getattr(table, name) for table in tables])
            for name in names
        }
    )


def distinct_scenes(tables: Sequence[SceneTable]) -> SceneTable:
    """Return the scenes of consecutive shards, each once: a scene may have its last samples in the next shard."""
    table = concatenate_scenes(tables)
    # The first occurrence of each ID, in ascending order.
    return table[np.unique(table.scene_ids, return_index=True)[1]]


def scene_attributes(families: Sequence[str]) -> dict[str, JsonObject]:
    """Return the HDF5 attributes of the arrays for families in the order of their indices."""
    return {
        item.name: {
            "units": item.unit,
            "long_name": item.long_name,
            "role": "context",
            "frame": "world" if item.dtype == "float" else "",
            "names": json.dumps(list(families) if item.name == "scene_family" else []),
            "convention": item.convention,
        }
        for item in SCENE_ARRAYS
    }


def check_scenes(
    table: SceneTable, obstacles: int, scene_id: Integers, families: int
) -> None:
    """Check the scenes of a shard with a capacity of obstacles and a number of families; raise DatasetError.

    IDs must be those of the samples, shape (rows,); numbers, kinds, sizes and
    quaternions must be valid.
    """
    check_shapes({name: values.shape for name, values in table.arrays()}, obstacles)
    if not np.array_equal(table.scene_ids, np.unique(scene_id)):
        raise DatasetError(
            "scene_ids are not the scene_id of the samples, each once and ascending"
        )
    # Mask of the entries that are obstacles; the others are padding.
    real = np.arange(obstacles) < table.obstacle_count[:, None]
    kind, sizes = table.obstacle_kind, table.obstacle_size
    norms = np.linalg.norm(table.obstacle_quaternion.astype(float), axis=-1)
    values = (table.obstacle_size, table.obstacle_position, table.obstacle_quaternion)
    problems = {
        "obstacle_count": (table.obstacle_count < 0)
        | (table.obstacle_count > obstacles),
        "scene_family": (table.scene_family < 0) | (table.scene_family >= families),
        "obstacle_kind": (
            np.where(
                real, (kind < 0) | (kind >= len(OBSTACLE_KINDS)), kind != NO_OBSTACLE
            )
        ).any(axis=1),
        # Each shape has a positive first size; unused sizes are zero.
        "obstacle_size": ((sizes < 0).any(axis=-1) | (real & ~(sizes[..., 0] > 0))).any(
            axis=1
        ),
        # Norms of float32 differ from 1 by rounding; the comparison is false for nan.
        "obstacle_quaternion": ~(np.abs(norms - 1) <= 1e-5).all(axis=1),
        "numbers": ~np.all(
            [np.isfinite(each).all(axis=(1, 2)) for each in values], axis=0
        ),
    }
    for name, wrong in problems.items():
        if wrong.any():
            scene = int(table.scene_ids[int(wrong.argmax())])
            raise DatasetError(
                f"{name} of {int(wrong.sum())} scenes are invalid, first those of scene {scene}"
            )


def check_shapes(shapes: Mapping[str, tuple[int, ...]], obstacles: int) -> None:
    """Raise DatasetError if the arrays of a scene table do not have the shapes for up to ``obstacles`` obstacles."""
    scenes = shapes.get("scene_ids") or (0,)
    for item in SCENE_ARRAYS:
        expected = item.shape(scenes[0], obstacles)
        if shapes.get(item.name) != expected:
            raise DatasetError(
                f"{item.name} must have shape {expected}, got {shapes.get(item.name)}"
            )
