"""What a file is, told by its first bytes and by what it says of itself: for messages, and before it is replaced."""

import re
from pathlib import Path

from cnpgen.errors import DatasetError, MachineError

HDF5 = b"\x89HDF\r\n\x1a\n"
_HEAD = re.compile(rb"cnpgen[- ]([a-z]+) [0-9]")  # of models and checkpoints, which are sealed, and of journals
PLANS = "a file of plans"
_SAID = {"cnpgen-plans": PLANS, "cnpgen-shard": "a shard of a dataset"}


def file_kind(path: Path) -> str:
    """Say what a file is: "a model of cnpgen", "a file of plans"; nothing where that is not known."""
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError:
        return ""
    if found := _HEAD.match(head):
        return f"a {found[1].decode()} of cnpgen"
    return _hdf5_kind(path) if head.startswith(HDF5) else ""


def _hdf5_kind(path: Path) -> str:
    from cnpgen.store.heaps import opened_foreign_hdf5

    try:
        with opened_foreign_hdf5(path) as file:
            said, names = file.attrs.get("format"), set(file)
    except (DatasetError, MachineError):
        return "an HDF5 file"
    said = said.decode(errors="replace") if isinstance(said, bytes) else said
    if said is None and {"path_control_points", "rate_control_points"} <= names:  # others' files need not say it
        return PLANS
    return _SAID.get(str(said), "an HDF5 file")
