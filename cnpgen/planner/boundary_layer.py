"""The paper's Omega block of one problem, for networks of any framework.

It combines boundary conditions, line, expected time and network outputs on the CPU, in
float64.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.kernels.library import Backend, choose_backend, problem_kernels
from cnpgen.machine.threads import one_thread
from cnpgen.planner import control_points
from cnpgen.planner.control_points import ControlPoints, Projection, make_projection
from cnpgen.planner.model import ModelConfig
from cnpgen.planner.task_preprocessor import TaskPreprocessor, make_task_preprocessor
from cnpgen.planner.tasks import EXPECTED_TIMES, Tasks
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.plans.plausible import check_boundary_units
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import check_choice, integer, number, numbers
from cnpgen.store.dataset_spec import StoredProblem
from cnpgen.trajectory.boundary import Boundary

# Number of path control points that the goal fixes.
FIXED_AT_GOAL = {
    "free": 2,
    "given": 3,
}


class BoundaryLayer:
    """The paper's Omega block: control points that meet boundary conditions exactly, from network outputs.

    Interior path control points are those of the line from start to goal plus
    ``path_scale`` times the network's ``phi``. Rates are ``exp(log_rate)`` over the
    expected time. The boundary control points follow (paper, Appendix A). If a problem
    has equalities, line and path are projected onto them; the paper uses zero steps.

    Args:
        problem: The problem, its record (``plans.problem``, ``dataset.problem``), or
            the name or the file of a problem, a pipeline or a dataset.
        path_scale: Factor of phi [rad]; pi in the paper.
        line_projection_steps: Number of Gauss-Newton steps that project the line.
        projection_steps: Number of Gauss-Newton steps that project the path.
        expected_time: Unit of durations: "distance", "reach" or "travel"
            (``ModelConfig``).
        goal_acceleration: "free", or "given" if boundary conditions include goal
            accelerations, as in panda-cup.
        backend: Backend of the kernels; by default the fastest available.
        cache_folder: Folder of compiled kernels; by default the shared cache.

    Attributes:
        problem: The problem.
        goal_acceleration: "free" or "given".
        path_scale: Factor of phi [rad].
        projection_steps: Number of Gauss-Newton steps that project the path.
        path_outputs: Width of phi: interior control points times joints.
        rate_outputs: Width of log_rate: control points of the rate.

    Raises:
        UsageError: An argument is invalid.
        MachineError: The backend is not available on this machine.
    """

    @checked_arguments
    def __init__(
        self,
        problem: Problem | StoredProblem | str | Path,
        *,
        path_scale: float = 0.5,
        line_projection_steps: int = 1,
        projection_steps: int = 1,
        expected_time: str = "distance",
        goal_acceleration: str = "free",
        backend: Backend | None = None,
        cache_folder: str | Path | None = None,
    ) -> None:
        self.problem = as_problem(problem)
        self.path_scale = number("path_scale", path_scale)
        line_steps = integer("line_projection_steps", line_projection_steps, least=0)
        self.projection_steps = integer("projection_steps", projection_steps, least=0)
        check_choice("expected_time", expected_time, EXPECTED_TIMES)
        check_choice("goal_acceleration", goal_acceleration, FIXED_AT_GOAL)
        self._config = ModelConfig(
            path_scale=self.path_scale,
            line_projection_steps=line_steps,
            projection_steps=self.projection_steps,
            expected_time=expected_time,
        )
        self.goal_acceleration = goal_acceleration
        self._fixed_at_goal = FIXED_AT_GOAL[goal_acceleration]
        spec = self.problem.trajectory
        # The start fixes three control points, the goal two or three.
        self.path_outputs = (spec.path_control_points - 3 - self._fixed_at_goal) * len(
            self.problem.robot.joints
        )
        self.rate_outputs = spec.rate_control_points
        chosen_backend, folder = choose_backend(backend)
        folder = folder if cache_folder is None else Path(cache_folder)
        self._kernels = problem_kernels(
            self.problem.for_planning, load_robot(self.problem), chosen_backend, folder
        )

    def __getstate__(self) -> dict[str, Any]:
        """Omit the loaded kernels, which are loaded again on first use."""
        return {
            name: part
            for name, part in vars(self).items()
            if name != "_preprocessor_and_projection"
        }

    @cached_property
    def _preprocessor_and_projection(
        self,
    ) -> tuple[TaskPreprocessor, Projection | None]:
        # Kernels omit the obstacles that samples place; features and losses measure
        # them.
        robot = self._kernels.arguments["robot"]
        problem = self.problem.for_planning
        kernels = self._kernels
        fixed, placed = self._fixed_at_goal, self.problem.sample_obstacles
        prepare = make_task_preprocessor(
            problem,
            robot,
            kernels,
            self._config,
            fixed_at_goal=fixed,
            placed=placed,
        )
        return prepare, make_projection(
            problem, kernels, steps=self.projection_steps, fixed_at_goal=fixed
        )

    @checked_arguments
    @one_thread()
    def tasks(
        self,
        boundary: Boundary,
        *,
        obstacle_poses: ArrayLike | None = None,
        allow_large_angles: bool = False,
    ) -> Tasks:
        """Prepare N tasks: compute everything that the network needs from boundary conditions.

        Args:
            boundary: Boundary conditions, shape (N, n) each: arrays, or tensors on the
                CPU.
            obstacle_poses: Poses and sizes of obstacles that samples place, shape (N,
                width), as ``dataset.scenes(split, rows).poses`` has them; needed if the
                problem has such obstacles.
            allow_large_angles: Whether to accept values that are probably in degrees or
                millimetres, with a warning.

        Raises:
            UsageError: A shape is wrong, a value is no real number, poses are missing,
                or the presence of goal accelerations does not match
                ``goal_acceleration``.
            UnitError: A value is probably in degrees or millimetres.
        """
        # Free accelerations are outputs of the network; given ones fix a third control
        # point.
        if boundary.fixed_at_goal > self._fixed_at_goal:
            raise UsageError(
                'goal_acceleration is "free", so goal_ddq must be None; pass goal_acceleration="given"',
                concerns="boundary",
            )
        if boundary.fixed_at_goal < self._fixed_at_goal:
            raise UsageError(
                'goal_ddq is missing: goal_acceleration is "given"', concerns="boundary"
            )
        checked = self._checked(boundary)
        robot = self._kernels.arguments["robot"]
        check_boundary_units(
            robot, checked, argument="boundary", allow_large_angles=allow_large_angles
        )
        poses = (
            None
            if obstacle_poses is None
            else numbers("obstacle_poses", obstacle_poses)
        )
        return self._preprocessor_and_projection[0](checked, obstacle_poses=poses)

    def _checked(self, boundary: Boundary) -> Boundary:
        """Return boundary conditions as arrays of the right shapes."""
        arrays = {
            name: numbers(name, values, differentiable=True)
            for name, values in boundary.arrays().items()
        }
        count = len(np.atleast_1d(arrays["start_q"]))
        joints, parameters = len(self.problem.robot.joints), self.problem.parameters
        for name, array in arrays.items():
            shape = count, len(parameters) if name == "parameters" else joints
            if array.shape != shape:
                raise UsageError(
                    f"must have shape (N, {shape[1]}), N = {shape[0]}, got {array.shape}",
                    argument=name,
                )
        return Boundary(**arrays)

    @checked_arguments
    @one_thread()
    def __call__(
        self, tasks: Tasks, phi: ArrayLike, log_rate: ArrayLike
    ) -> ControlPoints:
        """Compute control points, in float64.

        Args:
            tasks: N tasks.
            phi: Output of the configuration head, shape (N, path_outputs); shipped
                networks end in tanh.
            log_rate: Output of the time head, shape (N, rate_outputs).

        Raises:
            UsageError: A shape is wrong, or a value is no real number.
        """
        points = self._before_projection(tasks, phi, log_rate)
        projection = self._preprocessor_and_projection[1]
        if projection is None:
            return points
        # An overflow affects its own row only.
        with np.errstate(all="ignore"):
            return replace(
                points, path=projection.project(points.path, tasks.scene.poses)
            )

    @checked_arguments
    @one_thread()
    def vjp(
        self,
        tasks: Tasks,
        phi: ArrayLike,
        log_rate: ArrayLike,
        *,
        path_gradient: Array,
        rate_gradient: Array,
    ) -> tuple[Array, Array]:
        """Convert gradients with respect to control points to gradients with respect to the network's outputs.

        If control points overflowed, the gradient of that plan is 0; other plans are
        not affected.

        Args:
            tasks: N tasks.
            phi: Output of the configuration head, shape (N, path_outputs).
            log_rate: Output of the time head, shape (N, rate_outputs).
            path_gradient: Gradient with respect to the path control points, shape (N,
                C, n).
            rate_gradient: Gradient with respect to the rate control points, shape (N,
                R).

        Returns:
            Gradients with respect to phi and log_rate.
        """
        points = self._before_projection(tasks, phi, log_rate)
        projection = self._preprocessor_and_projection[1]
        path_gradient = _checked_gradient(
            "path_gradient", path_gradient, points.path.shape
        )
        rate_gradient = _checked_gradient(
            "rate_gradient", rate_gradient, points.rate.shape
        )
        with np.errstate(all="ignore"):
            # Reverse order of the forward pass: projection first, then the control
            # points.
            by_path = (
                projection.vjp(points.path, tasks.scene.poses, path_gradient)
                if projection
                else path_gradient
            )
            gradients = control_points.vjp(
                tasks,
                points,
                path_gradient=by_path,
                rate_gradient=rate_gradient,
                scale=self.path_scale,
                spec=self.problem.trajectory,
            )
        # An overflow of one plan must not stop training: its gradient is left out.
        overflowed = _finite(path_gradient, rate_gradient) & ~_finite(*gradients)
        for gradient in gradients:
            gradient[overflowed] = 0
        return gradients

    @checked_arguments
    def plans(
        self,
        tasks: Tasks,
        phi: ArrayLike,
        log_rate: ArrayLike,
        *,
        sample_id: ArrayLike | None = None,
    ) -> Plans:
        """Make plans from network outputs, to be evaluated, refined or saved.

        Args:
            tasks: N tasks.
            phi: Output of the configuration head, shape (N, path_outputs).
            log_rate: Output of the time head, shape (N, rate_outputs).
            sample_id: Dataset rows of the tasks, shape (N,), such as
                ``batch["sample_id"]``, also after shuffling; 0, 1, ... by default.

        Raises:
            UsageError: A shape is wrong, or a value is no real number.
        """
        points = self(tasks, phi, log_rate)
        return make_plans(
            self.problem,
            tasks.boundary,
            path_control_points=points.path,
            rate_control_points=points.rate,
            columns={"start_xyz": tasks.start_xyz, "goal_xyz": tasks.goal_xyz},
            sample_id=sample_id,
            # Checked with the tasks.
            allow_large_angles=True,
        )

    @checked_arguments
    def check_shapes(
        self, tasks: Tasks, phi: tuple[int, ...], log_rate: tuple[int, ...]
    ) -> None:
        """Check the shapes of network outputs.

        Raises:
            UsageError: A shape is wrong.
        """
        for name, shape, width in (
            ("phi", phi, self.path_outputs),
            ("log_rate", log_rate, self.rate_outputs),
        ):
            if shape != (len(tasks), width):
                raise UsageError(
                    f"must have shape ({len(tasks)}, {width}), got {shape}",
                    argument=name,
                )

    def _before_projection(
        self, tasks: Tasks, phi: ArrayLike, log_rate: ArrayLike
    ) -> ControlPoints:
        phi = numbers("phi", phi, differentiable=True)
        log_rate = numbers("log_rate", log_rate, differentiable=True)
        self.check_shapes(tasks, phi.shape, log_rate.shape)
        with np.errstate(all="ignore"):
            return control_points.control_points(
                tasks,
                phi,
                log_rate,
                scale=self.path_scale,
                spec=self.problem.trajectory,
            )


def _checked_gradient(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    gradient = (
        values
        if isinstance(values, np.ndarray) and values.dtype.kind == "f"
        else numbers(name, values)
    )
    if gradient.shape != shape:
        raise UsageError(
            f"must have shape {shape}, got {gradient.shape}", argument=name
        )
    return gradient


def _finite(*arrays: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a mask of the rows whose values are all finite, shape (N,)."""
    masks = [
        np.isfinite(array).all(axis=tuple(range(1, array.ndim))) for array in arrays
    ]
    return np.asarray(np.all(masks, axis=0))
