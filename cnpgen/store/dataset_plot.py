"""Figures of a dataset: distributions of joint fields, motions seen from above, and acceptance rates on the table."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Columns, Integers
from cnpgen.errors import DatasetError, counted
from cnpgen.store.field import Field
from cnpgen.store.files.figure_file import new_figure, save_figure
from cnpgen.store.inspection import Inspection
from cnpgen.store.reader import open_dataset
from cnpgen.store.sampling_statistics import DensityMap
from cnpgen.store.statistics import FieldStatistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

MAX_DRAWN_ROWS = 300  # in the top view
MIN_CANDIDATES_PER_CELL = 25  # acceptance rates of fewer candidates are noise
# An arrow is the distance covered at the goal velocity in this time.
ARROW_DURATION_S = 0.05

_COLORS = {"start": "tab:blue", "goal": "tab:red"}


def plot_dataset(inspection: Inspection, path: str | Path) -> None:
    """Draw a dataset, possibly unfinished, to a ``.png``, ``.pdf`` or ``.svg`` file, which is replaced if it exists.

    Raises:
        DatasetError: There are no rows, or a shard is damaged.
        MachineError: matplotlib is missing, or the file cannot be written.
    """
    if not inspection.statistics:
        raise DatasetError(
            f"{inspection.folder} has no rows yet: there is nothing to plot"
        )
    joints = _joint_fields(inspection)
    heights = [0.35 * max((len(field.names) for field in joints), default=0) + 1, 4.2]
    figure = new_figure(11, sum(heights) + 0.5)
    spec = inspection.spec
    figure.suptitle(
        f"{spec.name} {spec.version}, {counted(sum(inspection.rows.values()), 'row')} ({inspection.state})"
    )
    parts = figure.subfigures(2, 1, height_ratios=heights, squeeze=False)
    _draw_joints(parts[0, 0], joints, inspection.statistics)
    _draw_task_space(parts[1, 0], inspection)
    save_figure(figure, Path(path))


def _joint_fields(inspection: Inspection) -> list[Field]:
    """Return the fields with one column per joint and a histogram, without those that are constant."""
    joints = tuple(inspection.spec.robot.get("joint_names", ()))
    statistics = inspection.statistics
    fields = [field for field in inspection.spec.fields if field.names == joints]
    found = [(field, statistics[field.name]) for field in fields]
    return [
        field
        for field, values in found
        if values.histogram is not None and not values.constant.all()
    ]


def _draw_joints(
    figure: "SubFigure", fields: list[Field], statistics: Mapping[str, FieldStatistics]
) -> None:
    """Draw one panel per unit: a line per joint, with the starts above it and the goals below it."""
    if not fields:
        return
    units = list(dict.fromkeys(field.unit for field in fields))
    axes = figure.subplots(1, len(units), sharey=True, squeeze=False)[0]
    for axis, unit in zip(axes, units, strict=True):
        drawn = [field for field in fields if field.unit == unit]
        for field in drawn:
            _draw_distribution(axis, field, statistics[field.name])
        axis.set_title(
            f"{', '.join(field.name for field in drawn)} [{unit}]", fontsize=9
        )
        axis.set_xticks([-1, 1], ["lower limit", "upper limit"])
        axis.tick_params(labelsize=8)
    axes[0].set_yticks(range(len(fields[0].names)), fields[0].names)
    axes[0].invert_yaxis()


def _draw_distribution(axis: "Axes", field: Field, statistics: FieldStatistics) -> None:
    """Draw the histogram of every joint between its limits, over or under the joint's line."""
    assert statistics.histogram is not None
    end = field.name.partition("_")[0]
    side = 0.45 if end == "goal" else -0.45  # of the distance between two lines
    edges = np.linspace(-1, 1, statistics.histogram.shape[1] + 1)
    for joint, counts in enumerate(statistics.histogram):
        profile = joint + side * counts / max(counts.max(), 1)
        color = _COLORS.get(end, "tab:gray")
        axis.stairs(profile, edges, baseline=joint, fill=True, color=color)
        axis.axhline(joint, color="0.8", linewidth=0.5)


def _draw_task_space(figure: "SubFigure", inspection: Inspection) -> None:
    """Draw a top view of some motions, and a map of acceptance rates per end."""
    maps = inspection.sampling.densities
    axes = figure.subplots(1, 1 + len(maps), squeeze=False)[0]
    _draw_motions(axes[0], _some_rows(inspection))
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        fontsize=7,
        loc="outside lower left",
        ncols=2,
    )
    for axis, (name, density) in zip(axes[1:], maps.items(), strict=True):
        _draw_acceptance(figure, axis, name, density)
    for axis in axes:
        axis.set_aspect("equal")
        axis.set_xlabel("x [m]", fontsize=8)
        axis.set_ylabel("y [m]", fontsize=8)
        axis.tick_params(labelsize=7)


def _some_rows(inspection: Inspection) -> Columns:
    """Read the first rows of the first split that has rows."""
    dataset = open_dataset(inspection.folder, allow_incomplete=True)
    names = ("start_xyz", "goal_xyz", "hit_angle", "hit_speed")
    fields = [field.name for field in inspection.spec.fields if field.name in names]
    split = next(split for split, rows in inspection.rows.items() if rows)
    first = dataset.tasks(split)[0]
    end = first.first_row + min(first.rows, MAX_DRAWN_ROWS)
    return dataset.read(split, fields=fields, start=first.first_row, stop=end)


def _draw_motions(axis: "Axes", rows: Columns) -> None:
    for end, color in _COLORS.items():
        x, y = rows[f"{end}_xyz"][:, :2].T
        axis.plot(x, y, ".", color=color, markersize=2, label=end)
    if "hit_angle" in rows and "hit_speed" in rows:
        x, y = rows["goal_xyz"][:, :2].T
        angle = rows["hit_angle"]
        length = ARROW_DURATION_S * rows["hit_speed"]
        arrows: dict[str, Any] = {
            "angles": "xy",
            "scale_units": "xy",
            "scale": 1,
            "width": 0.003,
            "alpha": 0.6,
        }
        axis.quiver(
            x,
            y,
            length * np.cos(angle),
            length * np.sin(angle),
            color=_COLORS["goal"],
            **arrows,
        )
    legend = (
        f", arrows: goal velocity x {1e3 * ARROW_DURATION_S:g} ms"
        if "hit_speed" in rows
        else ""
    )
    axis.set_title(
        f"{counted(len(rows['goal_xyz']), 'row')} from above{legend}", fontsize=9
    )


def _draw_acceptance(
    figure: "SubFigure", axis: "Axes", name: str, density: DensityMap
) -> None:
    """Draw the acceptance rate per cell.

    Cells with too few candidates are left white.
    """
    candidates, accepted = _coarsened(density)
    rate = np.where(
        candidates >= MIN_CANDIDATES_PER_CELL / 5,
        accepted / np.maximum(candidates, 1),
        np.nan,
    )
    extent = (*_widened(*density.x), *_widened(*density.y))
    image = axis.imshow(rate.T, origin="lower", extent=extent, vmin=0, cmap="viridis")
    axis.set_title(
        f"acceptance rate by {name}\n{candidates.mean():,.0f} candidates per cell",
        fontsize=9,
    )
    figure.colorbar(image, ax=axis, shrink=0.8).ax.tick_params(labelsize=7)


def _coarsened(density: DensityMap) -> tuple[Integers, Integers]:
    """Return candidates and accepted candidates per cell of the finest grid with enough candidates per cell."""
    cells = min(density.candidates.shape)
    # Cells are merged k by k for the divisors k of the grid, the finest grid first.
    divisors = (k for k in range(1, cells) if cells % k == 0)
    enough = (
        k
        for k in divisors
        if _summed(density.candidates, k).mean() >= MIN_CANDIDATES_PER_CELL
    )
    factor = next(enough, cells)
    return _summed(density.candidates, factor), _summed(density.accepted, factor)


def _summed(counts: Integers, k: int) -> Integers:
    """Return the sums over k by k cells."""
    nx, ny = counts.shape
    # Axes 1 and 3 run over the k by k cells that are merged.
    return np.asarray(counts.reshape(nx // k, k, ny // k, k).sum(axis=(1, 3)))


def _widened(low: float, high: float) -> tuple[float, float]:
    """Return an interval of positive length."""
    return (low, high) if low < high else (low - 0.005, high + 0.005)
