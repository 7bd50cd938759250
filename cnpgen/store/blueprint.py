"""The blueprint of a dataset: everything that determines its bytes, in plan.json before the first shard is made."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, UsageError, nearest
from cnpgen.store.field import Field
from cnpgen.store.files.documents import canonical_sha256, load_document, plain, save_document
from cnpgen.store.files.forms import ANYTHING, EVERY, NUMBER, TEXT, WHOLE, Form, Maybe, check_form
from cnpgen.store.files.limits import MOST_COLUMNS, MOST_FIELDS, MOST_SHARDS
from cnpgen.store.layout import PLAN, SPLIT_NAME, WORK, shard_stem

FORMAT = "cnpgen-plan"
REVISION = 2  # of the generator: raised by every change after which the same blueprint would give other rows
FORMAT_VERSION = 2  # what was never extended is written as version 1, and has no "earlier"
_FIELD = {
    **dict.fromkeys(("name", "unit", "long_name", "role", "frame", "dtype"), TEXT),
    "width": WHOLE,
    "names": [TEXT],
    "valid_min": Maybe([NUMBER]),
    "valid_max": Maybe([NUMBER]),
}
FORM = {
    **dict.fromkeys(("name", "version", "title", "license", "recipe_sha256", "dtype", "backend", "generator"), TEXT),
    **dict.fromkeys(("fingerprint", "seed"), TEXT),
    **dict.fromkeys(("shard_size", "block_rows", "revision"), WHOLE),
    "recipe": {EVERY: ANYTHING},
    "splits": {EVERY: WHOLE},
    "fields": [_FIELD],
    "robot": {EVERY: ANYTHING},
    "versions": {EVERY: TEXT},
}
INFORMATIONAL = ("title", "license", "versions", "recipe")  # what may differ in equal blueprints; recipe_sha256 may not


@dataclass(frozen=True)
class ShardTask:
    """One shard that is to be made.

    Attributes:
        split: Name of the split.
        index: Number of the shard within the split.
        first_row: Index of its first row within the split.
        rows: Number of rows.
    """

    split: str
    index: int
    first_row: int
    rows: int

    @property
    def file(self) -> str:
        """Path of the shard, relative to the dataset's folder."""
        return shard_stem(self.split, self.index) + ".h5"

    @property
    def sidecar(self) -> str:
        """Path of the shard's commit record, relative to the dataset's folder."""
        return shard_stem(self.split, self.index) + ".json"


@dataclass(frozen=True)
class StoredProblem:
    """The problem that a dataset was made for, as text; ``PlanLoss``, ``Omega`` and the like take it.

    Attributes:
        recipe: The resolved problem as JSON, every number in SI.
        urdf: The robot's URDF.
    """

    recipe: str
    urdf: str

    def __repr__(self) -> str:
        return f"<problem {json.loads(self.recipe).get('name', '')} of a dataset>"


@dataclass(frozen=True, kw_only=True)
class Blueprint:
    """What a dataset will hold.

    Attributes:
        name: Name of the dataset.
        version: Its version, MAJOR.MINOR.PATCH.
        title: One line about it.
        license: Licence of the rows, an SPDX identifier.
        recipe_sha256: Digest of the resolved recipe.
        recipe: The resolved recipe as nested tables.
        seed: Root seed.
        splits: Split name -> rows.
        shard_size: Rows per shard; the last shard of a split may be shorter.
        block_rows: Rows per block.
        dtype: Float type of the stored numbers, "float64" or "float32".
        backend: Which kernels computed them: "compiled", "numpy", ...
        generator: How random numbers are made.
        revision: Revision of the generator's code: rows of different ones must not mix.
        fields: The columns, in order.
        robot: Name, digest of the URDF, joint names and limits.
        versions: Versions of cnpgen, Python and libraries that drew it up; not part of its identity.
        earlier: The splits that the dataset had before each of its extensions, the oldest first. Shards that were made
            then end where it ended, and stay as they are.
    """

    name: str
    version: str
    title: str = ""
    license: str = ""
    recipe_sha256: str
    recipe: Mapping[str, Any]
    seed: int
    splits: Mapping[str, int]
    shard_size: int
    block_rows: int
    dtype: str = "float64"
    backend: str
    generator: str = "numpy SFC64 seeded by SeedSequence"
    revision: int = REVISION
    fields: tuple[Field, ...]
    robot: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    earlier: tuple[Mapping[str, int], ...] = ()

    def __post_init__(self) -> None:
        for name in ("recipe", "splits", "robot", "versions"):  # as JSON will give them back
            object.__setattr__(self, name, plain(getattr(self, name)))
        object.__setattr__(self, "earlier", tuple(map(plain, self.earlier)))
        _check_sizes(self)
        _check_names(self)

    @cached_property
    def fingerprint(self) -> str:
        """The sha256 over everything that determines the bytes of the shards."""
        identity = {key: value for key, value in to_json(self).items() if key not in INFORMATIONAL}
        return canonical_sha256(identity)

    @cached_property
    def generations(self) -> tuple["Blueprint", ...]:
        """The blueprints that the dataset has had, the oldest first; this one is the last."""
        before = enumerate(self.earlier)
        return (*(replace(self, splits=rows, earlier=self.earlier[:number]) for number, rows in before), self)

    def of(self, task: "ShardTask") -> "Blueprint":
        """Return the blueprint that a shard is made by: the first one that has its rows."""
        end = task.first_row + task.rows
        return next((each for each in self.generations if end <= each.splits.get(task.split, 0)), self)

    @property
    def key(self) -> int:
        """The first 60 bits of the fingerprint: HDF5 stores numbers under a checksum, texts not."""
        return int(self.fingerprint[:15], 16)

    @property
    def problem(self) -> StoredProblem:
        """The problem whose motions the rows are the ends of.

        Raises:
            DatasetError: The blueprint does not say.
        """
        self._require({"pipeline": {"problem": {EVERY: ANYTHING}}}, "its problem")
        urdf = self.robot.get("urdf")
        if not isinstance(urdf, str):
            raise DatasetError(f"the blueprint of {self.name} lacks the robot's URDF, and so does not say its problem")
        return StoredProblem(json.dumps(self.recipe["pipeline"]["problem"], ensure_ascii=False), urdf)

    @property
    def stages(self) -> list[dict[str, Any]]:
        """The resolved stages that draw the rows.

        Raises:
            DatasetError: The blueprint does not say.
        """
        self._require({"pipeline": {"stage": [{"use": TEXT}]}}, "how rows are drawn")
        found: list[dict[str, Any]] = self.recipe["pipeline"]["stage"]
        return found

    def _require(self, form: Form, what: str) -> None:
        """Refuse a recipe that does not say something."""
        try:
            check_form(self.recipe, form)
        except ValueError as error:
            raise DatasetError(f"the blueprint of {self.name} does not say {what}: {error}") from error

    def field_named(self, name: str) -> Field:
        """Return the field called ``name``.

        Raises:
            DatasetError: There is none.
        """
        by_name = {item.name: item for item in self.fields}
        if name not in by_name:
            raise DatasetError(f"{self.name} has no field {name!r}{nearest(name, by_name)}")
        return by_name[name]


def _check_sizes(blueprint: Blueprint) -> None:
    if blueprint.block_rows < 1 or blueprint.shard_size < 1:
        raise UsageError(f"the shard size must be at least 1, got {blueprint.shard_size}")
    if blueprint.seed < 0:
        raise UsageError(f"the seed must not be negative, got {blueprint.seed}")
    if blueprint.dtype not in {"float64", "float32"}:
        raise UsageError(f"dtype must be 'float64' or 'float32', got {blueprint.dtype!r}")
    count = sum(-(-rows // blueprint.shard_size) for rows in blueprint.splits.values())
    if count > MOST_SHARDS:
        raise UsageError(
            f"{count:,} shards of {blueprint.shard_size:,} rows are too many, expected at most {MOST_SHARDS:,}:"
            " choose a larger shard_size="
        )
    if any(rows < 0 for rows in blueprint.splits.values()) or not any(blueprint.splits.values()):
        found = ", ".join(f"{name} {rows}" for name, rows in blueprint.splits.items())
        raise UsageError(f"the splits must have rows, got {found or 'none'}")
    for smaller, larger in pairwise((*blueprint.earlier, blueprint.splits)):
        if any(not 0 <= rows <= larger.get(split, 0) for split, rows in smaller.items()):
            raise UsageError(f"a dataset does not shrink: its splits had {dict(smaller)}, then {dict(larger)}")


def _check_names(blueprint: Blueprint) -> None:
    for split in blueprint.splits:
        if not SPLIT_NAME.fullmatch(split):
            raise UsageError(f"a split is named with letters, digits and '_', starting with a letter; got {split!r}")
    names = [item.name for item in blueprint.fields]
    if not names or len(set(names)) != len(names) or len(names) > MOST_FIELDS:
        raise UsageError(f"the fields must have different names, from 1 to {MOST_FIELDS:,}, got {names!s:.200}")
    for item in blueprint.fields:
        widths = {len(part) for part in (item.valid_min, item.valid_max) if part is not None}
        wrong = widths - {max(item.width, 1)} or (item.names and len(item.names) != item.width)
        if wrong or item.width > MOST_COLUMNS or item.dtype not in {"float", "int64"}:
            raise UsageError(f"the field {item.name!r} must have as many names and limits as columns: {item!r:.200}")


def default_shard_size(rows: int, block_rows: int = 4096) -> int:
    """Choose the rows per shard: about 16 shards, but between 8192 and 65536 rows, a power of two.

    Where blocks are smaller than 4096 rows, since every row takes long, shards have 1 to 16 blocks: an interruption
    loses what was not finished of a shard.

    Args:
        rows: Rows of the whole dataset.
        block_rows: Rows per block.
    """
    low, high = (8192, 65536) if block_rows >= 4096 else (block_rows, 16 * block_rows)
    return int(min(max(1 << max(round(math.log2(max(rows, 1) / 16)), 0), low), high))


def shards(blueprint: Blueprint) -> list[ShardTask]:
    """List the shards of a blueprint, split by split, in order; a split without rows has none.

    They begin at multiples of the shard size, and where an extension began.
    """
    return [
        ShardTask(split, index, first, end - first)
        for split, rows in blueprint.splits.items()
        for index, (first, end) in enumerate(pairwise([*_beginnings(blueprint, split, rows), rows]))
    ]


def _beginnings(blueprint: Blueprint, split: str, rows: int) -> list[int]:
    before = {each.get(split, 0) for each in blueprint.earlier}
    return sorted({*range(0, rows, blueprint.shard_size), *(end for end in before if 0 < end < rows)})


def shard_attributes(blueprint: Blueprint, task: ShardTask) -> dict[str, str | int]:
    """Say what a shard's file says about itself; no time, host or path: its bytes depend on the blueprint alone."""
    return {
        "dataset": blueprint.name,
        "dataset_version": blueprint.version,
        "split": task.split,
        "shard_index": task.index,
        "first_sample_id": task.first_row,
        "rows": task.rows,
        "recipe_sha256": blueprint.recipe_sha256,
        "plan_fingerprint": blueprint.of(task).fingerprint,
        "plan_key": blueprint.of(task).key,
        "root_seed": str(blueprint.seed),
        "generator": blueprint.generator,
        "backend": blueprint.backend,
        "cnpgen_version": blueprint.versions.get("cnpgen", ""),
    }


def to_json(blueprint: Blueprint) -> dict[str, Any]:
    """Return a blueprint as a JSON-able dict."""
    names = [name for name in Blueprint.__dataclass_fields__ if name not in {"fields", "seed", "earlier"}]
    content = {"seed": str(blueprint.seed), "fields": [asdict(item) for item in blueprint.fields]}
    content |= {"earlier": list(blueprint.earlier)} if blueprint.earlier else {}
    return {name: getattr(blueprint, name) for name in names} | {name: plain(value) for name, value in content.items()}


def from_json(content: Mapping[str, Any]) -> Blueprint:
    """Rebuild a blueprint from :func:`to_json`'s dict.

    Raises:
        DatasetError: A key is missing or has the wrong type.
    """
    try:
        arguments = {name: content[name] for name in Blueprint.__dataclass_fields__ if name != "earlier"}
        check_form(content.get("earlier", []), [{EVERY: WHOLE}])
        arguments["earlier"] = tuple(content.get("earlier", ()))
        arguments["seed"] = int(content["seed"])
        arguments["fields"] = tuple(_field(item) for item in content["fields"])
        return Blueprint(**arguments)
    except UsageError as error:
        raise DatasetError(f"plan.json is damaged: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DatasetError(f"plan.json is damaged: {type(error).__name__} {error}") from error


def _field(content: Mapping[str, Any]) -> Field:
    limits = {
        name: None if content[name] is None else tuple(float(value) for value in content[name])
        for name in ("valid_min", "valid_max")
    }
    return Field(**{**content, "names": tuple(content["names"]), **limits})


def write_blueprint(folder: Path, blueprint: Blueprint) -> None:
    """Write ``plan.json``, whatever was there.

    Raises:
        MachineError: The folder cannot be written.
    """
    version = FORMAT_VERSION if blueprint.earlier else 1
    document = {"format": FORMAT, "format_version": version, "fingerprint": blueprint.fingerprint}
    save_document(folder / PLAN, document | to_json(blueprint), work=folder / WORK)


def load_blueprint(folder: Path) -> Blueprint:
    """Read ``plan.json``.

    Raises:
        DatasetError: It is missing, damaged or written by a newer cnpgen.
        MachineError: The system would not let us read it.
    """
    path = folder / PLAN
    document = load_document(path, FORMAT, version=FORMAT_VERSION, form=FORM)
    blueprint = from_json(document)
    if blueprint.fingerprint != document.get("fingerprint"):
        raise DatasetError(f"{path} is damaged: its fingerprint does not match its content")
    return blueprint
