"""Figures of a dataset: histograms of joint fields, motions seen from above, and acceptance rates on the table."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

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
    heights = [1.3 * len(joints) + 0.3, 4.2]
    figure = new_figure(14, sum(heights) + 0.5)
    spec = inspection.spec
    figure.suptitle(
        f"{spec.name} {spec.version}, {counted(sum(inspection.rows.values()), 'row')} ({inspection.state})"
    )
    parts = figure.subfigures(2, 1, height_ratios=heights, squeeze=False)
    _draw_histograms(parts[0, 0], joints, inspection.statistics)
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


def _draw_histograms(
    figure: "SubFigure", fields: list[Field], statistics: Mapping[str, FieldStatistics]
) -> None:
    """Draw one row of histograms per field and one column per joint, between the planning limits."""
    if not fields:
        return
    axes = figure.subplots(len(fields), len(fields[0].names), squeeze=False)
    for line, field in zip(axes, fields, strict=True):
        for column, axis in enumerate(line):
            _draw_histogram(axis, statistics[field.name], column)
        line[0].set_ylabel(f"{field.name}\n[{field.unit}]", fontsize=8)
    for axis, name in zip(axes[0], fields[0].names, strict=True):
        axis.set_title(name, fontsize=9)


def _draw_histogram(axis: "Axes", statistics: FieldStatistics, column: int) -> None:
    assert statistics.histogram is not None
    assert statistics.low is not None
    assert statistics.high is not None
    counts = statistics.histogram[column]
    edges = np.linspace(
        statistics.low[column], statistics.high[column], len(counts) + 1
    )
    axis.stairs(counts, edges, fill=True, color="tab:gray")
    axis.set_xlim(*_widened(edges[0], edges[-1]))
    axis.set_yticks([])
    axis.tick_params(labelsize=6)


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


def _some_rows(inspection: Inspection) -> dict[str, NDArray[Any]]:
    """Read the first rows of the first split that has rows."""
    dataset = open_dataset(inspection.folder, allow_incomplete=True)
    names = ("start_xyz", "goal_xyz", "hit_angle", "hit_speed")
    fields = [field.name for field in inspection.spec.fields if field.name in names]
    split = next(split for split, rows in inspection.rows.items() if rows)
    first = dataset.tasks(split)[0]
    end = first.first_row + min(first.rows, MAX_DRAWN_ROWS)
    return dataset.read(split, fields=fields, start=first.first_row, stop=end)


def _draw_motions(axis: "Axes", rows: dict[str, NDArray[Any]]) -> None:
    for end, color in _COLORS.items():
        x, y = rows[f"{end}_xyz"][:, :2].T
        axis.plot(x, y, ".", color=color, markersize=2, label=end)
    if "hit_angle" in rows and "hit_speed" in rows:
        (x, y), angle, length = (
            rows["goal_xyz"][:, :2].T,
            rows["hit_angle"],
            ARROW_DURATION_S * rows["hit_speed"],
        )
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


def _coarsened(density: DensityMap) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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


def _summed(counts: NDArray[np.int64], k: int) -> NDArray[np.int64]:
    """Return the sums over k by k cells."""
    nx, ny = counts.shape
    # Axes 1 and 3 run over the k by k cells that are merged.
    return np.asarray(counts.reshape(nx // k, k, ny // k, k).sum(axis=(1, 3)))


def _widened(low: float, high: float) -> tuple[float, float]:
    """Return an interval of positive length."""
    return (low, high) if low < high else (low - 0.005, high + 0.005)
