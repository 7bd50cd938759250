"""Write the part of the first page that the README has, too.

    python docs/generate.py

``tests/docs/test_reference.py`` compares the page with the README.
"""

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


def main() -> None:
    """Write the page."""
    (FOLDER / "index.md").write_text(describe_index() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
