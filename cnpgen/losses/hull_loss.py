"""Loss of the distances of a robot's convex parts from obstacles that each sample places."""

from __future__ import annotations

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError
from cnpgen.kernels.collision.clearance_loss import ClearanceLoss
from cnpgen.kernels.collision.collision_checker import load_collision_library
from cnpgen.kernels.library import KernelLibrary
from cnpgen.losses.plan_batch import PlanBatch
from cnpgen.losses.quadrature import BasisTable
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.problem import Problem
from cnpgen.robots.observation.primitives import scene_primitives
from cnpgen.robots.robot import Robot
from cnpgen.robots.scene import Scene

# Every fourth node; which ones depends on 16ths of the shift.
NODE_STRIDE = 4
SHIFTS = 16
# In addition to the required one, so that plans keep it after training.
TRAINING_DISTANCE_M = 0.02


class HullLoss:
    """Loss of the first constraint ``robot-clearance``, which the kernels of a problem with placed obstacles omit.

    ``tightening`` has the factors, then the insets of all constraints, shape (2 m,).

    Raises:
        UsageError: The problem has no constraint ``robot-clearance``, or its robot no
            link geometry, or too many joints.
        MachineError: The compiled code is missing.
    """

    def __init__(
        self,
        problem: Problem,
        robot: Robot,
        kernels: KernelLibrary,
        tightening: AnyArray,
    ) -> None:
        constraint = problem.first(RobotClearance)
        if constraint is None:
            raise UsageError(
                f"the problem {problem.name!r} has no constraint robot-clearance",
                concerns="problem",
            )
        index = problem.constraint.index(constraint)
        inset = float(tightening[len(problem.constraint) + index])
        self._problem = problem
        self._losses = ClearanceLoss(load_collision_library(kernels), robot)
        # The task loss is the first one.
        self._term = 1 + index
        self._required = constraint.distance + TRAINING_DISTANCE_M + inset  # m

    def add(
        self,
        results: tuple[AnyArray, AnyArray, AnyArray],
        batch: PlanBatch,
        weights: AnyArray,
        table: BasisTable,
        *,
        shift: float,
    ) -> None:
        """Add the loss to the results of a block, and its weighted gradients if there are any.

        The results are changed in place: terms, shape (1 + m, lanes), and gradients,
        samples last. The batch has the N plans of the block, and constraints have
        weights of shape (m,).
        """
        terms, by_path, by_rate = results
        nodes, count, stride = len(table.s), len(batch), min(NODE_STRIDE, len(table.s))
        # Distances take most of the time of a step.
        chosen = slice(int(shift * SHIFTS) % stride, nodes, stride)
        # Plans with invalid control points get nan, which affects no other plan.
        path = np.where(batch.valid[:, None, None], batch.path, np.nan)
        values, rates = (
            table.path[:nodes][chosen].astype(float),
            table.rate[:nodes][chosen].astype(float),
        )
        node_weights = table.weights[0, chosen].astype(float)
        # The chosen nodes stand for all: their weights sum to 1 again.
        node_weights /= node_weights.sum()
        q = np.moveaxis(values @ path, 0, -1)
        # Only chosen rows of the tables: q and r at these nodes.
        r = rates @ batch.rate.T
        bodies = scene_primitives(
            Scene(self._problem.obstacle, batch.obstacle_poses.astype(float))
        )
        losses, gradients = self._losses(q, bodies, self._required)
        # integral of loss dt = sum of node weight / r loss
        step, weight = node_weights[:, None] / r, float(weights[self._term - 1])
        terms[self._term, :count] += (step * losses).sum(axis=0)
        if by_path.size:
            by_path[..., :count] += weight * np.einsum(
                "kc,kjs->cjs", values, step[:, None] * gradients
            )
            # d(1 / r)/dR_j = -B_j / r^2
            by_rate[..., :count] -= weight * (rates.T @ (step / r * losses))
