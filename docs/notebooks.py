"""Write the tutorials as Jupyter notebooks: python docs/notebooks.py FOLDER.

A page is the only source of its notebook. Its blocks become cells; a block of a file becomes a cell that writes it.
"""

import json
import re
import sys
from pathlib import Path
from typing import Any

TUTORIALS = Path(__file__).parent / "tutorials"
BLOCK = re.compile(r"((?:<!-- [^\n]* -->\n)*)```(bash|python|toml)\n(.*?)```\n?", re.S)


def notebook(page: str) -> dict[str, Any]:
    """Return a tutorial in Markdown as a notebook (nbformat 4.5)."""
    cells: list[dict[str, Any]] = []
    end = 0
    for block in BLOCK.finditer(page):
        _add(cells, "markdown", page[end : block.start()])
        marks, language, code = block.groups()
        file = re.search(r"<!-- file: (\S+) -->", marks)
        magic = f"%%writefile {file[1]}\n" if file else "%%bash\n" if language == "bash" else ""
        _add(cells, "code", magic + code)
        end = block.end()
    _add(cells, "markdown", page[end:])
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _add(cells: list[dict[str, Any]], kind: str, text: str) -> None:
    """Append a cell; without text there is none."""
    if not text.strip():
        return
    cell = {"cell_type": kind, "id": f"cell-{len(cells)}", "metadata": {}, "source": text.strip("\n")}
    cells.append(cell | ({"execution_count": None, "outputs": []} if kind == "code" else {}))


def write_notebooks(folder: Path) -> None:
    """Write one notebook for each tutorial."""
    folder.mkdir(parents=True, exist_ok=True)
    for page in sorted(TUTORIALS.glob("*.md")):
        content = notebook(page.read_text(encoding="utf-8"))
        (folder / f"{page.stem}.ipynb").write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")


if __name__ == "__main__":
    write_notebooks(Path(sys.argv[1]))
