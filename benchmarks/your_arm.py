"""Other arms: every command of docs/tutorials/your-arm.md, literally, with the URDF and the tip replaced.

The robots come with the package example-robot-data; the project ships none of them. Commands for optional packages that
are not installed are omitted. An arm completes the page if every command has the exit code 0.

    python benchmarks/your_arm.py
    python benchmarks/your_arm.py --arms z1 kinova --timeout 3600
    python benchmarks/your_arm.py --gaps --urdf fetch=fetch.urdf:gripper_link iiwa=model.urdf:lbr_iiwa_link_7

--gaps runs ``cnpgen init`` only. It prints the share of the random states without contact of the meshes that convex
hulls reject, and the share that the convex parts of the written problem reject.
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
GAP_ARMS = {  # whose convex parts are compared with their meshes
    **ARMS,
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "panda": ("panda_description/urdf/panda.urdf", "panda_hand"),
    "tiago": ("tiago_description/robots/tiago.urdf", "wrist_ft_tool_link"),
    "baxter": ("baxter_description/urdf/baxter.urdf", "left_gripper_base_link"),
}
MAX_GAP = 0.02
TARGET = 5  # arms that complete the page
BLOCK = re.compile(r"(?:<!-- library: (\w+) -->\n)?```bash\n(.*?)```", re.DOTALL)


def commands() -> list[str]:
    """Return the blocks of the page without the URDF of its example, and without those of missing packages."""
    blocks = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    return [text for library, text in blocks[1:] if not library or find_spec(library)]


def robots() -> Path:
    """Return the folder of the robots."""
    share = metadata.distribution("example-robot-data").locate_file(
        "cmeel.prefix/share"
    )
    return Path(str(share)) / "example-robot-data" / "robots"


def complete(name: str, urdf: Path, tip: str, seconds: float) -> dict[str, Any]:
    """Run the commands of the page for one arm, up to the first that fails."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment, started, done = (
        {**os.environ, "PATH": path, "OMP_NUM_THREADS": "1"},
        time.monotonic(),
        0,
    )
    blocks, outcome = commands(), "completed"
    with tempfile.TemporaryDirectory(prefix="cnpgen-arm-") as folder:
        for block in blocks:
            text = (
                block.replace("turret.urdf", str(urdf))
                .replace("--tip tool", f"--tip {tip}")
                .replace("turret", name)
            )
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
                lines = error.stderr.decode(errors="replace").strip().splitlines() or [
                    "no message"
                ]
                outcome = f"exit code {error.returncode}: {lines[-1]:.120}"
            if outcome != "completed":
                break
            done += 1
            progress(f"{name}: {done} of {len(blocks)} blocks")
    return {"arm": name, "blocks": done, "of": len(blocks), "outcome": outcome}


def gap(name: str, urdf: Path, tip: str) -> dict[str, Any]:
    """Write the recipes of one arm; return the shares of free states that hulls and convex parts reject."""
    from cnpgen.problems.problem_file import load_problem

    with tempfile.TemporaryDirectory(prefix="cnpgen-arm-") as folder:
        command = [
            sys.executable,
            "-m",
            "cnpgen",
            "init",
            name,
            "--urdf",
            str(urdf),
            "--tip",
            tip,
        ]
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            return {
                "arm": name,
                "outcome": f"{done.stderr.strip().splitlines()[-1]:.120}",
            }
        robot = load_problem(Path(folder) / name / "problem.toml").robot
    hulls = re.search(
        r"convex hulls of the meshes reject ([\d.]+)% of the states", done.stderr
    )
    return {
        "arm": name,
        "hulls": float(hulls[1]) / 100 if hulls else None,
        "parts": robot.hull_gap,
    }


def named_urdf(text: str) -> tuple[str, tuple[str, str]]:
    """Parse NAME=FILE:TIP."""
    name, _, place = text.partition("=")
    file, _, tip = place.rpartition(":")
    return name, (str(Path(file).resolve()), tip)


def report_gaps(found: dict[str, tuple[str, str]], *, as_json: bool) -> None:
    rows = []
    for name, (file, tip) in found.items():
        rows.append(gap(name, robots() / file, tip))
        progress(f"{name}: {rows[-1]}")
    cells = [
        (
            row["arm"],
            f"{row['hulls']:.2%}",
            f"{row['parts']:.2%}",
            *verdict(row["parts"], MAX_GAP, at_most=True),
        )
        if "parts" in row
        else (row["arm"], "", "", row["outcome"], "")
        for row in rows
    ]
    report(
        {"gaps": rows},
        [table("free states rejected", ("arm", "hulls", "parts", "target", ""), cells)],
        as_json=as_json,
    )


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--arms", nargs="+", choices=tuple(ARMS), default=[*ARMS])
    parser.add_argument("--timeout", type=float, default=3600, help="seconds per arm")
    parser.add_argument(
        "--gaps", action="store_true", help="measure the convex parts of links instead"
    )
    parser.add_argument(
        "--urdf", nargs="+", type=named_urdf, default=[], metavar="NAME=FILE:TIP"
    )


def main() -> None:
    chosen = arguments(__doc__, options)
    if chosen.gaps:
        report_gaps({**GAP_ARMS, **dict(chosen.urdf)}, as_json=chosen.json)
        return
    rows = [
        complete(name, robots() / ARMS[name][0], ARMS[name][1], chosen.timeout)
        for name in chosen.arms
    ]
    count = sum(row["outcome"] == "completed" for row in rows)
    cells = [
        (row["arm"], f"{row['blocks']} of {row['of']}", row["outcome"]) for row in rows
    ]
    total = (
        "arms that complete the page",
        str(count),
        " ".join(verdict(count, min(TARGET, len(rows)))),
    )
    report(
        {"arms": rows},
        [table("other arms", ("arm", "blocks", "outcome"), [*cells, total])],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
