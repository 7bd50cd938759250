"""Write the output blocks of pages, and the pictures that their blocks draw.

    python docs/outputs.py docs/tutorials/hit-a-puck.md ...

An output block follows ``<!-- output -->``. It shows some lines of what a terminal shows, results and notes, and ``...``
for those left out. An empty one is filled with all lines. A picture of a page is replaced if a block writes a file of
its name. ``tests/docs/test_blocks.py`` compares the pictures, and the lines without their numbers, which depend on the
machine.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

BLOCK = re.compile(r"((?:<!-- [^\n]* -->\n)*)```(\w*)\n(.*?)```", re.S)
LEFT_OUT = "..."
TERMINAL = {"PYTHONUNBUFFERED": "1"}  # results and notes in the order of a terminal
# A dash stands for a number that a row of a table lacks.
NUMBER = re.compile(r"[-+]?\d[\d.,]*(?:e[-+]?\d+)?|(?<= )-(?= )")


def masked(line: str) -> str:
    """Return a line without its numbers and with single spaces."""
    return " ".join(re.sub(r"[-=]{3,}", "-", NUMBER.sub("0", line)).split())


def absent_lines(shown: str, printed: str) -> list[str]:
    """Return the lines of an output block that the output does not have, in their order."""
    lines = iter([masked(line) for line in printed.splitlines()])
    wanted = [line for line in shown.splitlines() if line.strip() != LEFT_OUT]
    return [line for line in wanted if masked(line) not in lines]


def renewed(shown: str, printed: str) -> str:
    """Return an output block with the numbers of the output."""
    if not shown.strip():
        return printed
    left, lines = printed.splitlines(), []
    for line in shown.splitlines():
        if line.strip() == LEFT_OUT:
            lines.append(line)
            continue
        while left and masked(left[0]) != masked(line):
            del left[0]
        if not left:
            raise SystemExit(f"the output has no line like {line!r}")
        lines.append(left.pop(0))
    return "".join(f"{line.rstrip()}\n" for line in lines)


def write_outputs(page: Path, folder: Path) -> None:
    """Run the blocks of a page in a folder, and write its output blocks."""
    printed = ""

    def replace(block: re.Match[str]) -> str:
        nonlocal printed
        marks, language, text = block.groups()
        if "<!-- output -->" in marks:
            return f"{marks}```\n{renewed(text, printed)}```"
        if file := re.search(r"<!-- file: (\S+) -->", marks):
            (folder / file[1]).parent.mkdir(parents=True, exist_ok=True)
            (folder / file[1]).write_text(text, encoding="utf-8")
        elif language in {"bash", "python"}:
            command = {
                "bash": ["bash", "-euo", "pipefail", "-c", text],
                "python": [sys.executable, "-c", text],
            }[language]
            printed = subprocess.run(
                command,
                cwd=folder,
                env=os.environ | TERMINAL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=True,
            ).stdout
        return block[0]

    page.write_text(
        BLOCK.sub(replace, page.read_text(encoding="utf-8")), encoding="utf-8"
    )


def drawn_pictures(page: Path, folder: Path) -> list[tuple[Path, Path]]:
    """Return the pictures that the blocks of a page drew in a folder, each with its file in docs/images."""
    links = re.findall(r"!\[[^\]]*\]\((\S+\.png)\)", page.read_text(encoding="utf-8"))
    pairs = [(folder / Path(link).name, page.parent / link) for link in links]
    return [(drawn, shown) for drawn, shown in pairs if drawn.is_file()]


if __name__ == "__main__":
    from PIL import Image

    for name in sys.argv[1:]:
        with tempfile.TemporaryDirectory() as scratch:
            write_outputs(Path(name), Path(scratch))
            for drawn, shown in drawn_pictures(Path(name), Path(scratch)):
                Image.open(drawn).convert("P", palette=Image.ADAPTIVE).save(shown)
