"""The progress of long runs of faults in a file: an interrupted run continues, and a change of the package starts anew."""

import hashlib
import json
import secrets
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import cnpgen

SOURCES = ("*.py", "*.c", "*.h", "*.html")
MAX_SEED = 10**9


@dataclass
class Part:
    """Progress of one kind of faults.

    Attributes:
        done: Number of faults so far.
        next: Index of the next fault or run.
        counts: Number of outcomes of each kind.
        findings: Findings, one line each.
    """

    done: int = 0
    next: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    findings: list[str] = field(default_factory=list)

    def add(self, block: "Part") -> None:
        """Add the outcomes of a block of faults, which begins at ``next``."""
        self.done += block.done
        self.next = block.next
        self.counts.update(block.counts)
        self.findings += block.findings


@dataclass
class Progress:
    """Progress of all kinds of faults on one state of the package.

    Attributes:
        sources: sha256 of the sources of the package.
        seed: Seed of all faults.
        parts: Kind -> its progress.
    """

    sources: str
    seed: int
    parts: dict[str, Part] = field(default_factory=dict)


def source_sha256() -> str:
    """Return the sha256 of the names and contents of the package's sources."""
    root = Path(cnpgen.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(path for kind in SOURCES for path in root.rglob(kind)):
        digest.update(str(path.relative_to(root)).encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def load_progress(path: Path | None, seed: int | None) -> Progress:
    """Read the progress of a run with the same sources and seed, or begin one.

    Without a seed, that of the file is used if the sources are those of the file; it is
    drawn otherwise, so that it is never older than a fix.
    """
    sources = source_sha256()
    if path is not None and path.exists():
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["sources"] == sources and seed in {None, content["seed"]}:
            parts = {
                name: Part(**{**part, "counts": Counter(part["counts"])})
                for name, part in content["parts"].items()
            }
            return Progress(sources, content["seed"], parts)
    return Progress(sources, secrets.randbelow(MAX_SEED) if seed is None else seed)


def save_progress(progress: Progress, path: Path | None) -> None:
    """Write the progress, whole or not at all."""
    if path is None:
        return
    new = path.with_name(f"{path.name}.part")
    parts = {name: vars(part) for name, part in progress.parts.items()}
    content = {**vars(progress), "parts": parts}
    new.write_text(json.dumps(content, indent=1), encoding="utf-8")
    new.replace(path)
