"""Scenes in HDF5 as Motion Policy Networks and Avoid Everything store them.

Datasets at the root, one row per problem: ``cuboid_dims``, ``cuboid_centers``,
``cuboid_quaternions``, ``cylinder_radii``, ``cylinder_heights``, ``cylinder_centers``,
``cylinder_quaternions``; here also ``sphere_radii`` and ``sphere_centers``. Lengths are
in m, quaternions are (w, x, y, z), and poses are relative to the robot's base. Rows are
padded with zeros, quaternions included: an entry with a size of zero is no obstacle.
The ends are ``start_q`` and ``goal_q``, ``start_configs`` and ``target_configs``, or
the first and last state of trajectories.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.problems.scenes.quaternions import quaternion_of
from cnpgen.problems.scenes.scene_problem import (
    MAX_SCENES,
    SceneError,
    SceneProblem,
    check_count,
    make_obstacle,
)
from cnpgen.problems.scenes.scene_request import SceneRequest
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.obstacle_shapes.obstacle_shape import shape_class
from cnpgen.robots.shape.convex_part import turned
from cnpgen.store.files.accounted import Account, UnusedElements, accounted
from cnpgen.store.files.hdf5 import Hdf5, create_hdf5, open_hdf5

_ENDS = (("start_q", "goal_q"), ("start_configs", "target_configs"))
_TRAJECTORIES = ("global_solutions", "hybrid_solutions", "solutions")  # shape (N, T, n)
UNUSED_ELEMENTS = UnusedElements(
    harmless={},
    unused=dict.fromkeys(_TRAJECTORIES, "trajectories beside starts and goals"),
)
# Kind -> the word in the names of its datasets, and those of its dimensions.
_SHAPES = {
    "box": ("cuboid", "cuboid_dims"),
    "cylinder": ("cylinder", "cylinder_radii", "cylinder_heights"),
    "sphere": ("sphere", "sphere_radii"),
}
SCENE_NAMES = "scene_names"  # attribute: a line of text per scene


def is_mpinets(path: Path) -> bool:
    """Return whether an HDF5 file has the datasets of obstacles."""
    with open_hdf5(path) as file:
        return "cuboid_dims" in file or "cylinder_radii" in file


def read_mpinets(
    path: Path, rows: slice, *, allow_unused: Sequence[str] = ()
) -> Iterator[tuple[SceneProblem, Account]]:
    """Yield the problems of a file with the account of its datasets.

    DatasetError if it is damaged, SceneError if a dataset or obstacle is invalid.
    """
    account = Account(
        str(path), UNUSED_ELEMENTS, allow_unused=allow_unused, error=SceneError
    )
    with open_hdf5(path) as file:
        _check_names(file, account)
        start, goal = _ends(file, rows)
        count = len(start)
        shapes = {kind: _entries(file, kind, rows, count) for kind in _SHAPES}
        names = _names(file, rows, count)
    for row, name in enumerate(names):
        place = f"{path}: scene {name!r}"
        numbers = {kind: values[row] for kind, values in shapes.items()}
        check_count(
            sum(int(_is_present(values).sum()) for values in numbers.values()),
            place,
        )
        scene = SceneProblem(
            name=name,
            obstacles=tuple(_obstacles(numbers, place)),
            start_q=start[row],
            goal_q=goal[row][None],
            source=str(path),
            request=SceneRequest(accepted=tuple(account.accepted)),
        )
        yield scene, account


def _check_names(file: Hdf5, account: Account) -> None:
    """Refuse datasets and attributes that are not read; trajectories are unused if there are starts and goals."""
    # Starts and goals take precedence, so trajectories beside them are unused.
    ends = next((both for both in _ENDS if all(name in file for name in both)), ())
    trajectory = next((name for name in _TRAJECTORIES if name in file), "")
    used = [*ends] if ends else [trajectory]
    for word, *sizes in _SHAPES.values():
        used += [*sizes, f"{word}_centers", _quaternions(file, word)]
    names: dict[str, Any] = dict.fromkeys((*file.names(), *file.attributes))
    # Attributes of datasets, such as a unit or a scale, may change their numbers.
    names |= {
        name: dict.fromkeys(file[name].attributes) for name in used if name in file
    }
    entries = accounted(names, account)
    for name in (*used, SCENE_NAMES):
        entries.get(name)
    account.finish(entries)
    _check_counts(file, [name for name in used if name in file.names()])


def _check_counts(file: Hdf5, names: Sequence[str]) -> None:
    """Check that datasets have equally many rows: those of a part of a file would match by chance."""
    for name in names:
        shape, scenes = file[name].shape, file[names[0]].shape[:1]
        if shape[:1] != scenes:
            raise SceneError(
                f"{file.path}: {name} must have shape {(*scenes, '...')}, one row per scene of {names[0]}, got {shape}"
            )


def _quaternions(file: Hdf5, word: str) -> str:
    """Return the name of the dataset of the rotations of a kind."""
    return f"{word}_quats" if f"{word}_quats" in file else f"{word}_quaternions"


def _ends(file: Hdf5, rows: slice) -> tuple[Array, Array]:
    """Return the joint positions at start and goal, shape (N, n) each."""
    for names in _ENDS:
        if all(name in file for name in names):
            _check_rows(file, names[0], rows)
            start, goal = (np.asarray(file[name].read(rows), float) for name in names)
            if start.ndim != 2 or start.shape != goal.shape:
                raise SceneError(
                    f"{file.path}: {' and '.join(names)} must have one shape (N, n), got {start.shape}, {goal.shape}"
                )
            return start, goal
    for name in _TRAJECTORIES:
        if name in file:
            _check_rows(file, name, rows)
            states = np.asarray(file[name].read(rows), float)
            if states.ndim != 3 or not states.shape[1]:
                raise SceneError(
                    f"{file.path}: {name} must have shape (N, T, n), got {states.shape}"
                )
            return states[:, 0], states[:, -1]
    known = [" and ".join(names) for names in _ENDS] + list(_TRAJECTORIES)
    raise SceneError(
        f"{file.path} has no starts and goals, expected {', or '.join(known)}"
    )


def _check_rows(file: Hdf5, name: str, rows: slice) -> None:
    shape = file[name].shape
    count = len(range(*rows.indices(shape[0] if shape else 0)))
    if count > MAX_SCENES:
        raise SceneError(
            f"{file.path} has {count:,} scenes, expected at most {MAX_SCENES:,}: choose some by start and n"
        )


def _entries(file: Hdf5, kind: str, rows: slice, count: int) -> Array:
    """Return sizes, centers and quaternions of the obstacles of a kind, shape (N, M, sizes + 7)."""
    word, *names = _SHAPES[kind]
    widths = shape_class(kind).sizes().values()
    # A part of the datasets of a kind is an error: it is not a file without the kind.
    parts = (*names, f"{word}_centers", _quaternions(file, word))
    if not any(name in file for name in parts):
        return np.zeros((count, 0, sum(widths) + 7))
    columns = [
        _column(file, name, width, rows, count)
        for name, width in zip(names, widths, strict=True)
    ]
    columns.append(_column(file, f"{word}_centers", 3, rows, count))
    if kind == "sphere":
        columns.append(
            # Spheres have no quaternions in the file: theirs is the identity.
            np.broadcast_to([1.0, 0.0, 0.0, 0.0], (*columns[0].shape[:2], 4))
        )
    else:
        columns.append(_column(file, _quaternions(file, word), 4, rows, count))
    if len({column.shape[1] for column in columns}) > 1:
        counts = [column.shape[1] for column in columns]
        raise SceneError(
            f"{file.path}: the datasets of {word}s have different numbers of entries: {counts}"
        )
    return np.concatenate(columns, axis=2)


def _column(file: Hdf5, name: str, width: int, rows: slice, count: int) -> Array:
    """Return a dataset of shape (N, M, width), (N, M) of numbers, or (N, width) of one obstacle per row."""
    if name not in file:
        raise SceneError(f"{file.path} lacks {name}")
    values = np.asarray(file[name].read(rows), float)
    if values.ndim == 2:
        # Two axes are one number for each of M obstacles, or one obstacle per row.
        values = values[:, :, None] if width == 1 else values[:, None]
    if values.ndim != 3 or len(values) != count or values.shape[2] != width:
        raise SceneError(
            f"{file.path}: {name} must have shape ({count}, M, {width}), got {file[name].shape}"
        )
    return values


def _names(file: Hdf5, rows: slice, count: int) -> list[str]:
    """Return the names of the scenes: those in the file, or the numbers of their rows."""
    if SCENE_NAMES not in file.attributes:
        # Numbers of rows are those of the file, also for a part of it.
        first = rows.start or 0
        return [str(first + row) for row in range(count)]
    text = file.attributes[SCENE_NAMES]
    names = (
        text.decode(errors="replace") if isinstance(text, bytes) else str(text)
    ).split("\n")[rows]
    if len(names) != count:
        raise SceneError(
            f"{file.path}: {SCENE_NAMES} must have {count} lines, got {len(names)}"
        )
    return names


def _is_present(values: Array) -> Mask:
    """Return which entries are obstacles: those without a size of zero."""
    # Nan counts as a size.
    # Seven numbers of the pose follow.
    return np.asarray((values[:, :-7] != 0).all(axis=1))


def _obstacles(numbers: dict[str, Array], place: str) -> Iterator[Obstacle]:
    for kind, values in numbers.items():
        for index in np.flatnonzero(_is_present(values)).tolist():
            sizes, center, quaternion = np.split(values[index], [-7, -4])
            yield make_obstacle(
                f"{_SHAPES[kind][0]} {index}",
                kind,
                sizes,
                center,
                quaternion,
                place=place,
            )


def mpinets_bytes(scenes: Sequence[SceneProblem]) -> bytes:
    """Return scenes, with one goal state and equal numbers of joints, as HDF5.

    Equal scenes give equal bytes.
    """
    import h5py

    for scene in scenes:
        if len(scene.goal_q) != 1 or scene.start_q.shape != scenes[0].start_q.shape:
            raise SceneError(
                f"{scene.place} has {len(scene.goal_q)} goal states, HDF5 files have one start and one goal"
            )
        for obstacle in scene.obstacles:
            if obstacle.kind not in _SHAPES or obstacle.position is None:
                raise SceneError(
                    f"{scene.place}: obstacle {obstacle.name!r} is a {obstacle.kind}: HDF5 has no such shape"
                )
    columns = {"start_q": np.array([scene.start_q for scene in scenes])}
    columns["goal_q"] = np.array([scene.goal_q[0] for scene in scenes])
    for kind in _SHAPES:
        columns |= _padded(
            kind,
            [
                [item for item in scene.obstacles if item.kind == kind]
                for scene in scenes
            ],
        )
    buffer = io.BytesIO()
    with h5py.File(create_hdf5(buffer)) as file:
        for name, values in columns.items():
            # Times of writing would make equal scenes different bytes.
            file.create_dataset(name, data=values, track_times=False)
        text = "\n".join(scene.name.replace("\n", " ") for scene in scenes).encode()
        file.attrs[SCENE_NAMES] = np.array(text, h5py.string_dtype("utf-8", len(text)))
    return buffer.getvalue()


def _padded(kind: str, obstacles: list[list[Obstacle]]) -> dict[str, Array]:
    """Return the datasets of a kind, padded with zeros."""
    word, *names = _SHAPES[kind]
    widths = shape_class(kind).sizes().values()
    most = max(map(len, obstacles), default=0)
    # Files of others have no spheres, so an empty dataset is left out.
    if kind == "sphere" and not most:
        return {}
    count = len(obstacles)
    values = np.zeros((count, most, sum(widths) + 7))
    for row, items in enumerate(obstacles):
        for index, item in enumerate(items):
            values[row, index] = [
                *item.form.lengths(),
                *(item.position or ()),
                *quaternion_of(turned(*item.rotation)),
            ]
    # Columns are sizes, center and quaternion.
    ends = np.cumsum([*widths, 3])
    parts = np.split(values, ends, axis=2)
    found = dict(
        zip((*names, f"{word}_centers", f"{word}_quaternions"), parts, strict=True)
    )
    return {name: part for name, part in found.items() if name != "sphere_quaternions"}
