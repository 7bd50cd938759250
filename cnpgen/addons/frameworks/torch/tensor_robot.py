"""The robot of a problem in torch: kinematics, dynamics and constraints, differentiable any number of times."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from cnpgen.addons.frameworks.torch.tensor_tape import TensorTape
from cnpgen.addons.frameworks.torch.torch_plans import real_tensor
from cnpgen.errors import UsageError, counted
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.problems.robot_model import (
    RobotModel,
    constraint_values_of,
    inverse_dynamics_of,
    motor_torque_of,
    tip_pose,
)
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.store.dataset_spec import StoredProblem


class TensorRobot:
    """``RobotModel`` on tensors of any device; states have shape (N, n).

    Args:
        problem: The problem, its record, or the name or file of a problem, a pipeline
            or a dataset.

    Attributes:
        model: Limits, names and scenes of the same problem.
    """

    @checked_arguments
    def __init__(self, problem: Problem | StoredProblem | str | Path) -> None:
        self.problem = as_problem(problem)
        self.model = RobotModel(self.problem, backend="numpy")
        self._kernels = problem_kernels(
            self.problem, load_robot(self.problem), *choose_backend("numpy")
        )
        self._tapes = dict[Callable[..., Any], TensorTape]()

    def __repr__(self) -> str:
        return f"<TensorRobot of {self.problem.name!r}: {counted(len(self.model.joint_names), 'joint')}>"

    def forward_kinematics(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute positions [m], shape (N, 3), and rotation matrices, shape (N, 3, 3), of the tip."""
        position, rotation, _ = self._run(tip_pose, self._rows("q", q))
        return position.T, rotation.T.reshape(-1, 3, 3)

    def jacobian(self, q: torch.Tensor) -> torch.Tensor:
        """Compute the geometric Jacobian of the tip in world axes, linear rows first, shape (N, 6, n)."""
        columns: torch.Tensor = self._run(tip_pose, self._rows("q", q))[2].T.reshape(
            len(q), 6, -1
        )
        return columns

    def inverse_dynamics(
        self, q: torch.Tensor, dq: torch.Tensor, ddq: torch.Tensor
    ) -> torch.Tensor:
        """Compute joint torques [N m], payload included, shape (N, n)."""
        (torque,) = self._run(inverse_dynamics_of, *self._states(q, dq, ddq))
        return torque.T

    def motor_torque(
        self, q: torch.Tensor, dq: torch.Tensor, ddq: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the lowest and highest torques at the motors [N m], as ``RobotModel`` does, shape (N, n) each."""
        low, high = self._run(motor_torque_of, *self._states(q, dq, ddq))
        return low.T, high.T

    def constraint_values(
        self,
        q: torch.Tensor,
        dq: torch.Tensor,
        ddq: torch.Tensor,
        *,
        obstacle_poses: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Compute every condition of the problem, distances from obstacles included, as ``RobotModel`` does.

        ``model.constraint_values`` returns their names, bounds and tolerances.

        Args:
            q: Joint positions [rad], shape (N, n).
            dq: Joint velocities [rad/s].
            ddq: Joint accelerations [rad/s^2].
            obstacle_poses: Poses and sizes of the obstacles, ``scene.poses``, shape (N,
                width).

        Returns:
            Values in SI units, shape (N, m).
        """
        poses = (
            q.new_zeros((len(q), 0))
            if obstacle_poses is None
            else real_tensor("obstacle_poses", obstacle_poses)
        )
        width = self.problem.scene_width
        if tuple(poses.shape) != (len(q), width):
            raise UsageError(
                f"must have shape ({len(q)}, {width}), got {tuple(poses.shape)}",
                argument="obstacle_poses",
            )
        (values,) = self._run(
            constraint_values_of, *self._states(q, dq, ddq), poses.to(q).T
        )
        return values.T

    def _states(self, *states: torch.Tensor) -> list[torch.Tensor]:
        rows = [
            self._rows(name, values)
            for name, values in zip(("q", "dq", "ddq"), states, strict=True)
        ]
        for name, row in zip(("dq", "ddq"), rows[1:], strict=True):
            if row.shape != rows[0].shape:
                raise UsageError(
                    f"must have as many rows as q, {rows[0].shape[1]}, got {row.shape[1]}",
                    argument=name,
                )
        return rows

    def _rows(self, name: str, values: torch.Tensor) -> torch.Tensor:
        tensor = real_tensor(name, values)
        n = len(self.model.joint_names)
        if tensor.ndim != 2 or tensor.shape[1] != n:
            raise UsageError(
                f"must have shape (N, {n}), got {tuple(tensor.shape)}", argument=name
            )
        return tensor.T

    def _run(
        self, builder: Callable[..., Any], *arguments: torch.Tensor
    ) -> list[torch.Tensor]:
        """Evaluate the SX function of a builder.

        Only the values of constraints, without their derivatives.
        """
        if builder not in self._tapes:
            selected = (0,) if builder is constraint_values_of else None
            self._tapes[builder] = TensorTape(self._kernels.tape(builder), selected)
        return self._tapes[builder](*arguments)
