"""Write the part of the first page that the README has, too, and draw the pictures.

    python docs/generate.py
    python docs/generate.py --pictures    # extras benchmark, plot, robots, torch, view; needs Chromium, EGL or OSMesa

Pictures of benchmarks are drawn by their commands. ``tests/docs/test_reference.py`` compares the page with the README.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parent


def describe_index() -> str:
    """Return the first page, with the section of the README on its two commands."""
    shared = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    shared = shared[
        shared.index("## Two commands") : shared.index("## Plan, optimize, check")
    ].replace("](docs/", "](")
    page = (FOLDER / "index.md").read_text(encoding="utf-8")
    return (
        page[: page.index("## Two commands")]
        + shared
        + page[page.index("## When to use it") :].rstrip("\n")
    )


def draw_pictures() -> None:
    """Draw the pictures of the concepts, of action chunks, of the gallery, of the film and of the blocks of pages."""
    pages = [
        str(page)
        for page in sorted(FOLDER.glob("*/*.md"))
        if "\n<!-- output -->\n" in page.read_text(encoding="utf-8")
    ]
    with tempfile.TemporaryDirectory() as gallery:
        for script, *arguments in (
            ("pictures.py",),
            ("chunk_picture.py",),
            ("gallery.py", gallery, "--pictures"),
            ("film.py",),
            ("outputs.py", *pages),
        ):
            command = [sys.executable, str(FOLDER / script), *arguments]
            subprocess.run(command, check=True)


def main() -> None:
    """Write the page, and draw the pictures if they are requested."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--pictures", action="store_true", help="also draw the pictures"
    )
    arguments = parser.parse_args()
    (FOLDER / "index.md").write_text(describe_index() + "\n", encoding="utf-8")
    if arguments.pictures:
        draw_pictures()


if __name__ == "__main__":
    main()
