"""Write the tutorials as Jupyter notebooks: python docs/notebooks.py FOLDER.

A page is the only source of its notebook. jupytext turns its blocks into cells; a block of a file writes the file.
"""

import re
import sys
from pathlib import Path

import jupytext

TUTORIALS = Path(__file__).parent / "tutorials"
FILE_BLOCK = re.compile(r"<!-- file: (\S+) -->\n```\w+\n")
HEADER = """\
---
jupyter:
  kernelspec:
    display_name: Python 3
    language: python
    name: python3
---
"""


def write_notebooks(folder: Path) -> None:
    """Write one notebook for each tutorial."""
    folder.mkdir(parents=True, exist_ok=True)
    for page in sorted(TUTORIALS.glob("*.md")):
        text = FILE_BLOCK.sub(
            r"```python\n%%writefile \1\n", page.read_text(encoding="utf-8")
        )
        jupytext.write(
            jupytext.reads(HEADER + text, fmt="md"), folder / f"{page.stem}.ipynb"
        )


if __name__ == "__main__":
    write_notebooks(Path(sys.argv[1]))
