"""Figures of a benchmark as PDF files, and its report as one HTML file with tables, figures, images or films.

Figures are success over planning time, and distributions of all figures of a plant.
"""

import base64
import io
import tempfile
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.addons.benchmark.answers import Task, execution_of
from cnpgen.addons.benchmark.hypothesis_tests import FIGURES, Values, values_of
from cnpgen.addons.benchmark.result_tables import failure_summaries, notes, table_rows
from cnpgen.addons.benchmark.run_suite import Benchmark
from cnpgen.addons.benchmark.simulator.plant import Plant
from cnpgen.addons.benchmark.simulator.rendering import save_film, save_picture
from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.errors import CnpgenError, MachineError, counted
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.files.atomic import write_file
from cnpgen.store.files.figure_file import new_figure, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_FILM_FRAMES = 300  # less than 1 MB
_STYLE = "body{font-family:sans-serif;max-width:75em;margin:2em auto}td,th{padding:.2em .8em;text-align:right}"
_STYLE += "td:first-child,th:first-child{text-align:left}table{border-collapse:collapse}tr{border-top:1px solid #ccc}"
_STYLE += "svg{max-width:100%;height:auto}figure{display:inline-block;width:46%;margin:1%}img,video{width:100%}"
# Of the largest to the smallest positive value, from which axes are logarithmic.
MIN_LOGARITHMIC_RATIO = 20.0
PANELS_PER_ROW = 4
# With the ten colors of matplotlib, forty planners differ.
STYLES = "-", "--", "-.", ":"
COLORS = 10


@checked_arguments
def save_benchmark_figures(
    benchmark: Benchmark, folder: str | Path
) -> tuple[Path, ...]:
    """Write ``success-PLANT.pdf`` and ``distributions-PLANT.pdf`` for every plant; existing files are replaced.

    The first one has the ratio of problems that are solved within a planning time on
    one thread: successful executions, or without a plant valid plans. Distributions are
    box plots with medians and quartiles.

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
    return {
        "success": success_figure(values, plant),
        "distributions": distribution_figure(values),
    }


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
    times = np.sort(
        [float(known["planning_cpu_ms"]) for known in rows if known.get(flag)]
    )
    return times, np.arange(1, len(times) + 1) / max(len(rows), 1)


def success_figure(values: dict[str, list[Values]], plant: str) -> "Figure":
    """Draw the ratio of successful executions, or of valid plans without a plant, over the planning time."""
    figure = new_figure(4.5, 3.2)
    axes = figure.add_subplot()
    flag = "success" if plant else "valid"
    times_ms = [
        float(known.get("planning_cpu_ms", 0.0))
        for rows in values.values()
        for known in rows
    ]
    max_time = max(times_ms, default=1.0)
    for index, (name, rows) in enumerate(values.items()):
        times, ratios = success_over_time(rows, flag)
        end = ratios[-1] if len(ratios) else 0.0
        line = np.append(times, max(max_time, 1e-3)), np.append(ratios, end)
        style = {
            "linestyle": STYLES[index // COLORS % len(STYLES)],
            "color": f"C{index % COLORS}",
        }
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
    keys = [
        key
        for key in FIGURES
        if any(key in known for rows in values.values() for known in rows)
    ]
    columns = max(min(len(keys), PANELS_PER_ROW), 1)
    count = max(-(-len(keys) // columns), 1)
    figure = new_figure(4 * columns, 3 * count, dpi=100)
    for place, key in enumerate(keys, start=1):
        known = {
            name: [float(row[key]) for row in rows if key in row]
            for name, rows in values.items()
        }
        _draw_boxes(figure.add_subplot(count, columns, place), known, FIGURES[key])
    return figure


def _draw_boxes(axes: "Axes", known: dict[str, list[float]], title: str) -> None:
    axes.boxplot(list(known.values()))
    axes.set_xticks(range(1, len(known) + 1), list(known), rotation=30, fontsize=7)
    axes.set_title(title, fontsize=9)
    numbers: Any = np.concatenate([np.array(part, float) for part in known.values()])
    if (
        len(numbers)
        and numbers.min() > 0
        and numbers.max() > MIN_LOGARITHMIC_RATIO * numbers.min()
    ):
        axes.set_yscale("log")


@checked_arguments
def save_benchmark_report(
    benchmark: Benchmark, path: str | Path, *, video: bool = False
) -> Path:
    """Write the report of a benchmark as one self-contained file; an existing file is replaced.

    Args:
        benchmark: Result of ``run_benchmark``.
        path: Output file, ``.html``.
        video: Whether to film the first plan of every planner, instead of an image;
            takes some seconds each.

    Raises:
        MachineError: matplotlib is missing, or the file cannot be written.
    """
    suite = benchmark.suite
    place = Path(path)
    size = counted(len(benchmark.problems), "problem")
    parts = [
        f"<h1>{escape(suite.name)} {suite.version}</h1><p>{escape(suite.title)}: {size}</p>"
    ]
    parts += [
        f"<p>{escape(text)}</p>"
        for text in [*failure_summaries(benchmark), *notes(benchmark)]
    ]
    for plant in benchmark.executions:
        title = f"executed by the {plant} plant" if plant else "planned"
        drawings = "".join(map(_as_svg, benchmark_figures(benchmark, plant).values()))
        parts.append(f"<h2>{title}</h2>{_table(benchmark, plant)}{drawings}")
    parts += _motions(benchmark, video=video)
    head = f"<!doctype html><meta charset='utf-8'><title>{escape(suite.name)}</title><style>{_STYLE}</style>"
    write_file(place, "\n".join([head, *parts]))
    return place


def _table(benchmark: Benchmark, plant: str) -> str:
    """Format the rows of ``table_rows``."""
    head, *rows = table_rows(benchmark, plant)
    lines = [
        "<table><tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>"
    ]
    lines += [
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows
    ]
    return "\n".join([*lines, "</table>"])


def _as_svg(figure: "Figure") -> str:
    picture = io.StringIO()
    figure.savefig(picture, format="svg", metadata={"Date": None})
    return picture.getvalue().partition("?>\n")[2]


def _motions(benchmark: Benchmark, *, video: bool) -> list[str]:
    """Render one executable plan of each planner, if this machine can render: of the same problem if all have one."""
    if not benchmark.plants:
        return []
    parts = []
    plant = benchmark.plants[0]
    executed = {
        name: [row for row in rows if _was_executed(row, plant.name)]
        for name, rows in benchmark.results.items()
    }
    problems = [{row["problem"] for row in rows} for rows in executed.values() if rows]
    common = min(set.intersection(*problems), default=None) if problems else None
    for name, rows in executed.items():
        if not rows:
            continue
        row = next((row for row in rows if row["problem"] == common), rows[0])
        index = row["problem"]
        task = (
            benchmark.problems[index],
            row["answer"],
            benchmark.prefix and benchmark.prefix[index],
        )
        label = f"{escape(name)}, problem {index}"
        try:
            element, caption = _render(task, plant, video=video)
        except MachineError as error:
            return [f"<p>No images: {escape(str(error))}</p>"]
        except CnpgenError as error:
            # The line is damaged.
            parts.append(f"<p>{label}: no image: {escape(str(error))}</p>")
            continue
        parts.append(
            f"<figure>{element}<figcaption>{label}, {caption}</figcaption></figure>"
        )
    return parts


def _was_executed(row: JsonObject, plant: str) -> bool:
    executed = row.get("executed", {}).get(plant)
    return executed is not None and "failure" not in executed


def _render(task: Task, plant: Plant, *, video: bool) -> tuple[str, str]:
    """Execute a plan; return an image or a film, and its caption."""
    execution = execution_of(task, plant)
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "end.png"
        film = Path(folder) / "plan.mp4"
        save_picture(picture, execution)
        image = _embedded(picture, "image/png")
        caption = "at the end of its plan"
        if video:
            try:
                save_film(film, execution, max_frames=MAX_FILM_FRAMES)
            except MachineError as error:
                caption += f"; no film: {escape(str(error))}"
                film.unlink(missing_ok=True)
        if not film.exists():
            return f"<img src='{image}'>", caption
        source = _embedded(film, "video/mp4")
    return (
        f"<video controls loop muted poster='{image}' src='{source}'></video>",
        "scaled in time",
    )


def _embedded(file: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(file.read_bytes()).decode()}"
