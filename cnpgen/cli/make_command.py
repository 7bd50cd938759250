"""``cnpgen make-dataset``: make a dataset, or go on with one that was interrupted."""

import argparse
import sys
from functools import partial
from typing import TYPE_CHECKING, Any

from cnpgen.cli import values
from cnpgen.cli.interruption import raise_if_interrupted
from cnpgen.cli.parser import Commands, Parser, add_command, add_engine
from cnpgen.cli.progress import Meter
from cnpgen.errors import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from cnpgen.make.dataset import MadeDataset
    from cnpgen.make.recipe import DatasetRecipe
    from cnpgen.store.fates import Fates

KEPT = "finished shards are kept, run the same command again to go on"

_TEXT = """\
The same recipe, seed and backend give the same rows, however the work is shared out: --workers, --shard-size and
--part decide which process makes which rows, never what is in them; a smaller --n gives the first rows of each split.
With --certify every sample is planned from nothing (about 30 ms each): those without a valid plan are left out and
counted under "no plan found", and the plan's control points are stored beside the others. With --model it begins
with a planner's plans, in half the time; the same judges decide.
The folder of the dataset is printed on stdout.

What is in the folder already is kept if it is of the same dataset: its shards are read and compared with their
recorded sha256 (at 0.3 to 1 GB/s per core), and damaged ones are made again. Another dataset is replaced only with
--force, or if it has no rows yet. After Ctrl-C (exit code 130), SIGTERM (143), kill -9 or a full disk the same command
goes on.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "make-dataset", run, title="make a dataset, or go on with it", text=_TEXT)
    option = parser.add_argument
    option("recipe", metavar="NAME|FILE", help="a shipped dataset or pipeline (see 'cnpgen list'), or a recipe file")
    option("--n", metavar="N", type=values.rows, help="rows of all splits together; default the recipe's")
    option("--seed", metavar="S", type=values.seed, help="root seed; default the recipe's")
    option("-o", "--out", metavar="DIR", help="folder of the dataset; default NAME-vMAJOR here")
    option("--workers", metavar="W", type=values.positive, help="processes; default one per available core")
    add_engine(parser)
    option(
        "--shard-size",
        metavar="R",
        type=values.positive,
        help="rows per file; default 8192 to 65536, with --certify 64 to 1024",
    )
    option("--dtype", choices=("float64", "float32"), default="float64", help="what numbers are stored as")
    option("--backend", choices=("compiled", "numpy", "casadi"), help="what computes; default the fastest that works")
    option(
        "--part", metavar="K/M", type=values.part, help="make the K-th of M parts only (0/M to M-1/M), for job arrays"
    )
    option("--certify", action="store_true", help="plan every sample, and keep those with a valid plan, with the plan")
    option(
        "--model",
        metavar="NAME|FILE",
        help="with --certify: begin with the plans of this planner, a shipped one or a file (default: from nothing)",
    )
    option("--force", action="store_true", help="replace another dataset that is in the folder")
    option("--dry-run", action="store_true", help="print what would be made, and write nothing")
    option("--quiet", action="store_true", help="no progress and no summary")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.cli.recipe_names import check_recipe
    from cnpgen.errors import UsageError
    from cnpgen.make.load import load_dataset_recipe

    check_recipe(arguments.recipe, of_dataset="'cnpgen make-dataset NAME --out {0}' goes on with it")
    recipe = load_dataset_recipe(arguments.recipe)
    if arguments.model is not None and not arguments.certify:
        raise UsageError("--model says where certifying begins: it needs --certify")
    if arguments.certify:
        from cnpgen.make.certify import certified

        if arguments.dtype == "float32":
            raise UsageError("--certify stores plans, which are exact in float64 only: leave out --dtype float32")
        recipe = certified(recipe, model=arguments.model)
    if arguments.dry_run:
        from cnpgen.cli.dry_run import blueprint_text

        print(blueprint_text(recipe, **_settings(arguments), force=arguments.force))
        return 0
    _make(recipe, arguments)
    return 0


def _settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments that decide what the dataset is."""
    return {name: getattr(arguments, name) for name in ("out", "n", "seed", "shard_size", "dtype", "backend")}


def _make(recipe: "DatasetRecipe", arguments: argparse.Namespace) -> None:
    from cnpgen.make.dataset import make_dataset

    make = partial(
        make_dataset,
        recipe,
        arguments.out,
        n=arguments.n,
        seed=arguments.seed,
        workers=arguments.workers,
        engine=arguments.engine,
        address=arguments.address,
        shard_size=arguments.shard_size,
        dtype=arguments.dtype,
        backend=arguments.backend,
        force=arguments.force,
        part=arguments.part,
    )
    make_metered(make, quiet=arguments.quiet, part=arguments.part)


def make_metered(
    make: "Callable[..., MadeDataset]", *, quiet: bool, part: tuple[int, int] | None = None, verb: str = "made"
) -> None:
    """Make a dataset with progress and a summary on stderr, and print its folder.

    Args:
        make: Takes ``begin`` and ``progress``, as ``make_dataset`` does.
        quiet: Whether to show neither.
        part: Which part of the dataset is made.
        verb: What was done to the rows.
    """
    meter = Meter(quiet=quiet)

    def begin(step: str, folder: "Path", rows: int, there: int) -> None:
        raise_if_interrupted()
        meter.begin(f"{step} {folder}", rows, there)

    def count(rows: int, fates: "Fates | None") -> None:
        raise_if_interrupted()
        meter(rows, fates)

    try:
        made = make(begin=begin, progress=count)
    except Exception:
        raise_if_interrupted()  # what the same Ctrl-C did to a compiler is not the news
        raise
    except KeyboardInterrupt as interruption:
        raise type(interruption)(KEPT) from interruption
    finally:
        meter.close()
    if not quiet:
        print("\n".join(_summary(made, meter, part, verb)), file=sys.stderr)
    print(made.folder)


def _summary(made: "MadeDataset", meter: Meter, part: tuple[int, int] | None, verb: str) -> list[str]:
    """Say in a few lines what was done."""
    import textwrap

    wanted = sum(made.rows.values())
    text, rest = _rows_text(made.rows), "" if made.complete else "; other parts are still to be made"
    if part is not None:
        all_rows = counted(sum(made.blueprint.splits.values()), "row")
        text, rest = f"{text}, part {part[0]}/{part[1]} of {all_rows},", rest or "; all parts are made"
    if not made.made:
        return [f"{_unmade(made, part)}: {text.rstrip(',')}{rest}"]
    share = "" if made.made == wanted else f"the missing {made.made:,} of "
    whole, making = meter.seconds, max(meter.running, 1e-9)
    times = f"in {whole:.1f} s: {whole - making:.1f} s to get ready, then {made.made / making:,.0f} rows/s"
    lines = [f"{verb} {share}{text} {times}{rest}"]
    lines += [_yield(meter.fates)] if meter.fates else []
    return [row for line in lines for row in textwrap.wrap(line, 100, subsequent_indent="  ")]


def _unmade(made: "MadeDataset", part: tuple[int, int] | None) -> str:
    """Say in what state a dataset was of which no row had to be made."""
    if made.mended:
        return f"every row was there already, {', '.join(made.mended)} written now"
    return f"already {'made' if part else 'complete'}"


def _rows_text(rows: "Mapping[str, int]") -> str:
    """Write rows in all and by split, without empty splits."""
    splits = ", ".join(f"{split} {number:,}" for split, number in rows.items() if number)
    return counted(sum(rows.values()), "row") + (f" ({splits})" if splits else "")


def _yield(fates: "Fates") -> str:
    """Say how many draws were accepted and why most of the others were not."""
    tried = max(fates.tried, 1)
    worst = sorted(fates.rejections.items(), key=lambda item: -item[1])[:3]
    reasons = ", ".join(f"{reason} {count / tried:.1%}" for reason, count in worst if count >= 5e-4 * tried)
    text = f"accepted {fates.accepted / tried:.1%} of {fates.tried:,} draws"
    return f"{text}; rejected: {reasons}" if reasons else text
