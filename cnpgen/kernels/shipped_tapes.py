"""Tapes of shipped problems, which the package has as data, so that their first use needs no graph of CasADi.

``tapes.zip`` stores every tape once, under the digest of its content. ``index.json`` maps
the key of a tape, a digest of everything that it is built from, also of the sources, to
that name. Changed sources thus never find an old tape. ``tests/kernels/make_shipped_tapes.py``
writes both files.
"""

import json
from contextlib import suppress
from functools import cache
from pathlib import Path
from zipfile import BadZipFile, ZipFile

from cnpgen.kernels.tape import Tape

FOLDER = Path(__file__).with_name("shipped")
INDEX = "index.json"
ARCHIVE = "tapes.zip"


def find_shipped(key: str) -> Tape | None:
    """Return a tape of the package, or None.

    Without the files, or if they are damaged, tapes are built.
    """
    if (name := _index().get(key)) is None:
        return None
    # NotImplementedError: this Python has no LZMA.
    with (
        suppress(OSError, KeyError, ValueError, BadZipFile, NotImplementedError),
        ZipFile(FOLDER / ARCHIVE) as archive,
    ):
        return Tape.from_bytes(archive.read(name))
    return None


@cache
def _index() -> dict[str, str]:
    with suppress(OSError, ValueError):
        index: dict[str, str] = json.loads((FOLDER / INDEX).read_text("ascii"))
        return index
    return {}
