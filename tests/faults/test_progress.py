"""Long runs of faults continue where they were interrupted, on the same sources only."""

import json
from collections import Counter
from pathlib import Path

from tests.faults import progress
from tests.faults.progress import Part, load_progress, save_progress


def test_a_run_continues_with_its_seed_and_counts(tmp_path: Path) -> None:
    path = tmp_path / "progress.json"
    begun = load_progress(path, None)
    part = begun.parts["inputs"] = Part()
    for first in (0, 5):
        assert part.next == first
        part.add(Part(5, first + 5, Counter({"urdf, read": 2}), [f"finding {first}"]))
    save_progress(begun, path)
    assert load_progress(path, None) == begun
    assert load_progress(path, begun.seed) == begun
    assert (part.done, part.counts["urdf, read"]) == (10, 4)
    assert part.findings == ["finding 0", "finding 5"]
    assert load_progress(path, begun.seed + 1).parts == {}


def test_a_change_of_the_sources_begins_a_run_with_another_seed(tmp_path: Path) -> None:
    path = tmp_path / "progress.json"
    begun = load_progress(path, None)
    save_progress(begun, path)
    content = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**content, "sources": "0" * 64}), encoding="utf-8")
    fresh = load_progress(path, None)
    assert fresh.parts == {}
    assert fresh.seed != begun.seed
    assert fresh.sources == progress.source_sha256()
