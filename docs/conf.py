"""Settings of the documentation site, for Sphinx.

    python -m sphinx -W --keep-going -c docs . build/site                  # the site: build/site/index.html
    python -m sphinx -W --keep-going -b linkcheck -c docs . build/links    # external links, with a network

The source folder is the repository: links to SECURITY.md or to data cards work on the site and in the repository.
The navigation follows the order of the links in index.md. Pages of the API are written before the build to
reference/api/, and the pages that `cnpgen docs` makes from the code beside that folder; git ignores both. Notebooks of
the tutorials are written to the folder notebooks of the site, interactive pages to the folders gallery and interactive.
"""

import inspect
import re
import sys
from importlib.util import find_spec
from pathlib import Path

from docutils import nodes
from numpy.typing import ArrayLike
from sphinx.application import Sphinx
from sphinx.util.typing import stringify_annotation

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [
    str(DOCS.parent),
    str(DOCS),
]  # the package of this checkout; the scripts beside this file

from gallery import CARDS, available, write_gallery  # noqa: E402
from notebooks import write_notebooks  # noqa: E402
from planner_pages import write_pages  # noqa: E402

from cnpgen.addons.manual.name_page import (  # noqa: E402
    BRIDGES,
    bridge_names,
    public_objects,
)
from cnpgen.cli.docs_command import (  # noqa: E402
    list_pages,
    page_text,
    rendered_pages,
)
from cnpgen.machine.versions import DOCUMENTATION_URL, __version__  # noqa: E402

project = "cnpgen"
author = "The cnpgen developers"
copyright = author  # noqa: A001 - Sphinx reads this name
version = release = __version__
root_doc = "docs/index"
include_patterns = [
    "*.md",
    "docs/**",
    "datasets/*.md",
    "datasets/**/*.md",
    "pipelines/*.md",
    "problems/*.md",
]
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",  # links from names to their source
    "sphinx_copybutton",
]
copybutton_exclude = ".linenos, .gp"
copybutton_selector = "div:not(.output) > div.highlight > pre"  # commands, not outputs
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
myst_enable_extensions = ["attrs_block"]  # classes of tables and blocks
myst_heading_anchors = 4  # the anchors of headings are GitHub's
smartquotes = False  # they would change --n
highlight_language = "none"  # blocks without a language
autodoc_typehints_format = "short"
maximum_signature_line_length = 60  # longer ones have a parameter per line
autodoc_mock_imports = list(BRIDGES)  # the pages of the bridges need no framework
napoleon_use_ivar = True  # attributes in docstrings describe those that autodoc lists
linkcheck_ignore = [
    *([re.escape(DOCUMENTATION_URL)] if DOCUMENTATION_URL else []),
    r"https?://(localhost|[\w.]*\bexample\.(org|com))\b",
]  # not published
linkcheck_timeout = 20  # [s]
linkcheck_retries = 2

html_theme = "furo"
html_title = f"cnpgen {__version__}"
html_logo = "static/logo.svg"
html_baseurl = DOCUMENTATION_URL
html_extra_path = ["site"]  # index.html forwards to docs/index.html
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["site.css"]

CAPTIONS = {
    "tutorials": "Tutorials",
    "how-to": "How-to guides",
    "concepts": "Concepts",
    "reference": "Reference",
    "benchmarks": "Benchmarks",
}
MADE = [page.stem for page in rendered_pages()]  # of the reference
OTHERS = (
    "README",
    "CHANGELOG",
    "CONTRIBUTING",
    "CODE_OF_CONDUCT",
    "SECURITY",
    "datasets/**",
    "pipelines/**",
    "problems/**",
    "docs/examples/ros2/README",
)


def toctree(entries: list[str], *options: str) -> str:
    """Return a hidden table of contents in MyST."""
    return "\n".join(
        ["", "```{toctree}", ":hidden:", *options, "", *entries, "```", ""]
    )


def add_navigation(_: Sphinx, docname: str, source: list[str]) -> None:
    """Append tables of contents to the pages that list others."""
    if docname == root_doc:
        source[0] = source[0].replace("| your aim |", "{.cards}\n| your aim |")
        lists = source[0].partition("## Tutorials")[
            2
        ]  # the table above it repeats some links
        links = re.findall(r"\]\(([\w-]+)/([\w-]+)\.md\)", lists)
        for folder, caption in CAPTIONS.items():
            pages = list(
                dict.fromkeys(
                    f"{kind}/{page}" for kind, page in links if kind == folder
                )
            )
            made = [f"{folder}/{name}" for name in MADE if folder == "reference"]
            source[0] += toctree([*made, *pages], f":caption: {caption}")
        source[0] += toctree(
            [f"/{name}" for name in OTHERS], ":caption: Project", ":glob:"
        )
    source[0] = source[0].replace("<!-- output -->\n", "{.output}\n")
    # MyST gives a link without a text the title of its page.
    source[0] = re.sub(r"\[[\w/.-]+\.md\]\(", "[](", source[0])
    for name in MADE:  # a command in the repository, a link on the site
        command = f"`cnpgen docs {name}`"
        source[0] = source[0].replace(
            command, f"[{command}](/docs/reference/{name}.md)"
        )
    if docname.startswith("docs/tutorials/"):
        file = f"../../notebooks/{docname.rpartition('/')[2]}.ipynb"
        source[0] += f'\n<p><a href="{file}" download>This page as a notebook</a></p>\n'
    if docname.startswith("datasets/") and not source[0].startswith("#"):
        source[0] = (
            f"# {docname.rpartition('/')[2]}\n\n{source[0]}"  # cards have no heading
        )
    if docname == "docs/how-to/gallery":
        source[0] = with_pages(source[0])
    if docname == "docs/how-to/deploy" and find_spec("ziglang"):
        link = r'<p><a href="../../interactive/\1.html">Open this page</a></p>'
        pattern = r"<!-- page: (\w+) -->\n\n(!\[[^\]]*\]\([^)]*\))"
        source[0] = re.sub(pattern, rf"\2\n\n{link}", source[0])
    if docname == "docs/reference/api":
        source[0] = with_names(source[0]) + toctree(["api/*"], ":glob:")


def with_names(text: str) -> str:
    """Link the names in the tables of the public names to their pages."""
    parts = re.split(r"(?m)^(?=## `)", text)
    for index, part in enumerate(parts[1:], start=1):
        module = part.partition("`")[2].partition("`")[0]
        parts[index] = re.sub(
            r"(?m)^\| `(\w+)` \|", rf"| [`\1`](api/{module}.\1.rst) |", part
        )
    return "".join(parts)


def with_pages(text: str) -> str:
    """Replace the pictures of the gallery by interactive pages, and add those of dataset cards."""
    for name in available():
        frame = f'<iframe src="../../gallery/{name}.html" title="{name}" loading="lazy"></iframe>'
        pattern = rf"<!-- gallery: {name} -->\n\n!\[[^\]]*\]\([^)]*\)"
        link = f'<a href="../../gallery/{name}.html">Open this page alone</a>'
        text = re.sub(
            pattern, f'<div class="gallery">\n{frame}\n</div>\n<p>{link}</p>', text
        )
    for name in CARDS:
        alt = f"Histograms, task space and acceptance of {name}"
        picture = f'<p><img src="../../gallery/{name}.png" alt="{alt}"></p>'
        text = text.replace(
            f"<!-- card: {name} -->", picture if find_spec("matplotlib") else ""
        )
    return text


def write_made_pages(app: Sphinx) -> None:
    """Write the pages that ``cnpgen docs`` makes from the code."""
    for name in MADE:
        page = Path(app.srcdir) / "docs" / "reference" / f"{name}.md"
        page.write_text(page_text(list_pages()[name]), encoding="utf-8")


def write_api_pages(app: Sphinx) -> None:
    """Write one page for each public name."""
    folder = Path(app.srcdir) / "docs" / "reference" / "api"
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.rst"):
        old.unlink()
    objects, once = public_objects(), set[int]()
    kinds = {name: _kind(value) for name, value in objects.items()}
    for name, kind in (
        kinds | {name: kind for name, (kind, _) in bridge_names().items()}
    ).items():
        members = (
            "\n   :members:\n   :inherited-members: Exception, tuple, int, str"
            if kind == "class"
            else ""
        )
        repeated = id(objects.get(name, name)) in once
        once.add(id(objects.get(name, name)))
        members += "\n   :no-index:" if repeated else ""  # a name of two modules
        text = f"{name}\n{'=' * len(name)}\n\n.. auto{kind}:: {name}{members}\n"
        (folder / f"{name}.rst").write_text(text, encoding="utf-8")


def _kind(value: object) -> str:
    """Return the kind of a public object for autodoc."""
    if inspect.isclass(value):
        return "exception" if issubclass(value, BaseException) else "class"
    return "function" if inspect.isroutine(value) else "data"


def escape_bars(
    _: Sphinx,
    what: str,  # noqa: ARG001
    name: str,  # noqa: ARG001
    obj: object,  # noqa: ARG001
    options: object,  # noqa: ARG001
    lines: list[str],
) -> None:
    """Escape |x| outside of code: it is an absolute value, and reStructuredText has substitutions there."""
    for number, line in enumerate(lines):
        parts = re.split(r"(``.*?``)", line)
        lines[number] = "".join(
            part if part.startswith("``") else part.replace("|", r"\|")
            for part in parts
        )


def name_array_like(_: Sphinx, *described: str | None) -> tuple[str | None, str | None]:
    """Write ArrayLike in place of the union that it stands for."""
    *_, signature, result = described
    union = stringify_annotation(ArrayLike, "smart")
    return signature and signature.replace(union, "~numpy.typing.ArrayLike"), result


def write_dashes(_: Sphinx, doctree: nodes.document, docname: str) -> None:  # noqa: ARG001
    """Write a dash between a parameter and its description."""
    for text in list(doctree.findall(nodes.Text)):
        if text == " -- ":
            text.parent.replace(text, nodes.Text(" \N{EN DASH} "))


def write_downloads(app: Sphinx, error: Exception | None) -> None:
    """Write the notebooks and the interactive pages into a site that was built."""
    if error is None and app.builder.name == "html":
        write_notebooks(Path(app.outdir) / "notebooks")
        write_gallery(Path(app.outdir) / "gallery")
        if find_spec("ziglang"):
            write_pages(Path(app.outdir) / "interactive")


def setup(app: Sphinx) -> None:
    """Register the functions above."""
    app.connect("source-read", add_navigation)
    app.connect("builder-inited", write_made_pages)
    app.connect("builder-inited", write_api_pages)
    app.connect("build-finished", write_downloads)
    app.connect("autodoc-process-docstring", escape_bars)
    app.connect("autodoc-process-signature", name_array_like)
    app.connect("doctree-resolved", write_dashes)
