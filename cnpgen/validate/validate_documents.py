"""Consistency of the documents of a dataset: digest of the recipe, and statistics of the shards."""

from pathlib import Path

from cnpgen.errors import DatasetError
from cnpgen.make.recipe import resolved_digest
from cnpgen.store.check import REPLACE_HINT, Finding
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.dataset_summary import (
    STATS_FORMAT,
    STATS_STRUCTURE,
    STATS_VERSION,
    stats_document,
    summarize_dataset,
)
from cnpgen.store.files.documents import load_document, plain
from cnpgen.store.intact import RERUN_HINT
from cnpgen.store.layout import SPECIFICATION, STATS


def check_recipe(spec: DatasetSpec) -> list[Finding]:
    """Check that the recipe in a specification has the recorded sha256."""
    try:
        digest = resolved_digest(spec.recipe["pipeline"], str(spec.robot["urdf"]).encode())
    except (KeyError, TypeError, AttributeError):
        return [Finding(SPECIFICATION, "its recipe cannot be read", hint=REPLACE_HINT)]
    if digest == spec.recipe_sha256:
        return []
    return [
        Finding(
            SPECIFICATION,
            f"its recipe has the sha256 {digest}, not the recorded {spec.recipe_sha256}",
            hint=REPLACE_HINT,
        )
    ]


def check_statistics(folder: Path, spec: DatasetSpec) -> list[Finding]:
    """Check that ``stats.json`` is the summary of the records of all shards; these must exist."""
    try:
        document = load_document(folder / STATS, STATS_FORMAT, version=STATS_VERSION, structure=STATS_STRUCTURE)
        expected = plain(stats_document(summarize_dataset(folder, spec)))
    except DatasetError:  # missing or damaged files are findings already
        return []
    different = [key for key in expected if document.get(key) != expected[key]]
    if not different:
        return []
    hint = f"delete {STATS} and {RERUN_HINT}: it writes the file again"
    return [
        Finding(STATS, f"is not the summary of the records of the shards: {', '.join(different)} differ", hint=hint)
    ]
