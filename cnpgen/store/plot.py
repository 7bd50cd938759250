"""Pictures of a dataset: histograms of its joint fields, its motions from above, and where draws were accepted."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError
from cnpgen.store.fates import DensityMap
from cnpgen.store.field import Field
from cnpgen.store.files.picture import new_figure, save_figure
from cnpgen.store.inspection import Inspection
from cnpgen.store.reader import open_dataset
from cnpgen.store.statistics import FieldStatistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

SHOWN = 300  # rows in the picture from above
ENOUGH = 25  # draws per cell of a map: shares of fewer say little
ARROW = 0.05  # s: goal velocities are drawn as what they cover in this time

_COLOURS = {"start": "tab:blue", "goal": "tab:red"}


def plot_dataset(inspection: Inspection, path: str | Path) -> None:
    """Draw a dataset.

    Args:
        inspection: The dataset; unfinished is enough.
        path: Picture file, ``.png``, ``.pdf`` or ``.svg``; replaced if it exists.

    Raises:
        DatasetError: There are no rows yet, or a shard is damaged.
        MachineError: matplotlib is missing, or the file cannot be written.
    """
    if not inspection.statistics:
        raise DatasetError(f"{inspection.folder} has no rows yet: nothing to draw")
    joints = _joint_fields(inspection)
    heights = [1.3 * len(joints) + 0.3, 4.2]
    figure = new_figure(14, sum(heights) + 0.5)
    blueprint = inspection.blueprint
    figure.suptitle(
        f"{blueprint.name} {blueprint.version}, {sum(inspection.rows.values()):,} rows ({inspection.state})"
    )
    parts = figure.subfigures(2, 1, height_ratios=heights, squeeze=False)
    _draw_histograms(parts[0, 0], joints, inspection.statistics)
    _draw_task_space(parts[1, 0], inspection)
    save_figure(figure, Path(path))


def _joint_fields(inspection: Inspection) -> list[Field]:
    """Return the fields with one column per joint and a histogram."""
    joints = tuple(inspection.blueprint.robot.get("joint_names", ()))
    found = inspection.statistics
    return [
        item for item in inspection.blueprint.fields if item.names == joints and found[item.name].histogram is not None
    ]


def _draw_histograms(figure: "SubFigure", fields: list[Field], statistics: Mapping[str, FieldStatistics]) -> None:
    """Draw a row of histograms per field, a column per joint, between the planning limits."""
    if not fields:
        return
    axes = figure.subplots(len(fields), len(fields[0].names), squeeze=False)
    for line, field in zip(axes, fields, strict=True):
        found = statistics[field.name]
        for column, axis in enumerate(line):
            _draw_histogram(axis, found, column)
        line[0].set_ylabel(f"{field.name}\n[{field.unit}]", fontsize=8)
    for axis, name in zip(axes[0], fields[0].names, strict=True):
        axis.set_title(name, fontsize=9)


def _draw_histogram(axis: "Axes", found: FieldStatistics, column: int) -> None:
    assert found.histogram is not None
    assert found.low is not None
    assert found.high is not None
    counts = found.histogram[column]
    edges = np.linspace(found.low[column], found.high[column], len(counts) + 1)
    axis.stairs(counts, edges, fill=True, color="tab:gray")
    axis.set_xlim(*_widened(edges[0], edges[-1]))
    axis.set_yticks([])
    axis.tick_params(labelsize=6)


def _draw_task_space(figure: "SubFigure", inspection: Inspection) -> None:
    """Draw some motions from above, and per end how many of its draws were accepted where."""
    maps = inspection.fates.densities
    axes = figure.subplots(1, 1 + len(maps), squeeze=False)[0]
    _draw_motions(axes[0], _some_rows(inspection))
    figure.legend(*axes[0].get_legend_handles_labels(), fontsize=7, loc="outside lower left", ncols=2)
    for axis, (name, density) in zip(axes[1:], maps.items(), strict=True):
        _draw_acceptance(figure, axis, name, density)
    for axis in axes:
        axis.set_aspect("equal")
        axis.set_xlabel("x [m]", fontsize=8)
        axis.set_ylabel("y [m]", fontsize=8)
        axis.tick_params(labelsize=7)


def _some_rows(inspection: Inspection) -> dict[str, NDArray[Any]]:
    """Read the first rows of the first split that has any."""
    dataset = open_dataset(inspection.folder, allow_incomplete=True)
    wanted = ("start_xyz", "goal_xyz", "hit_angle", "hit_speed")
    fields = [field.name for field in inspection.blueprint.fields if field.name in wanted]
    split = next(split for split, rows in inspection.rows.items() if rows)
    _, columns = next(dataset.iter_shards(split, fields=fields))
    return {name: values[:SHOWN] for name, values in columns.items()}


def _draw_motions(axis: "Axes", rows: dict[str, NDArray[Any]]) -> None:
    for end, colour in _COLOURS.items():
        x, y = rows[f"{end}_xyz"][:, :2].T
        axis.plot(x, y, ".", color=colour, markersize=2, label=end)
    if "hit_angle" in rows and "hit_speed" in rows:
        (x, y), angle, way = rows["goal_xyz"][:, :2].T, rows["hit_angle"], ARROW * rows["hit_speed"]
        arrows: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.003, "alpha": 0.6}
        axis.quiver(x, y, way * np.cos(angle), way * np.sin(angle), color=_COLOURS["goal"], **arrows)
    meaning = f", arrows: goal velocity x {1e3 * ARROW:g} ms" if "hit_speed" in rows else ""
    axis.set_title(f"{len(rows['goal_xyz'])} rows from above{meaning}", fontsize=9)


def _draw_acceptance(figure: "SubFigure", axis: "Axes", name: str, density: DensityMap) -> None:
    """Draw the share of accepted draws per cell; cells with hardly a draw stay white."""
    drawn, accepted = _coarsened(density)
    share = np.where(drawn >= ENOUGH / 5, accepted / np.maximum(drawn, 1), np.nan)
    extent = (*_widened(*density.x), *_widened(*density.y))
    picture = axis.imshow(share.T, origin="lower", extent=extent, vmin=0, cmap="viridis")
    axis.set_title(f"share of draws accepted, by {name}\n{drawn.mean():,.0f} draws per cell", fontsize=9)
    figure.colorbar(picture, ax=axis, shrink=0.8).ax.tick_params(labelsize=7)


def _coarsened(density: DensityMap) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return draws, and accepted ones, per cell of the finest grid whose cells have enough of them on the average."""
    cells = min(density.drawn.shape)
    joined = next((k for k in range(1, cells) if cells % k == 0 and _joined(density.drawn, k).mean() >= ENOUGH), cells)
    return _joined(density.drawn, joined), _joined(density.accepted, joined)


def _joined(counts: NDArray[np.int64], k: int) -> NDArray[np.int64]:
    """Add up k by k cells."""
    nx, ny = counts.shape
    return np.asarray(counts.reshape(nx // k, k, ny // k, k).sum(axis=(1, 3)))


def _widened(low: float, high: float) -> tuple[float, float]:
    """Return an interval that is not a single point."""
    return (low, high) if low < high else (low - 0.005, high + 0.005)
