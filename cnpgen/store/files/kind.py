"""What a file seems to be, from its first bytes."""

import re
from pathlib import Path

HDF5 = b"\x89HDF\r\n\x1a\n"
_OURS = re.compile(rb"cnpgen[- ](plans|model|checkpoint|proposals|journal) [0-9]")
_SIGNATURES = {
    HDF5: "an HDF5 file",
    b"PK\x03\x04": "a zip archive, as .npz files are",
    b"\x93NUMPY": "an array of NumPy",
    b"\x1f\x8b": "a gzip archive",
    b"PAR1": "a Parquet file",
    b"\x80": "a pickle",
}
PLANS = "a file of plans"
_HEAD = 256  # bytes that are looked at
_BEGINNINGS = (0, 512, 1024, 2048)  # bytes, where HDF5 files of users begin


def own_kind(head: bytes) -> str:
    """Say what a file of cnpgen's own formats is, from its first bytes: "a model of cnpgen"; else nothing."""
    found = _OURS.match(head)
    return kind_name(found[1].decode()) if found else ""


def kind_name(word: str) -> str:
    """Name a kind of file by the word that its seal has for it: "a model of cnpgen", or "a file of plans"."""
    return PLANS if word == "plans" else f"a {word} of cnpgen"


def is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, by its signature, which may follow a block that the format leaves to the user.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        return any(file.seek(place) == place and file.read(len(HDF5)) == HDF5 for place in _BEGINNINGS)


def seeming(path: Path) -> str:
    """Say what a file seems to be, for a message that ends with it: ": it seems to be a text file"; else nothing."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return ""
    if not head:
        return ": it is empty"
    known = (kind for signature, kind in _SIGNATURES.items() if head.startswith(signature))
    kind = own_kind(head) or next(known, "a text file" if _is_text(head) else "")
    return f": it seems to be {kind}" if kind else ""


def _is_text(head: bytes) -> bool:
    """Whether bytes are printable UTF-8, of which the last character may be cut off."""
    text = head.decode(errors="replace").rstrip("\ufffd")
    return bool(text) and "\ufffd" not in text and all(letter.isprintable() or letter.isspace() for letter in text)
