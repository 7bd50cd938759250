"""Detection of the kind of a file from its first bytes."""

import re
from pathlib import Path

HDF5_SUFFIXES = (".h5", ".hdf5")
HDF5 = b"\x89HDF\r\n\x1a\n"
_CNPGEN_HEADER = re.compile(
    rb'(?:{"format": "cnpgen-|cnpgen[- ])(plans|model|checkpoint|proposals|journal)[" ]'
)
_SIGNATURES = {
    HDF5: "an HDF5 file",
    b"PK\x03\x04": "a zip archive, as .npz files are",
    b"\x93NUMPY": "an array of NumPy",
    b"\x1f\x8b": "a gzip archive",
    b"PAR1": "a Parquet file",
    b"\x80": "a pickle",
}
PLANS = "a file of plans"
_HEAD_BYTES = 256
# Bytes; the offset is the size of the user block.
_SIGNATURE_OFFSETS = 0, 512, 1024, 2048


def own_kind(head: bytes) -> str:
    """Return the kind of a file in a format of cnpgen, "a model of cnpgen", from its first bytes; otherwise empty."""
    match = _CNPGEN_HEADER.match(head)
    return kind_name(match[1].decode()) if match else ""


def kind_name(word: str) -> str:
    """Return the name of a kind of file, "a model of cnpgen" or "a file of plans", from the word in its header."""
    return PLANS if word == "plans" else f"a {word} of cnpgen"


def is_hdf5(path: Path) -> bool:
    """Return whether a file has the signature of HDF5, possibly after a user block."""
    with path.open("rb") as file:
        return any(
            file.seek(offset) == offset and file.read(len(HDF5)) == HDF5
            for offset in _SIGNATURE_OFFSETS
        )


def apparent_kind(path: Path) -> str:
    """Return the apparent kind of a file as the end of a message, ": it seems to be a text file"; otherwise empty."""
    try:
        kind = kind_of_content(path)
        size = path.stat().st_size
    except OSError:
        return ""
    return (f": it seems to be {kind}" if kind else "") if size else ": it is empty"


def kind_of_content(path: Path) -> str:
    """Return the kind of a file from its first bytes, "a zip archive" or "a model of cnpgen"; empty if unknown."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    known = (
        kind for signature, kind in _SIGNATURES.items() if head.startswith(signature)
    )
    return own_kind(head) or next(known, "a text file" if _is_text(head) else "")


def _is_text(head: bytes) -> bool:
    """Return whether bytes are printable UTF-8, ignoring an incomplete last character."""
    # The first bytes may end within a character.
    text = head.decode(errors="replace").rstrip("\ufffd")
    return (
        bool(text)
        and "\ufffd" not in text
        and all(letter.isprintable() or letter.isspace() for letter in text)
    )
