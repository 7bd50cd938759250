"""Tables of reference pages in Markdown, with escaped texts."""

import re


def reference_table(head: tuple[str, str], rows: list[tuple[str, str]]) -> str:
    """Format a table of a reference page in Markdown."""
    lines = [head, ("---", "---"), *((_cell(one), _cell(other)) for one, other in rows)]
    return "\n".join(f"| {one} | {other} |" for one, other in lines)


def _cell(text: str) -> str:
    return escaped(" ".join(text.split()).replace("|", r"\|"))


def escaped(text: str | None) -> str:
    """Return a text without accidental markup."""
    return re.sub(r"(?<!`)\*", r"\*", re.sub(r"<(?=\w)", r"\<", text or ""))
