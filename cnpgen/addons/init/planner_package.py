"""Template of a package with a planner for the benchmark, written by ``cnpgen init NAME --planner``."""

PYPROJECT = """\
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "{name}"
version = "0.1.0"
dependencies = ["cnpgen[benchmark]"]

[project.entry-points."cnpgen.planners"]
{name} = "{module}:{kind}"

[tool.hatch.build.targets.wheel]
include = ["{module}.py"]
"""

PLANNER = '''\
"""Planner of the benchmark: a straight line in joint space, projected onto the table, from rest to rest."""

from dataclasses import dataclass

import numpy as np

from cnpgen import RobotModel
from cnpgen.benchmark import BenchmarkPlanner, Trajectory
from cnpgen.plugins import field


@dataclass(frozen=True)
class {kind}(BenchmarkPlanner):
    """A straight line in joint space, slowed down to the limits."""

    samples: int = field("number of samples", default=100, low=10)  # --set {name}.samples=50

    def prepare(self, setting):
        """Load what all boundary problems share; this time is not measured."""
        robot = RobotModel(setting.problem)  # limits, kinematics, dynamics and collisions
        robot.forward_kinematics(robot.home), robot.jacobian(robot.home), robot.inverse_dynamics(robot.home)  # compiles
        tables = [constraint for constraint in setting.problem.content["constraint"] if constraint["use"] == "table"]
        height = tables[0]["z"] if tables else None  # m

        def plan(problem):
            """Plan one boundary problem, a cnpgen.Plans of length 1; return a Trajectory, Plans of length 1, or None.

            Random planners use setting.random(problem), and setting.time_limit is the limit of this call [s].
            """
            start, goal = problem.boundary.start_q[0], problem.boundary.goal_q[0]  # also start_dq, start_ddq, goal_dq
            s = np.linspace(0, 1, self.samples)
            q = start + np.outer(10 * s**3 - 15 * s**4 + 6 * s**5, goal - start)
            if height is not None:
                q = on_table(robot, q, height)
            # Obstacles: problem.scene.bodies(0) are convex bodies with low and high corners [m].
            # Whether states are free of collisions: robot.is_collision_free(q[:1], scene=problem.scene).
            duration = min_duration(robot, q, s)
            return Trajectory(duration * s, q, np.gradient(q, duration * s, axis=0))

        return plan


def on_table(robot, q, height):
    """Project positions onto the height of the table by Newton's method."""
    for _ in range(10):
        error = robot.forward_kinematics(q)[0][:, 2] - height
        row = robot.jacobian(q)[:, 2]
        q = q - error[:, None] * row / np.sum(row**2, axis=1, keepdims=True)
    return q


def min_duration(robot, q, s):
    """Return the duration at which one joint reaches its limit of velocity, acceleration or torque."""
    dq = np.gradient(q, s, axis=0)
    ddq = np.gradient(dq, s, axis=0)
    duration = max(np.max(np.abs(dq) / robot.velocity_limit), np.sqrt(np.max(np.abs(ddq) / robot.acceleration_limit)))
    while np.any(np.abs(robot.inverse_dynamics(q, dq / duration, ddq / duration**2)) > robot.torque_limit):
        duration *= 1.05
        if duration > 60:
            break
    return duration
'''


def planner_texts(name: str) -> dict[str, str]:
    """Return file -> text of a package with one planner.

    The name has lower-case letters, digits and hyphens.
    """
    module = name.replace("-", "_")
    kind = "".join(part.capitalize() for part in name.split("-"))
    values = {"{name}": name, "{module}": module, "{kind}": kind}
    texts = {"pyproject.toml": PYPROJECT, f"{module}.py": PLANNER}
    for old, new in values.items():
        texts = {file: text.replace(old, new) for file, text in texts.items()}
    return texts
