"""Make the tapes of shipped problems that the package has as data, and the shapes of their robots.

    python -m tests.kernels.make_shipped_tapes

All tapes are built, whatever is stored. The robots of example-robot-data must be installed. Kernels of training
are included for the tasks of the paper only: those of all datasets are half of all instructions.
"""

import json
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.kernels import library, shipped_tapes
from cnpgen.kernels.interpreted_kernel import InterpretedGridKernel, InterpretedKernel
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.tape import Tape
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.planner.planner import Planner
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import with_capacity
from cnpgen.problems.problem_file import load_problem
from cnpgen.refine.refiner import Refiner
from cnpgen.robots.shape import shape
from cnpgen.schema.catalogue import list_recipes
from cnpgen.training.train import train_model

ROOT = Path(__file__).parents[2]
ROUNDING = 1e-12  # of constants, relative, and absolute below one
TRAINED = ("airhockey-hit", "airhockey-replan", "airhockey-online", "heavy-object", "heavy-object-anywhere")  # fmt: skip


@contextmanager
def recorded() -> Iterator[dict[str, Tape]]:
    """Record tapes under their keys; in the context they are built, and no machine code is made."""
    tapes: dict[str, Tape] = {}
    build = KernelLibrary._tape

    def record(self: KernelLibrary, builder: Callable[..., Any], *args: Any, **options: Any) -> Tape:  # fmt: skip
        keys: list[str] = []
        with pytest.MonkeyPatch.context() as inner:
            inner.setattr(library, "find_shipped", keys.append)
            tape = build(self, builder, *args, **options)
        return tapes.setdefault(keys[0], tape)

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as cache:
        patch.setenv("CNPGEN_CACHE", cache)
        patch.setattr(KernelLibrary, "_tape", record)
        patch.setattr(library, "CompiledKernel", lambda tape, _: InterpretedKernel(tape))  # fmt: skip
        patch.setattr(library, "CompiledGridKernel", lambda tape, _: InterpretedGridKernel(tape))  # fmt: skip
        patch.setattr(library, "_try_generator", lambda _: None)
        yield tapes


def load_kernels(name: str) -> None:
    """Load all kernels of a shipped dataset: of its pipeline, the solver and the planner."""
    pipeline = load_dataset_recipe(name).pipeline
    backend, cache = library.choose_backend(None)
    problem = PreparedPipeline(pipeline, backend=backend, cache_folder=cache).context.problem  # fmt: skip
    refiner = Refiner(problem, load_robot(problem))
    if refiner.check.projects:
        assert refiner.equalities.tape.inputs
    if (ROOT / f"datasets/models/{name}.h5").exists():
        Planner(name)


def load_training_kernels(name: str) -> None:
    """Load the kernels of a planner's training by one step on a few rows."""
    with tempfile.TemporaryDirectory() as folder:
        made = make_dataset(name, Path(folder, "rows"), n=60, workers=1)
        train_model(made.folder, Path(folder, "model.h5"), steps=1)


def load_all() -> None:
    """Load all kernels of shipped datasets, and those of the solver for scenes of a Panda."""
    for path in sorted((ROOT / "datasets").glob("*.toml")):
        load_kernels(path.stem)
        print(path.stem, flush=True)
    for name in TRAINED:
        load_training_kernels(name)
    # They do not depend on the number of obstacles.
    scenes = with_capacity(load_problem("panda"), {"box": 1})
    Refiner(scenes, load_robot(scenes))


def stored_tapes() -> dict[str, Tape]:
    """Return digest -> tape of the package."""
    with zipfile.ZipFile(shipped_tapes.FOLDER / shipped_tapes.ARCHIVE) as archive:
        return {
            name: Tape.from_bytes(archive.read(name)) for name in archive.namelist()
        }


def are_equal(first: Tape, second: Tape) -> bool:
    """Whether two tapes have the same instructions, and constants that differ by rounding only.

    Linear algebra rounds differently on processors with other vector instructions.
    """
    parts = ("name", "inputs", "outputs", "loop", "grid", "dtype")
    return (
        all(getattr(first, part) == getattr(second, part) for part in parts)
        and all(
            np.array_equal(getattr(first, part), getattr(second, part))
            for part in ("operation", "a", "b")
        )
        and np.allclose(first.constant, second.constant, rtol=ROUNDING, atol=ROUNDING)
    )


def contents_of(tapes: dict[str, Tape]) -> dict[str, Tape]:
    """Return key -> tape; stored tapes replace equal ones, so that all processors give the same bytes."""
    stored = list(stored_tapes().values())
    return {
        key: next((each for each in stored if are_equal(each, tape)), tape)
        for key, tape in sorted(tapes.items())
    }


def digest_of(tape: Tape) -> str:
    """Return the name of a tape in the archive, a digest of its content."""
    return sha256(tape.to_bytes()).hexdigest()[:32]


def write(tapes: dict[str, Tape], folder: Path) -> None:
    """Write the index and the archive; equal tapes give equal bytes."""
    contents = contents_of(tapes)
    folder.mkdir(exist_ok=True)
    names = {key: digest_of(tape) for key, tape in contents.items()}
    (folder / shipped_tapes.INDEX).write_text(json.dumps(names, indent=0) + "\n", encoding="ascii")  # fmt: skip
    unique = {names[key]: tape.to_bytes() for key, tape in contents.items()}
    with zipfile.ZipFile(folder / shipped_tapes.ARCHIVE, "w", zipfile.ZIP_LZMA) as archive:  # fmt: skip
        for name in sorted(unique):
            archive.writestr(zipfile.ZipInfo(name), unique[name], zipfile.ZIP_LZMA)


def write_shapes(folder: Path) -> None:
    """Compute the capsules and link pairs of the robots of shipped problems; write those that the folder lacks.

    Their last digits depend on the processor.
    """
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as cache:
        patch.setattr(shape, "SHIPPED", None)
        patch.setenv("CNPGEN_CACHE", cache)
        for name in list_recipes("problem"):
            load_robot(load_problem(name))
        folder.mkdir(exist_ok=True)
        made = {path.name: path for path in Path(cache).glob("shape-*.json")}
        stored = {path.name: path for path in folder.glob("*")}
        for name in stored.keys() - made.keys():
            stored[name].unlink()
        for name in made.keys() - stored.keys():
            (folder / name).write_bytes(made[name].read_bytes())


def main() -> None:
    """Make the files of the package."""
    write_shapes(shape.SHIPPED)
    with recorded() as tapes:
        load_all()
    write(tapes, shipped_tapes.FOLDER)


if __name__ == "__main__":
    main()
