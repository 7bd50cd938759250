"""The specification of a dataset: everything that determines its bytes.

It is stored in ``specification.json`` before the first shard is made.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import DatasetError, UsageError, nearest
from cnpgen.store.field import Field, Fields
from cnpgen.store.files.atomic import read_file
from cnpgen.store.files.document_structure import (
    ANY_KEY,
    ANYTHING,
    TEXT,
    Structure,
    check_structure,
    structure_of,
)
from cnpgen.store.files.documents import (
    canonical_sha256,
    load_document,
    parse_json,
    plain,
    save_document,
)
from cnpgen.store.files.size_limits import (
    MAX_COLUMNS,
    MAX_DOCUMENT_BYTES,
    MAX_FIELDS,
    MAX_SHARDS,
)
from cnpgen.store.layout import (
    OLD_SPECIFICATION,
    SPECIFICATION,
    SPLIT_NAME,
    WORK,
    shard_stem,
)
from cnpgen.store.scene_table import SCENE_ARRAYS

SPECIFICATION_FORMAT = "cnpgen-specification"
# Raised by every change of the generator after which an equal specification gives other
# samples.
GENERATOR_REVISION = 2
SPECIFICATION_VERSION = 3
# Keys that may differ between equal specifications. The key recipe_sha256 may not.
INFORMATIONAL = ("title", "license", "versions", "recipe")
_SCENE_KEYS = ("scene_obstacles", "scene_families")  # of datasets with scenes only


@dataclass(frozen=True)
class ShardTask:
    """A shard of a dataset specification.

    Attributes:
        split: Name of the split.
        index: Index of the shard within the split.
        first_row: Index of its first row within the split.
        rows: Number of rows.
    """

    split: str
    index: int
    first_row: int
    rows: int

    @property
    def file(self) -> str:
        """Path of the shard, relative to the folder of the dataset."""
        return shard_stem(self.split, self.index) + ".h5"

    @property
    def sidecar(self) -> str:
        """Path of the commit record of the shard, relative to the folder of the dataset."""
        return shard_stem(self.split, self.index) + ".json"


@dataclass(frozen=True)
class StoredProblem:
    """The problem of a dataset, as text; an argument of ``PlanLoss``, ``BoundaryLayer`` and others.

    Attributes:
        recipe: The resolved problem as JSON, in SI units.
        urdf: The URDF of the robot.
    """

    recipe: str
    urdf: str

    def __repr__(self) -> str:
        return f"<problem {json.loads(self.recipe).get('name', '')} of a dataset>"


@dataclass(frozen=True, kw_only=True)
class DatasetSpec:
    """The specification of a dataset.

    Attributes:
        name: Name of the dataset.
        version: Its version, MAJOR.MINOR.PATCH.
        title: Description in one line.
        license: License of the samples, an SPDX identifier.
        recipe_sha256: sha256 of the resolved recipe.
        recipe: The resolved recipe as nested tables.
        seed: Root seed.
        splits: Split name -> number of rows.
        shard_size: Rows per shard. The last shard of a split may be shorter.
        block_rows: Rows per block.
        dtype: Float type of the stored numbers, "float64" or "float32".
        backend: Backend of the kernels: "compiled", "numpy", ...
        generator: Random number generator.
        revision: Revision of the code of the generator. Rows of different revisions
            must not be mixed.
        fields: Fields of the dataset, in order.
        robot: Name, URDF with its sha256, joint names and limits of the robot.
        versions: Versions of cnpgen, Python and libraries that wrote the specification.
            They are not part of its identity.
        previous_splits: The splits before each extension, the oldest first. An
            extension does not change existing shards, so shards also end where a
            previous split ended.
        scene_obstacles: Largest number of obstacles of a scene; 0 for samples without
            scenes of their own.
        scene_families: Names of the families of the scenes.
    """

    name: str
    version: str
    title: str = ""
    license: str = ""
    recipe_sha256: str
    recipe: JsonMapping
    seed: int
    splits: Mapping[str, int]
    shard_size: int
    block_rows: int
    dtype: str = "float64"
    backend: str
    generator: str = "numpy SFC64 seeded by SeedSequence"
    revision: int = GENERATOR_REVISION
    fields: Fields
    robot: JsonMapping = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    previous_splits: tuple[Mapping[str, int], ...] = ()
    scene_obstacles: int = 0
    scene_families: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # Equal to what is read from JSON.
        for name in (
            "recipe",
            "splits",
            "robot",
            "versions",
        ):
            object.__setattr__(self, name, plain(getattr(self, name)))
        object.__setattr__(
            self, "previous_splits", tuple(map(plain, self.previous_splits))
        )
        _check_sizes(self)
        _check_names(self)

    @cached_property
    def fingerprint(self) -> str:
        """The sha256 over everything that determines the bytes of the shards."""
        identity = {
            key: value
            for key, value in to_json(self).items()
            if key not in INFORMATIONAL
        }
        return canonical_sha256(identity)

    @cached_property
    def spec_versions(self) -> tuple[DatasetSpec, ...]:
        """All versions of the specification, from the first one to this one.

        An extension adds one.
        """
        previous = self.previous_splits
        older = (
            replace(self, splits=splits, previous_splits=previous[:index])
            for index, splits in enumerate(previous)
        )
        return (*older, self)

    def version_with(self, task: ShardTask) -> DatasetSpec:
        """Return the first version of the specification that contains a shard.

        The shard is made from that version.
        """
        # Splits only grow: the first version with enough rows has the shard.
        end = task.first_row + task.rows
        return next(
            (
                spec
                for spec in self.spec_versions
                if end <= spec.splits.get(task.split, 0)
            ),
            self,
        )

    @property
    def key(self) -> int:
        """The first 60 bits of the fingerprint: HDF5 protects numbers in attributes by a checksum, but not texts."""
        return int(self.fingerprint[:15], 16)

    @property
    def problem(self) -> StoredProblem:
        """The problem of the dataset: its samples are boundary problems of it.

        Raises:
            DatasetError: The specification does not contain its problem.
        """
        self._require({"pipeline": {"problem": {ANY_KEY: ANYTHING}}}, "the problem")
        urdf = self.robot.get("urdf")
        if not isinstance(urdf, str):
            raise DatasetError(
                f"the specification of {self.name} does not contain the URDF of the robot"
            )
        return StoredProblem(
            json.dumps(self.recipe["pipeline"]["problem"], ensure_ascii=False), urdf
        )

    @property
    def stages(self) -> list[JsonObject]:
        """The resolved stages that draw the samples.

        Raises:
            DatasetError: The specification does not contain its stages.
        """
        self._require({"pipeline": {"stage": [{"use": TEXT}]}}, "the stages")
        stages: list[JsonObject] = self.recipe["pipeline"]["stage"]
        return stages

    def _require(self, structure: Structure, content: str) -> None:
        """Raise an error if the recipe does not have a structure.

        ``content`` names the missing part.
        """
        try:
            check_structure(self.recipe, structure)
        except ValueError as error:
            raise DatasetError(
                f"the specification of {self.name} does not contain {content}: {error}"
            ) from error

    @cached_property
    def scene_fields(self) -> Fields:
        """The fields of the scene of each sample, flattened.

        They are stored once for each scene.
        """
        return (
            tuple(item.field(self.scene_obstacles) for item in SCENE_ARRAYS[1:])
            if self.scene_obstacles
            else ()
        )

    def field_named(self, name: str) -> Field:
        """Return the field called ``name``.

        Raises:
            DatasetError: There is no such field.
        """
        by_name = {item.name: item for item in self.fields}
        if name not in by_name:
            raise DatasetError(
                f"{self.name} has no field {name!r}{nearest(name, by_name)}",
                concerns="fields",
            )
        return by_name[name]


SPECIFICATION_STRUCTURE = {
    name: structure
    for name, structure in structure_of(DatasetSpec).items()
    if name not in _SCENE_KEYS
} | {"seed": TEXT, "fingerprint": TEXT}


def _check_sizes(spec: DatasetSpec) -> None:
    if spec.block_rows < 1 or spec.shard_size < 1:
        raise UsageError(
            f"the shard size must be at least 1, got {spec.shard_size}",
            concerns="shard_size",
        )
    if spec.seed < 0:
        raise UsageError(
            f"the seed must not be negative, got {spec.seed}", concerns="seed"
        )
    if spec.dtype not in {"float64", "float32"}:
        raise UsageError(
            f"must be 'float64' or 'float32', got {spec.dtype!r}", argument="dtype"
        )
    if not 0 <= spec.scene_obstacles <= MAX_COLUMNS:
        raise UsageError(
            f"scenes must have at most {MAX_COLUMNS:,} obstacles, got {spec.scene_obstacles}"
        )
    # The last shard of a split may be partly filled: the division rounds up.
    count = sum(-(-rows // spec.shard_size) for rows in spec.splits.values())
    if count > MAX_SHARDS:
        raise UsageError(
            f"{count:,} shards of {spec.shard_size:,} rows are too many, expected at most {MAX_SHARDS:,}:"
            " choose a larger {shard_size}",
            remedies={"shard_size": None},
        )
    if any(rows < 0 for rows in spec.splits.values()) or not any(spec.splits.values()):
        sizes = ", ".join(f"{name} {rows}" for name, rows in spec.splits.items())
        raise UsageError(f"the splits must have rows, got {sizes or 'none'}")
    # Rows of earlier versions stay in the dataset.
    for smaller, larger in pairwise((*spec.previous_splits, spec.splits)):
        if any(
            not 0 <= rows <= larger.get(split, 0) for split, rows in smaller.items()
        ):
            raise UsageError(
                f"the splits of a dataset must not shrink: they had {dict(smaller)}, then {dict(larger)}"
            )


def _check_names(spec: DatasetSpec) -> None:
    for split in spec.splits:
        if not SPLIT_NAME.fullmatch(split):
            raise UsageError(
                "the name of a split must have letters, digits and '_' and start with a letter, got "
                f"{split!r}"
            )
    names = [item.name for item in spec.fields]
    if not names or len(set(names)) != len(names) or len(names) > MAX_FIELDS:
        raise UsageError(
            f"the fields must have different names, from 1 to {MAX_FIELDS:,}, got {names!s:.200}"
        )
    for item in spec.fields:
        # A scalar field has one column and the width 0.
        widths = {
            len(part) for part in (item.valid_min, item.valid_max) if part is not None
        }
        wrong = widths - {max(item.width, 1)} or (
            item.names and len(item.names) != item.width
        )
        if wrong or item.width > MAX_COLUMNS or item.dtype not in {"float", "int64"}:
            raise UsageError(
                f"the field {item.name!r} must have as many names and limits as columns: {item!r:.200}"
            )


def default_shard_size(rows: int, block_rows: int = 4096) -> int:
    """Choose the rows per shard: a power of two that gives about 16 shards, between 8192 and 65536 rows.

    Blocks have fewer than 4096 rows if samples are expensive. Shards then have 1 to 16
    blocks, because an interruption loses the unfinished shard.
    """
    low, high = (8192, 65536) if block_rows >= 4096 else (block_rows, 16 * block_rows)
    return int(min(max(1 << max(round(math.log2(max(rows, 1) / 16)), 0), low), high))


def shards(spec: DatasetSpec) -> list[ShardTask]:
    """List the shards of a specification, split by split, in order.

    Shards begin at multiples of the shard size and at the first row of every extension.
    """
    tasks = []
    for split, rows in spec.splits.items():
        previous = {splits.get(split, 0) for splits in spec.previous_splits}
        # Shards begin at multiples of the size, and where an earlier version ended: its
        # last shard keeps its bytes.
        first_rows = sorted(
            {
                *range(0, rows, spec.shard_size),
                *(end for end in previous if 0 < end < rows),
            }
        )
        ranges = enumerate(pairwise([*first_rows, rows]))
        tasks += [
            ShardTask(split, index, first, end - first)
            for index, (first, end) in ranges
        ]
    return tasks


def shard_attributes(spec: DatasetSpec, task: ShardTask) -> dict[str, str | int]:
    """Return the HDF5 attributes of a shard: they depend on the specification alone, not on time, host or path."""
    return {
        "dataset": spec.name,
        "dataset_version": spec.version,
        "split": task.split,
        "shard_index": task.index,
        "first_sample_id": task.first_row,
        "rows": task.rows,
        "recipe_sha256": spec.recipe_sha256,
        "specification_fingerprint": spec.version_with(task).fingerprint,
        "specification_key": spec.version_with(task).key,
        "root_seed": str(spec.seed),
        "generator": spec.generator,
        "backend": spec.backend,
        "cnpgen_version": spec.versions.get("cnpgen", ""),
    }


def to_json(spec: DatasetSpec) -> JsonObject:
    """Return a specification as a JSON-able dict."""
    converted = {
        # JSON numbers of other readers have 53 bits
        "seed": str(spec.seed),
        "fields": plain([asdict(item) for item in spec.fields]),
        "previous_splits": plain(spec.previous_splits),
    }
    if spec.scene_obstacles:
        # Absent in specifications without scenes, whose fingerprints stay the same.
        converted |= {name: plain(getattr(spec, name)) for name in _SCENE_KEYS}
    names = [
        name
        for name in DatasetSpec.__dataclass_fields__
        if name not in {*converted, *_SCENE_KEYS}
    ]
    return {name: getattr(spec, name) for name in names} | converted


def from_json(content: JsonMapping) -> DatasetSpec:
    """Rebuild a specification from the result of ``to_json``.

    A missing key or a wrong type raises DatasetError.
    """
    try:
        required = [
            name for name in DatasetSpec.__dataclass_fields__ if name not in _SCENE_KEYS
        ]
        arguments = {name: content[name] for name in required}
        if "scene_obstacles" in content:
            arguments["scene_obstacles"] = int(content["scene_obstacles"])
            arguments["scene_families"] = tuple(map(str, content["scene_families"]))
        arguments["previous_splits"] = tuple(content["previous_splits"])
        arguments["seed"] = int(content["seed"])
        arguments["fields"] = tuple(
            Field(**item | {"names": tuple(item["names"])})
            for item in content["fields"]
        )
        return DatasetSpec(**arguments)
    except UsageError as error:
        raise DatasetError(f"{SPECIFICATION} is damaged: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(
            f"{SPECIFICATION} is damaged: {type(error).__name__} {error}"
        ) from error


def write_dataset_spec(folder: Path, spec: DatasetSpec) -> None:
    """Write ``specification.json``; an existing file is replaced."""
    document = {
        "format": SPECIFICATION_FORMAT,
        "format_version": SPECIFICATION_VERSION,
        "fingerprint": spec.fingerprint,
    }
    save_document(folder / SPECIFICATION, document | to_json(spec), work=folder / WORK)


def load_dataset_spec(folder: Path) -> DatasetSpec:
    """Read ``specification.json``.

    Raise DatasetError if it is missing, damaged, or of another format version.
    """
    path = folder / SPECIFICATION
    _refuse_old_format(folder)
    document = load_document(
        path,
        SPECIFICATION_FORMAT,
        version=SPECIFICATION_VERSION,
        structure=SPECIFICATION_STRUCTURE,
    )
    spec = from_json(document)
    # The checksum protects the text; the fingerprint, the meaning that this version
    # reads.
    if spec.fingerprint != document.get("fingerprint"):
        raise DatasetError(
            f"{path} is damaged: its fingerprint does not match its content"
        )
    return spec


def _refuse_old_format(folder: Path) -> None:
    """Raise an error that names both format versions if the folder has a specification of an older format only."""
    path = folder / OLD_SPECIFICATION
    if (folder / SPECIFICATION).exists() or not path.is_file():
        return
    try:
        version = parse_json(read_file(path, max_bytes=MAX_DOCUMENT_BYTES).decode())[
            "format_version"
        ]
    except (ValueError, KeyError, TypeError):
        version = "1 or 2"
    raise DatasetError(
        f"{path} has format version {version}, this cnpgen reads version {SPECIFICATION_VERSION} ({SPECIFICATION}):"
        " make the dataset again"
    )
