"""Make the page where the reader moves the puck: python docs/puck_page.py FILE.html (extra `compiler`).

    python docs/puck_page.py build/puck.html

The planner of airhockey-hit is exported to C, compiled to WebAssembly by zig, and
embedded in the page, which needs no server and no other file.
"""

import argparse
import base64
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from cnpgen.addons.deploy.c_source import CODES
from cnpgen.addons.deploy.export_planner import planner_files, write_planner
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model_file import find_model, load_model
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem

STATIC = Path(__file__).with_name("static")
MODEL = "airhockey-hit"
EXPORTS = ("numbers", "plan", "duration", "path", "violations", "state")
START_XY_M = (0.65, 0.0)  # in the middle of the starts of the pipeline
OPTIONS = ("-O2", "-msimd128", "-fno-math-errno", "-fno-trapping-math")
MAX_BYTES = 1_000_000


def planner_module(folder: Path) -> bytes:
    """Export and compile the planner in a folder; return the WebAssembly."""
    files = planner_files(find_model(MODEL))
    source = write_planner(files, folder)[0]
    sources = [str(source), str(STATIC / "puck-page.c")]
    command = [sys.executable, "-m", "ziglang", "cc", "-target", "wasm32-wasi"]
    command += ["-mexec-model=reactor", "-std=c11", *OPTIONS, f"-I{folder}", *sources]
    command += [f"-Wl,--export={name}" for name in EXPORTS]
    command += ["-Wl,--strip-all", "-o", str(folder / "planner.wasm")]
    subprocess.run(command, check=True)
    return (folder / "planner.wasm").read_bytes()


def page_data(module: bytes) -> dict[str, Any]:
    """Return the constants of the page: the module, the robot and the table."""
    model = load_model(find_model(MODEL))
    with loaded_problem(model.problem, "numpy") as loaded:
        robot, problem = loaded.robot, loaded.problem
        spec = problem.trajectory
        chain = [
            {
                "rotation": joint.rotation.ravel().tolist(),
                "translation": joint.translation.tolist(),
                "axis": joint.axis.tolist(),
            }
            for joint in robot.chain.joints
        ]
        return {
            "wasm": base64.b64encode(module).decode(),
            "chain": chain,
            "tip": robot.chain.tip_translation.tolist(),
            "home": robot.home.tolist(),
            "rated": robot.rated_velocity.tolist(),
            "velocity": robot.velocity_limit.tolist(),
            "acceleration": robot.acceleration_limit.tolist(),
            "pathNumbers": spec.path_control_points * robot.n,
            "constraints": [type(each).__name__ for each in problem.constraint],
            "codes": list(CODES.values()),
            **_places(problem),
        }


def _places(problem: Problem) -> dict[str, Any]:
    """Return the bounds of the table and the sizes of mallet and puck [m]."""
    table = next(each for each in problem.constraint if isinstance(each, Table))
    puck = next(each for each in problem.constraint if isinstance(each, PuckContact))
    return {
        "x": [table.x.low, table.x.high],
        "y": [table.y.low, table.y.high],
        "z": table.z,
        "start": [*START_XY_M, table.z],
        "contact": puck.contact_distance,
        "mallet": puck.mallet_radius,
        "puck": puck.puck_radius,
    }


def page_text(module: bytes) -> str:
    """Return the page."""
    data = json.dumps(page_data(module), separators=(",", ":")).replace("<", "\\u003c")
    template = (STATIC / "puck-page.html").read_text(encoding="utf-8")
    return template.replace("/*DATA*/", data)


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path, metavar="FILE.html")
    target: Path = parser.parse_args().page
    with tempfile.TemporaryDirectory() as folder:
        text = page_text(planner_module(Path(folder)))
    if len(text.encode()) > MAX_BYTES:
        sys.exit(f"the page has {len(text.encode()):,} bytes, more than {MAX_BYTES:,}")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(text, encoding="utf-8")
    print(target)


if __name__ == "__main__":
    main()
