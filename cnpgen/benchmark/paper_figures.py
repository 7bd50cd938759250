"""Figures of a benchmark as PDF files: success over planning time, and distributions of all figures of a plant."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.benchmark.hypothesis_tests import FIGURES, Values, values_of
from cnpgen.benchmark.run_suite import Benchmark
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.files.figure_file import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

MIN_LOGARITHMIC_RATIO = 20.0  # of the largest to the smallest positive value, from which axes are logarithmic
PANELS_PER_ROW = 4
STYLES = ("-", "--", "-.", ":")  # with the ten colors of matplotlib, forty planners differ
COLORS = 10


@checked_arguments
def save_benchmark_figures(benchmark: Benchmark, folder: str | Path) -> tuple[Path, ...]:
    """Write ``success-PLANT.pdf`` and ``distributions-PLANT.pdf`` for every plant; existing files are replaced.

    The first one has the ratio of problems that are solved within a planning time on one thread: successful
    executions, or without a plant valid plans. Distributions are box plots with medians and quartiles.

    Args:
        benchmark: Result of ``run_benchmark``.
        folder: Output folder.

    Raises:
        MachineError: matplotlib is missing, or a file cannot be written.
    """
    paths = []
    for plant in benchmark.executions:
        for name, figure in benchmark_figures(benchmark, plant).items():
            paths.append(Path(folder) / f"{name}-{plant or 'planned'}.pdf")
            save_figure(figure, paths[-1])
    return tuple(paths)


def benchmark_figures(benchmark: Benchmark, plant: str) -> dict[str, "Figure"]:
    """Draw both figures of a plant; return name -> figure."""
    values = benchmark_values(benchmark, plant)
    return {"success": success_figure(values, plant), "distributions": distribution_figure(values)}


def benchmark_values(benchmark: Benchmark, plant: str) -> dict[str, list[Values]]:
    """Return planner -> flags and figures of its problems on a plant, without planners that do not apply."""
    tolerance = benchmark.plane_tolerance
    values = {
        name: [known for row in rows if (known := values_of(row, plant, tolerance))]
        for name, rows in benchmark.results.items()
    }
    return {name: rows for name, rows in values.items() if rows}


def success_over_time(rows: list[Values], flag: str) -> tuple[Array, Array]:
    """Return the planning times of problems with a flag in increasing order [ms], and the ratios solved by then."""
    times = np.sort([float(known["planning_cpu_ms"]) for known in rows if known.get(flag)])
    return times, np.arange(1, len(times) + 1) / max(len(rows), 1)


def success_figure(values: dict[str, list[Values]], plant: str) -> "Figure":
    """Draw the ratio of successful executions, or of valid plans without a plant, over the planning time."""
    figure = new_figure(4.5, 3.2)
    axes, flag = figure.add_subplot(), "success" if plant else "valid"
    times_ms = [float(known.get("planning_cpu_ms", 0.0)) for rows in values.values() for known in rows]
    max_time = max(times_ms, default=1.0)
    for index, (name, rows) in enumerate(values.items()):
        times, ratios = success_over_time(rows, flag)
        end = ratios[-1] if len(ratios) else 0.0
        line = np.append(times, max(max_time, 1e-3)), np.append(ratios, end)
        style = {"linestyle": STYLES[index // COLORS % len(STYLES)], "color": f"C{index % COLORS}"}
        axes.step(*line, where="post", label=f"{name} ({100 * end:.0f} %)", **style)  # type: ignore[arg-type]
    axes.set_xscale("log")
    axes.set_ylim(0, 1.02)
    axes.set_xlabel("planning time, CPU [ms]")
    axes.set_ylabel("successful executions" if plant else "valid plans")
    axes.grid(visible=True, linewidth=0.3)
    axes.legend(fontsize=6)
    return figure


def distribution_figure(values: dict[str, list[Values]]) -> "Figure":
    """Draw a box plot of each known figure."""
    keys = [key for key in FIGURES if any(key in known for rows in values.values() for known in rows)]
    columns = max(min(len(keys), PANELS_PER_ROW), 1)
    count = max(-(-len(keys) // columns), 1)
    figure = new_figure(4 * columns, 3 * count, dpi=100)
    for place, key in enumerate(keys, start=1):
        known = {name: [float(row[key]) for row in rows if key in row] for name, rows in values.items()}
        _draw_boxes(figure.add_subplot(count, columns, place), known, FIGURES[key])
    return figure


def _draw_boxes(axes: "Axes", known: dict[str, list[float]], title: str) -> None:
    axes.boxplot(list(known.values()))
    axes.set_xticks(range(1, len(known) + 1), list(known), rotation=30, fontsize=7)
    axes.set_title(title, fontsize=9)
    numbers: Any = np.concatenate([np.array(part, float) for part in known.values()])
    if len(numbers) and numbers.min() > 0 and numbers.max() > MIN_LOGARITHMIC_RATIO * numbers.min():
        axes.set_yscale("log")
