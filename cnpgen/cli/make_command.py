"""Make a dataset, or resume one.

The same recipe, seed and backend give the same samples. --workers, --shard-size and
--part decide which process makes which samples, never their content; a smaller --n
gives the first samples of each split. With --certify every sample is planned (about 30
ms each). Samples without a valid plan are rejected as "no plan found", and the control
points of the plans are stored. With --model certification starts from a planner's
plans, in half the time, with the same judge. The folder of the dataset is printed on
stdout.

Shards of the same dataset in the folder are kept: they are compared with their recorded
sha256 (at 0.3 to 1 GB/s per core), and damaged ones are made again. Another dataset is
replaced only with --force, or if it has no shards. After Ctrl-C (exit code 130),
SIGTERM (143), kill -9 or a full disk the same command resumes.
"""

import argparse
import sys
from dataclasses import fields
from typing import TYPE_CHECKING

from cnpgen.cli import recipe_names, values
from cnpgen.cli.interruption import raise_if_interrupted
from cnpgen.cli.parser import ENGINE, Parser, add_engine, options_of
from cnpgen.cli.terminal import Meter
from cnpgen.errors import UsageError, counted

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from cnpgen.make.make_dataset import MadeDataset
    from cnpgen.store.sampling_statistics import SamplingStatistics

_SETTINGS = ("n", "seed", "shard_size", "dtype", "backend", "force")
INTERRUPTED_TEXT = "finished shards are kept; run the same command again to resume"


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option(
        "recipe",
        metavar="NAME|FILE",
        help="a shipped dataset or pipeline (see 'cnpgen list'), or a recipe file",
    )
    option(
        "--n",
        metavar="N",
        type=values.rows,
        help="total number of samples; default the recipe's",
    )
    option(
        "--seed", metavar="S", type=values.seed, help="root seed; default the recipe's"
    )
    option(
        "-o",
        "--out",
        metavar="DIR",
        help="folder of the dataset; default NAME-vMAJOR here",
    )
    add_engine(parser)
    _add_generation(parser)
    option(
        "--force", action="store_true", help="overwrite another dataset in the folder"
    )
    option(
        "--dry-run",
        action="store_true",
        help="print the specification and write nothing",
    )


def _add_generation(parser: Parser) -> None:
    """Add the options of how samples are made and stored."""
    option = parser.add_argument
    option(
        "--shard-size",
        metavar="R",
        type=values.positive,
        help="rows per file; default 8192 to 65536, with --certify 64 to 1024",
    )
    option(
        "--dtype",
        choices=("float64", "float32"),
        default="float64",
        help="stored number type",
    )
    option(
        "--backend",
        choices=("compiled", "numpy"),
        help="kernel backend; default the fastest available",
    )
    option(
        "--part",
        metavar="K/M",
        type=values.part,
        help="make only part K of M (0/M to M-1/M), for job arrays",
    )
    option(
        "--certify",
        action="store_true",
        help="plan every sample, and store those with a valid plan",
    )
    option(
        "--model",
        metavar="NAME|FILE",
        type=recipe_names.model,
        help="with --certify: start from the plans of this planner, a shipped one or a file",
    )


def run(arguments: argparse.Namespace) -> None:
    from cnpgen.make.recipe import load_dataset_recipe

    recipe_names.check_recipe(
        arguments.recipe, of_dataset="'cnpgen make-dataset NAME --out {0}' resumes it"
    )
    recipe = load_dataset_recipe(arguments.recipe)
    if arguments.model is not None and not arguments.certify:
        raise UsageError("--model needs --certify")
    if arguments.certify:
        from cnpgen.make.certify import certified

        if arguments.dtype == "float32":
            raise UsageError(
                "--certify stores plans, which are exact in float64 only: leave out --dtype float32"
            )
        recipe = certified(recipe, model=arguments.model)
    if arguments.dry_run:
        from cnpgen.cli.dry_run import spec_text

        print(spec_text(recipe, arguments.out, **options_of(arguments, *_SETTINGS)))
        return
    from cnpgen.make.generation_options import Begin, GenerationOptions
    from cnpgen.make.make_dataset import MadeDataset, Progress, make_dataset

    given = options_of(arguments, *_SETTINGS, *ENGINE, "part")
    names = {entry.name for entry in fields(GenerationOptions)}
    options = {name: given.pop(name) for name in names & given.keys()}

    def make(begin: Begin, progress: Progress) -> MadeDataset:
        chosen = GenerationOptions(**options, begin=begin)
        return make_dataset(
            recipe, arguments.out, **given, progress=progress, options=chosen
        )

    make_metered(
        make,
        quiet=arguments.quiet,
        part=arguments.part,
    )


def make_metered(
    make: "Callable[..., MadeDataset]",
    *,
    quiet: bool,
    part: tuple[int, int] | None = None,
    verb: str = "made",
) -> None:
    """Make a dataset with progress and a summary on stderr, and print its folder.

    ``make`` takes ``begin`` and ``progress``, as ``make_dataset`` does; the verb of the
    summary is a past participle.
    """
    meter = Meter(quiet=quiet)

    def begin(step: str, folder: "Path", rows: int, there: int) -> None:
        # Libraries may have dropped the interruption; every step raises it again.
        raise_if_interrupted()
        meter.begin(f"{step} {folder}", rows, there)

    def count(rows: int, sampling: "SamplingStatistics | None") -> None:
        raise_if_interrupted()
        meter(rows, sampling)

    try:
        made = make(begin=begin, progress=count)
    except Exception:
        # The interruption also ended a compiler.
        raise_if_interrupted()
        raise
    except KeyboardInterrupt as interruption:
        raise type(interruption)(INTERRUPTED_TEXT) from interruption
    finally:
        meter.close()
    if not quiet:
        print("\n".join(_summary(made, meter, part, verb)), file=sys.stderr)
    print(made.folder)


def _summary(
    made: "MadeDataset", meter: Meter, part: tuple[int, int] | None, verb: str
) -> list[str]:
    """Summarize the run."""
    import textwrap

    wanted = sum(made.rows.values())
    text = _rows_text(made.rows)
    rest = "" if made.complete else "; other parts are still to be made"
    if part is not None:
        all_rows = counted(sum(made.spec.splits.values()), "row")
        text = f"{text}, part {part[0]}/{part[1]} of {all_rows},"
        rest = rest or "; all parts are made"
    if not made.made:
        return [f"{_unmade(made, part)}: {text.rstrip(',')}{rest}"]
    share = "" if made.made == wanted else f"the missing {made.made:,} of "
    # The time before the last step prepares; a rate needs a time above 0.
    whole = meter.seconds
    making = max(meter.running, 1e-9)
    times = f"in {whole:.1f} s: {whole - making:.1f} s to get ready, then {made.made / making:,.0f} rows/s"
    lines = [
        f"{verb} {share}{text} {times}{rest}",
        *([_yield(meter.sampling)] if meter.sampling else []),
    ]
    return [
        row
        for line in lines
        for row in textwrap.wrap(line, 100, subsequent_indent="  ")
    ]


def _unmade(made: "MadeDataset", part: tuple[int, int] | None) -> str:
    """Describe a dataset of which no sample had to be made."""
    if made.repaired:
        return f"all samples existed, {', '.join(made.repaired)} written again"
    return f"already {'made' if part else 'complete'}"


def _rows_text(rows: "Mapping[str, int]") -> str:
    """Format the number of samples in total and by split, without empty splits."""
    splits = ", ".join(
        f"{split} {number:,}" for split, number in rows.items() if number
    )
    return counted(sum(rows.values()), "row") + (f" ({splits})" if splits else "")


def _yield(sampling: "SamplingStatistics") -> str:
    """Summarize accepted candidates and the most frequent rejection reasons."""
    tried = max(sampling.tried, 1)
    worst = sorted(sampling.rejections.items(), key=lambda item: -item[1])[:3]
    reasons = ", ".join(
        f"{reason} {count / tried:.1%}"
        for reason, count in worst
        if count >= 5e-4 * tried
    )
    text = f"accepted {sampling.accepted / tried:.1%} of {sampling.tried:,} draws"
    return f"{text}; rejected: {reasons}" if reasons else text
