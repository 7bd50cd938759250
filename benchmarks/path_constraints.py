"""Motion plan requests with path constraints: share solved, against RRT-Connect of OMPL, and an independent check.

Requests are drawn for a Panda among two boxes: a fixed orientation of the hand within 5 to 20 degrees, the hand within a
box with edges of 5 to 20 cm, or both along a tube. The straight line in joint space violates every one of them. Files
are MoveIt's, and ``solve_scenes`` plans them. OMPL searches for a path with projected states first, then by rejection.
The check reads the file and the URDF: every millisecond it computes the pose of the hand by its own kinematics, and the
angles and distances as MoveIt's messages define them.
"""

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
from common import arguments, median, progress, report, table
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cnpgen.addons.benchmark.planners.cbirrt import joint_space, load_ompl
from cnpgen.addons.benchmark.planners.rrtconnect import FreeSearch
from cnpgen.addons.scene_files.scene_files import load_scenes
from cnpgen.make.solve_scenes import solve_scenes
from cnpgen.pipelines.resting_states import RestingStates
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.problems.scenes.scene_request import NO_REQUEST
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.world.pose_ik import PoseKinematics, solve_pose_ik

Array = NDArray[np.float64]
Document = dict[str, Any]

LINK, FREE = "panda_hand", 3.2  # link of the constraints; limit of a free axis [rad]
KINDS = "orientation", "box", "both"
ANGLES_DEG, EDGES_M = (5.0, 20.0), (0.05, 0.2)
DISTANCES_M = 0.25, 0.6  # of the hand from start to goal
TURNS_RAD = 0.8, 2.0  # of the hand within its box
CLEARANCE_M, LINE_STATES = 0.02, 200
CHECK_STEP_S, ROUNDING = 1e-3, 1e-5  # rad or m: control points are rounded
PROJECTION_TOLERANCE, MANIFOLD_DELTA_RAD, DIFFERENCE_RAD = 1e-3, 0.05, 1e-6


def violations(document: Document, rotation: Array, position: Array) -> Array:
    """Return the violations of a request's path constraints by K poses, shape (m, K) [rad or m], negative inside."""
    path, rows = document["path_constraints"], list[Array]()
    for entry in path.get("orientation_constraints", ()):
        wanted = Rotation.from_quat(entry["orientation"])
        relative = wanted.inv() * Rotation.from_matrix(rotation)
        euler = entry["parameterization"] == 0
        angles = relative.as_euler("XYZ") if euler else relative.as_rotvec()
        limits = [entry[f"absolute_{axis}_axis_tolerance"] for axis in "xyz"]
        rows += list(np.abs(angles).T - np.array(limits)[:, None])
    for entry in path.get("position_constraints", ()):
        region = entry["constraint_region"]
        (shape,), (pose,) = region["primitives"], region["primitive_poses"]
        turn = Rotation.from_quat(pose["orientation"]).as_matrix()
        local = (position - pose["position"]) @ turn
        rows += list(np.abs(local).T - np.array(shape["dimensions"])[:, None] / 2)
    return np.array(rows)


class Kinematics:
    """Pose of a link of a URDF by products of its joints' transforms."""

    def __init__(self, urdf: str, link: str, joints: tuple[str, ...]) -> None:
        elements = {
            joint.find("child").get("link"): joint  # type: ignore[union-attr]
            for joint in ElementTree.fromstring(urdf).findall("joint")
        }
        chain = []
        while link in elements:
            joint = elements[link]
            link = joint.find("parent").get("link", "")  # type: ignore[union-attr]
            chain.append(joint)
        self._steps = [_step(joint, joints) for joint in reversed(chain)]

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Return rotations (K, 3, 3) and positions [m], (K, 3), at states (K, n)."""
        R, p = np.tile(np.eye(3), (len(q), 1, 1)), np.zeros((len(q), 3))
        for turn, shift, axis, index in self._steps:
            p, R = p + R @ shift, R @ turn
            if index is not None:
                R = R @ Rotation.from_rotvec(q[:, index, None] * axis).as_matrix()
        return R, p


def _step(
    joint: Any, joints: tuple[str, ...]
) -> tuple[Array, Array, Array, int | None]:
    """Return the placement of a joint, its axis, and its index among the planned joints."""
    origin, axis = joint.find("origin"), joint.find("axis")
    numbers = {
        key: [
            float(each)
            for each in (origin.get(key) if origin is not None else "0 0 0").split()
        ]
        for key in ("xyz", "rpy")
    }
    turn = Rotation.from_euler("xyz", numbers["rpy"]).as_matrix()
    direction = (
        [0.0, 0.0, 1.0] if axis is None else [float(x) for x in axis.get("xyz").split()]
    )
    name = joint.get("name")
    index = joints.index(name) if name in joints else None
    return turn, np.array(numbers["xyz"]), np.array(direction), index


def draw_requests(
    robot: Robot, problem: Problem, count: int, seed: int
) -> Iterator[Document]:
    """Yield requests whose straight line violates their path constraints, the kinds in turn."""
    random = np.random.default_rng(seed)
    hand = PoseKinematics(robot, int(robot.model.getFrameId(LINK)))
    for number in range(count):
        document = None
        while document is None:
            document = _draw(robot, problem, hand, KINDS[number % len(KINDS)], random)
        yield document


def _draw(
    robot: Robot,
    problem: Problem,
    hand: PoseKinematics,
    kind: str,
    random: np.random.Generator,
) -> Document | None:
    """Return a request of a kind, or None if its ends or its line do not fit."""
    low, high = robot.position_lower, robot.position_upper
    start = random.uniform(0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high)
    (p0,), (R0,), _ = hand.evaluate(start[:, None])
    direction = _unit(random)
    if kind == "box":
        shift = direction * 0.0
        R1 = (
            R0
            @ Rotation.from_rotvec(
                _unit(random) * random.uniform(*TURNS_RAD)
            ).as_matrix()
        )
    else:
        shift, R1 = direction * random.uniform(*DISTANCES_M), R0
    constraints, shift = _constraints(kind, p0, R0, shift, random)
    seeds = np.clip(
        start[:, None] + random.normal(0, 0.5, (robot.n, 16)),
        low[:, None],
        high[:, None],
    )
    goals, met = solve_pose_ik(
        hand, np.tile(p0 + shift, (16, 1)), np.tile(R1, (16, 1, 1)), seeds
    )
    if p0[2] < 0.1 or not met.any():
        return None
    goal = goals[:, met][:, random.integers(met.sum())]
    obstacles = [_box(random) for _ in range(2)]
    document = _document(robot, start, goal, constraints, obstacles)
    line = np.linspace(start, goal, LINE_STATES).T.copy()
    positions, rotations, _ = hand.evaluate(line)
    worst = violations(document, rotations, positions).max(axis=0)
    states = RestingStates(problem, robot, [each for each, _ in obstacles])
    ends = states.are_ends(np.stack([start, goal], axis=1), margin=CLEARANCE_M)
    fits = worst.max() > 0.02 and worst[[0, -1]].max() < 0 and ends.all()
    return document if fits else None


def _constraints(
    kind: str, p0: Array, R0: Array, shift: Array, random: np.random.Generator
) -> tuple[Document, Array]:
    """Return the path constraints of a kind, and the displacement of the hand from the start to the goal."""
    constraints: Document = {}
    if kind != "box":
        limits = np.radians(random.uniform(*ANGLES_DEG, 3))
        if random.uniform() < 0.5:
            limits[2] = FREE
        tolerances = {
            f"absolute_{axis}_axis_tolerance": limit
            for axis, limit in zip("xyz", limits.tolist(), strict=True)
        }
        constraints["orientation_constraints"] = [
            {
                "header": {"frame_id": "panda_link0"},
                "link_name": LINK,
                "orientation": Rotation.from_matrix(R0).as_quat().tolist(),
                "parameterization": int(random.integers(2)),
                **tolerances,
            }
        ]
    if kind != "orientation":
        edges, turn = (
            random.uniform(*EDGES_M, 3),
            Rotation.random(random_state=random.integers(1 << 31)).as_matrix(),
        )
        center = p0 + turn @ (random.uniform(-0.4, 0.4, 3) * edges)
        if kind == "box":
            shift = turn @ (random.uniform(-0.4, 0.4, 3) * edges) + center - p0
        else:  # a tube along the motion
            turn = _frame_along(shift)
            edges[2] = np.linalg.norm(shift) + random.uniform(*EDGES_M)
            center = p0 + shift / 2
        constraints["position_constraints"] = [
            {
                "header": {"frame_id": "panda_link0"},
                "link_name": LINK,
                "constraint_region": {
                    "primitives": [{"type": "box", "dimensions": edges.tolist()}],
                    "primitive_poses": [
                        {
                            "position": center.tolist(),
                            "orientation": Rotation.from_matrix(turn)
                            .as_quat()
                            .tolist(),
                        }
                    ],
                },
            }
        ]
    return constraints, shift


def _unit(random: np.random.Generator) -> Array:
    vector = random.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _frame_along(vector: Array) -> Array:
    """Return a rotation matrix whose z axis is along a vector."""
    return np.asarray(Rotation.align_vectors(vector[None], [[0, 0, 1]])[0].as_matrix())


def _box(random: np.random.Generator) -> tuple[Obstacle, Document]:
    """Return a random box around the robot, and its message."""
    angle, distance = random.uniform(-np.pi, np.pi), random.uniform(0.35, 0.8)
    position = [
        distance * np.cos(angle),
        distance * np.sin(angle),
        random.uniform(0.0, 0.9),
    ]
    size = random.uniform(0.05, 0.25, 3).tolist()
    x, y, z = (float(each) for each in position)
    box = Obstacle(name="box", position=(x, y, z), size=(size[0], size[1], size[2]))
    pose = {"position": [x, y, z], "orientation": [0, 0, 0, 1]}
    return box, {
        "primitives": [{"type": "box", "dimensions": size}],
        "primitive_poses": [pose],
    }


def _document(
    robot: Robot,
    start: Array,
    goal: Array,
    constraints: Document,
    obstacles: list[tuple[Obstacle, Document]],
) -> Document:
    joints = zip(robot.joint_names, goal.tolist(), strict=True)
    return {
        "world": {
            "collision_objects": [
                {"id": f"box {index}", "header": {"frame_id": "panda_link0"}, **entry}
                for index, (_, entry) in enumerate(obstacles)
            ]
        },
        "start_state": {
            "joint_state": {"name": list(robot.joint_names), "position": start.tolist()}
        },
        "goal_constraints": [
            {
                "joint_constraints": [
                    {"joint_name": name, "position": q} for name, q in joints
                ]
            }
        ],
        "path_constraints": constraints,
    }


class ConstrainedSearch(FreeSearch):
    """Search of OMPL among obstacles for states that meet the path constraints of a request."""

    def __init__(
        self,
        robot: Robot,
        problem: Problem,
        scene: SceneProblem,
        document: Document,
        projects: bool,
    ) -> None:
        plain = replace(scene, request=NO_REQUEST)
        task = scene_plans(problem, [plain])
        placed, _ = open_problem(task.problem)
        super().__init__(RestingStates(placed, robot), robot, task)
        self._document, self._projects = document, projects
        self._data, self._link = robot.model.createData(), robot.model.getFrameId(LINK)

    def violation(self, q: Array) -> Array:
        """Return the positive parts of the violations, shape (m,)."""
        pin.forwardKinematics(self._robot.model, self._data, q)
        pose = pin.updateFramePlacement(self._robot.model, self._data, self._link)
        poses = np.array(pose.rotation)[None], np.array(pose.translation)[None]
        return np.maximum(violations(self._document, *poses)[:, 0], 0.0)

    def is_valid(self, q: Array) -> bool:
        """Return whether the constraints are met, by projected states up to their tolerance, without collision."""
        allowed = PROJECTION_TOLERANCE if self._projects else 0.0
        return bool(self.violation(q).max() <= allowed and super().is_valid(q))

    def space(self, ompl: Any) -> tuple[Any, list[Any]]:
        """Return OMPL's space of joint positions, or of projected ones."""
        if not self._projects:
            return super().space(ompl)
        search, base = self, ompl.base

        class Violations(base.Constraint):  # type: ignore[misc, name-defined]
            def __init__(self) -> None:
                rows = len(search.violation(search._ends[0]))
                super().__init__(search._robot.n, rows, PROJECTION_TOLERANCE)

            def function(self, x: Any, out: Any) -> None:
                out[:] = search.violation(np.array(x))

            def jacobian(self, x: Any, out: Any) -> None:
                q = np.array(x)
                now = search.violation(q)
                for joint in range(len(q)):
                    moved = q.copy()
                    moved[joint] += DIFFERENCE_RAD
                    out[:, joint] = (search.violation(moved) - now) / DIFFERENCE_RAD

        self._constraint = Violations()
        space = base.ProjectedStateSpace(
            joint_space(base, self._robot), self._constraint
        )
        space.setDelta(MANIFOLD_DELTA_RAD)
        ends = [space.allocState() for _ in self._ends]
        for state, q in zip(ends, self._ends, strict=True):
            state.copy(q.tolist())
        return base.ConstrainedSpaceInformation(space), ends


def run(
    count: int, seed: int, seconds: float, problem_name: str = "panda"
) -> Iterator[dict[str, Any]]:
    """Yield the outcome of every request."""
    problem = load_problem(problem_name)
    robot = load_robot(problem)
    kinematics = Kinematics(problem.urdf_text, LINK, robot.joint_names)
    for number, document in enumerate(draw_requests(robot, problem, count, seed)):
        with TemporaryDirectory() as folder:
            file = Path(folder) / "request.yaml"
            file.write_text(json.dumps(document))  # JSON is YAML
            (scene,) = load_scenes(file)
        begun = time.process_time()
        solved = solve_scenes(problem, [scene], workers=1)
        outcome: dict[str, Any] = {
            "request": number,
            "kind": KINDS[number % len(KINDS)],
            "solved": bool(solved.valid[0]),
            "reason": str(solved.results[0].reason),
            "cpu_s": time.process_time() - begun,
            "violation": None,
        }
        if outcome["solved"]:
            duration = float(solved.plans.duration[0])
            t = np.append(np.arange(0.0, duration, CHECK_STEP_S), duration)
            q, _, _ = solved.plans[[0] * len(t)].states_at(t)
            outcome["violation"] = float(
                violations(document, *kinematics.poses(q)).max()
            )
        outcome |= _ompl(robot, problem, scene, document, seconds, number)
        progress(str(outcome))
        yield outcome


def _ompl(
    robot: Robot,
    problem: Problem,
    scene: SceneProblem,
    document: Document,
    seconds: float,
    seed: int,
) -> dict[str, Any]:
    """Return which of OMPL's searches finds a path, and after which time."""
    ompl, begun = load_ompl(), time.perf_counter()
    for name, projects in (
        (("projection", True), ("rejection", False)) if seconds else ()
    ):
        ompl.util.RNG.setSeed(seed + 1)
        search = ConstrainedSearch(robot, problem, scene, document, projects)
        if search.solve(ompl, seconds) is not None:
            return {"ompl": name, "ompl_s": time.perf_counter() - begun}
    return {"ompl": "", "ompl_s": time.perf_counter() - begun}


def summary(outcomes: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the shares of all requests, of each kind, and of those that OMPL solves."""
    rows = []
    for kind in ("all", *KINDS):
        own = [each for each in outcomes if kind in {"all", each["kind"]}]
        by_ompl = [each for each in own if each["ompl"]]
        checked = [each["violation"] for each in own if each["solved"]]
        rows.append(
            {
                "kind": kind,
                "requests": len(own),
                "solved": sum(each["solved"] for each in own),
                "by OMPL": len(by_ompl),
                "by both": sum(each["solved"] for each in by_ompl),
                "violations": sum(each > ROUNDING for each in checked),
                "worst": max(checked, default=None),
                "CPU time [s]": median(each["cpu_s"] for each in own),
                "OMPL [s]": median(each["ompl_s"] for each in own),
            }
        )
    return rows


def main() -> None:
    """Run the benchmark."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--n", type=int, default=60, help="number of requests")
        parser.add_argument("--seed", type=int, default=1, help="seed of the requests")
        parser.add_argument(
            "--seconds",
            type=float,
            default=60.0,
            help="time of each search of OMPL; 0: none",
        )

    options = arguments(__doc__, add)
    outcomes = list(run(options.n, options.seed, options.seconds))
    rows = summary(outcomes)
    text = table(
        "requests with path constraints",
        tuple(rows[0]),
        [[_cell(value) for value in row.values()] for row in rows],
    )
    results = {"rows": rows, "outcomes": outcomes}
    report(results, [text], as_json=options.json)


def _cell(value: object) -> str:
    return f"{value:.2g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
