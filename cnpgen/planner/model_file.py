"""Writing and reading models, and finding those that cnpgen ships."""

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, UsageError, nearest
from cnpgen.planner.model import Meaning, Model
from cnpgen.planner.network.architecture import Architecture
from cnpgen.planner.network.features import BLOCKS, Features
from cnpgen.problems.record import ProblemRecord
from cnpgen.schema.catalogue import recipes_root
from cnpgen.store.files.sealed import Content, read_sealed, write_sealed
from cnpgen.store.paths import require_file

KIND, VERSION = "cnpgen-model", 1


def save_model(path: str | Path, model: Model) -> None:
    """Write a model to a file, atomically; equal models give equal bytes.

    Args:
        path: Where to; a file that is there is replaced.
        model: The model.

    Raises:
        MachineError: The disk is full, read-only or otherwise unwilling.
    """
    write_sealed(Path(path), model_content(model), kind=KIND, version=VERSION)


def load_model(name_or_path: str | Path) -> Model:
    """Read a model.

    Args:
        name_or_path: Name of a shipped model, or path of a model file.

    Raises:
        UsageError: There is no such file, or no shipped model of this name.
        DatasetError: The file is damaged, cut off, or no model.
        MachineError: The system would not let us read it.
    """
    path = find_model(name_or_path)
    require_file(path, "a model")
    return model_from_content(path, read_sealed(path, kind=KIND, version=VERSION))


def shipped_models() -> dict[str, Path]:
    """List the models that cnpgen ships: name -> file, by name."""
    return {path.stem: path for path in sorted((recipes_root() / "datasets" / "models").glob("*.h5"))}


def find_model(name_or_path: str | Path) -> Path:
    """Find the file of a model: a path if it ends in ``.h5``, has a path separator or is a file; else a shipped one.

    Raises:
        UsageError: There is no shipped model of this name.
    """
    if not isinstance(name_or_path, str | Path):
        raise UsageError(f"a model is a name or a path, got {name_or_path!r}")
    text, known = os.fspath(name_or_path), shipped_models()
    if isinstance(name_or_path, Path) or text.endswith(".h5") or os.sep in text or Path(text).is_file():
        return Path(text)
    if text not in known:
        raise UsageError(f"unknown model {text!r}{nearest(text, known)}; known: {', '.join(known) or 'none'}")
    return known[text]


def model_content(model: Model) -> Content:
    """Lay a model out as arrays and texts; the arrays of a layer are called after it."""
    arrays: dict[str, NDArray[Any]] = {}
    for layer in model.architecture.all_layers:
        arrays[f"{layer.name}_weight"] = layer.weight(model.parameters)
        arrays[f"{layer.name}_bias"] = layer.bias(model.parameters)
    arrays["feature_mean"], arrays["feature_scale"] = model.features.mean, model.features.scale
    description = {
        "architecture": asdict(model.architecture),
        "features": list(model.features.blocks),
        "meaning": asdict(model.meaning),
        "rest": list(model.rest),
        "problem_sha256": model.problem.comparable_sha256,
    }
    texts = {
        "description": json.dumps(description, indent=1),
        "training": json.dumps(dict(model.training), indent=1),
        "log": model.log,
        "problem_recipe": model.problem.recipe,
        "problem_urdf": model.problem.urdf,
    }
    return Content(arrays, texts)


def model_from_content(path: Path, content: Content) -> Model:
    """Put a model together again.

    Args:
        path: Where it comes from, for messages.
        content: What ``model_content`` made.

    Raises:
        DatasetError: It needs another version of cnpgen.
    """
    try:
        return _assembled(content)
    except (KeyError, TypeError, ValueError, UsageError) as error:
        raise DatasetError(f"{path} does not fit this version of cnpgen: {error}") from error


def _assembled(content: Content) -> Model:
    description = json.loads(content.texts["description"])
    architecture = Architecture(**description["architecture"])
    parameters = np.empty(architecture.n_parameters, np.float32)
    for layer in architecture.all_layers:
        layer.weight(parameters)[:] = content.arrays[f"{layer.name}_weight"]
        layer.bias(parameters)[:] = content.arrays[f"{layer.name}_bias"]
    unknown = set(description["features"]) - set(BLOCKS)
    if unknown:
        raise ValueError(f"unknown features {', '.join(sorted(unknown))}")
    features = Features(tuple(description["features"]), content.arrays["feature_mean"], content.arrays["feature_scale"])
    return Model(
        problem=ProblemRecord(content.texts["problem_recipe"], content.texts["problem_urdf"]),
        architecture=architecture,
        parameters=parameters,
        features=features,
        meaning=Meaning(**description["meaning"]),
        rest=tuple(description["rest"]),
        training=json.loads(content.texts["training"]),
        log=content.texts["log"],
    )
