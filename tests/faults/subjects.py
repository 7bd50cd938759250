"""The kinds of untrusted files: how a valid one is changed, mostly with a valid checksum, and how it is read."""

import base64
import json
import shutil
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np

from cnpgen.addons.benchmark.results_file import answer_from_dict, open_results
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.cli.inspect_command import inspection_text
from cnpgen.errors import CnpgenError
from cnpgen.loader.load import load_dataset
from cnpgen.make.complete import read_tasks
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.planner.model_file import MODEL_KIND, MODEL_VERSION, load_model
from cnpgen.planner.plan_requests import read_file
from cnpgen.planner.planner import Planner
from cnpgen.plans.boundary_problems import load_boundary_problems, read_boundary_file
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.format import PLAN_FILE_VERSION
from cnpgen.plans.plan_file import load_plans
from cnpgen.plans.plans import screen
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.refinement_journal import JOURNAL, open_journal
from cnpgen.store.dataset_spec import from_json
from cnpgen.store.field import Field
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.files.checksum_file import (
    HEADER_BYTES,
    Content,
    encode_with_checksum,
    read_with_checksum,
    with_checksum,
)
from cnpgen.store.files.documents import canonical_sha256, save_document
from cnpgen.store.files.record_file import RecordFormat
from cnpgen.store.inspection import inspect_dataset
from cnpgen.store.manifest import data_fingerprint
from cnpgen.store.shard import read_schema, read_shard
from cnpgen.training.checkpoint import CHECKPOINT, Checkpoints
from cnpgen.validate.validate_dataset import validate_dataset
from tests.examples.documents import read_unverified
from tests.examples.plan_files import plans_of
from tests.examples.plans import load as stored_plan
from tests.examples.urdf_reading import bodies_in, differences
from tests.faults.good_files import IDENTITY
from tests.faults.mesh_subjects import change_mesh, change_srdf, read_shaped_robot
from tests.faults.mutations import (
    change_bytes,
    change_json,
    change_text,
    change_urdf,
    changed_number,
)
from tests.faults.scene_subjects import (
    change_scene,
    change_trajectory,
    read_scene,
    read_scene_plans,
    read_trajectory,
)

MAX_FUZZED_PUCKS = 100
COSTLY_SHARE = 0.1  # of inputs with which a planner is built, or problems are completed
_PROBLEM = plans_of(stored_plan("hit"))

DOCUMENTS = (
    "specification.json",
    "manifest.json",
    "stats.json",
    "train/shard-00000.json",
    "validation/shard-00000.json",
)


Change = Callable[[Path, Path, Random], None]


@dataclass(frozen=True)
class Subject:
    """A kind of file.

    Attributes:
        change: Writes a changed copy of a valid file into a folder.
        read: Reads it with all functions of cnpgen.
    """

    change: Change
    read: Callable[[Path, Random], None]


def _change_text_of(
    find: Callable[[Path, Random], Path], change_content: Callable[[str, Random], str]
) -> Change:
    """Change one of the texts in the folder of recipes, mostly as a text."""

    def change(good: Path, folder: Path, draw: Random) -> None:
        shutil.copytree(good / "recipes", folder / "recipes")
        path = find(folder / "recipes", draw)
        content = path.read_bytes()
        if draw.random() < 0.2:
            path.write_bytes(change_bytes(content, draw))
        else:
            path.write_text(
                change_content(content.decode(), draw),
                encoding="utf-8",
                errors="replace",
            )

    return change


def _recipe_in(folder: Path, draw: Random) -> Path:
    return folder / draw.choice(("datasets.toml", "pipelines.toml", "problem.toml"))


def _urdf_in(folder: Path, _draw: Random) -> Path:
    return next(folder.glob("*.urdf"))


def _read_recipe(folder: Path, draw: Random) -> None:
    recipe = load_dataset_recipe(folder / "recipes" / "datasets.toml")
    load_robot(recipe.pipeline.problem)


def _read_urdf(folder: Path, draw: Random) -> None:
    robot = load_robot(load_problem(folder / "recipes" / "problem.toml"))
    assert robot.capsule_axes is not None


def _change_document(good: Path, folder: Path, draw: Random) -> None:
    shutil.copytree(good / "set", folder / "set")
    name = draw.choice(DOCUMENTS)
    path = folder / "set" / name
    if draw.random() < 0.1:
        path.write_bytes(change_bytes(path.read_bytes(), draw))
        return
    changed = change_json(read_unverified(path), draw)
    if name == "specification.json" and draw.random() < 0.7:
        _follow(folder / "set", changed)
    _save(path, changed)
    if name != "manifest.json":
        _list_again(folder / "set")


def _follow(folder: Path, specification: dict[str, Any]) -> None:
    """Write the fingerprint of a changed specification into all documents, as a forger would."""
    with suppress(CnpgenError, ValueError, KeyError, TypeError):
        specification["fingerprint"] = from_json(specification).fingerprint
    for name in DOCUMENTS[1:]:
        _save(
            folder / name,
            {
                **read_unverified(folder / name),
                "specification_fingerprint": specification.get("fingerprint"),
            },
        )


def _list_again(folder: Path) -> None:
    """Update the digests in the manifest."""
    manifest = read_unverified(folder / "manifest.json")
    for name, entry in manifest["files"].items():
        entry |= {
            "sha256": file_sha256(folder / name),
            "bytes": (folder / name).stat().st_size,
        }
    for split in manifest["splits"].values():
        for entry in split["shards"]:
            entry["sidecar"]["sha256"] = file_sha256(folder / entry["sidecar"]["file"])
            entry |= {
                "sha256": file_sha256(folder / entry["file"]),
                "bytes": (folder / entry["file"]).stat().st_size,
            }
    files = (
        (entry["file"], entry["sha256"])
        for split in manifest["splits"].values()
        for entry in split["shards"]
    )
    _save(
        folder / "manifest.json", {**manifest, "fingerprint": data_fingerprint(files)}
    )


def _save(path: Path, document: Mapping[str, Any]) -> None:
    """Write a document with its checksum; ignore documents that cannot be written."""
    with suppress(TypeError, ValueError, AttributeError, RecursionError):
        save_document(path, document)


def _read_set(folder: Path, draw: Random) -> None:
    """Read a dataset with one of several functions, which may raise an error."""
    path = folder / "set"
    readers: list[Callable[[], Any]] = [
        lambda: load_dataset(path, verify=draw.random() < 0.5).arrays("train"),
        lambda: next(iter(load_dataset(path, allow_incomplete=True).batches(4))),
        lambda: inspection_text(inspect_dataset(path)),
        lambda: validate_dataset(path, deep=draw.random() < 0.1, workers=1).summary(),
    ]
    draw.choice(readers)()


def _change_shard(good: Path, folder: Path, draw: Random) -> None:
    shutil.copytree(good / "set", folder / "set")
    path = folder / "set" / "train" / "shard-00000.h5"
    path.write_bytes(_changed_hdf5(path.read_bytes(), draw))
    sidecar = path.with_suffix(".json")
    _save(
        sidecar,
        {
            **read_unverified(sidecar),
            "sha256": file_sha256(path),
            "bytes": path.stat().st_size,
        },
    )
    _list_again(folder / "set")


def _changed_hdf5(content: bytes, draw: Random, *, first: int = 0) -> bytes:
    """Change bytes of an HDF5 file, most of them in its headers."""
    return content[:first] + change_bytes(
        content[first:], draw, among=_headers(content, first)
    )


@cache
def _headers(content: bytes, first: int) -> list[int]:
    """List the positions of a file with many zeros around, as in headers, relative to the first."""
    parts = range(first, len(content), 256)
    among = [
        part
        for part in parts
        if part < first + 2048 or content[part : part + 256].count(0) > 100
    ]
    return [
        place - first
        for part in among
        for place in range(part, min(part + 256, len(content)))
    ]


def _read_shard(folder: Path, draw: Random) -> None:
    path = folder / "set" / "train" / "shard-00000.h5"
    if draw.random() < 0.5:
        read_schema(path)
        read_shard(path)
    _read_set(folder, draw)


def _change_plans(good: Path, folder: Path, draw: Random) -> None:
    _change_plan_file(good / "without_checksum.h5", folder, draw)


def _change_scene_plans(good: Path, folder: Path, draw: Random) -> None:
    _change_plan_file(good / "scene_plans.h5", folder, draw)


def _change_plan_file(good: Path, folder: Path, draw: Random) -> None:
    content = good.read_bytes()
    path = folder / "plans.h5"
    if draw.random() < 0.3:
        path.write_bytes(content)
        _change_values(path, draw)
    else:
        path.write_bytes(_changed_hdf5(content, draw))
    if draw.random() < 0.3 and path.stat().st_size > HEADER_BYTES:
        path.write_bytes(
            with_checksum(
                path.read_bytes(), kind="cnpgen-plans", version=PLAN_FILE_VERSION
            )
        )


def _change_values(path: Path, draw: Random) -> None:
    """Change a dataset or an attribute of a file of plans as h5py does."""
    with h5py.File(path, "a") as file:
        name = draw.choice([*file])
        if draw.random() < 0.5 or not file.attrs:
            values = file[name][()]
            flat = values.reshape(-1)
            flat[draw.randrange(len(flat))] = draw.choice((0, 1, 100)) if values.dtype.kind in "iu" else draw.choice(
                (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, -1e200, 0.0)
            )  # fmt: skip
            del file[name]
            shapes = (
                values.shape,
                values.shape,
                (*values.shape, 1),
                values.shape[1:],
                (0, *values.shape[1:]),
                (1,),
            )
            stored = draw.choice(("f8", "f4", "i8", "u1", values.dtype))
            with np.errstate(all="ignore"):
                file[name] = np.resize(values, draw.choice(shapes)).astype(stored)
        else:
            key = draw.choice([*file.attrs])
            value = file.attrs[key]
            text = value.decode() if isinstance(value, bytes) else str(value)
            with suppress(ValueError):
                text = json.dumps(change_json(json.loads(text), draw))
            odd = (
                text,
                text[:-1],
                np.int64(draw.choice((-1, 0, 3, 10**9))),
                1.5,
                [1, 2],
                "",
                "airhockey",
                "/dev/zero",
            )
            file.attrs[key] = draw.choice(odd)
            if key == "problem_recipe" and draw.random() < 0.7:
                file.attrs[key] = text
                with suppress(CnpgenError, ValueError):
                    file.attrs["problem_sha256"] = _comparable(
                        text, file.attrs["problem_urdf"]
                    )


def _comparable(recipe: str, urdf: Any) -> str:
    from cnpgen.problems.problem_record import ProblemRecord

    with suppress(KeyError, TypeError, AttributeError):
        return ProblemRecord(
            recipe, urdf.decode() if isinstance(urdf, bytes) else urdf
        ).comparable_sha256
    return canonical_sha256({})


def _read_plans(folder: Path, draw: Random) -> None:
    path = folder / "plans.h5"
    with suppress(CnpgenError):
        read_boundary_file(path).problem()
    plans = load_plans(path)
    screen(plans)
    if draw.random() < COSTLY_SHARE and len(plans):
        evaluate_plans(plans[:2], workers=1).summary()


def _change_with_checksum(name: str, kind: str, version: int) -> Change:
    def change(good: Path, folder: Path, draw: Random) -> None:
        content = (good / name).read_bytes()
        path = folder / name
        how = draw.random()
        if how < 0.1:
            path.write_bytes(change_bytes(content, draw))
        elif how < 0.6:
            path.write_bytes(
                with_checksum(
                    _changed_hdf5(content, draw, first=HEADER_BYTES),
                    kind=kind,
                    version=version,
                )
            )
        else:
            valid = read_with_checksum(good / name, kind=kind, version=version)
            path.write_bytes(
                encode_with_checksum(
                    _changed_content(valid, draw), kind=kind, version=version
                )
            )

    return change


def _changed_content(content: Content, draw: Random) -> Content:
    """Change a text or an array of a file with a checksum."""
    arrays, texts = dict(content.arrays), dict(content.texts)
    if draw.random() < 0.7:
        name = draw.choice([*texts])
        try:
            texts[name] = json.dumps(change_json(json.loads(texts[name]), draw))
        except ValueError:
            texts[name] = (
                change_text(texts[name], draw).encode(errors="replace").decode()
            )
    else:
        name = draw.choice([*arrays])
        odd = (
            arrays[name][..., :-1],
            arrays[name][None],
            np.zeros(0),
            np.zeros((2, 2, 2)),
            arrays[name].astype("i8"),
        )
        arrays[name] = draw.choice(odd)
        if draw.random() < 0.2:
            del arrays[name]
    return Content(arrays, texts)


def _read_model(folder: Path, draw: Random) -> None:
    model = load_model(folder / "model.h5")
    str(model)
    if draw.random() < COSTLY_SHARE:
        base = open_problem(model.problem)[1].home
        Planner(model, backend="numpy").plan(base, base + 0.1)


def _read_checkpoint(folder: Path, draw: Random) -> None:
    Checkpoints(folder / "checkpoint", IDENTITY).load()


def _change_records(name: str, form: RecordFormat) -> Change:
    def change(good: Path, folder: Path, draw: Random) -> None:
        if draw.random() < 0.3:
            content = change_bytes((good / name).read_bytes(), draw)
            (folder / name).write_bytes(content)
            return
        _, (record,) = form.read(good / name)
        if draw.random() < 0.5:
            record = change_json(record, draw)
        else:
            archive = base64.b64decode(record["arrays"])
            record["arrays"] = base64.b64encode(change_bytes(archive, draw)).decode()
        form.replace(folder / name, IDENTITY, record)

    return change


def _read_journal(folder: Path, draw: Random) -> None:
    open_journal(folder / "journal", IDENTITY).file.close()


def _suite_in(folder: Path, draw: Random) -> Path:
    return folder / draw.choice(("suite.toml", "suite.toml", "problem.toml"))


def _read_suite(folder: Path, draw: Random) -> None:
    suite = load_suite(folder / "recipes" / "suite.toml")
    str(suite)
    if (
        draw.random() < COSTLY_SHARE
        and suite.pucks is not None
        and suite.pucks.rows * suite.pucks.columns <= MAX_FUZZED_PUCKS
    ):
        suite.problems(3)


def _change_boundary(good: Path, folder: Path, draw: Random) -> None:
    path = folder / "boundary.h5"
    if draw.random() < 0.5:
        shutil.copy(good / "boundary.h5", path)
        _change_values(path, draw)
    else:
        path.write_bytes(_changed_hdf5((good / "boundary.h5").read_bytes(), draw))
    shutil.copy(good / "model.h5", folder)


def _read_boundary(folder: Path, draw: Random) -> None:
    path = folder / "boundary.h5"
    readers: list[Callable[[], Any]] = [
        lambda: load_boundary_problems(path),
        lambda: load_boundary_problems(path, problem="airhockey"),
        lambda: read_file(path, load_model(folder / "model.h5")),
    ]
    draw.choice(readers)()


def _change_tasks(good: Path, folder: Path, draw: Random) -> None:
    name = draw.choice(("tasks.h5", "tasks.csv"))
    path, content = folder / "tasks", (good / name).read_bytes()
    if draw.random() < 0.4:
        path.write_bytes(change_bytes(content, draw))
    elif name == "tasks.csv":
        lines = change_text(content.decode().replace(",", "=,"), draw).replace(
            "=,", ","
        )
        path.write_text(lines, encoding="utf-8", errors="replace")
    else:
        path.write_bytes(content)
        _change_values(path, draw)


def _read_tasks(folder: Path, draw: Random) -> None:
    fields = {
        name: Field(name, "m", name, 3, ("x", "y", "z")) for name in ("goal_xyz",)
    }
    fields["hit_angle"] = Field("hit_angle", "rad", "angle")
    read_tasks(folder / "tasks", fields, flat=True)


def _change_results(good: Path, folder: Path, draw: Random) -> None:
    lines = (good / "results.jsonl").read_text(encoding="utf-8").splitlines()
    if draw.random() < 0.2:
        (folder / "results.jsonl").write_bytes(
            change_bytes("\n".join(lines).encode(), draw)
        )
        return
    index = draw.randrange(1, len(lines))
    lines[index] = json.dumps(change_json(json.loads(lines[index]), draw))
    (folder / "results.jsonl").write_text(
        "\n".join(lines) + "\n", encoding="utf-8", errors="replace"
    )


def _read_results(folder: Path, draw: Random) -> None:
    results = open_results(folder / "results.jsonl", IDENTITY)
    results.file.close()
    for row in results.rows.values():
        if row.get("answer") is not None:
            answer_from_dict(_PROBLEM[:1], row["answer"])


def _change_embedded(good: Path, folder: Path, draw: Random) -> None:
    """Change a number, an attribute or an element of the URDF in a plan file or in a model."""
    name = draw.choice(("plans.h5", "model.h5"))
    change = changed_number if draw.random() < 0.5 else change_urdf
    if name == "plans.h5":
        shutil.copy(good / "without_checksum.h5", folder / name)
        with h5py.File(folder / name, "r+") as file:
            urdf = file.attrs["problem_urdf"]
            changed = change(urdf.decode() if isinstance(urdf, bytes) else urdf, draw)
            file.attrs["problem_urdf"] = changed.replace("\0", " ").encode(
                errors="replace"
            )
            recipe = file.attrs["problem_recipe"]
            text = recipe.decode() if isinstance(recipe, bytes) else recipe
            with suppress(CnpgenError, ValueError):
                file.attrs["problem_sha256"] = _comparable(
                    text, file.attrs["problem_urdf"]
                )
        return
    content = read_with_checksum(good / name, kind=MODEL_KIND, version=MODEL_VERSION)
    key = next(key for key, text in content.texts.items() if "<robot" in text)
    changed_content = Content(
        content.arrays,
        {**content.texts, key: _with_urdf(content.texts[key], change, draw)},
    )
    (folder / name).write_bytes(
        encode_with_checksum(changed_content, kind=MODEL_KIND, version=MODEL_VERSION)
    )


def _with_urdf(text: str, change: Callable[[str, Random], str], draw: Random) -> str:
    """Change a text that is a URDF, or a JSON document with one."""
    if text.lstrip().startswith("<"):
        return change(text, draw).encode(errors="replace").decode()
    document = json.loads(text)
    key = next(
        key
        for key, value in document.items()
        if isinstance(value, str) and "<robot" in value
    )
    return json.dumps({**document, key: change(document[key], draw)})


def _read_embedded(folder: Path, draw: Random) -> None:
    """Read a robot; its model has the numbers of an independent reading of the XML."""
    if (folder / "plans.h5").exists():
        plans = load_plans(folder / "plans.h5")
        record, robot = plans.problem, open_problem(plans.problem)[1]
        if draw.random() < 0.2:
            evaluate_plans(plans, workers=1)
    else:
        model = load_model(folder / "model.h5")
        record, robot = model.problem, open_problem(model.problem)[1]
        if draw.random() < COSTLY_SHARE:
            Planner(model, backend="numpy").plan(robot.home, robot.home + 0.1)
    assert differences(robot, bodies_in(record.urdf, robot.joint_names)) == []


SUBJECTS: dict[str, Subject] = {
    "recipe": Subject(_change_text_of(_recipe_in, change_text), _read_recipe),
    "urdf": Subject(_change_text_of(_urdf_in, change_urdf), _read_urdf),
    "document": Subject(_change_document, _read_set),
    "shard": Subject(_change_shard, _read_shard),
    "plans": Subject(_change_plans, _read_plans),
    "model": Subject(
        _change_with_checksum("model.h5", MODEL_KIND, MODEL_VERSION), _read_model
    ),
    "checkpoint": Subject(
        _change_records("checkpoint", CHECKPOINT),
        _read_checkpoint,
    ),
    "journal": Subject(_change_records("journal", JOURNAL), _read_journal),
    "embedded": Subject(_change_embedded, _read_embedded),
    "suite": Subject(_change_text_of(_suite_in, change_text), _read_suite),
    "boundary": Subject(_change_boundary, _read_boundary),
    "tasks": Subject(_change_tasks, _read_tasks),
    "results": Subject(_change_results, _read_results),
    "scenes": Subject(change_scene, read_scene),
    "trajectory": Subject(change_trajectory, read_trajectory),
    "scene-plans": Subject(_change_scene_plans, read_scene_plans),
    "mesh": Subject(change_mesh, read_shaped_robot),
    "srdf": Subject(change_srdf, read_shaped_robot),
}


def read_quietly(subject: Subject, folder: Path, draw: Random) -> None:
    """Read a changed file and ignore warnings."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        subject.read(folder, draw)
