"""Print a page of the documentation as Markdown.

Without PAGE it lists all pages. --search lists the lines that contain TEXT. The pages
cli and keys, with all commands and all keys of recipe files, are made from the code.
Pictures are on the site and in the repository only.
"""

import argparse
import re
import sys
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

from cnpgen.cli.parser import Parser, add_json, refuse
from cnpgen.errors import CnpgenError, MachineError, UsageError, lacks
from cnpgen.schema import addons

PAGES = "cnpgen.pages"  # functions that return a page of the reference
KINDS = ("tutorials", "how-to", "concepts", "reference", "benchmarks")


def add_options(parser: Parser) -> None:
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "page", metavar="PAGE", nargs="?", help="name of a page, such as hit-a-puck"
    )
    what.add_argument(
        "--search",
        metavar="TEXT",
        help="list the lines with all words of TEXT on all pages, in any case",
    )
    parser.add_argument(
        "--url", action="store_true", help="print the address of PAGE on the site"
    )
    add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    pages = list_pages()
    name = None if arguments.page is None else page_name(arguments.page, pages)
    if arguments.search is not None:
        refuse(arguments, ["url"], "{} has no effect with --search")
        return _search(arguments.search, pages, as_json=arguments.json)
    if arguments.url:
        _print_url(pages[name] if name else pages["index"])
    elif name is None:
        _list(pages, as_json=arguments.json)
    elif arguments.json:
        _print_json(
            {
                "page": name,
                "url": page_url(pages[name]),
                "markdown": page_text(pages[name]),
            }
        )
    else:
        print(page_text(pages[name]), end="")
    return 0


def _print_url(page: Path) -> None:
    url = page_url(page)
    if url is None:
        raise UsageError(
            "the documentation has no address yet: 'cnpgen docs PAGE' prints a page"
        )
    print(url)


def docs_folder() -> Path:
    """Return the folder of the pages: in the installed package, or in a checkout."""
    from cnpgen.schema.catalogue import recipes_root

    return recipes_root() / "docs"


def list_pages() -> dict[str, Path]:
    """List the pages, name -> file, in the order of the index, which is the first.

    Raises:
        MachineError: The installation lacks the pages.
    """
    folder = docs_folder()
    if not (folder / "index.md").is_file():
        raise MachineError(
            f"{folder} has no pages of the documentation: reinstall cnpgen"
        )
    pages = {"index": folder / "index.md"}
    # The table above it repeats some links.
    lists = page_text(pages["index"]).partition("## Tutorials")[2]
    for kind in KINDS:
        made = [page for page in rendered_pages() if page.parent.name == kind]
        # Pages of benchmarks are named with their folder.
        prefix = "benchmarks/" if kind == "benchmarks" else ""
        files = sorted(
            {*(folder / kind).glob("*.md"), *made},
            key=lambda file: lists.find(f"{file.parent.name}/{file.name}"),
        )
        pages |= {prefix + file.stem: file for file in files}
    return pages


def rendered_pages() -> list[Path]:
    """Return the paths of the pages that are made from the code; only the site has such files."""
    folder = docs_folder() / "reference"
    return [folder / f"{entry.name}.md" for entry in addons.installed(PAGES)]


def page_name(text: str, pages: dict[str, Path]) -> str:
    """Return the name of a page from its name, its path, or a link to it.

    Raise UsageError for other texts.
    """
    # A link may end in a heading: "page.md#heading".
    path = PurePosixPath(text.partition("#")[0].removesuffix(".md"))
    folder = path.parent.name
    name = f"benchmarks/{path.name}" if folder == "benchmarks" else path.name
    # A folder in front of the name must be that of the page.
    if name not in pages or folder not in {"", "..", pages[name].parent.name}:
        raise UsageError(f"documentation {lacks('page', text, pages)}")
    return name


def page_url(page: Path) -> str | None:
    """Return the address of a page on the site; None if the site has no address."""
    from cnpgen.machine import versions

    if not versions.DOCUMENTATION_URL:
        return None
    path = page.relative_to(docs_folder()).with_suffix(".html").as_posix()
    return f"{versions.DOCUMENTATION_URL}docs/{path}"


def mentioned_addresses(text: str) -> list[str]:
    """Return the addresses of the pages that a text names as ``'cnpgen docs PAGE'``.

    None without installed pages or an address of the site.
    """
    # Help wraps lines, so that the command and the page may be on two of them.
    names = re.findall(r"'cnpgen docs ([\w/-]+)'", " ".join(text.split()))
    # An error text must not fail because the pages are missing.
    with suppress(CnpgenError):
        pages = list_pages() if names else {}
        named = [pages[name] for name in dict.fromkeys(names) if name in pages]
        return list(filter(None, map(page_url, named)))
    return []


def page_text(page: Path) -> str:
    """Return the text of a page of ``list_pages``, from its file or from the code."""
    if page not in rendered_pages():
        return page.read_text(encoding="utf-8")
    return rendered_page(page.stem)


def rendered_page(name: str) -> str:
    """Return a page that is made from the code.

    Raises:
        MissingAddonError: This installation lacks the add-on that makes it.
    """
    entry = addons.find(PAGES, name)
    assert entry is not None, name
    return f"{addons.load_entry(entry, f'the page {name!r}')()}\n"


def _list(pages: dict[str, Path], *, as_json: bool) -> None:
    listed = {name: file for name, file in pages.items() if name != "index"}
    titles = {
        name: page_text(file).partition("\n")[0].removeprefix("# ")
        for name, file in listed.items()
    }
    rows = [
        {"page": name, "kind": file.parent.name, "title": titles[name]}
        for name, file in listed.items()
    ]
    if as_json:
        _print_json(rows)
        return
    width = max(map(len, pages))
    for kind in KINDS:
        print(f"{kind}:")
        lines = [
            f"  {row['page']:<{width}}  {row['title']}"
            for row in rows
            if row["kind"] == kind
        ]
        print(*lines, sep="\n", end="\n\n")
    print(
        "'cnpgen docs PAGE' prints a page, 'cnpgen docs --search TEXT' searches all pages."
    )


def _search(text: str, pages: dict[str, Path], *, as_json: bool) -> int:
    """Print the lines that contain all words of a text, in any order.

    Return 1 if there are none.
    """
    words = text.casefold().split()
    rows = [
        {"page": name, "line": number, "text": line.strip()}
        for name, file in pages.items()
        for number, line in enumerate(page_text(file).splitlines(), 1)
        if all(word in line.casefold() for word in words)
    ]
    if as_json:
        _print_json(rows)
    else:
        for row in rows:
            print(f"{row['page']}:{row['line']}: {row['text']}")
    if not rows:
        print(f"cnpgen: no line of the documentation has {text!r}", file=sys.stderr)
    return 0 if rows else 1


def _print_json(content: Any) -> None:
    from cnpgen.store.files.documents import render

    print(render(content))
