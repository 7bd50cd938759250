"""Write and read model files, and find the shipped ones."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, RecipeError, UsageError, nearest
from cnpgen.planner.model import MAX_NETWORK_ITERATIONS, Model, ModelConfig
from cnpgen.planner.network.architecture import Architecture
from cnpgen.planner.network.features import (
    ARRIVAL,
    BLOCKS,
    LINE,
    Features,
    count_features,
)
from cnpgen.planner.tasks import EXPECTED_TIMES
from cnpgen.plans.format import CONDITIONS
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord, as_record
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.catalogue import recipes_root
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.store.files.checksum_file import (
    Content,
    read_with_checksum,
    write_with_checksum,
)
from cnpgen.store.files.document_structure import (
    ANY_KEY,
    ANYTHING,
    NUMBER,
    TEXT,
    WHOLE,
    check_structure,
    structure_of,
)
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.kind import kind_name
from cnpgen.store.paths import ANY_HDF5, require_file

MODEL_KIND, MODEL_VERSION = "cnpgen-model", 2
MAX_PROJECTION_STEPS = 20  # Gauss-Newton steps; each makes a kernel larger
# Values that files omit.
_DEFAULTS = {field.name: field.default for field in fields(ModelConfig)}
_STRUCTURE = {
    "architecture": structure_of(Architecture),
    "features": [TEXT],
    "config": {
        "path_scale": NUMBER,
        "line_projection_steps": WHOLE,
        "projection_steps": WHOLE,
    },
    "zero_conditions": [TEXT],
}
# Of the optional keys read.
_TRAINING_STRUCTURE = {
    "dataset": {ANY_KEY: ANYTHING},
    "stages": [{ANY_KEY: ANYTHING}],
    "input_ranges": {"low": [NUMBER], "high": [NUMBER]},
}


@checked_arguments
def save_model(path: str | Path, model: Model) -> None:
    """Write a model to a file, atomically; equal models give equal bytes.

    Args:
        path: Output file; replaced if it exists.
        model: The model.

    Raises:
        MachineError: The disk is full or read-only.
    """
    write_with_checksum(
        Path(path), model_content(model), kind=MODEL_KIND, version=MODEL_VERSION
    )


@checked_arguments
def load_model(name_or_path: str | Path) -> Model:
    """Read a model.

    Args:
        name_or_path: Name of a shipped model, or path of a model file.

    Raises:
        UsageError: There is no such file, it is of another kind, or there is no shipped
            model of this name.
        DatasetError: The file is damaged or of another format version.
        MachineError: The operating system denies reading it.
    """
    path = find_model(name_or_path)
    return model_from_content(
        path, read_with_checksum(path, kind=MODEL_KIND, version=MODEL_VERSION)
    )


def model_for(problem: Problem | StoredProblem) -> Model:
    """Read the shipped model of a problem.

    Raise UsageError if there is none, or several.
    """
    record = as_record(problem)
    # Equal digests: the same problem, whatever file it came from.
    models = {name: load_model(path) for name, path in shipped_models().items()}
    matches = [
        name
        for name, model in models.items()
        if model.problem.comparable_sha256 == record.comparable_sha256
    ]
    if len(matches) != 1:
        subject = (
            f"several shipped models ({', '.join(matches)})"
            if matches
            else "no shipped model"
        )
        raise UsageError(
            f"{subject} for the problem {record.name!r}: pass the name or the file of a model",
            concerns="model",
        )
    return models[matches[0]]


def shipped_models() -> dict[str, Path]:
    """Return the shipped models: name -> file, sorted by name."""
    files = (recipes_root() / "datasets" / "models").glob("*.h5")
    return {path.stem: path for path in sorted(files, key=lambda path: path.stem)}


def find_model(name_or_path: str | Path) -> Path:
    """Return the file of a model: a path if it ends in ``.h5``, has a separator or is a file; else a shipped model.

    Raises:
        UsageError: There is no such file, it is of another kind, or there is no shipped
            model of this name.
        MachineError: The operating system denies reading it.
    """
    if not isinstance(name_or_path, str | Path):
        raise UsageError(
            f"a model must be a name or a path, got {name_or_path!r}",
            concerns="name_or_path",
        )
    text, known = os.fspath(name_or_path), shipped_models()
    if (
        isinstance(name_or_path, Path)
        or text.endswith(".h5")
        or os.sep in text
        or Path(text).is_file()
    ):
        expected = kind_name("model")
        require_file(
            Path(text), expected, kinds=(expected, ANY_HDF5), argument="name_or_path"
        )
        return Path(text)
    if text not in known:
        raise UsageError(
            f"unknown model {text!r}{nearest(text, known)}; known: {', '.join(known) or 'none'}",
            concerns="name_or_path",
        )
    return known[text]


def model_content(model: Model) -> Content:
    """Convert a model to arrays and texts; arrays are named after their layer."""
    arrays: dict[str, NDArray[Any]] = {}
    for layer in model.architecture.all_layers:
        arrays[f"{layer.name}_weight"] = layer.weight(model.parameters)
        arrays[f"{layer.name}_bias"] = layer.bias(model.parameters)
    arrays["feature_mean"] = model.features.mean
    arrays["feature_scale"] = model.features.scale
    description = {
        "architecture": asdict(model.architecture),
        "features": list(model.features.blocks),
        "config": {
            name: value
            for name, value in asdict(model.config).items()
            # Options that were added later do not change the bytes of models without
            # them.
            if value != _DEFAULTS.get(name)
        },
        "zero_conditions": list(model.zero_conditions),
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
    """Make a model from the result of ``model_content``; the path of its file is for messages.

    Raises:
        DatasetError: The content does not fit this version of cnpgen.
    """
    try:
        return _assembled(content)
    except KeyError as error:
        raise DatasetError(
            f"{path} does not fit this version of cnpgen: it has no {error}"
        ) from error
    except (TypeError, ValueError, UsageError, RecipeError) as error:
        raise DatasetError(
            f"{path} does not fit this version of cnpgen: {error}"
        ) from error


def _assembled(content: Content) -> Model:
    """Make a model; check its description against its arrays first."""
    description, training = (
        parse_json(content.texts[name]) for name in ("description", "training")
    )
    check_structure(description, _STRUCTURE)
    # The keys that this version reads must have their form; others may be of any.
    check_structure(training, {ANY_KEY: ANYTHING})
    check_structure(
        training,
        {key: form for key, form in _TRAINING_STRUCTURE.items() if key in training},
    )
    problem = ProblemRecord(
        content.texts["problem_recipe"], content.texts["problem_urdf"]
    )
    architecture = Architecture(**description["architecture"])
    features = Features(
        tuple(description["features"]),
        content.arrays["feature_mean"],
        content.arrays["feature_scale"],
    )
    stored = description["config"]
    # JSON has lists where the class has tuples.
    via_points = tuple(tuple(map(float, each)) for each in stored.get("via_points", ()))
    config = ModelConfig(**{**stored, "via_points": via_points})
    _check_sizes(problem, architecture, features)
    _check_ranges(training, architecture)
    _check_config(config, problem, features)
    _check_zero_conditions(set(description["zero_conditions"]))
    return Model(
        problem=problem,
        architecture=architecture,
        parameters=_parameters(architecture, content.arrays),
        features=features,
        config=config,
        zero_conditions=tuple(description["zero_conditions"]),
        training=training,
        log=content.texts["log"],
    )


def _check_ranges(training: Mapping[str, Any], architecture: Architecture) -> None:
    """Check that the ranges of inputs in the training rows have one number per input."""
    for name, values in training.get("input_ranges", {}).items():
        if len(values) != architecture.inputs:
            text = f"{architecture.inputs} numbers, got {len(values)}"
            raise ValueError(f"input_ranges has {name} of {text}")


def _check_zero_conditions(names: set[str]) -> None:
    """Check the names of boundary conditions that are zero in every row."""
    if unknown := names - set(CONDITIONS):
        raise ValueError(f"unknown boundary conditions {', '.join(sorted(unknown))}")
    if positions := {"start_q", "goal_q"} & names:
        raise ValueError(
            f"{', '.join(sorted(positions))}: only velocities and accelerations are zero in every row"
        )


def _check_config(
    config: ModelConfig, problem: ProblemRecord, features: Features
) -> None:
    """Check the definition of the outputs: sizes, ranges and choices."""
    joints = len(problem.joint_names)
    if not all(
        len(each) == joints and np.isfinite(each).all() for each in config.via_points
    ):
        raise ValueError(
            f"via points must be {joints} numbers each, got {config.via_points}"
        )
    steps = max(config.line_projection_steps, config.projection_steps)
    if steps > MAX_PROJECTION_STEPS or not math.isfinite(float(config.path_scale)):
        raise ValueError(
            f"{config} is invalid: there are at most {MAX_PROJECTION_STEPS} steps, and path_scale is finite"
        )
    if not (
        type(config.iterations) is int
        and 1 <= config.iterations <= MAX_NETWORK_ITERATIONS
    ):
        raise ValueError(
            f"iterations must be an integer from 1 to {MAX_NETWORK_ITERATIONS}, got {config.iterations!r}"
        )
    # The feature of the line is the path that an iteration corrects.
    if (config.iterations > 1) != (LINE in features.blocks):
        raise ValueError(
            f"{config.iterations} iterations do not fit the features {', '.join(features.blocks)}"
        )
    if config.expected_time not in EXPECTED_TIMES:
        raise ValueError(
            f"expected_time must be one of {', '.join(EXPECTED_TIMES)}, got {config.expected_time!r}"
        )
    for name in ("within_limits", "time_parametrized"):
        if getattr(config, name) not in {True, False}:
            raise ValueError(
                f"{name} must be true or false, got {getattr(config, name)!r}"
            )


def _check_sizes(
    problem: ProblemRecord, architecture: Architecture, features: Features
) -> None:
    """Check that the network's inputs and outputs fit its features and its problem."""
    if unknown := set(features.blocks) - set(BLOCKS):
        raise ValueError(f"unknown features {', '.join(sorted(unknown))}")
    joints, spec = len(problem.joint_names), problem.trajectory
    inputs = count_features(
        features.blocks, joints, len(problem.parameters), line=architecture.path_outputs
    )
    rates = spec.rate_control_points
    # The goal fixes two control points, or three with a given acceleration.
    interior = [(spec.path_control_points - 3 - fixed) * joints for fixed in (2, 3)]
    widths = (architecture.inputs, architecture.path_outputs, architecture.rate_outputs)
    if widths not in [(inputs, outputs, rates) for outputs in interior]:
        expected = f"{(inputs, interior[0], rates)}, or {interior[1]} path outputs if goal accelerations are given"
        raise ValueError(
            f"the network has {widths} inputs, path outputs and rate outputs, expected {expected}"
        )
    if ARRIVAL in features.blocks and architecture.path_outputs == interior[0]:
        raise ValueError(
            f"its features include {ARRIVAL}, but its outputs leave goal accelerations free"
        )
    # A wrong size would be found only when the network runs, as an error of NumPy.
    for name in ("mean", "scale"):
        shape = getattr(features, name).shape
        if shape != (architecture.inputs,):
            raise ValueError(
                f"feature_{name} must have shape ({architecture.inputs},), got {shape}"
            )


def _parameters(
    architecture: Architecture, arrays: Mapping[str, NDArray[Any]]
) -> NDArray[np.float32]:
    """Concatenate the arrays of all layers; check their shapes."""
    # Before layers are listed: a damaged number may be huge.
    if architecture.layers > len(arrays):
        raise ValueError(
            f"{architecture.layers} layers cannot be in {len(arrays)} arrays"
        )
    parts = []
    # One vector of all parameters, in the order of the layers.
    for layer in architecture.all_layers:
        for name, shape in (
            ("weight", (layer.inputs, layer.outputs)),
            ("bias", (layer.outputs,)),
        ):
            values = arrays[f"{layer.name}_{name}"]
            if values.shape != shape:
                raise ValueError(
                    f"{layer.name}_{name} must have shape {shape}, got {values.shape}"
                )
            parts.append(values.ravel())
    return np.concatenate(parts).astype(np.float32)
