"""Finished datasets with all documents, as ``make_dataset`` finishes them."""

from pathlib import Path
from typing import Any

from cnpgen.make.dataset_documents import dataset_documents
from cnpgen.store import manifest
from cnpgen.store.dataset_spec import DatasetSpec


def finalize(folder: Path, spec: DatasetSpec, *, notes: str = "") -> dict[str, Any]:
    """Write statistics, documents and manifest of a dataset whose shards exist."""
    return manifest.finalize(folder, spec, notes=notes, documents=dataset_documents())
