"""Plans for the tests of the verdict: stored valid ones, perturbations, and an independent evaluation."""

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import scipy

from cnpgen.judges.plans import Verdict
from cnpgen.judges.plans.judge import Judge
from cnpgen.problems.obstacles import goal_velocities, scene_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.spline_motion import Motion
from tests.examples.shipped import PROBLEMS, ROBOTS

STORED_PLANS = Path(__file__).parents[1] / "data" / "plans.json"
KNOTS = {
    count: np.r_[np.zeros(8), np.arange(1, count - 7) / (count - 7), np.ones(8)]
    for count in (15, 20)
}


@dataclass(frozen=True)
class Plan:
    """One plan and its problem: the arguments of ``judge``."""

    problem: Problem
    robot: Robot
    motion: Motion
    boundary: Boundary
    start_xyz: np.ndarray
    goal_xyz: np.ndarray

    @property
    def scene(self) -> Scene:
        velocity = goal_velocities(
            self.problem, self.robot, self.boundary.goal_q, self.boundary.goal_dq
        )
        return scene_of(self.problem, self.start_xyz, self.goal_xyz, velocity)

    def judged(self, *, early_exit: bool = False, **options: Any) -> Verdict:
        arguments = self.motion, self.boundary, self.scene, self.goal_xyz
        (verdict,) = Judge(self.problem, self.robot, **options)(
            *arguments, early_exit=early_exit
        )
        return verdict

    def changed(
        self, *, path: np.ndarray | None = None, rate: np.ndarray | None = None
    ) -> "Plan":
        old = self.motion
        return replace(
            self,
            motion=Motion(
                old.path if path is None else path, old.rate if rate is None else rate
            ),
        )

    def with_constraint(self, kind: str, **changes: Any) -> "Plan":
        """Return the same plan in a problem with one constraint changed."""
        constraints = tuple(
            replace(constraint, **changes)
            if type(constraint).__name__ == kind
            else constraint
            for constraint in self.problem.constraint
        )
        return replace(self, problem=replace(self.problem, constraint=constraints))


@cache
def stored_plans() -> dict[str, Any]:
    """Read the valid plans by label; not to be changed."""
    return json.loads(STORED_PLANS.read_text())


def load(label: str) -> Plan:
    content = stored_plans()[label]
    value = {
        name: np.array(values)[None]
        for name, values in content.items()
        if name != "problem"
    }
    boundary = Boundary(
        *(
            value[name]
            for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
        )
    )
    name = content["problem"]
    motion = Motion(value["path"], value["rate"])
    return Plan(
        PROBLEMS[name],
        ROBOTS[name],
        motion,
        boundary,
        value["start_xyz"],
        value["goal_xyz"],
    )


def joined(*plans: Plan) -> tuple[Any, ...]:
    """Return the arguments of ``judge`` for several plans of one problem."""

    def stack(values: list[np.ndarray]) -> np.ndarray:
        return np.concatenate(values)

    names = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
    boundary = Boundary(
        *(stack([getattr(plan.boundary, name) for plan in plans]) for name in names)
    )
    motion = Motion(
        stack([plan.motion.path for plan in plans]),
        stack([plan.motion.rate for plan in plans]),
    )
    scene = Scene(plans[0].scene.obstacles, stack([plan.scene.poses for plan in plans]))
    return (
        plans[0].problem,
        plans[0].robot,
        motion,
        boundary,
        scene,
        stack([plan.goal_xyz for plan in plans]),
    )


def perturbed(plan: Plan, by: float, *, seed: int = 0) -> Plan:
    """Return the plan with its interior control points moved by up to ``by`` rad."""
    path = plan.motion.path.copy()
    path[:, 3:13] += by * np.random.default_rng(seed).uniform(
        -1, 1, path[:, 3:13].shape
    )
    return plan.changed(path=path)


def raised(plan: Plan, by: float) -> Plan:
    """Return the plan with a start whose tip is ``by`` [m] above the table."""
    table = next(c for c in plan.problem.constraint if type(c).__name__ == "Table")
    goal, q = np.r_[plan.start_xyz[0, :2], table.z + by], plan.boundary.start_q[0]
    model, frame = plan.robot.model, plan.robot.model.getFrameId(plan.robot.tip)
    data, axes = model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for _ in range(20):
        pin.computeJointJacobians(model, data, q)
        error = goal - pin.updateFramePlacement(model, data, frame).translation
        q = (
            q
            + np.linalg.pinv(pin.getFrameJacobian(model, data, frame, axes)[:3]) @ error
        )
    return replace(
        plan, boundary=replace(plan.boundary, start_q=q[None]), start_xyz=goal[None]
    )


@dataclass(frozen=True)
class ReferenceTrajectory:
    """A plan evaluated with SciPy's splines and Pinocchio at many phases."""

    s: np.ndarray
    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    jerk: np.ndarray
    tau: np.ndarray
    tip: np.ndarray
    rotation: np.ndarray

    def integral(self, values: np.ndarray) -> float:
        return float(scipy.integrate.simpson(values, x=self.t))


def reference_trajectory(plan: Plan, count: int = 4001) -> ReferenceTrajectory:
    """Evaluate a plan independently of cnpgen's splines, on purpose."""
    s = np.linspace(0, 1, count)
    path, rate = plan.motion.path[0], plan.motion.rate[0]
    p, r = (
        scipy.interpolate.BSpline(KNOTS[15], path, 7),
        scipy.interpolate.BSpline(KNOTS[20], rate, 7),
    )
    q, r0 = p(s), r(s)[:, None]
    dq, ddq = p(s, 1) * r0, p(s, 2) * r0**2 + p(s, 1) * r(s, 1)[:, None] * r0
    jerk = (p(s, 3) * r0**2 + 3 * p(s, 2) * r(s, 1)[:, None] * r0) * r0
    jerk += p(s, 1) * (r(s, 2)[:, None] * r0 + r(s, 1)[:, None] ** 2) * r0
    nodes, weights = np.polynomial.legendre.leggauss(5)
    centers, half = (s[1:] + s[:-1]) / 2, np.diff(s)[:, None] / 2
    t = np.concatenate(
        [[0], np.cumsum((half / r(centers[:, None] + half * nodes)) @ weights)]
    )
    model, data = plan.robot.model, plan.robot.model.createData()
    tip = model.getFrameId(plan.robot.tip)
    poses, tau = [], []
    for state in zip(q, dq, ddq, strict=True):
        tau.append(np.array(pin.rnea(model, data, *state)))
        pin.framesForwardKinematics(model, data, state[0])
        poses.append(data.oMf[tip].copy())
    rotation = np.array([pose.rotation for pose in poses])
    return ReferenceTrajectory(
        s,
        t,
        q,
        dq,
        ddq,
        jerk,
        np.array(tau),
        np.array([pose.translation for pose in poses]),
        rotation,
    )
