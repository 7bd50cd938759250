"""Tiny datasets for the tests of make_dataset, and the content of their folders."""

import hashlib
from pathlib import Path

from cnpgen.make.generation_options import GenerationOptions
from cnpgen.make.make_dataset import MadeDataset, make_dataset
from tests.conftest import TINY_SHARD, tiny_recipe
from tests.examples.grouped import grouped

SHARDS = 4  # of a tiny dataset: 250, 250 and 100 rows of training, 60 of validation


def make_tiny(
    folder: Path, name: str = "airhockey-hit", **options: object
) -> MadeDataset:
    given = {"shard_size": TINY_SHARD, "workers": 1, **options}
    return grouped(make_dataset, GenerationOptions, tiny_recipe(name), folder, **given)


def digests(folder: Path) -> dict[str, str]:
    """Return shard -> sha256."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(
            path.read_bytes()
        ).hexdigest()
        for path in sorted(folder.glob("*/*.h5"))
    }


def snapshot(folder: Path) -> dict[str, bytes]:
    """Return file -> content."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def flip(path: Path, where: float = 0.5) -> None:
    """Flip one bit of a file."""
    content = bytearray(path.read_bytes())
    content[round(where * (len(content) - 1))] ^= 1
    path.write_bytes(content)
