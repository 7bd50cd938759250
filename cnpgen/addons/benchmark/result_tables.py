"""Tables of a benchmark as Markdown and LaTeX, with machine, versions, date and seed, and all results as CSV."""

import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cnpgen.addons.benchmark.hypothesis_tests import (
    FIGURES,
    FLAGS,
    NOT_APPLICABLE,
    TAILS,
    reference_planner,
    values_of,
)
from cnpgen.addons.benchmark.run_suite import Benchmark
from cnpgen.documents import JsonMapping, JsonObject, TextRows
from cnpgen.errors import counted
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.files.atomic import write_file

FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")  # of cells that spreadsheets execute
PAPER_PLANNER = "cnp-b-paper"  # the planner that the paper calls CNP-B
# Suite -> planner -> figure -> value in the paper's text.
PRINTED: dict[str, dict[str, dict[str, str]]] = {
    "hits-81": {
        PAPER_PLANNER: {"scored": "100 %", "planning_ms": "33", "z_error_mm_s": "< 5"},
        "aqp": {"scored": "92.59 %", "planning_ms": "42 in C++"},
        "trajopt": {"scored": "91.35 %", "planning_ms": "about 10,000"},
    },
    "heavy-100": {
        PAPER_PLANNER: {"paper_finished": "100 %", "paper_valid": "95 %"},
        "cbirrt": {"paper_finished": "88 %", "paper_valid": "74 %"},
    },
    "hits-110": {
        PAPER_PLANNER: {"scored": "78.2 % (real robot)"},
        "aqp": {"scored": "52.7 % (real robot)"},
    },
}
# Planners whose authors' inner loops are in C++.
PYTHON_LOOPS = "aqp", "cbirrt", "rrtconnect", "sscbirrt"
# Constraints of the problems that the paper states rules for; they say nothing of others.
_PAPER_CONSTRAINTS = {"table", "vertical", "object-contact"}
_PAPER_FLAGS = "paper_valid", "paper_finished"
TAIL_FIGURES = ("planning_ms", "planning_cpu_ms")  # printed with their tails
MAX_PRINTED_P = 0.05
TABLE_FILES = ("results.csv", "tables.md", "tables.tex")
_LATEX = str.maketrans(
    {
        "&": r"\&",
        "%": r"\%",
        "_": r"\_",
        "<": r"\textless{}",
        "#": r"\#",
        "²": r"\textsuperscript{2}",
    }
)
_COLUMNS = (
    "suite",
    "suite_version",
    "planner",
    "repetition",
    "problem",
    "plant",
    "ending",
    "seed",
)


@checked_arguments
def save_benchmark_tables(benchmark: Benchmark, folder: str | Path) -> tuple[Path, ...]:
    """Write ``results.csv`` (a row per problem and plant), ``tables.md`` and ``tables.tex``; they are replaced.

    Args:
        benchmark: Result of ``run_benchmark``.
        folder: Output folder.

    Raises:
        MachineError: A file cannot be written.
    """
    contents = csv_text(benchmark), markdown_text(benchmark), latex_text(benchmark)
    paths = tuple(Path(folder) / name for name in TABLE_FILES)
    for path, content in zip(paths, contents, strict=True):
        write_file(path, content)
    return paths


def table_rows(benchmark: Benchmark, plant: str) -> TextRows:
    """Return the comparison on a plant: a head, then one row per ratio and figure, with the paper's values."""
    summary = benchmark.summary(plant)
    printed = PRINTED.get(benchmark.suite.name, {})
    rows: TextRows = [(f"{plant} plant" if plant else "planned", *summary)]
    missing = {
        name: _missing_text(benchmark.results[name])
        for name in summary
        if not summary[name]["ratios"]
    }
    if missing:
        rows.append(("applicability", *(missing.get(name, "") for name in summary)))
    for group, texts in (("ratios", flags_of(benchmark)), ("figures", FIGURES)):
        for key, text in texts.items():
            statistics = [summary[name][group].get(key) for name in summary]
            if not any(statistics):
                continue
            cells = (
                cell_text(item, printed.get(name, {}).get(key))
                for name, item in zip(summary, statistics, strict=True)
            )
            rows.append((text, *cells))
            if key in TAIL_FIGURES:
                rows.append(
                    (f"{text}: p99, p99.9, maximum", *map(tail_text, statistics))
                )
    return rows


def flags_of(benchmark: Benchmark) -> dict[str, str]:
    """Return the flags that apply to the problems: those of the paper's rules, if it has rules for the constraints."""
    applies = not _PAPER_CONSTRAINTS.isdisjoint(_constraints(benchmark))
    return {
        key: text for key, text in FLAGS.items() if applies or key not in _PAPER_FLAGS
    }


def _constraints(benchmark: Benchmark) -> set[str]:
    """Return the kinds of the constraints of the problems."""
    content = benchmark.problems.problem.content
    return {constraint["use"] for constraint in content["constraint"]}


def _missing_text(rows: Sequence[JsonMapping]) -> str:
    """Return the reason why a planner has no values: it does not apply, or the plant has not executed its plans."""
    return (
        NOT_APPLICABLE
        if all(row["ending"] == NOT_APPLICABLE for row in rows)
        else "not executed"
    )


def cell_text(statistic: JsonObject | None, printed: str | None = None) -> str:
    """Format a ratio with its interval, or a figure with its quartiles, and the paper's value."""
    if statistic is None:
        return f"paper: {printed}" if printed else ""
    if "share" in statistic:
        interval = f"{100 * statistic['low']:.3g} to {100 * statistic['high']:.3g} %"
        text = f"{statistic['count']} of {statistic['of']} ({interval})"
    else:
        text = (
            f"{statistic['median']:.3g} [{statistic['q1']:.3g}, {statistic['q3']:.3g}]"
        )
    text += (
        f", p {statistic['p_holm']:.1g}" if statistic["p_holm"] < MAX_PRINTED_P else ""
    )
    return text + (f" (paper: {printed})" if printed else "")


def tail_text(statistic: JsonObject | None) -> str:
    """Format the tails of a figure."""
    return (
        ""
        if statistic is None
        else ", ".join(f"{statistic[name]:.3g}" for name in TAILS)
    )


def notes(benchmark: Benchmark) -> list[str]:
    """Return the definitions below the tables, and date, machine, versions and seed of all runs."""
    other = reference_planner(benchmark.results, benchmark.reference)
    return [
        f"Ratios with 95 % intervals by Wilson; medians [quartiles]; p: p-value of the difference from {other},"
        f" corrected by Holm for all comparisons of a table, if below {MAX_PRINTED_P:g}.",
        *_hit_note(benchmark),
        *_python_note(benchmark),
        *_printed_note(benchmark),
        *(f"Run {run}." for run in benchmark.runs),
    ]


def _hit_note(benchmark: Benchmark) -> list[str]:
    """Return the definition of a successful hit, if the problems are hits."""
    if "puck-contact" not in _constraints(benchmark):
        return []
    text = (
        "A hit succeeds if it scores without early contact and its mallet stays within"
    )
    return [f"{text} {1e3 * benchmark.plane_tolerance:g} mm of the table plane."]


def _python_note(benchmark: Benchmark) -> list[str]:
    """Return the planners whose times are not comparable with those of their authors."""
    names = ", ".join(name for name in PYTHON_LOOPS if name in benchmark.results)
    text = "inner loops in Python; their authors' are in C++, so planning times are not comparable with theirs"
    return [f"{names}: {text}."] if names else []


def _printed_note(benchmark: Benchmark) -> list[str]:
    """Return the paper's values of its planner, unless the table has a column for it."""
    printed = PRINTED.get(benchmark.suite.name, {}).get(PAPER_PLANNER)
    if printed is None or PAPER_PLANNER in benchmark.results:
        return []
    values = ", ".join(
        f"{ ({**FLAGS, **FIGURES}[key]) }: {value}" for key, value in printed.items()
    )
    return [f"The paper's planner, CNP-B, has in the paper: {values}."]


def failure_summaries(benchmark: Benchmark) -> list[str]:
    """Report problems without a plan, with the first error, and the violated conditions of plans that are not valid."""
    texts = []
    for name, rows in benchmark.results.items():
        unplanned = [row for row in rows if row["answer"] is None]
        for ending in dict.fromkeys(row["ending"] for row in unplanned):
            failed = [row for row in unplanned if row["ending"] == ending]
            detail = (
                f", problem {failed[0]['problem']}: {failed[0]['error']}"
                if failed[0]["error"]
                else ""
            )
            texts.append(f"{name}: {len(failed)} of {len(rows)} {ending}{detail}")
        verdicts = [row["verdict"] for row in rows if row["answer"] is not None]
        reasons = Counter(
            str(verdict.get("reason", "no reason"))
            for verdict in verdicts
            if not verdict["valid"]
        )
        if reasons:
            counts = ", ".join(
                f"{reason} {count}" for reason, count in reasons.most_common()
            )
            texts.append(
                f"{name}: {reasons.total()} of {len(verdicts)} plans not valid by the verdict: {counts}"
            )
    return texts


def csv_text(benchmark: Benchmark) -> str:
    """Write all results as CSV: a head, then a row per planner, repetition, problem and plant."""
    suite = benchmark.suite
    seed = benchmark.runs[-1].seed if benchmark.runs else 0
    plants = [name for name in benchmark.executions if name]
    text = io.StringIO()
    columns = (*flags_of(benchmark), *FIGURES)
    writer = csv.DictWriter(
        text, [*_COLUMNS, *columns, "error"], restval="", lineterminator="\n"
    )
    writer.writeheader()
    for planner, rows in benchmark.results.items():
        for row in rows:
            executed = [plant for plant in plants if plant in row.get("executed", {})]
            for plant in executed or [""]:
                values = values_of(row, plant, benchmark.plane_tolerance)
                known = (
                    suite.name,
                    suite.version,
                    planner,
                    row.get("repetition", 0),
                    row["problem"],
                    plant,
                )
                texts = (*known, row["ending"], seed)
                head = zip(_COLUMNS, map(_inert, texts), strict=True)
                numbers = {
                    name: int(value) if isinstance(value, bool) else value
                    for name, value in values.items()
                    if name in columns
                }
                writer.writerow(
                    {**dict(head), **numbers, "error": _inert(row["error"])}
                )
    return text.getvalue()


def _inert(value: Any) -> Any:
    """Return a cell; a text that spreadsheets would execute gets an apostrophe before it."""
    is_formula = isinstance(value, str) and value.startswith(FORMULA_STARTS)
    return f"'{value}" if is_formula else value


def markdown_text(benchmark: Benchmark) -> str:
    """Write the tables of all plants as Markdown."""
    lines = [f"# {benchmark.suite.name} {benchmark.suite.version}", ""]
    for plant in benchmark.executions:
        head, *rows = (
            [cell.replace("|", r"\|") for cell in row]
            for row in table_rows(benchmark, plant)
        )
        lines += [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
        lines += [f"| {' | '.join(row)} |" for row in rows]
        lines.append("")
    return "\n".join(
        [
            *lines,
            *(
                f"* {note}"
                for note in [*notes(benchmark), *failure_summaries(benchmark)]
            ),
            "",
        ]
    )


def latex_text(benchmark: Benchmark) -> str:
    """Write the tables of all plants as LaTeX, a row per planner, for the packages booktabs and graphicx."""
    lines = [f"% {note}" for note in [*notes(benchmark), *failure_summaries(benchmark)]]
    suite = benchmark.suite
    for plant in benchmark.executions:
        rows = [
            [cell.translate(_LATEX) for cell in row]
            for row in zip(*table_rows(benchmark, plant), strict=True)
        ]
        (_, *head), *planners = rows
        size = counted(len(benchmark.problems), "problem")
        caption = f"{suite.title or suite.name}: {size} of {suite.name} {suite.version}"
        caption += f", executed by the {plant} plant." if plant else "."
        label = f"tab:{suite.name}{f'-{plant}' if plant else ''}"
        lines += [
            r"\begin{table}",
            rf"\caption{{{caption.translate(_LATEX)}}}",
            rf"\label{{{label}}}",
            r"\resizebox{\textwidth}{!}{%",
            rf"\begin{{tabular}}{{l{'r' * len(head)}}}",
            r"\toprule",
            rf"{' & '.join(['planner', *head])} \\",
            r"\midrule",
            *(rf"{' & '.join(row)} \\" for row in planners),
            r"\bottomrule",
            r"\end{tabular}}",
            r"\end{table}",
            "",
        ]
    return "\n".join(lines)
