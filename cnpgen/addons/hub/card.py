"""The card of a dataset: the README.md for users and the Hugging Face hub."""

import json
from collections.abc import Sequence

import numpy as np

from cnpgen.addons.hub.card_problem import (
    constraint_table,
    describe_frame,
    limits_table,
    problem_of,
    what_samples_prove,
)
from cnpgen.addons.hub.markdown import markdown_table
from cnpgen.documents import JsonMapping, TextRows
from cnpgen.problems.constraints.joint import judged_torque
from cnpgen.problems.problem_record import as_record, open_problem
from cnpgen.robots.drive import RIGID
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.dataset_summary import DatasetSummary
from cnpgen.store.field import Field
from cnpgen.store.scene_table import SCENE_ARRAYS
from cnpgen.store.statistics import FieldStatistics

# Size categories of Hugging Face: below 10^3 rows, below 10^4 rows, and so on.
_SIZES = (
    "n<1K",
    "1K<n<10K",
    "10K<n<100K",
    "100K<n<1M",
    "1M<n<10M",
    "10M<n<100M",
    "100M<n<1B",
    "n>1B",
)

PARQUET = "parquet"  # folder of the Parquet view in a repository

_LOAD = """\
Each `.h5` file holds one dataset per field, of shape `(rows, width)` or `(rows,)`, raw and in SI units. With h5py
alone, in this folder:

```python
import glob

import h5py
import numpy as np


def load(split):
    shards = []
    for path in sorted(glob.glob(f"{split}/shard-*.h5")):
        with h5py.File(path) as file:
            shards.append({name: file[name][()] for name in file})
    return {name: np.concatenate([shard[name] for shard in shards]) for name in shards[0]}


rows = load("SPLIT")
```

`file[name].attrs` has the units, the names of the columns and their limits. With Hugging Face
datasets (`pip install datasets h5py`):

```text
datasets.load_dataset("./FOLDER")
```

With cnpgen, as batches for training:

```text
cnpgen.load_dataset("CNPGEN")
```
"""

_BEFORE_NOTES = ("split", "rows", "files")
_AFTER_NOTES = "## How it was made"

_VERIFY = """\
```text
cnpgen validate . --deep
```

checks every file against `manifest.json` and evaluates all constraints of every row again with Pinocchio and Coal,
independently of the code that made the dataset.
"""


def card_text(
    summary: DatasetSummary,
    *,
    created: str,
    folder: str,
    notes: str = "",
    shards: str = "",
    picture: str = "",
) -> str:
    """Return the card of a finished dataset; it depends on its rows, specification and date only.

    The folder is that of the dataset or its repository on the Hugging Face Hub, the
    notes are Markdown. A repository with a Parquet view in ``PARQUET`` has the shards
    in a folder, with a slash at its end, and the file of a picture.
    """
    spec = summary.spec
    source = f'"{folder}"' if shards else f'"./{folder}"'
    load = (
        _LOAD.replace('"./FOLDER"', source)
        .replace('f"{split}/', f'f"{shards}{{split}}/')
        .replace("CNPGEN", f"hf://datasets/{folder}@main" if shards else folder)
    )
    split = next(iter(summary.statistics))
    # Hugging Face reads equally many rows of all arrays only
    files = "" if spec.scene_obstacles else "{}/*.h5"
    sections = [
        _front_matter(summary, f"{PARQUET}/{{}}/*.parquet" if shards else files),
        f"# {spec.name} {spec.version}\n\n{spec.title or spec.name}\n\n{_contents(summary)}",
        notes.strip(),
        f"{_AFTER_NOTES}\n\n{_making(summary, created)}",
        f"![Distributions and positions of the samples]({picture})" if picture else "",
        f"## What a sample proves\n\n{what_samples_prove(spec)}",
        _under("Limits", limits_table(spec)),
        _under("Constraints, in SI units", constraint_table(spec)),
        f"## How to load it\n\n{load.replace('SPLIT', split)}",
        f"## Fields\n\n{_field_table(spec.fields)}",
        f"## Scenes\n\n{_scene_table(spec, shards)}" if spec.scene_obstacles else "",
        f"## Yield\n\n{_yield_table(summary)}",
        f"## Ranges ({split})\n\n{_range_table(spec.fields, summary.statistics[split])}",
        f"## How to verify it\n\n{_VERIFY.replace('validate .', f'validate {shards}') if shards else _VERIFY}",
        _origin(spec.recipe),
    ]
    return "\n\n".join(section.strip() for section in sections if section) + "\n"


def card_notes(card: str) -> str:
    """Return the notes in a card of ``card_text``; empty if there are none."""
    _, _, rest = card.partition(f"| {' | '.join(_BEFORE_NOTES)} |\n")
    # The end of the table.
    _, _, rest = rest.partition("\n\n")
    notes, _, _ = f"\n\n{rest}".rpartition(f"\n\n{_AFTER_NOTES}\n")
    return notes.strip()


def _origin(recipe: JsonMapping) -> str:
    """Return the authors and the citation of a recipe."""
    creator, citation = (
        str(recipe.get(key, "")).strip() for key in ("creator", "citation")
    )
    authors = f"Made by {creator}." if creator else ""
    quote = f"```text\n{citation}\n```" if citation else ""
    return (
        "\n\n".join(part for part in ("## Citation", authors, quote) if part)
        if authors or quote
        else ""
    )


def _front_matter(summary: DatasetSummary, files: str) -> str:
    """Return the YAML header for Hugging Face, with JSON strings.

    Without a pattern of files, there are no splits.
    """
    spec = summary.spec
    digits = len(str(sum(spec.splits.values())))
    size = _SIZES[min(max(digits - 3, 0), len(_SIZES) - 1)]
    lines = [f"license: {json.dumps(spec.license.lower())}"] if spec.license else []
    lines += [f"pretty_name: {json.dumps(spec.title or spec.name, ensure_ascii=False)}"]
    lines += [
        "task_categories:",
        "- robotics",
        "tags:",
        "- robotics",
        "- motion-planning",
        "- trajectory-optimization",
    ]
    lines += ["- cnpgen", "size_categories:", f'- "{size}"']
    if files:
        lines += ["configs:", "- config_name: default", "  data_files:"]
    for split, count in spec.splits.items():
        if count and files:
            lines += [f"  - split: {split}", f'    path: "{files.format(split)}"']
    return "\n".join(["---", *lines, "---"])


def _contents(summary: DatasetSummary) -> str:
    spec = summary.spec
    rows = [
        (f"`{split}`", f"{count:,}", len(summary.of_split(split)))
        for split, count in spec.splits.items()
    ]
    checks = "All rows satisfy all checks of the pipeline, which were made on the stored values."
    return f"{checks}\n\n{markdown_table(_BEFORE_NOTES, rows)}"


def _under(heading: str, text: str) -> str:
    """Return a section; empty without a text."""
    return f"## {heading}\n\n{text}" if text else ""


def _making(summary: DatasetSummary, created: str) -> str:
    spec = summary.spec
    facts = {
        "date": created.partition("T")[0],
        "recipe": f"sha256 `{spec.recipe_sha256}`, in full in `manifest.json`",
        "robot": str(spec.robot.get("name", "")),
        "frame": describe_frame(spec),
        "seed": str(spec.seed),
        "random numbers": spec.generator,
        "kernels": spec.backend,
        "stored as": spec.dtype,
        "torque": _torque(spec),
        "specification": f"fingerprint `{spec.fingerprint}`",
        "made with": ", ".join(
            f"{name} {version}" for name, version in spec.versions.items()
        ),
    }
    lines = [f"- {name}: {value}" for name, value in facts.items() if value]
    return (
        "\n".join(lines)
        + "\n\nThe same specification with the same versions gives the same bytes, for any number of workers."
    )


def _torque(spec: DatasetSpec) -> str:
    """Return which torque the problem limits, as 'cnpgen show' does; empty if it limits none."""
    stated = problem_of(spec)
    if "drive" in stated:
        problem, robot = open_problem(as_record(spec.problem))
        return judged_torque(problem.constraint, robot)
    kinds = {each.get("use") for each in stated.get("constraint", ())}
    return RIGID if "joint-torque" in kinds else ""


def _field_table(fields: Sequence[Field]) -> str:
    head = ("field", "unit", "width", "description", "role", "frame", "columns")
    rows = [
        (
            f"`{f.name}`",
            f.unit,
            f.width or "-",
            f.long_name,
            f.role,
            f.frame or "-",
            ", ".join(f.names) or "-",
        )
        for f in fields
    ]
    return markdown_table(head, rows)


def _scene_table(spec: DatasetSpec, shards: str) -> str:
    """Describe the scenes beside the rows of every shard.

    ``shards`` is that of ``card_text``.
    """
    only = f" The tables in `{PARQUET}/` have no scenes, only `scene_id`: the shards in `{shards}` have them."
    where = only if shards else ""
    head = ("HDF5 dataset", "unit", "shape", "description", "convention")
    symbols = {spec.scene_obstacles: "O", 1: "S"}
    rows = [
        (
            f"`{item.name}`",
            item.unit,
            " x ".join(
                symbols.get(size, str(size))
                for size in item.shape(1, spec.scene_obstacles)
            ),
            item.long_name,
            item.convention or "-",
        )
        for item in SCENE_ARRAYS
    ]
    families = ", ".join(
        f"{index} {name}" for index, name in enumerate(spec.scene_families)
    )
    return (
        f"Every shard has each of its S scenes once, in arrays for up to O = {spec.scene_obstacles} obstacles."
        " The scene of row `i` is `numpy.searchsorted(scene_ids, scene_id[i])`."
        f" Poses are in the frame of the robot's base.{where}\n\n{markdown_table(head, rows)}\n\nFamilies: {families}."
    )


def _yield_table(summary: DatasetSummary) -> str:
    sampling = summary.sampling
    counts = {
        "**tried**": sampling.tried,
        **sampling.rejections,
        "**accepted**": sampling.accepted,
    }
    rows = [
        (name, f"{count:,}", f"{100 * count / max(sampling.tried, 1):.3f} %")
        for name, count in counts.items()
    ]
    text = markdown_table(("outcome", "candidates", "share"), rows)
    if sampling.verification:
        worst = [
            (f"`{name}`", f"{value:.3g}")
            for name, value in sampling.verification.items()
        ]
        text += (
            "\n\nWorst violation in 32 rows of every shard, recomputed with Pinocchio and Coal, in SI units:\n\n"
            + markdown_table(("constraint", "worst"), worst)
        )
    return text


def _range_table(
    fields: Sequence[Field], statistics: dict[str, FieldStatistics]
) -> str:
    head = ("column", "unit", "min", "max", "mean", "std", "limits")
    rows = [
        row for field in fields for row in _range_rows(field, statistics[field.name])
    ]
    return markdown_table(head, rows)


def _range_rows(field: Field, statistics: FieldStatistics) -> TextRows:
    """Return one row per column of a field."""
    numbers = np.stack(
        [statistics.minimum, statistics.maximum, statistics.mean, statistics.std],
        axis=1,
    )
    rows = []
    for column, values in enumerate(numbers):
        name = (
            f"{field.name}.{field.names[column] if field.names else column}"
            if field.width
            else field.name
        )
        limits = [
            limit[column] for limit in (field.valid_min, field.valid_max) if limit
        ]
        text = f"{limits[0]:.6g} ... {limits[1]:.6g}" if len(limits) == 2 else "-"
        rows.append(
            (
                f"`{name}`",
                field.units[column],
                *(f"{value:.6g}" for value in values),
                text,
            )
        )
    return rows
