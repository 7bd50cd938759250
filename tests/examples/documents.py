"""Changing documents and recomputing their checksums, as a forger does."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cnpgen.store.files.documents import save_document


def read_unverified(path: Path) -> dict[str, Any]:
    """Read a document without verifying its checksum."""
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    del document["self_sha256"]
    return document


def rewritten(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change a document and recompute its checksum."""
    document = read_unverified(path)
    change(document)
    save_document(path, document)
