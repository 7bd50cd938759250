"""Table and upright direction of candidates, which parameters of the problem may move, and factors of limits."""

from collections.abc import Sequence

import numpy as np

from cnpgen.arrays import Array
from cnpgen.pipelines.stages.stage import CandidateBatch, Context
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.obstacles import table_frame_of
from cnpgen.robots import table_frame
from cnpgen.robots.table_frame import TableFrame, moved_box


def candidate_table(context: Context, candidates: CandidateBatch) -> TableFrame | None:
    """Return the frame of the table of every candidate.

    None if no parameters move the table.
    """
    return table_frame_of(
        context.problem,
        candidates["parameters"].T if context.problem.parameters else None,
    )


def table_corners(context: Context, candidates: CandidateBatch) -> tuple[Array, Array]:
    """Return the lower and the upper corner of the rectangle of every table: x and y [m], shape (2, n) each."""
    columns = dict(
        zip(context.problem.parameters.names, candidates["parameters"], strict=True)
    )
    low, high = context.constraint(Table).bounds_of(columns)
    # Corners that do not vary are repeated for every candidate.
    zero = 0 * next(iter(columns.values()))
    return np.array([value + zero for value in low]), np.array(
        [value + zero for value in high]
    )


def upright_axes(context: Context, candidates: CandidateBatch) -> list[Array]:
    """Return the axes that turn with the upright direction, shape (9, n), in a list that is empty if none turns."""
    ranges = context.problem.parameters
    if not ranges.turns_upright:
        return []
    # Three axes of three components, one column for each candidate.
    axes = table_frame.upright_axes(ranges, candidates["parameters"].T)
    return [np.ascontiguousarray(axes.reshape(len(axes), 9).T)]


def in_world(context: Context, candidates: CandidateBatch, positions: Array) -> Array:
    """Return positions on the table of every candidate in the world frame [m], shape (3, n)."""
    frame = candidate_table(context, candidates)
    return (
        positions
        if frame is None
        else np.ascontiguousarray(frame.to_world(positions.T).T)
    )


def in_world_box(
    context: Context, low: Sequence[float], high: Sequence[float]
) -> tuple[Sequence[float], Sequence[float]]:
    """Return the corners of a box that contains a box on the tables of all candidates, in the world frame [m]."""
    ranges = context.problem.parameters
    if not ranges.tilts_table:
        return low, high
    lower, upper = moved_box(
        ranges, context.robot.table_origin, np.array(low), np.array(high)
    )
    return lower.tolist(), upper.tolist()


def on_table(context: Context, candidates: CandidateBatch, positions: Array) -> Array:
    """Return positions in the frame of the table of every candidate [m], shape (3, n)."""
    frame = candidate_table(context, candidates)
    return (
        positions
        if frame is None
        else np.ascontiguousarray(frame.to_table(positions.T).T)
    )


def hit_direction(context: Context, candidates: CandidateBatch) -> Array:
    """Return the unit direction of every hit in the world frame: x and y, and z if parameters move the table."""
    angle = candidates["hit_angle"]
    direction = np.concatenate([np.cos(angle), np.sin(angle)])
    frame = candidate_table(context, candidates)
    if frame is None:
        return direction
    return np.ascontiguousarray(
        frame.along_world(np.concatenate([direction, np.zeros_like(angle)]).T).T
    )


def table_normal(context: Context, candidates: CandidateBatch) -> list[Array]:
    """Return the normal of the table of every candidate, shape (3, n), in a list that is empty for unmoved tables."""
    frame = candidate_table(context, candidates)
    # The normal is the z axis of the table's frame.
    return [] if frame is None else [np.ascontiguousarray(frame.axes[..., 2].T)]


def velocity_factor(context: Context, candidates: CandidateBatch) -> Array | None:
    """Return the factor of the velocity limits of every candidate, shape (1, n).

    None without this parameter.
    """
    names = context.problem.parameters.names
    if "velocity_factor" not in names:
        return None
    return candidates["parameters"][[names.index("velocity_factor")]]
