"""Sampled plans as one NumPy archive."""

import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.export.sampled import Sampled
from cnpgen.store.files.atomic import committing


def write_npz(path: Path, about: dict[str, NDArray[Any]], plans: Iterable[tuple[int, Sampled]]) -> None:
    """Write an archive plan by plan, atomically: ``numpy.savez`` would need all of them in memory.

    Args:
        path: Where to.
        about: Arrays about all plans: name -> values.
        plans: (number, samples) of every plan.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    with committing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, values in about.items():
            _add(archive, name, values)
        for number, sampled in plans:
            for name, values in vars(sampled).items():
                _add(archive, f"plan_{number:05d}_{name}", values)


def _add(archive: zipfile.ZipFile, name: str, values: NDArray[Any]) -> None:
    """Add an array under a fixed date, so that equal plans give equal bytes."""
    with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
        np.lib.format.write_array(member, values, allow_pickle=False)
