"""Make the pages where the reader moves a puck and a load: python docs/planner_pages.py FOLDER (extra `compiler`).

    python docs/planner_pages.py build/interactive

They are FOLDER/puck.html with the planner of airhockey-tables, and FOLDER/transport.html
with that of heavy-object-loads. Each planner is exported to C, compiled to WebAssembly by
zig, and embedded in its page, which needs no server and no other file.
"""

import argparse
import base64
import html
import json
import subprocess
import sys
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.addons.deploy.c_source import CODES
from cnpgen.addons.deploy.c_tape import point_function
from cnpgen.addons.deploy.export_planner import planner_files, write_planner
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.inference_pipeline import LoadedProblem, loaded_problem
from cnpgen.planner.model_file import find_model, load_model
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.constraints.table import Table
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot

SOURCES = Path(__file__).with_name("interactive")
EXPORTS = ("numbers", "plan", "duration", "path", "violations", "state")
START_XY_M = (0.65, 0.0)  # in the middle of the starts of the pipeline
EXAMPLES = 200  # pairs of configurations near which those of a transport are sought
OPTIONS = ("-O2", "-msimd128", "-fno-math-errno", "-fno-trapping-math")
MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Page:
    """An interactive page; its script is NAME.js of ``SOURCES``.

    Attributes:
        model: The shipped model.
        title: The title.
        introduction: Its first paragraph.
    """

    model: str
    title: str
    introduction: str


PAGES = {
    "puck": Page(
        "airhockey-tables",
        "Move the puck",
        "Drag the puck (blue) or the target (green), and move the table.",
    ),
    "transport": Page(
        "heavy-object-loads",
        "Move the load",
        "Drag the start (blue) or the goal (green) of the load, and change its mass.",
    ),
}


def torque(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, dq, ddq, scene) -> torques`` of the rigid body with the load of the scene [N m]."""
    import casadi as ca

    columns, state = SymbolicState.of_symbols(
        robot, tuple(problem.obstacle), problem.object_size, problem.scene_width
    )
    return ca.Function("torque", columns, [ca.vertcat(*state.torque)])


def planner_module(model: str, folder: Path) -> bytes:
    """Export and compile a planner in a folder; return the WebAssembly."""
    source = write_planner(planner_files(find_model(model)), folder)[0]
    with loaded_problem(load_model(find_model(model)).problem, "numpy") as loaded:
        dynamics = point_function(loaded.kernels.tape(torque), "torque")
    functions = (SOURCES / "page.c").read_text(encoding="utf-8")
    functions = functions.replace("NAME_", f"{source.stem}_")
    text = f'#include "{source.name}"\n{dynamics}\n{functions}'
    (folder / "page.c").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "ziglang", "cc", "-target", "wasm32-wasi"]
    command += ["-mexec-model=reactor", "-std=c11", *OPTIONS, str(folder / "page.c")]
    command += [f"-Wl,--export={name}" for name in EXPORTS]
    command += ["-Wl,--strip-all", "-o", str(folder / "planner.wasm")]
    subprocess.run(command, check=True)
    return (folder / "planner.wasm").read_bytes()


def page_data(page: Page, module: bytes) -> dict[str, Any]:
    """Return the constants of a page: the module, the robot and its task."""
    model = load_model(find_model(page.model))
    packer = zlib.compressobj(9, wbits=-15)  # DEFLATE without a header
    deflated = packer.compress(module) + packer.flush()
    with loaded_problem(model.problem, "numpy") as loaded:
        robot, problem = loaded.robot, loaded.problem
        chain = robot.chain
        parameters = problem.parameters
        return {
            "wasm": base64.b64encode(deflated).decode(),
            "wasmBytes": len(module),
            "chain": [
                {
                    "rotation": joint.rotation.ravel().tolist(),
                    "translation": joint.translation.tolist(),
                    "axis": joint.axis.tolist(),
                }
                for joint in chain.joints
            ],
            "tip": chain.tip_translation.tolist(),
            "tipRotation": chain.tip_rotation.ravel().tolist(),
            "home": robot.home.tolist(),
            "rated": robot.rated_velocity.tolist(),
            "lower": robot.position_lower.tolist(),
            "upper": robot.position_upper.tolist(),
            "velocity": robot.velocity_limit.tolist(),
            "acceleration": robot.acceleration_limit.tolist(),
            "torque": robot.torque_limit.tolist(),
            "pathNumbers": problem.trajectory.path_control_points * robot.n,
            "constraints": [type(each).__name__ for each in problem.constraint],
            "codes": list(CODES.values()),
            "ranges": {
                name: [span.low, span.high]
                for name, span in zip(parameters.names, parameters.ranges, strict=True)
            },
            **(_hit(problem) if problem.object is None else _transport(page, loaded)),
        }


def _hit(problem: Problem) -> dict[str, Any]:
    """Return the bounds of the table, its pivot, and the sizes of mallet and puck [m]."""
    table = next(each for each in problem.constraint if isinstance(each, Table))
    puck = next(each for each in problem.constraint if isinstance(each, PuckContact))
    return {
        "x": [table.x.low, table.x.high],
        "y": [table.y.low, table.y.high],
        "z": table.z,
        "pivot": problem.table_origin.tolist(),
        "start": [*START_XY_M, table.z],
        "contact": puck.contact_distance,
        "mallet": puck.mallet_radius,
        "puck": puck.puck_radius,
    }


def _transport(page: Page, loaded: LoadedProblem) -> dict[str, Any]:
    """Return the object, the pedestals, and examples: configurations and positions of the object at both ends."""
    assert loaded.problem.object is not None
    boundary = draw_boundary_problems(page.model, EXAMPLES, seed=1).boundary
    ends = [boundary.start_q, boundary.goal_q]
    tips = [loaded.robot.tip_positions(q) for q in ends]
    return {
        "object": list(loaded.problem.object.size),
        "pedestals": [
            [each.x.low, each.x.high, each.y.low, each.y.high]
            for each in loaded.problem.obstacle
            if each.x is not None and each.y is not None
        ],
        "examples": np.concatenate([*tips, *ends], axis=1).round(4).tolist(),
    }


def page_text(name: str, module: bytes) -> str:
    """Return a page of ``PAGES``."""
    page = PAGES[name]
    data = json.dumps(page_data(page, module), separators=(",", ":"))
    text = (SOURCES / "page.html").read_text(encoding="utf-8")
    for placeholder, value in {
        "@TITLE@": html.escape(page.title),
        "@INTRODUCTION@": html.escape(page.introduction),
        "@MODEL@": html.escape(page.model),
        "/*DATA*/": data.replace("<", "\\u003c"),
        "/*PAGE*/": (SOURCES / f"{name}.js").read_text(encoding="utf-8"),
    }.items():
        text = text.replace(placeholder, value)
    if len(text.encode()) > MAX_BYTES:
        size = len(text.encode())
        sys.exit(f"the page {name} has {size:,} bytes, more than {MAX_BYTES:,}")
    return text


def write_pages(folder: Path) -> list[Path]:
    """Write all pages into a folder; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, page in PAGES.items():
        with tempfile.TemporaryDirectory() as temporary:
            text = page_text(name, planner_module(page.model, Path(temporary)))
        (folder / f"{name}.html").write_text(text, encoding="utf-8")
    return [folder / f"{name}.html" for name in PAGES]


def main() -> None:
    """Write the pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    print(*write_pages(parser.parse_args().folder), sep="\n")


if __name__ == "__main__":
    main()
