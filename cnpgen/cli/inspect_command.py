"""Summarize a dataset and its sampling.

The command reads documents and shard records, not samples, so it is fast for large
datasets and works for unfinished ones; 'cnpgen validate' verifies the samples.
"accepts" is the share of candidates that pass a condition, "left" the share of all
candidates that remain after it. The exit code is 1 if the dataset is damaged, 0 if it
is unfinished.
"""

import argparse
import sys
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.parser import Parser, add_json
from cnpgen.cli.terminal import table
from cnpgen.documents import TextRows

if TYPE_CHECKING:
    from cnpgen.store.field import Field
    from cnpgen.store.inspection import Inspection
    from cnpgen.store.sampling_statistics import SamplingStatistics
    from cnpgen.store.statistics import FieldStatistics


def add_options(parser: Parser) -> None:
    parser.add_argument(
        "folder",
        metavar="DIR",
        type=recipe_names.dataset,
        help="folder of a dataset, finished or not",
    )
    parser.add_argument(
        "--plot",
        metavar="FILE",
        type=values.plot_file,
        help="also draw it: .png, .pdf or .svg",
    )
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    from cnpgen.store.files.documents import render
    from cnpgen.store.inspection import inspect_dataset

    found = inspect_dataset(arguments.folder)
    print(render(found.to_dict()) if arguments.json else inspection_text(found))
    if arguments.plot:
        from cnpgen.store.dataset_plot import plot_dataset

        plot_dataset(found, arguments.plot)
        print(f"drawn: {arguments.plot}", file=sys.stderr)
    return 1 if found.damaged else 0


def inspection_text(found: "Inspection") -> str:
    """Lay out an inspection for people."""
    spec = found.spec
    sections = [
        [
            f"{spec.name} {spec.version}  {spec.title}".rstrip(),
            *table(_facts(found), indent="  "),
        ]
    ]
    if found.sampling.tried:
        sections.append(_yield_lines(found.sampling))
    head = ("field", "column", "unit", "min", "mean", "max")
    rows = [
        row
        for field in spec.fields
        for row in _field_rows(field, found.statistics.get(field.name))
    ]
    sections.append(
        table([(*row, "") for row in (head, *rows)], indent="  ", right=(3, 4, 5))
    )
    return "\n\n".join("\n".join(lines) for lines in sections)


def _facts(found: "Inspection") -> list[tuple[str, str]]:
    from cnpgen.cli.dry_run import size_text

    spec = found.spec
    splits = [
        f"{split} {n:,}"
        + ("" if n == spec.splits[split] else f" of {spec.splits[split]:,}")
        for split, n in found.rows.items()
    ]
    unread = "checksums of the shards were not checked, 'cnpgen validate' does"
    versions = [
        ", ".join(f"{name} {version}" for name, version in made.items())
        for made in found.environments
    ]
    return [
        ("state", f"complete; {unread}" if found.complete else found.state),
        ("rows", f"{sum(found.rows.values()):,}: {', '.join(splits)}"),
        ("shards", f"{len(found.summary.records)} of at most {spec.shard_size:,} rows"),
        ("size", f"{size_text(found.bytes)}, {spec.dtype}"),
        ("seed", str(spec.seed)),
        ("backend", f"{spec.backend}, {found.seconds:,.1f} s of work"),
        ("recipe", f"sha256 {spec.recipe_sha256}"),
        *(("made with", text) for text in versions),
    ]


def _yield_lines(sampling: "SamplingStatistics") -> list[str]:
    """Lay out the sampling statistics of the draws, in pipeline order."""
    rows = [
        ("stage", "rejects because", "draws", "accepts", "left"),
        ("", "", f"{sampling.tried:,}", "", "100.00 %"),
    ]
    # Candidates that are left: each reason takes its count from those that came to it.
    left = sampling.tried
    before = ""
    for reason, count in sampling.rejections.items():
        stage = sampling.stages.get(reason, "")
        accepts = 100 * (1 - count / left) if left else 100.0
        left -= count
        # A stage with several reasons is named once.
        label = stage if stage != before else ""
        rows.append(
            (
                label,
                reason,
                f"{count:,}",
                f"{accepts:.2f} %",
                f"{100 * left / sampling.tried:.2f} %",
            )
        )
        before = stage
    share = f"{100 * sampling.accepted / sampling.tried:.2f} %"
    lines = table([(*row, "") for row in rows], indent="  ", right=(2, 3, 4))
    return [
        f"  {sampling.accepted:,} of {sampling.tried:,} draws accepted, {share}",
        *lines,
    ]


def _field_rows(field: "Field", found: "FieldStatistics | None") -> TextRows:
    """Return a row per column of a field.

    Its name is on the first one, its unit where it is not that of the last.
    """
    # A column without a name is an empty text; a scalar field has one column.
    columns = field.names or ("",) * max(field.width, 1)
    rows = []
    before = ""
    for index, (column, unit) in enumerate(zip(columns, field.units, strict=True)):
        first = ("" if index else field.name, column, "" if unit == before else unit)
        before = unit
        numbers = (found.minimum, found.mean, found.maximum) if found else ()
        rows.append(
            (
                *first,
                *(f"{values[index]:.5g}" for values in numbers),
                *([] if found else ["-"] * 3),
            )
        )
    return rows
