"""Single flipped bits in files with checksums: every one must be refused when the file is read."""

import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from cnpgen.errors import CnpgenError
from cnpgen.loader.load import load_dataset
from cnpgen.planner.model_file import load_model
from cnpgen.plans.plan_file import load_plans
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.shard_record import load_record
from cnpgen.training.checkpoint import Checkpoints
from tests.faults.good_files import IDENTITY, make_good_files


@dataclass
class Flips:
    """Outcomes of flipped bits.

    Attributes:
        refused: Kind -> number of flips that were refused.
        findings: Flips that were not, one line each.
    """

    refused: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)


def _read_set(folder: Path) -> None:
    load_dataset(folder / "set", verify=True).arrays("train")


def _read_record(folder: Path) -> None:
    task = shards(load_dataset_spec(folder / "set"))[0]
    load_record(folder / "set", task)


READERS: dict[str, Callable[[Path], object]] = {
    "set/specification.json": _read_set,
    "set/manifest.json": _read_set,
    "set/train/shard-00000.json": _read_record,
    "set/train/shard-00000.h5": _read_set,
    "plans.h5": lambda folder: load_plans(folder / "plans.h5"),
    "model.h5": lambda folder: load_model(folder / "model.h5"),
    "checkpoint": lambda folder: Checkpoints(folder / "checkpoint", IDENTITY).load(),
}


def flip_bits(count: int, *, seed: int = 0, first: int = 0) -> Flips:
    """Flip one bit of a file, read it, and restore it.

    Args:
        count: Number of flips; the kinds of files follow each other.
        seed: Seed of all choices.
        first: Number of the first flip.
    """
    outcome, names = Flips(), list(READERS)
    with (
        tempfile.TemporaryDirectory(prefix="cnpgen-flips-") as place,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        folder = Path(place) / "good"
        folder.mkdir()
        make_good_files(folder)
        for read in READERS.values():
            read(folder)  # every file is readable unchanged
        for number in range(first, first + count):
            name = names[number % len(names)]
            draw = Random(f"{seed} {number}")
            if finding := _flip(folder, name, draw):
                outcome.findings.append(f"seed {seed}, flip {number}, {finding}")
            else:
                outcome.refused[name] += 1
        shutil.rmtree(folder)
    return outcome


def _flip(folder: Path, name: str, draw: Random) -> str:
    """Flip a bit and read the file; return what was not refused, or an empty text."""
    path = folder / name
    content = path.read_bytes()
    position = draw.randrange(8 * len(content))
    changed = bytearray(content)
    changed[position // 8] ^= 1 << position % 8
    path.write_bytes(changed)
    try:
        READERS[name](folder)
    except CnpgenError:
        return ""
    except Exception as error:  # noqa: BLE001 - a foreign exception is a finding
        return f"{name}, bit {position}: {type(error).__name__} {error!s:.120}"
    finally:
        path.write_bytes(content)
    return f"{name}, bit {position}: read without an error"
