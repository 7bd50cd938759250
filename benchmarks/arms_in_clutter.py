"""Arms in clutter: CPU time of new scenes as ratios to the Panda's median of another checkout, in one run.

    python benchmarks/arms_in_clutter.py --folder FOLDER --base CHECKOUT --fetch fetch.urdf

Results are stored in FOLDER/results.json after every family, and a second call goes on with those that are missing.

The families are tables, shelves, boxes and cages of benchmarks/scenes.py. Each tree solves the problems of one robot
and family in one process and thread, with its own benchmarks/scenes.py, right after the other tree. The set-up of a
scene is part of its time. Pinocchio and Coal check valid plans on the meshes of the URDF. The Fetch, whose URDF
is not in example-robot-data, stands lower: its scenes are moved, and have no table around its torso.
"""

import argparse
import json
import os
import subprocess
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from common import arguments, progress, report, table
from scenes import PANDA, PROBLEM

HERE = Path(__file__).parents[1]
FAMILIES = ("table", "shelf", "boxes", "cage")
PANDA_NAME = "panda"
UR5_GRIPPER = PROBLEM.format(
    robot="""urdf = "package://example-robot-data/robots/ur_description/urdf/ur5_gripper.urdf"
joints = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
tip = "tool0"
base = "[0, -90, 90, -90, -90, 0] deg"
convex_parts = 4
decomposed = ["base_link", "upper_arm_link", "forearm_link", "wrist_2_link", "wrist_3_link"]
""",
    limits='acceleration_rate = "10 1/s"\nacceleration_cap = "20 rad/s^2"',
    payload="",
)
FETCH = """urdf = "{urdf}"
joints = [
  "torso_lift_joint", "shoulder_pan_joint", "shoulder_lift_joint", "upperarm_roll_joint", "elbow_flex_joint",
  "forearm_roll_joint", "wrist_flex_joint", "wrist_roll_joint",
]
tip = "gripper_link"
base = [0.2, 0.0, 0.0, 0.0, 0.5, 0.0, 0.5, 0.0]
convex_parts = 4
decomposed = [
  "torso_lift_link", "shoulder_lift_link", "wrist_roll_link", "gripper_link", "r_gripper_finger_link",
  "l_gripper_finger_link",
]
"""
FETCH_LIMITS = """acceleration_rate = "10 1/s"
acceleration_cap = "20 rad/s^2"
position = [
  [0.0, 0.386], [-1.606, 1.606], [-1.221, 1.518], [-3.14, 3.14], [-2.251, 2.251], [-3.14, 3.14], [-2.16, 2.16],
  [-3.14, 3.14],
]"""
FETCH_OFFSET_M = (0.15, 0.0, 0.45)  # of its scenes, which are made for arms on a table
# A tree's own modules solve the problems. Final code may still be generated in the background; an older checkout has
# no such module.
PROGRAM = """
import contextlib, dataclasses, json, sys
import numpy as np
import scenes

task = json.loads(sys.argv[1])
scenes.ROBOTS["arm"] = task["text"]
problem, robot, checker = scenes.loaded("arm")
offset, make = np.array(task["offset"]), scenes.FAMILIES[task["family"]]

def moved(random):
    scene = make(random)
    obstacles = [
        dataclasses.replace(each, position=tuple(float(x) for x in each.position + offset))
        for each in scene.obstacles
        if not (offset.any() and task["family"] == "cage" and each.name == "table")
    ]
    regions = [tuple(tuple(corner + offset) for corner in region) for region in scene.regions]
    return scenes.GeneratedScene(tuple(obstacles), tuple(regions))

scenes.FAMILIES[task["family"]] = moved
sampler = scenes.EndSampler(problem, robot, checker)
with np.errstate(all="ignore"):
    problems = list(scenes.generate(problem, sampler, task["family"], task["count"], task["seed"]))
    scenes.solve_scene(*problems[0])
    with contextlib.suppress(ImportError):
        from cnpgen.kernels.optimizer import replacer

        replacer.wait(300)
    solved = [scenes.solve_scene(*each) for each in problems[1:]]
    found = {
        "cpu": [each.cpu for each in solved],
        "valid": [bool(each.attempt.valid) for each in solved],
        "duration": [float(each.attempt.cost) for each in solved],
        "reasons": [str(each.attempt.reason) for each in solved if not each.attempt.valid],
    }
    if task["meshes"]:
        found["contacts"] = scenes.check_meshes(problem, solved)["with contact"]
    if task["seconds"]:
        found["reference"] = scenes.search_reference(problem, solved, task["seconds"])["with a path"]
print(json.dumps(found))
"""


def solve(tree: Path, text: str, family: str, options: argparse.Namespace) -> dict[str, Any]:  # fmt: skip
    """Solve problems of a family with a tree; return CPU times, verdicts, durations and contacts."""
    is_fetch = "torso_lift_joint" in text
    task = {
        "text": text,
        "offset": FETCH_OFFSET_M if is_fetch else (0.0, 0.0, 0.0),
        "family": family,
        "count": options.count + 1,
        "seed": options.seed,
        "meshes": tree == HERE,
        "seconds": options.reference if tree == HERE else 0.0,
    }
    paths = [str(tree), str(tree / "benchmarks")]
    with TemporaryDirectory() as folder:
        program = Path(folder) / "solve_scenes.py"
        program.write_text(PROGRAM, encoding="utf-8")
        done = subprocess.run(
            [tree / ".venv/bin/python", program, json.dumps(task)],
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join(paths),
                "OMP_NUM_THREADS": "1",
            },
            stdout=subprocess.PIPE,
            check=True,
        )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def figures(
    here: list[dict[str, Any]], base: list[dict[str, Any]], unit: float
) -> dict[str, float]:
    """Return the figures of a robot from the results of its families; ``unit`` is the Panda's median [s].

    The median is that of the base, if there is one.
    """

    def joined(results: list[dict[str, Any]], key: str) -> Any:
        return np.concatenate([each[key] for each in results])

    cpu, valid = joined(here, "cpu"), joined(here, "valid").astype(bool)
    found = {
        "problems": len(cpu),
        "valid": int(valid.sum()),
        "contacts of the meshes": sum(each["contacts"] for each in here),
        "RRT-Connect solves others": sum(each.get("reference", 0) for each in here),
        "median [s]": float(np.median(cpu)),
        "p99 [s]": float(np.percentile(cpu, 99)),
        "largest [s]": float(cpu.max()),
        "median / Panda's median": float(np.median(cpu)) / unit,
        "p99 / Panda's median": float(np.percentile(cpu, 99)) / unit,
    }
    if base:
        old, old_valid = joined(base, "cpu"), joined(base, "valid").astype(bool)
        both = valid & old_valid
        ratios = joined(here, "duration")[both] / joined(base, "duration")[both]
        found |= {
            "base: valid": int(old_valid.sum()),
            "base: valid, but not here": int((old_valid & ~valid).sum()),
            "base: median / its Panda's": float(np.median(old)) / unit,
            "base: p99 / its Panda's median": float(np.percentile(old, 99)) / unit,
            "duration / base, median": float(np.median(ratios)),
            "duration / base, mean": float(ratios.mean()),
        }
    return found


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--base", type=Path, help="another checkout to compare with, with .venv")
    option("--folder", type=Path, required=True, help="where results are stored")
    option("--fetch", type=Path, help="URDF of a Fetch on a fixed base, with absolute paths of meshes")  # fmt: skip
    option("--families", nargs="*", default=list(FAMILIES), choices=FAMILIES)
    option("--count", type=int, default=75, help="problems of every family")
    option("--seed", type=int, default=29_112_903, help="seed of the scenes")
    option("--reference", type=float, default=0.0, metavar="S", help="CPU time of RRT-Connect [s]")  # fmt: skip


def main() -> None:
    """Solve what is missing and print the table."""
    chosen = arguments(__doc__, options)
    robots = {PANDA_NAME: PANDA, "ur5-gripper": UR5_GRIPPER}
    if chosen.fetch:
        robot = FETCH.format(urdf=chosen.fetch.resolve())
        robots["fetch"] = PROBLEM.format(robot=robot, limits=FETCH_LIMITS, payload="")
    trees = {"here": HERE, **({"base": chosen.base.resolve()} if chosen.base else {})}
    chosen.folder.mkdir(parents=True, exist_ok=True)
    store = chosen.folder / "results.json"
    solved = json.loads(store.read_text()) if store.exists() else {}
    for (name, text), family in product(robots.items(), chosen.families):
        for label, tree in trees.items():
            key = f"{name}, {family}, {label}"
            if key not in solved:
                progress(key)
                solved[key] = solve(tree, text, family, chosen)
                store.write_text(json.dumps(solved, indent=1))
    chosen_results = {
        (name, label): [
            solved[f"{name}, {family}, {label}"] for family in chosen.families
        ]
        for name, label in product(robots, trees)
    }
    reference = "base" if chosen.base else "here"
    times = [each["cpu"] for each in chosen_results[PANDA_NAME, reference]]
    unit = float(np.median(np.concatenate(times)))
    compared = {
        name: figures(chosen_results[name, "here"], chosen_results.get((name, "base"), []), unit)
        for name in robots
    }  # fmt: skip
    rows = [
        (figure, *(f"{values[figure]:,.4g}" for values in compared.values()))
        for figure in compared[PANDA_NAME]
    ]
    tables = [table("new scenes, CPU time with set-up", ("figure", *compared), rows)]
    report({"arms in clutter": compared}, tables, as_json=chosen.json)


if __name__ == "__main__":
    main()
