"""Tables in HTML, as notebooks show objects."""

from collections.abc import Iterable, Sequence
from html import escape

MAX_SHOWN_ROWS = 20


def html_table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[object]]
) -> str:
    """Return a table with a caption above it; of more than ``MAX_SHOWN_ROWS`` rows the first, and how many follow."""
    cells = [[escape(str(cell)) for cell in row] for row in rows]
    hidden = len(cells) - MAX_SHOWN_ROWS
    lines = [f"<tr><td>{'</td><td>'.join(row)}</td></tr>" for row in cells]
    if hidden > 0:
        text = f"<tr><td colspan='{len(head)}'>{hidden:,} more</td></tr>"
        lines[MAX_SHOWN_ROWS:] = [text]
    named = "</th><th>".join(map(escape, head))
    return f"<p>{escape(caption)}</p><table><tr><th>{named}</th></tr>{''.join(lines)}</table>"
