"""Print again every figure of the README and of docs/benchmarks: run all commands that these pages name, one by one.

    python benchmarks/figures.py OUT [--list] [--pages planners loss] [--environment CLONE] [--time-limit 3600]

The output of each command becomes one text file in OUT. Commands whose file exists are skipped, so that an interrupted
run resumes. FOLDER in a command is a folder in OUT, and ``air_hockey_challenge`` is the clone of --environment, without
which those commands are skipped, like those that need files which the reader has trained. --list also prints the
maximum planning time of comparisons of planners: every planner uses its time limit for every problem.
"""

import argparse
import re
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
QUOTED = r"(?:benchmarks/\w+\.py|cnpgen benchmark [\w-]+ --sim)"
COMMAND = re.compile(
    rf"`(?:python )?({QUOTED}[^`]*)`|^(?:python )?({QUOTED}.*)$", re.MULTILINE
)
OWN_NAME = Path(__file__).name
OTHER_PAGES = tuple(
    ROOT / "docs" / "how-to" / name for name in ("benchmark.md", "trajectories.md")
)
CLONE, FOLDER = "air_hockey_challenge", "FOLDER"
GIVEN_FILE = re.compile(r"[*?]|\bFILE\b")  # a file that the reader makes first
DEFAULT_TIME_LIMIT_S = 12 * 3600.0
HOUR_S = 3600.0


@dataclass(frozen=True)
class QuotedCommand:
    """Command of a page whose output has figures of that page.

    Attributes:
        page: Name of the page.
        text: The command, without ``python``.
    """

    page: str
    text: str

    @property
    def file_name(self) -> str:
        """Name of the file of its output."""
        return (
            re.sub(r"[^\w.+-]+", "_", self.text.removeprefix("benchmarks/"))[:150]
            + ".txt"
        )

    def arguments(self, out: Path, environment: Path | None) -> list[str] | None:
        """Return the arguments of the process, or None if the command needs a clone or files that are missing."""
        words = shlex.split(self.text)
        if any(GIVEN_FILE.search(word) for word in words):
            return None
        if CLONE in words and environment is None:
            return None
        known = {
            FOLDER: str(out / "work" / Path(words[0]).stem),
            CLONE: str(environment),
        }
        words = [known.get(word, word) for word in words]
        if words[0] == "cnpgen":
            return [sys.executable, "-m", *words, "-o", str(out / "work" / words[2])]
        return [sys.executable, *words]

    def planning_bound(self) -> float | None:
        """Return the maximum planning time [h] of a comparison with a time limit, including the margin of its stops."""
        from cnpgen.addons.benchmark.process import STOP_MARGIN_S
        from cnpgen.addons.benchmark.suite import load_suite
        from cnpgen.schema.units import parse_number

        words = shlex.split(self.text)
        if words[0] != "cnpgen" or "--time-limit" not in words:
            return None
        limit = parse_number(words[words.index("--time-limit") + 1], "s")
        planners = list(
            takewhile(
                lambda word: not word.startswith("--"),
                words[words.index("--planners") + 1 :],
            )
        )
        problems, _ = load_suite(words[2]).problems()
        return len(planners) * len(problems) * (limit + STOP_MARGIN_S) / HOUR_S


def quoted_commands(pages: list[str] | None = None) -> list[QuotedCommand]:
    """Return the commands of all pages in their order, each once.

    Args:
        pages: Names of pages; all by default.
    """
    found: dict[str, QuotedCommand] = {}
    for path in (
        ROOT / "README.md",
        *sorted((ROOT / "docs" / "benchmarks").glob("*.md")),
        *OTHER_PAGES,
    ):
        if pages and path.stem not in pages:
            continue
        for texts in COMMAND.findall(path.read_text(encoding="utf-8")):
            text = "".join(texts).strip()
            if is_program(text):
                found.setdefault(text, QuotedCommand(path.stem, text))
    return list(found.values())


def is_program(text: str) -> bool:
    """Return whether a quotation is a command, and neither the name of a module nor this script."""
    script = ROOT / text.split(maxsplit=1)[0]
    return script.name == "cnpgen" or (
        script.name != OWN_NAME and "__main__" in script.read_text(encoding="utf-8")
    )


def run(
    command: QuotedCommand, out: Path, environment: Path | None, time_limit: float
) -> str:
    """Run a command unless its output exists; return a word for the outcome."""
    path = out / command.file_name
    if path.exists():
        return "kept"
    words = command.arguments(out, environment)
    if words is None:
        return "skipped: it needs --environment or trained files"
    (out / "work").mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    begun = time.monotonic()
    with partial.open("w", encoding="utf-8") as file:
        file.write(f"$ {command.text}\n")
        file.flush()
        try:
            code = subprocess.run(
                words, cwd=ROOT, stdout=file, check=False, timeout=time_limit
            ).returncode
        except subprocess.TimeoutExpired:
            return f"failed: longer than {time_limit:g} s"
    if code:
        return f"failed: exit code {code}"
    partial.rename(path)
    return f"done in {time.monotonic() - begun:.0f} s"


def print_list(commands: list[QuotedCommand]) -> None:
    """Print the commands, and the maximum planning time of comparisons of planners with its sum."""
    total = 0.0
    for command in commands:
        print(f"{command.page}: {command.text}")
        if (bound := command.planning_bound()) is not None:
            total += bound
            print(f"    plans for at most {bound:.2f} h")
    if total:
        print(f"all comparisons of planners: at most {total:.2f} h of planning")


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "out",
        type=Path,
        nargs="?",
        default=Path("figures"),
        help="folder of the outputs",
    )
    parser.add_argument(
        "--list", action="store_true", help="list the commands and their pages"
    )
    parser.add_argument(
        "--pages", nargs="+", help="names of pages, for example planners loss"
    )
    parser.add_argument(
        "--environment", type=Path, help="clone of the Air Hockey Challenge"
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        default=DEFAULT_TIME_LIMIT_S,
        help="of one command [s]",
    )
    options = parser.parse_args()
    commands = quoted_commands(options.pages)
    if options.list:
        print_list(commands)
        return 0
    failed = False
    for command in commands:
        outcome = run(
            command, options.out.resolve(), options.environment, options.time_limit
        )
        failed |= outcome.startswith("failed")
        print(f"{command.page}: {command.text}: {outcome}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
