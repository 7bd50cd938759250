"""``cnpgen make-dataset``: make a dataset, or go on with one that was interrupted."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Commands, Parser, add_command
from cnpgen.cli.progress import Meter

if TYPE_CHECKING:
    from cnpgen.make import MadeDataset
    from cnpgen.outcome import Outcome
    from cnpgen.recipes import DatasetRecipe

INTERRUPTED = "interrupted: finished shards are kept, run the same command again to go on"

_TEXT = """\
The same recipe, seed and backend give the same rows, however the work is shared out: --workers, --shard-size and
--part decide which process makes which rows, never what is in them; a smaller --n gives the first rows of each split.
The folder of the dataset is printed on stdout.
"""


def add(commands: "Commands[Parser]") -> None:
    """Add the command."""
    parser = add_command(commands, "make-dataset", run, title="make a dataset, or go on with it", text=_TEXT)
    option = parser.add_argument
    option("recipe", metavar="NAME|FILE", help="a shipped dataset or pipeline (see 'cnpgen list'), or a recipe file")
    option("--n", metavar="N", type=values.rows, help="rows of all splits together; default the recipe's")
    option("--seed", metavar="S", type=values.seed, help="root seed; default the recipe's")
    option("--out", metavar="DIR", type=Path, help="folder of the dataset; default NAME-vMAJOR here")
    option("--workers", metavar="W", type=values.positive, help="processes; default one per available core")
    option("--shard-size", metavar="R", type=values.positive, help="rows per file (default: 8192 to 65536)")
    option("--dtype", choices=("float64", "float32"), default="float64", help="what numbers are stored as")
    option("--backend", choices=("compiled", "numpy", "casadi"), help="what computes; default the fastest that works")
    option(
        "--part", metavar="K/M", type=values.part, help="make the K-th of M parts only (0/M to M-1/M), for job arrays"
    )
    option("--force", action="store_true", help="replace another dataset that is in the folder")
    option("--dry-run", action="store_true", help="print what would be made, and write nothing")
    option("--quiet", action="store_true", help="no progress and no summary")


def run(arguments: argparse.Namespace) -> int:
    """Run the command."""
    from cnpgen.library import load_dataset_recipe

    recipe = load_dataset_recipe(arguments.recipe)
    if arguments.dry_run:
        from cnpgen.cli.plan_text import plan_text

        print(plan_text(recipe, **_settings(arguments), force=arguments.force))
        return 0
    try:
        _make(recipe, arguments)
    except KeyboardInterrupt:
        print(f"cnpgen: {INTERRUPTED}", file=sys.stderr)
        return 130
    return 0


def _settings(arguments: argparse.Namespace) -> dict[str, object]:
    """Return the arguments that decide what the dataset is."""
    return {name: getattr(arguments, name) for name in ("out", "n", "seed", "shard_size", "dtype", "backend")}


def _make(recipe: "DatasetRecipe", arguments: argparse.Namespace) -> None:
    from cnpgen.make import make_dataset

    meter = Meter(quiet=arguments.quiet)
    try:
        made = make_dataset(
            recipe,
            arguments.out,
            n=arguments.n,
            seed=arguments.seed,
            workers=arguments.workers,
            shard_size=arguments.shard_size,
            dtype=arguments.dtype,
            backend=arguments.backend,
            force=arguments.force,
            part=arguments.part,
            begin=lambda folder, total, there: meter.begin(f"making {folder}", total, there),
            progress=meter,
        )
    finally:
        meter.close()
    if not arguments.quiet:
        print("\n".join(_summary(made, meter)), file=sys.stderr)
    print(made.folder)


def _summary(made: "MadeDataset", meter: Meter) -> list[str]:
    """Say in a few lines what was done."""
    import textwrap

    splits = ", ".join(f"{split} {rows:,}" for split, rows in made.plan.splits.items())
    rows = sum(made.plan.splits.values())
    total = f"{rows:,} rows ({splits})"
    rest = "" if made.complete else "; other parts are still to be made"
    if not made.made:
        return [f"already {'complete' if made.complete else 'made, this part of'}: {total}{rest}"]
    share = "" if made.made == rows else f"the last {made.made:,} of " if made.complete else f"{made.made:,} of "
    speed = f"in {meter.seconds:.1f} s, {made.made / max(meter.seconds, 1e-9):,.0f} rows/s"
    lines = [f"made {share}{total} {speed}{rest}", *([_yield(meter.outcome)] if meter.outcome else [])]
    return [part for line in lines for part in textwrap.wrap(line, 100, subsequent_indent="  ")]


def _yield(outcome: "Outcome") -> str:
    """Say how many draws were accepted and why most of the others were not."""
    tried = max(outcome.tried, 1)
    worst = sorted(outcome.rejections.items(), key=lambda item: -item[1])[:3]
    reasons = ", ".join(f"{reason} {count / tried:.1%}" for reason, count in worst if count)
    text = f"accepted {outcome.accepted / tried:.1%} of {outcome.tried:,} draws"
    return f"{text}; rejected: {reasons}" if reasons else text
