"""Batches of perturbed plans for the tests of the loss, and its evaluation with SciPy, Pinocchio and Coal."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import scipy

from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.world.world import World
from tests.examples.plans import KNOTS, PROBLEMS, ROBOTS, load

LABELS = ("hit", "transport")
PROBLEM_OF = {"hit": "airhockey", "replan": "airhockey", "transport": "heavy-object"}


@cache
def loss(problem: str, **options: Any) -> PlanLoss:
    """Return a loss of a shipped problem, built once per session."""
    return PlanLoss(PROBLEMS[problem], **{"dtype": "float64", **options})


@dataclass(frozen=True)
class Batch:
    """The arguments of a loss."""

    problem: str
    path: np.ndarray
    rate: np.ndarray
    obstacle_poses: np.ndarray

    def __getitem__(self, rows: Any) -> "Batch":
        return Batch(
            self.problem, self.path[rows], self.rate[rows], self.obstacle_poses[rows]
        )

    def evaluated(self, of: PlanLoss, **options: Any) -> Any:
        weights = np.linspace(1.0, 2.0, len(of.terms) - 1)
        return of(
            self.path,
            self.rate,
            **{"weights": weights, "obstacle_poses": self.obstacle_poses, **options},
        )


def batch(
    label: str, count: int, by: float = 0.1, seed: int = 0, raised: float = 0.25
) -> Batch:
    """Return a stored plan with its control points moved by up to ``by`` rad, with other rates and obstacles.

    Also the ends are moved: at rest, or with an object exactly upright, the loss has kinks.
    """
    plan = load(label)
    random = np.random.default_rng(seed)
    path = plan.motion.path + by * random.uniform(
        -1, 1, (count, *plan.motion.path.shape[1:])
    )
    rate = plan.motion.rate * random.uniform(
        0.9, 1.4, (count, plan.motion.rate.shape[1])
    )
    obstacle_poses = np.repeat(plan.scene.poses, count, axis=0)
    obstacle_poses += random.uniform(
        -0.02, raised, obstacle_poses.shape
    )  # obstacles that may collide with the arm
    return Batch(PROBLEM_OF[label], path, rate, obstacle_poses)


@dataclass(frozen=True)
class States:
    """The states of one plan at K phases, from SciPy's splines."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    rate: np.ndarray


def states(path: np.ndarray, rate: np.ndarray, s: np.ndarray) -> States:
    """Evaluate a plan independently of cnpgen's splines, on purpose."""
    p, r = (
        scipy.interpolate.BSpline(KNOTS[len(path)], path, 7),
        scipy.interpolate.BSpline(KNOTS[len(rate)], rate, 7),
    )
    r0, r1 = r(s)[:, None], r(s, 1)[:, None]
    return States(p(s), p(s, 1) * r0, p(s, 2) * r0**2 + p(s, 1) * r1 * r0, r0[:, 0])


def huber(x: np.ndarray) -> np.ndarray:
    """Return the paper's Huber function: quadratic up to 1, linear above."""
    return np.where(np.abs(x) < 1, 0.5 * x**2, np.abs(x) - 0.5)


def step_losses(problem: str, at: States, obstacle_poses: np.ndarray) -> np.ndarray:
    """Return the task loss and Huber(ReLU(violation)) of every constraint by Pinocchio and Coal, shape (K, 1 + m).

    Robot clearance is only right where the robot does not enter an obstacle: Coal's distance of a segment is 0 there.
    """
    robot, chosen = ROBOTS[problem], PROBLEMS[problem]
    world, rows = World(robot, chosen.obstacle, chosen.object_size), []
    for q, dq, ddq in zip(at.q, at.dq, at.ddq, strict=True):
        world.set_state(q, dq, ddq, obstacle_poses)
        row = [1 + chosen.objective.centrifugal * centrifugal(problem, q, dq, ddq)]
        for constraint in chosen.constraint:
            conditions = constraint.measured(world)
            below = [np.maximum(c.lower - np.array(c.g, float), 0) for c in conditions]
            above = [np.maximum(np.array(c.g, float) - c.upper, 0) for c in conditions]
            row.append(float(huber(np.concatenate(below + above)).sum()))
        rows.append(row)
    return np.array(rows)


def centrifugal(problem: str, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> float:
    """Return the curvature of the tip's path times its squared speed [m/s^2], by Pinocchio, smoothed as in the loss."""
    robot = ROBOTS[problem]
    model, data = robot.model, robot.model.createData()
    tip, frame = model.getFrameId(robot.tip), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    pin.forwardKinematics(model, data, q, dq, ddq)
    v = pin.getFrameVelocity(model, data, tip, frame).linear
    a = pin.getFrameClassicalAcceleration(model, data, tip, frame).linear
    return float(np.sqrt(np.sum(np.cross(v, a) ** 2) / (v @ v + 1e-4) + 0.05**2) - 0.05)


def with_weight(of: PlanLoss, term: int) -> np.ndarray:
    """Return weights of 0 for all constraint terms but one."""
    weights = np.zeros(len(of.terms) - 1)
    weights[term] = 3.0
    return weights


def moved(given: Batch, path: np.ndarray, rate: np.ndarray) -> Batch:
    """Return the batch with other control points."""
    return replace(given, path=path, rate=rate)
