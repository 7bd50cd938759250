"""Texts that people write, recipes, robots and cards: read only if they are not too large, and as UTF-8."""

import os
from pathlib import Path

MOST_NOTES = 1 << 20  # bytes of a card, or of the notes for one


def read_at_most(path: Path, most: int, what: str) -> bytes:
    """Read a file of a bounded size.

    Args:
        path: The file.
        most: Size that it may have [bytes].
        what: What was expected, for the message: "a recipe".

    Raises:
        ValueError: It is missing, no file or larger.
        OSError: It cannot be read.
    """
    if not path.is_file():
        raise ValueError("not a file" if path.exists() else "no such file")
    if (size := path.stat().st_size) > most:
        raise ValueError(f"has {size:,} bytes, expected {what} of at most {most:,}")
    return path.read_bytes()


def read_own(path: Path, owner: Path, what: str) -> bytes:
    """Read what lies beside a file and is passed on; a link from elsewhere would pass on what nobody meant to give.

    Args:
        path: The file, of at most ``MOST_NOTES`` bytes.
        owner: The file that it belongs to.
        what: What was expected, for the message: "notes".

    Raises:
        ValueError: It is a link that leads out of the owner's folder, missing, no file or larger.
        OSError: It cannot be read.
    """
    folders = Path(os.path.realpath(owner)).parent, Path(os.path.realpath(owner.parent))
    if Path(os.path.realpath(path)).parent not in folders:
        raise ValueError("is a link that leads to another folder, from which nothing is taken over: copy the file")
    return read_at_most(path, MOST_NOTES, what)


def utf8_text(content: bytes, encoding: str = "utf-8-sig", *, advice: str = "") -> str:
    """Decode a text, by default without the mark of byte order at its beginning.

    Args:
        content: What was read.
        encoding: "utf-8-sig", or "utf-8" to leave that mark in it.
        advice: What to add to the message.

    Raises:
        ValueError: It is not UTF-8; the message names line and byte.
    """
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ValueError(f"line {line}: not UTF-8: byte 0x{error.object[error.start]:02x}{advice}") from error
