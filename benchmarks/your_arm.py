"""Other arms: every command of docs/tutorials/your-arm.md, literally, with the URDF and the tip replaced.

The robots come with the package example-robot-data; the project ships none of them. Commands for optional packages that
are not installed are omitted. An arm completes the page if every command has the exit code 0.

    python benchmarks/your_arm.py
    python benchmarks/your_arm.py --arms z1 kinova --timeout 3600
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from common import arguments, progress, report, table, verdict

PAGE = Path(__file__).parents[1] / "docs" / "tutorials" / "your-arm.md"
ARMS = {  # name -> URDF in the package, tip
    "z1": ("z1_description/urdf/z1.urdf", "gripperStator"),
    "kinova": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "ur10": ("ur_description/urdf/ur10_robot.urdf", "tool0"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link7"),
    "so101": ("so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
}
TARGET = 5  # arms that complete the page
BLOCK = re.compile(r"(?:<!-- library: (\w+) -->\n)?```bash\n(.*?)```", re.DOTALL)


def commands() -> list[str]:
    """Return the blocks of the page without the URDF of its example, and without those of missing packages."""
    blocks = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    return [text for library, text in blocks[1:] if not library or find_spec(library)]


def robots() -> Path:
    """Return the folder of the robots."""
    share = metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share")
    return Path(str(share)) / "example-robot-data" / "robots"


def complete(name: str, urdf: Path, tip: str, seconds: float) -> dict[str, Any]:
    """Run the commands of the page for one arm, up to the first that fails."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment, started, done = {**os.environ, "PATH": path, "OMP_NUM_THREADS": "1"}, time.monotonic(), 0
    blocks, outcome = commands(), "completed"
    with tempfile.TemporaryDirectory(prefix="cnpgen-arm-") as folder:
        for block in blocks:
            text = block.replace("turret.urdf", str(urdf)).replace("--tip tool", f"--tip {tip}").replace("turret", name)
            left = seconds - (time.monotonic() - started)
            try:
                subprocess.run(
                    ["bash", "-e", "-c", text],
                    cwd=folder,
                    env=environment,
                    timeout=left,
                    capture_output=True,
                    check=True,
                )
            except subprocess.TimeoutExpired:
                outcome = f"not finished within {seconds:g} s"
            except subprocess.CalledProcessError as error:
                lines = error.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
                outcome = f"exit code {error.returncode}: {lines[-1]:.120}"
            if outcome != "completed":
                break
            done += 1
            progress(f"{name}: {done} of {len(blocks)} blocks")
    return {"arm": name, "blocks": done, "of": len(blocks), "outcome": outcome}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--arms", nargs="+", choices=tuple(ARMS), default=[*ARMS])
    parser.add_argument("--timeout", type=float, default=3600, help="seconds per arm")


def main() -> None:
    chosen = arguments(__doc__, options)
    rows = [complete(name, robots() / ARMS[name][0], ARMS[name][1], chosen.timeout) for name in chosen.arms]
    count = sum(row["outcome"] == "completed" for row in rows)
    cells = [(row["arm"], f"{row['blocks']} of {row['of']}", row["outcome"]) for row in rows]
    total = ("arms that complete the page", str(count), " ".join(verdict(count, min(TARGET, len(rows)))))
    report({"arms": rows}, [table("other arms", ("arm", "blocks", "outcome"), [*cells, total])], as_json=chosen.json)


if __name__ == "__main__":
    main()
