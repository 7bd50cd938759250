"""The boundary layer in torch operations, on the device of its arguments, differentiable any number of times."""

import torch

from cnpgen.addons.frameworks.torch.tensor_splines import start_points
from cnpgen.addons.frameworks.torch.tensor_tape import TensorTape
from cnpgen.addons.frameworks.torch.torch_plans import real_tensor
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.planner.boundary_layer import BoundaryLayer
from cnpgen.planner.control_point_functions import (
    MAX_STEP_RAD,
    PROJECTION_DAMPING,
    collocation,
)
from cnpgen.planner.control_points import along_line
from cnpgen.planner.expressions import effective_steps
from cnpgen.planner.tasks import Tasks
from cnpgen.problems.conditions import equality_residuals
from cnpgen.problems.load_robot import load_robot
from cnpgen.schema.argument_types import checked_arguments


class TensorBoundaryLayer:
    """The paper's Omega without a copy to the CPU; ``control_points`` is faster for tensors on the CPU.

    Args:
        layer: The boundary layer; it makes the tasks.
    """

    @checked_arguments
    def __init__(self, layer: BoundaryLayer) -> None:
        self.layer = layer
        problem = layer.problem
        kernels = problem_kernels(
            problem, load_robot(problem), *choose_backend("numpy")
        )
        self._steps = effective_steps(kernels, layer.projection_steps)
        self._equalities = TensorTape(kernels.tape(equality_residuals))
        # Control points at an end follow from position, velocity and, if given,
        # acceleration.
        fixed = 3 if layer.goal_acceleration == "given" else 2
        points = problem.trajectory.path_control_points
        self._interior = slice(3, points - fixed)
        self._table, self._response = collocation(
            problem.trajectory.degree, points, self._interior
        )

    def __repr__(self) -> str:
        return f"<TensorBoundaryLayer of {self.layer.problem.name!r}>"

    def __call__(
        self, tasks: Tasks, phi: torch.Tensor, log_rate: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute control points that meet the boundary conditions from network outputs.

        Args:
            tasks: N tasks from ``layer.tasks``; constants, copied to the device of phi.
            phi: Network outputs of the path, shape (N, ``layer.path_outputs``).
            log_rate: Network outputs of the rate, shape (N, ``layer.rate_outputs``), on
                the same device.

        Returns:
            Path [rad] and rate [1/s] control points, shape (N, C, n) and (N, R), in the
            type of phi, at least float32.

        Raises:
            UsageError: A shape is wrong.
        """
        phi = real_tensor("phi", phi)
        log_rate = real_tensor("log_rate", log_rate)
        self.layer.check_shapes(tasks, tuple(phi.shape), tuple(log_rate.shape))
        kind = {
            "device": phi.device,
            "dtype": torch.promote_types(phi.dtype, torch.float32),
        }
        spec = self.layer.problem.trajectory
        conditions = tasks.boundary.conditions()
        state = {
            name: torch.tensor(values, **kind) for name, values in conditions.items()
        }
        expected_time = torch.tensor(tasks.expected_time, **kind)
        rate = log_rate.to(**kind).exp() / expected_time[:, None]
        first = start_points(
            state["start_q"], state["start_dq"], state["start_ddq"], rate, spec
        )
        # In reversed phase r' and p' change sign: the goal is a start with the velocity
        # -dq.
        goal_ddq = state.get("goal_ddq", torch.zeros_like(state["goal_q"]))
        last = start_points(
            state["goal_q"], -state["goal_dq"], goal_ddq, rate.flip(1), spec
        ).flip(1)
        last = last[:, self._interior.stop - spec.path_control_points :]
        interior = (self.layer.path_scale * phi.to(**kind)).reshape(
            len(phi), -1, first.shape[2]
        )
        along = torch.tensor(along_line(interior.shape[1]), **kind)
        # Offsets phi are added to the line between the fixed points of both ends.
        interior = interior + first[:, 2:3] + (last[:, :1] - first[:, 2:3]) * along
        if tasks.correction is not None:
            interior = interior + torch.tensor(tasks.correction, **kind)
        path = torch.cat([first, interior, last], dim=1)
        return self._projected(path, torch.tensor(tasks.scene.poses, **kind)), rate

    def _projected(self, path: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
        """Project the interior control points onto the equalities, as ``projection_change`` of the planner does."""
        kind = {"device": path.device, "dtype": path.dtype}
        table = torch.tensor(self._table, **kind)
        response = torch.tensor(self._response, **kind)
        # Response of the path at one collocation phase to a change at another one.
        coupling = table[:, self._interior] @ response
        for _ in range(self._steps):
            q = torch.einsum("kc,ncj->jnk", table, path)
            # (m, N, K) and (n m, N, K)
            residual, jacobian = self._equalities(q, poses.T[:, :, None])
            # (n, m, N, K)
            rows = jacobian.reshape(q.shape[0], -1, *q.shape[1:])
            normal = (
                torch.einsum("janx,jbny,xy->nxayb", rows, rows, coupling)
                .flatten(3)
                .flatten(1, 2)
            )
            # Damped normal equations stay regular at singular Jacobians.
            normal = normal + PROJECTION_DAMPING * torch.eye(normal.shape[1], **kind)
            force = torch.linalg.solve(normal, residual.permute(1, 2, 0).flatten(1))
            force = force.reshape(len(path), -1, residual.shape[0])  # (N, K, m)
            step = -torch.einsum("ik,jank,nka->nij", response, rows, force)
            before, inner, after = path.tensor_split(
                (self._interior.start, self._interior.stop), dim=1
            )
            # Large steps leave the region in which the linearization holds.
            path = torch.cat(
                [before, inner + step.clamp(-MAX_STEP_RAD, MAX_STEP_RAD), after], dim=1
            )
        return path
