"""Text files of users (recipes, robots, cards), read as UTF-8 with a size limit."""

import os
from pathlib import Path

MAX_NOTES_BYTES = 1 << 20  # of a card, or of the notes for one


def read_at_most(path: Path, most: int, what: str) -> bytes:
    """Read a file of at most so many bytes; the message has the expected content, such as "a recipe".

    Raises:
        ValueError: The file is missing, not a regular file or too large.
        OSError: The file cannot be read.
    """
    if not path.is_file():
        raise ValueError("not a file" if path.exists() else "no such file")
    if (size := path.stat().st_size) > most:
        raise ValueError(f"has {size:,} bytes, expected {what} of at most {most:,}")
    return path.read_bytes()


def read_own(path: Path, owner: Path, what: str) -> bytes:
    """Read a file of at most ``MAX_NOTES_BYTES`` bytes next to the file to which it belongs, as ``read_at_most``.

    Links to other folders raise ValueError, since they could leak private files.
    """
    # The folder of the owner, and that of the file that it links to.
    folders = Path(os.path.realpath(owner)).parent, Path(os.path.realpath(owner.parent))
    if Path(os.path.realpath(path)).parent not in folders:
        raise ValueError(
            "is a link that leads to another folder, from which nothing is taken over: copy the file"
        )
    return read_at_most(path, MAX_NOTES_BYTES, what)


def utf8_text(content: bytes, encoding: str = "utf-8-sig", *, hint: str = "") -> str:
    """Decode a text, by default without a byte order mark; "utf-8" keeps it.

    Raises:
        ValueError: The content is not UTF-8; the message names line and byte, and ends
            with the hint.
    """
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise ValueError(
            f"line {line}: not UTF-8: byte 0x{error.object[error.start]:02x}{hint}"
        ) from error
