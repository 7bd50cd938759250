"""Sealed documents as a forger changes them: opened, changed and sealed again."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cnpgen.store.files.documents import save_document


def unsealed(path: Path) -> dict[str, Any]:
    """Read a document without its seal."""
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    del document["self_sha256"]
    return document


def rewritten(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Change a document and seal it again."""
    document = unsealed(path)
    change(document)
    save_document(path, document)
