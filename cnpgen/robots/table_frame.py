"""Frame of the table of samples, which is raised and turned about the center of the table's rectangle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.robots.parameter_ranges import UPRIGHT_TURN, ParameterRanges


@dataclass(frozen=True)
class TableFrame:
    """Frame of the table of N samples; without a turn and a height its coordinates are those of the world.

    Attributes:
        axes: Axes of the table in the world, columns x, y and the normal, shape (N, 3,
            3).
        pivot: Point about which the unmoved table turns [m], shape (3,).
        height: Height of the pivot above the unmoved one [m], shape (N,).
    """

    axes: Array
    pivot: Array
    height: Array

    def to_world(self, positions: Array) -> Array:
        """Return positions on the table in the world frame [m], shape (N, 3)."""
        world = self.along_world(positions - self.pivot) + self.pivot
        world[:, 2] += self.height
        return world

    def along_world(self, vectors: Array) -> Array:
        """Return vectors along the axes of the table along those of the world, shape (N, 3)."""
        return np.asarray(np.einsum("nij,nj->ni", self.axes, vectors))

    def to_table(self, positions: Array) -> Array:
        """Return positions in the frame of the table [m], shape (N, 3)."""
        relative = positions - self.pivot
        relative[:, 2] -= self.height
        return self.along_table(relative) + self.pivot

    def along_table(self, vectors: Array) -> Array:
        """Return vectors along the axes of the table, shape (N, 3)."""
        return np.asarray(np.einsum("nji,nj->ni", self.axes, vectors))


def table_frame(ranges: ParameterRanges, pivot: Array, parameters: Array) -> TableFrame:
    """Return the frame of the table of N samples, with parameters of shape (N, width), turned about a pivot [m]."""
    columns = dict(zip(ranges.names, parameters.T, strict=True))
    zero = np.zeros(len(parameters))
    roll, pitch, height = (
        columns.get(name, zero)
        for name in ("table_roll", "table_pitch", "table_height")
    )
    return TableFrame(turned_axes(roll, pitch).transpose(0, 2, 1), pivot, height)


def upright_axes(ranges: ParameterRanges, parameters: Array) -> Array:
    """Return the axes that turn with the upright direction of N samples, one per row, shape (N, 3, 3)."""
    columns = dict(zip(ranges.names, parameters.T, strict=True))
    zero = np.zeros(len(parameters))
    return turned_axes(*(columns.get(name, zero) for name in UPRIGHT_TURN))


def turned_axes(roll: Array, pitch: Array) -> Array:
    """Return the axes x, y and z after N rolls and then pitches [rad], one per row, shape (N, 3, 3)."""
    axes = table_axes(np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch))
    return np.array(
        [[component + np.zeros(len(roll)) for component in axis] for axis in axes]
    ).transpose(2, 0, 1)


def table_axes(
    sin_roll: Any, cos_roll: Any, sin_pitch: Any, cos_pitch: Any
) -> tuple[list[Any], ...]:
    """Return the axes of a table, ``Ry(pitch) Rx(roll)``: x, y and the normal, of numbers, arrays or symbols."""
    return (
        [cos_pitch, 0.0, -sin_pitch],
        [sin_pitch * sin_roll, cos_roll, cos_pitch * sin_roll],
        [sin_pitch * cos_roll, -sin_roll, cos_pitch * cos_roll],
    )


def moved_box(
    ranges: ParameterRanges, pivot: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """Return a box in the world frame that contains a box in the frames of all tables: both corners [m], shape (3,).

    The tables turn about a pivot [m], shape (3,).
    """
    heights = ranges.table_height
    roll, pitch = (
        0.0 if span is None else max(abs(span.low), abs(span.high))
        for span in (ranges.table_roll, ranges.table_pitch)
    )
    identity = np.eye(3)
    reach = np.maximum(np.abs(low - pivot), np.abs(high - pivot))
    deviation = np.abs(
        np.array(table_axes(np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch))).T
        - identity
    )
    margin = deviation @ reach
    raised = np.zeros(2) if heights is None else np.array([heights.low, heights.high])
    return low - margin + raised[0] * identity[2], high + margin + raised[1] * identity[
        2
    ]
