"""The card of a dataset: the README.md that people and the Hugging Face hub read."""

import json
from collections.abc import Sequence

import numpy as np

from cnpgen.store.field import Field
from cnpgen.store.statistics import FieldStatistics
from cnpgen.store.summary import Summary

_SIZES = (
    (10**3, "n<1K"),
    (10**4, "1K<n<10K"),
    (10**5, "10K<n<100K"),
    (10**6, "100K<n<1M"),
    (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"),
    (10**9, "100M<n<1B"),
)

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
"""

_BEFORE_NOTES, _AFTER_NOTES = ("split", "rows", "files"), "## How it was made"

_VERIFY = """\
```text
cnpgen validate . --deep
```

checks every file against `manifest.json` and computes every row's constraints again with Pinocchio and Coal, sharing no
code with what made them.
"""


def card_text(summary: Summary, *, folder: str, notes: str = "") -> str:
    """Write the card of a finished dataset; it depends on rows and blueprint only, not on when or where they were made.

    Args:
        summary: The finished shards.
        folder: Name of the dataset's folder.
        notes: Text about the dataset to include, Markdown.
    """
    blueprint = summary.blueprint
    split = next(iter(summary.statistics))
    sections = [
        _front_matter(summary),
        f"# {blueprint.name} {blueprint.version}\n\n{blueprint.title or blueprint.name}\n\n{_contents(summary)}",
        notes.strip(),
        f"{_AFTER_NOTES}\n\n{_making(summary)}",
        f"## How to load it\n\n{_LOAD.replace('SPLIT', split).replace('FOLDER', folder)}",
        f"## Fields\n\n{_field_table(blueprint.fields)}",
        f"## Yield\n\n{_yield_table(summary)}",
        f"## Ranges ({split})\n\n{_range_table(blueprint.fields, summary.statistics[split])}",
        f"## How to verify it\n\n{_VERIFY}",
    ]
    return "\n\n".join(section.strip() for section in sections if section) + "\n"


def card_notes(card: str) -> str:
    """Return the notes in a card that ``card_text`` wrote; nothing where there are none."""
    _, _, rest = card.partition(f"| {' | '.join(_BEFORE_NOTES)} |\n")
    _, _, rest = rest.partition("\n\n")  # the end of the table
    notes, _, _ = f"\n\n{rest}".rpartition(f"\n\n{_AFTER_NOTES}\n")
    return notes.strip()


def _front_matter(summary: Summary) -> str:
    """Write the YAML that makes the folder a dataset of Hugging Face; JSON strings are YAML strings."""
    blueprint = summary.blueprint
    rows = sum(blueprint.splits.values())
    size = next((name for limit, name in _SIZES if rows < limit), "n>1B")
    lines = [f"license: {json.dumps(blueprint.license.lower())}"] if blueprint.license else []
    lines += [f"pretty_name: {json.dumps(blueprint.title or blueprint.name, ensure_ascii=False)}"]
    lines += ["task_categories:", "- robotics", "tags:", "- robotics", "- motion-planning", "- trajectory-optimization"]
    lines += ["- cnpgen", "size_categories:", f'- "{size}"', "configs:", "- config_name: default", "  data_files:"]
    for split, count in blueprint.splits.items():
        if count:
            lines += [f"  - split: {split}", f'    path: "{split}/*.h5"']
    return "\n".join(["---", *lines, "---"])


def _contents(summary: Summary) -> str:
    blueprint = summary.blueprint
    rows = [(f"`{split}`", f"{count:,}", len(summary.of_split(split))) for split, count in blueprint.splits.items()]
    proven = (
        "Every row passed every stage of its pipeline; the problem's constraints were evaluated on the stored numbers."
    )
    return f"{proven}\n\n{_table(_BEFORE_NOTES, rows)}"


def _making(summary: Summary) -> str:
    blueprint = summary.blueprint
    facts = {
        "recipe": f"sha256 `{blueprint.recipe_sha256}`, in full in `manifest.json`",
        "robot": str(blueprint.robot.get("name", "")),
        "seed": str(blueprint.seed),
        "random numbers": blueprint.generator,
        "kernels": blueprint.backend,
        "stored as": blueprint.dtype,
        "blueprint": f"fingerprint `{blueprint.fingerprint}`",
        "made with": ", ".join(f"{name} {version}" for name, version in blueprint.versions.items()),
    }
    lines = [f"- {name}: {value}" for name, value in facts.items() if value]
    return (
        "\n".join(lines)
        + "\n\nThe same blueprint with the same versions gives the same bytes, however the work is shared out."
    )


def _field_table(fields: Sequence[Field]) -> str:
    head = ("field", "unit", "width", "what", "role", "frame", "columns")
    rows = [
        (f"`{f.name}`", f.unit, f.width or "-", f.long_name, f.role, f.frame or "-", ", ".join(f.names) or "-")
        for f in fields
    ]
    return _table(head, rows)


def _yield_table(summary: Summary) -> str:
    fates = summary.fates
    counts = {"**tried**": fates.tried, **fates.rejections, "**accepted**": fates.accepted}
    rows = [(name, f"{count:,}", f"{100 * count / max(fates.tried, 1):.3f} %") for name, count in counts.items()]
    text = _table(("fate", "draws", "share"), rows)
    if fates.verification:
        worst = [(f"`{name}`", f"{value:.3g}") for name, value in fates.verification.items()]
        text += (
            "\n\nWorst violation in 32 rows of every shard, recomputed with Pinocchio and Coal, in SI units:\n\n"
            + _table(("constraint", "worst"), worst)
        )
    return text


def _range_table(fields: Sequence[Field], statistics: dict[str, FieldStatistics]) -> str:
    head = ("column", "unit", "min", "max", "mean", "std", "limits")
    rows = [row for field in fields for row in _range_rows(field, statistics[field.name])]
    return _table(head, rows)


def _range_rows(field: Field, found: FieldStatistics) -> list[tuple[str, ...]]:
    """Return a row per column of a field."""
    numbers = np.stack([found.minimum, found.maximum, found.mean, found.std], axis=1)
    rows = []
    for column, values in enumerate(numbers):
        name = f"{field.name}.{field.names[column] if field.names else column}" if field.width else field.name
        limits = [limit[column] for limit in (field.valid_min, field.valid_max) if limit]
        text = f"{limits[0]:.6g} ... {limits[1]:.6g}" if len(limits) == 2 else "-"
        rows.append((f"`{name}`", field.units[column], *(f"{value:.6g}" for value in values), text))
    return rows


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay out a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)
