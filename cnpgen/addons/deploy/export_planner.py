"""Write a trained model as a planner in C: a source, a header and a README."""

import hashlib
from pathlib import Path

from cnpgen.addons.deploy.c_source import Names, header_text, source_text
from cnpgen.addons.deploy.c_text import identifier
from cnpgen.addons.deploy.input_ranges import input_ranges
from cnpgen.addons.deploy.planner_parts import check_supported, planner_parts
from cnpgen.addons.deploy.readme import readme_text
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model_file import load_model
from cnpgen.store.files.atomic import read_file, write_file


def planner_files(model_file: Path, rows: Path | None = None) -> dict[str, str]:
    """Return the files of a planner: name -> text. Equal models give equal texts.

    The training rows of a dataset give the ranges of the network's inputs, if it is
    passed.

    Raises:
        UsageError: The file is no model, or of a kind that C files do not support.
        DatasetError: The file is damaged.
    """
    model = load_model(model_file)
    digest = hashlib.sha256(read_file(model_file)).hexdigest()
    names = Names(identifier(model_file.stem), model_file.stem, digest)
    # Only tapes are needed, no compiled kernels: any backend has them.
    with loaded_problem(model.problem, "numpy") as loaded:
        check_supported(model, loaded.problem, loaded.robot)
        parts = planner_parts(model, loaded, input_ranges(model, loaded, rows))
        return {
            f"{names.name}.c": source_text(parts, names),
            f"{names.name}.h": header_text(parts, names),
            "README.md": readme_text(parts, names),
        }


def write_planner(files: dict[str, str], folder: Path) -> list[Path]:
    """Write the files of a planner into a folder, which is created; return their paths."""
    paths = [folder / name for name in files]
    for path, text in zip(paths, files.values(), strict=True):
        write_file(path, text)
    return paths
