"""Writing and reading models, and finding those that cnpgen ships."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import DatasetError, RecipeError, UsageError, nearest
from cnpgen.planner.model import Meaning, Model
from cnpgen.planner.network.architecture import Architecture
from cnpgen.planner.network.features import ARRIVAL, BLOCKS, Features, count_features
from cnpgen.planner.tasks import EXPECTED_TIMES
from cnpgen.plans.format import CONDITIONS
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import ProblemRecord, as_record
from cnpgen.schema.catalogue import recipes_root
from cnpgen.store.blueprint import StoredProblem
from cnpgen.store.files.documents import parse_json
from cnpgen.store.files.forms import ANYTHING, EVERY, NUMBER, TEXT, WHOLE, check_form
from cnpgen.store.files.sealed import Content, read_sealed, write_sealed
from cnpgen.store.paths import require_file

KIND, VERSION = "cnpgen-model", 1
MOST_STEPS = 20  # of Gauss-Newton, each of which makes a kernel larger
_UNSAID = {
    "expected_time": "distance",
    "within_limits": False,
    "paced": False,
    "middles": (),
}  # what files need not say
_FORM = {
    "architecture": dict.fromkeys(("inputs", "hidden", "layers", "path_outputs", "rate_outputs"), WHOLE),
    "features": [TEXT],
    "meaning": {"path_scale": NUMBER, "bending_steps": WHOLE, "landing_steps": WHOLE},
    "rest": [TEXT],
}
_TRAINING = {"dataset": {EVERY: ANYTHING}, "stages": [{EVERY: ANYTHING}]}  # what is read of it, where it is there


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


def model_for(problem: Problem | StoredProblem) -> Model:
    """Read the shipped model that plans for a problem, where there is one and no other.

    Args:
        problem: The problem, or its record: ``plans.problem``, ``dataset.problem``.

    Raises:
        UsageError: No shipped model plans for it, or several, which are named.
    """
    record = as_record(problem)
    models = {name: load_model(path) for name, path in shipped_models().items()}
    found = [name for name, each in models.items() if each.problem.comparable_sha256 == record.comparable_sha256]
    if len(found) != 1:
        which = f"several shipped models ({', '.join(found)})" if found else "no shipped model"
        raise UsageError(f"{which} for the problem {record.name!r}: say the name or the file of a model")
    return models[found[0]]


def shipped_models() -> dict[str, Path]:
    """List the models that cnpgen ships: name -> file, by name."""
    found = (recipes_root() / "datasets" / "models").glob("*.h5")
    return {path.stem: path for path in sorted(found, key=lambda path: path.stem)}


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
        "meaning": {name: value for name, value in asdict(model.meaning).items() if value != _UNSAID.get(name)},
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
    except KeyError as error:
        raise DatasetError(f"{path} does not fit this version of cnpgen: it has no {error}") from error
    except (TypeError, ValueError, UsageError, RecipeError) as error:
        raise DatasetError(f"{path} does not fit this version of cnpgen: {error}") from error


def _assembled(content: Content) -> Model:
    """Put a model together; what it says of itself is compared with its arrays before anything is made of it."""
    description, training = (parse_json(content.texts[name]) for name in ("description", "training"))
    check_form(description, _FORM)
    check_form(training, {EVERY: ANYTHING})
    check_form(training, {key: form for key, form in _TRAINING.items() if key in training})
    problem = ProblemRecord(content.texts["problem_recipe"], content.texts["problem_urdf"])
    architecture = Architecture(**description["architecture"])
    features = Features(tuple(description["features"]), content.arrays["feature_mean"], content.arrays["feature_scale"])
    said = description["meaning"]
    meaning = Meaning(**{**said, "middles": tuple(tuple(map(float, each)) for each in said.get("middles", ()))})
    _check_sizes(problem, architecture, features)
    joints = len(problem.joint_names)
    if not all(len(each) == joints and np.isfinite(each).all() for each in meaning.middles):
        raise ValueError(f"middles must be {joints} numbers each, got {meaning.middles}")
    if unknown := set(description["rest"]) - set(CONDITIONS):
        raise ValueError(f"unknown boundary conditions {', '.join(sorted(unknown))}")
    if positions := {"start_q", "goal_q"} & set(description["rest"]):
        raise ValueError(f"{', '.join(sorted(positions))}: only velocities and accelerations are zero in every row")
    if max(meaning.bending_steps, meaning.landing_steps) > MOST_STEPS or not math.isfinite(float(meaning.path_scale)):
        raise ValueError(f"{meaning} cannot be meant: there are at most {MOST_STEPS} steps")
    if meaning.expected_time not in EXPECTED_TIMES:
        raise ValueError(f"expected_time must be one of {', '.join(EXPECTED_TIMES)}, got {meaning.expected_time!r}")
    for name in ("within_limits", "paced"):
        if getattr(meaning, name) not in {True, False}:
            raise ValueError(f"{name} must be true or false, got {getattr(meaning, name)!r}")
    return Model(
        problem=problem,
        architecture=architecture,
        parameters=_parameters(architecture, content.arrays),
        features=features,
        meaning=meaning,
        rest=tuple(description["rest"]),
        training=training,
        log=content.texts["log"],
    )


def _check_sizes(problem: ProblemRecord, architecture: Architecture, features: Features) -> None:
    """Refuse a network whose inputs and outputs are not those of its features and its problem."""
    unknown = set(features.blocks) - set(BLOCKS)
    if unknown:
        raise ValueError(f"unknown features {', '.join(sorted(unknown))}")
    joints, spec = len(problem.joint_names), problem.trajectory
    inputs, rates = count_features(features.blocks, joints), spec.rate_control_points
    interior = [(spec.path_control_points - 3 - fixed) * joints for fixed in (2, 3)]
    found = (architecture.inputs, architecture.path_outputs, architecture.rate_outputs)
    if found not in [(inputs, outputs, rates) for outputs in interior]:
        expected = f"{(inputs, interior[0], rates)}, or {interior[1]} path outputs where goal accelerations are given"
        raise ValueError(f"the network has {found} inputs, path outputs and rate outputs, expected {expected}")
    if ARRIVAL in features.blocks and architecture.path_outputs == interior[0]:
        raise ValueError(f"{ARRIVAL} is among its features, and its outputs leave goal accelerations free")
    for name in ("mean", "scale"):
        shape = getattr(features, name).shape
        if shape != (architecture.inputs,):
            raise ValueError(f"feature_{name} must have shape ({architecture.inputs},), got {shape}")


def _parameters(architecture: Architecture, arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Join the arrays of all layers, each of which must be there in its shape."""
    if architecture.layers > len(arrays):
        raise ValueError(f"{architecture.layers} layers cannot be in {len(arrays)} arrays")
    parts = []
    for layer in architecture.all_layers:
        for name, shape in (("weight", (layer.inputs, layer.outputs)), ("bias", (layer.outputs,))):
            values = arrays[f"{layer.name}_{name}"]
            if values.shape != shape:
                raise ValueError(f"{layer.name}_{name} must have shape {shape}, got {values.shape}")
            parts.append(values.ravel())
    return np.concatenate(parts).astype(np.float32)
