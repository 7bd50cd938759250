"""Memory of a running ``make-dataset`` and of its workers, from /proc."""

import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from common import progress

from cnpgen.store.dataset_spec import default_shard_size

MARKS = (0.1, 0.5, 1.0)  # of the rows


@dataclass
class Sample:
    """Memory of the processes of a run at one time.

    Attributes:
        done: Fraction of the committed rows.
        seconds: Time since the start [s].
        peaks: Process id -> ("maker" or "worker", peak of its resident memory [MiB], resident memory now [MiB]).
    """

    done: float
    seconds: float
    peaks: dict[int, tuple[str, float, float]]


def sample_memory(
    process: "subprocess.Popen[bytes]", out: Path, rows: int
) -> list[Sample]:
    """Sample a run until it ends; return the samples at ``MARKS``, the last one just before the end."""
    start, latest = time.perf_counter(), Sample(0.0, 0.0, {})
    samples: list[Sample] = []
    while process.poll() is None:
        peaks = memory(process.pid)
        if any(kind == "worker" for kind, _, _ in peaks.values()):
            latest = Sample(
                committed(out, rows) / rows, time.perf_counter() - start, peaks
            )
        if len(samples) < len(MARKS) - 1 and latest.done >= MARKS[len(samples)]:
            samples.append(latest)
            progress(f"{latest.done:.0%} after {latest.seconds:.1f} s")
        time.sleep(0.05)
    return [*samples, latest]


def committed(out: Path, rows: int) -> int:
    """Count the rows of the committed shards, all counted with full size."""
    return min(len(list(out.glob("*/shard-*.json"))) * default_shard_size(rows), rows)


def memory(pid: int) -> dict[int, tuple[str, float, float]]:
    """Read the memory of a process and of its workers."""
    sizes_of = {}
    for child in (pid, *children(pid)):
        try:
            command = Path(f"/proc/{child}/cmdline").read_text(
                encoding="utf-8", errors="replace"
            )
            status = dict(
                line.split(":", 1)
                for line in Path(f"/proc/{child}/status").read_text().splitlines()
            )
            sizes = [int(status[name].split()[0]) / 1024 for name in ("VmHWM", "VmRSS")]
        except (OSError, KeyError, ValueError):
            continue  # the process has ended
        kind = (
            "maker"
            if child == pid
            else "worker"
            if "popen_loky" in command
            else "other"
        )
        if kind != "other":
            sizes_of[child] = (kind, sizes[0], sizes[1])
    return sizes_of


def children(pid: int) -> list[int]:
    """List the descendants of a process."""
    try:
        text = "".join(
            path.read_text() for path in Path(f"/proc/{pid}/task").glob("*/children")
        )
    except OSError:
        return []
    direct = [int(word) for word in text.split()]
    return [
        *direct,
        *(grandchild for child in direct for grandchild in children(child)),
    ]
