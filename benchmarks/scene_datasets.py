"""Datasets of scenes: CPU time of their samples, and an independent check of certified plans on the URDF's meshes.

``rate`` computes blocks of panda-scenes in one process. ``meshes`` reads the shards of a certified dataset with h5py,
evaluates the plans with SciPy, and measures collisions of the URDF's meshes with the obstacles by Pinocchio and Coal.
"""

import argparse
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import coal
import h5py
import numpy as np
import pinocchio as pin
from common import arguments, progress, report, table
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from cnpgen.kernels.library import choose_backend
from cnpgen.make.certify import certified
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.problems.load_robot import load_robot

Array = NDArray[np.float64]
KINDS = ("box", "sphere", "cylinder", "capsule")
BENCHMARK_SPLIT = "benchmark"  # a split that no dataset has


def main() -> None:
    """Measure the rate, or check the plans of a folder."""
    options = arguments(__doc__, add_options)
    if options.part == "rate":
        results = measure_rate(
            options.blocks, options.seed, certify=options.certify, model=options.model
        )
    else:
        results = check_meshes(options.folder, options.plans, options.step)
    tables = [
        table("Result", list(results), [[str(value) for value in results.values()]])
    ]
    report(results, tables, as_json=options.json)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command line."""
    parser.add_argument("part", choices=("rate", "meshes"))
    parser.add_argument(
        "folder", nargs="?", type=Path, help="certified dataset, for meshes"
    )
    parser.add_argument(
        "--blocks", type=int, default=4, help="blocks of the rate (default: 4)"
    )
    parser.add_argument(
        "--certify", action="store_true", help="measure the rate of certified samples"
    )
    parser.add_argument(
        "--model", help="planner whose plans are initial guesses of certified samples"
    )
    parser.add_argument(
        "--seed", type=int, default=2, help="seed of the rate (default: 2)"
    )
    parser.add_argument(
        "--plans",
        type=int,
        default=10**9,
        help="number of checked plans (default: all)",
    )
    parser.add_argument(
        "--step",
        type=float,
        default=0.002,
        help="time between checked states [s] (default: 0.002)",
    )


def measure_rate(
    blocks: int, seed: int, *, certify: bool, model: str | None
) -> dict[str, float]:
    """Return the CPU time of blocks of panda-scenes after the first one, which loads all kernels."""
    recipe = load_dataset_recipe("panda-scenes")
    backend, cache = choose_backend(None)
    pipeline = certified(recipe, model=model).pipeline if certify else recipe.pipeline
    prepared = PreparedPipeline(pipeline, backend=backend, cache_folder=cache)
    prepared.block(seed, BENCHMARK_SPLIT, 0)
    begun, tried, scenes = time.process_time(), 0, 0
    for index in range(1, blocks + 1):
        block = prepared.block(seed, BENCHMARK_SPLIT, index)
        tried, scenes = tried + block.sampling.tried, scenes + len(block.scenes or ())
        progress(f"block {index}: {time.process_time() - begun:.1f} s of CPU time")
    seconds, rows = time.process_time() - begun, blocks * prepared.block_rows
    counts = {"samples": rows, "scenes": scenes, "candidates": tried}
    return counts | {
        "CPU time [s]": round(seconds, 2),
        "samples per second and core": round(rows / seconds, 1),
    }


def check_meshes(folder: Path, plans: int, step: float) -> dict[str, float]:
    """Return the number of plans with contacts of the meshes."""
    problem = load_dataset_recipe("panda-scenes").pipeline.problem
    robot, checked, states, contacts, depth = load_robot(problem), 0, 0, 0, 0.0
    assert robot.shape is not None
    left_out = {
        frozenset((pair.first, pair.second))
        for pair in robot.shape.pairs
        if pair.left_out
    }
    meshes = Meshes(problem.urdf_path.read_text(), robot.joint_names, left_out)
    for name, row, path, rate, obstacles in rows_of(folder, robot.n, plans):
        if obstacles is not meshes.obstacles:
            meshes.place(obstacles)
        q = plan_states(path, rate, problem.trajectory.degree, step)
        checked, states = checked + 1, states + len(q)
        if touching := [state for state in q if meshes.touch(state)]:
            contacts, depth = contacts + 1, max(depth, *map(meshes.depth, touching))
            progress(f"contact in row {row} of {name}")
        if checked % 100 == 0:
            progress(f"{checked} plans")
    counts = {"plans": checked, "states": states, "plans with contact": contacts}
    return counts | {"largest penetration [mm]": round(1000 * depth, 3)}


def rows_of(
    folder: Path, n: int, count: int
) -> Iterator[tuple[str, int, Array, Array, list[tuple[Any, Any]]]]:
    """Yield shard, row, path and rate control points, and the obstacles of up to ``count`` plans."""
    for shard in sorted(folder.glob("*/*.h5")):
        with h5py.File(shard) as file:
            scenes = np.searchsorted(file["scene_ids"][:], file["scene_id"][:])
            path, rate = file["path_control_points"][:], file["rate_control_points"][:]
            names = ("count", "kind", "size", "position", "quaternion")
            arrays = {name: file[f"obstacle_{name}"][:] for name in names}
        placed = [
            coal_obstacles({name: values[scene] for name, values in arrays.items()})
            for scene in range(scenes[-1] + 1)
        ]
        for row, scene in enumerate(scenes.tolist()):
            if count <= 0:
                return
            count -= 1
            yield shard.name, row, path[row].reshape(-1, n), rate[row], placed[scene]


def coal_obstacles(arrays: dict[str, Any]) -> list[tuple[Any, Any]]:
    """Return the obstacles of one scene as Coal's exact shapes with their placements."""
    obstacles = []
    for index in range(int(arrays["count"])):
        kind, (a, b, c) = (
            KINDS[int(arrays["kind"][index])],
            arrays["size"][index].astype(float),
        )
        sizes = {
            "box": (a, b, c),
            "sphere": (a,),
            "cylinder": (a, b),
            "capsule": (a, b),
        }[kind]
        shape = getattr(coal, kind.capitalize())(*sizes)
        w, x, y, z = arrays["quaternion"][index].astype(float)
        rotation = pin.Quaternion(w, x, y, z).normalized().toRotationMatrix()
        obstacles.append(
            (shape, pin.SE3(rotation, arrays["position"][index].astype(float)))
        )
    return obstacles


class Meshes:
    """A robot with the meshes of its URDF among obstacles.

    Args:
        urdf: Text of the URDF.
        joints: Names of the planned joints; the others are locked.
        left_out: Pairs of links that may touch.
    """

    def __init__(
        self, urdf: str, joints: tuple[str, ...], left_out: set[frozenset[str]]
    ) -> None:
        share = Path(
            str(
                metadata.distribution("example-robot-data").locate_file(
                    "cmeel.prefix/share"
                )
            )
        )
        full = pin.buildModelFromXML(urdf)
        geometry = pin.buildGeomFromUrdfString(
            full, urdf, pin.COLLISION, package_dirs=[str(share)]
        )
        locked = [
            full.getJointId(name) for name in full.names[1:] if name not in joints
        ]
        self.model, (self._links,) = pin.buildReducedModel(
            full, [geometry], locked, pin.neutral(full)
        )
        names = [
            self.model.frames[each.parentFrame].name
            for each in self._links.geometryObjects
        ]
        joint = [each.parentJoint for each in self._links.geometryObjects]
        self._moving = [index for index, carrier in enumerate(joint) if carrier > 0]
        self._self_pairs = [
            (j, i)
            for i in range(len(names))
            for j in range(i)
            if joint[i] != joint[j] and frozenset((names[i], names[j])) not in left_out
        ]
        self.obstacles: list[tuple[Any, Any]] = []
        self._data = self.model.createData()

    def place(self, obstacles: list[tuple[Any, Any]]) -> None:
        """Set the obstacles."""
        self.obstacles, geometry = obstacles, self._links.copy()
        for index, (shape, pose) in enumerate(obstacles):
            body = geometry.addGeometryObject(
                pin.GeometryObject(f"obstacle {index}", 0, pose, shape)
            )
            for link in self._moving:
                geometry.addCollisionPair(pin.CollisionPair(link, body))
        for first, second in self._self_pairs:
            geometry.addCollisionPair(pin.CollisionPair(first, second))
        self._geometry, self._results = geometry, geometry.createData()

    def touch(self, q: Array) -> bool:
        """Return whether any pair collides at a state."""
        return bool(
            pin.computeCollisions(
                self.model, self._data, self._geometry, self._results, q, True
            )
        )

    def depth(self, q: Array) -> float:
        """Return the largest penetration of any pair at a state [m], at least 0."""
        pin.computeDistances(self.model, self._data, self._geometry, self._results, q)
        return float(
            max(
                0.0, *(-result.min_distance for result in self._results.distanceResults)
            )
        )


def plan_states(path: Array, rate: Array, degree: int, step: float) -> Array:
    """Return the joint positions of a plan every ``step`` seconds [rad], shape (K, n), by SciPy's splines."""
    p, r = (
        BSpline(
            np.concatenate(
                [[0] * degree, np.linspace(0, 1, len(c) - degree + 1), [1] * degree]
            ),
            c,
            degree,
        )
        for c in (path, rate)
    )
    s = np.linspace(0, 1, 20001)
    t = np.concatenate(
        [[0], np.cumsum((1 / r(s[:-1]) + 1 / r(s[1:])) / 2 * np.diff(s))]
    )
    return np.asarray(p(np.interp(np.append(np.arange(0, t[-1], step), t[-1]), t, s)))


if __name__ == "__main__":
    main()
