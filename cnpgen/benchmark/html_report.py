"""Report of a benchmark as one HTML file: tables beside the paper's figures, drawings, images or films."""

import base64
import io
import tempfile
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cnpgen.benchmark.answers import Task, execution_of
from cnpgen.benchmark.paper_figures import benchmark_figures
from cnpgen.benchmark.result_tables import failure_summaries, notes, table_rows
from cnpgen.benchmark.run_suite import Benchmark
from cnpgen.benchmark.simulator.plant import Plant
from cnpgen.benchmark.simulator.rendering import save_film, save_picture
from cnpgen.errors import CnpgenError, MachineError
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.files.atomic import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_FILM_FRAMES = 300  # less than 1 MB
_STYLE = "body{font-family:sans-serif;max-width:75em;margin:2em auto}td,th{padding:.2em .8em;text-align:right}"
_STYLE += "td:first-child,th:first-child{text-align:left}table{border-collapse:collapse}tr{border-top:1px solid #ccc}"
_STYLE += "svg{max-width:100%;height:auto}figure{display:inline-block;width:46%;margin:1%}img,video{width:100%}"


@checked_arguments
def save_benchmark_report(benchmark: Benchmark, path: str | Path, *, video: bool = False) -> Path:
    """Write the report of a benchmark as one self-contained file; an existing file is replaced.

    Args:
        benchmark: Result of ``run_benchmark``.
        path: Output file, ``.html``.
        video: Whether to film the first plan of every planner, instead of an image; takes some seconds each.

    Raises:
        MachineError: matplotlib is missing, or the file cannot be written.
    """
    suite, place = benchmark.suite, Path(path)
    parts = [
        f"<h1>{escape(suite.name)} {suite.version}</h1><p>{escape(suite.title)}: {len(benchmark.problems)} problems</p>"
    ]
    parts += [f"<p>{escape(text)}</p>" for text in [*failure_summaries(benchmark), *notes(benchmark)]]
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
    lines = ["<table><tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return "\n".join([*lines, "</table>"])


def _as_svg(figure: "Figure") -> str:
    picture = io.StringIO()
    figure.savefig(picture, format="svg", metadata={"Date": None})
    return picture.getvalue().partition("?>\n")[2]


def _motions(benchmark: Benchmark, *, video: bool) -> list[str]:
    """Render one executable plan of each planner, if this machine can render: of the same problem if all have one."""
    if not benchmark.plants:
        return []
    parts, plant = [], benchmark.plants[0]
    executed = {
        name: [row for row in rows if _was_executed(row, plant.name)] for name, rows in benchmark.results.items()
    }
    problems = [{row["problem"] for row in rows} for rows in executed.values() if rows]
    common = min(set.intersection(*problems), default=None) if problems else None
    for name, rows in executed.items():
        if not rows:
            continue
        row = next((row for row in rows if row["problem"] == common), rows[0])
        index = row["problem"]
        task = benchmark.problems[index], row["answer"], benchmark.prefix and benchmark.prefix[index]
        label = f"{escape(name)}, problem {index}"
        try:
            element, caption = _render(task, plant, video=video)
        except MachineError as error:
            return [f"<p>No images: {escape(str(error))}</p>"]
        except CnpgenError as error:  # the line is damaged
            parts.append(f"<p>{label}: no image: {escape(str(error))}</p>")
            continue
        parts.append(f"<figure>{element}<figcaption>{label}, {caption}</figcaption></figure>")
    return parts


def _was_executed(row: dict[str, Any], plant: str) -> bool:
    executed = row.get("executed", {}).get(plant)
    return executed is not None and "failure" not in executed


def _render(task: Task, plant: Plant, *, video: bool) -> tuple[str, str]:
    """Execute a plan; return an image or a film, and its caption."""
    execution = execution_of(task, plant)
    with tempfile.TemporaryDirectory() as folder:
        picture, film = Path(folder) / "end.png", Path(folder) / "plan.mp4"
        save_picture(picture, execution)
        image, caption = _embedded(picture, "image/png"), "at the end of its plan"
        if video:
            try:
                save_film(film, execution, max_frames=MAX_FILM_FRAMES)
            except MachineError as error:
                caption += f"; no film: {escape(str(error))}"
                film.unlink(missing_ok=True)
        if not film.exists():
            return f"<img src='{image}'>", caption
        source = _embedded(film, "video/mp4")
    return f"<video controls loop muted poster='{image}' src='{source}'></video>", "scaled in time"


def _embedded(file: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(file.read_bytes()).decode()}"
