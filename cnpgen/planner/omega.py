"""The paper's Omega block of one problem, for networks of any framework: from their outputs to control points and back.

What boundary conditions, line and expected time make of a network's outputs, on the host and in float64.
"""

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cnpgen.errors import UsageError
from cnpgen.kernels.library import Backend, choose_backend, problem_kernels
from cnpgen.machine.threads import one_thread
from cnpgen.planner import control_points
from cnpgen.planner.control_points import ControlPoints
from cnpgen.planner.landing import Landing, make_landing
from cnpgen.planner.preparation import Preparation, prepare_tasks
from cnpgen.planner.tasks import EXPECTED_TIMES, Tasks
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.plans.plausible import warn_of_far_joints
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import as_problem
from cnpgen.problems.robot import load_robot
from cnpgen.schema.arguments import integer, number, numbers
from cnpgen.store.blueprint import StoredProblem
from cnpgen.trajectory.boundary import Boundary

Array = NDArray[np.float64]

FIXED_AT_GOAL = {"free": 2, "given": 3}  # control points, by what is said of the goal's acceleration


class Omega:
    """Control points that meet boundary conditions exactly, from what a network says of a task, and gradients back.

    Interior path control points are those of the line from start to goal plus ``path_scale`` times the network's
    ``phi``; rates are ``exp(log_rate)`` over the expected time; the others follow (paper, Appendix A). Where a problem
    has equalities, line and path are bent onto them, in zero steps in the paper.

    Args:
        problem: The problem, its record (``plans.problem``, ``dataset.problem``), or the name or the file of a problem,
            a pipeline or a dataset.
        path_scale: What phi is a multiple of [rad]; pi in the paper.
        bending_steps: Gauss-Newton steps that bend the line.
        landing_steps: Gauss-Newton steps that bend the path.
        expected_time: What rates are multiples of the inverse of: "distance" as in the paper, or "reach" (``Meaning``).
        goal_acceleration: Whether accelerations at the goal are "free", or "given" as those of the rows of panda-cup.
        backend: Which kernels run; by default the fastest that works here.
        cache_folder: Where kernels are kept; by default where all are.

    Attributes:
        problem: The problem.
        goal_acceleration: Whether accelerations at the goal are "free" or "given".
        path_outputs: Width of phi: interior control points times joints.
        rate_outputs: Width of log_rate: control points of the rate.

    Raises:
        UsageError: An argument is none of what it may be.
        MachineError: The backend that was asked for does not work here.
    """

    def __init__(
        self,
        problem: Problem | StoredProblem | str | Path,
        *,
        path_scale: float = 0.5,
        bending_steps: int = 1,
        landing_steps: int = 1,
        expected_time: str = "distance",
        goal_acceleration: str = "free",
        backend: Backend | None = None,
        cache_folder: str | Path | None = None,
    ) -> None:
        self.problem, self._scale = as_problem(problem), number("path_scale", path_scale)
        self._bending = integer("bending_steps", bending_steps, least=0)
        self._landed = integer("landing_steps", landing_steps, least=0)
        if expected_time not in EXPECTED_TIMES:
            raise UsageError(f"expected_time must be one of {', '.join(EXPECTED_TIMES)}, got {expected_time!r}")
        if goal_acceleration not in FIXED_AT_GOAL:
            raise UsageError(f"goal_acceleration must be one of {', '.join(FIXED_AT_GOAL)}, got {goal_acceleration!r}")
        self._time, self.goal_acceleration = expected_time, goal_acceleration
        self._fixed = FIXED_AT_GOAL[goal_acceleration]
        spec = self.problem.trajectory
        self.path_outputs = (spec.path_control_points - 3 - self._fixed) * len(self.problem.robot.joints)
        self.rate_outputs = spec.rate_control_points
        chosen, folder = choose_backend(backend)
        folder = folder if cache_folder is None else Path(cache_folder)
        self._kernels = problem_kernels(self.problem, load_robot(self.problem), chosen, folder)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what was built for this process; it is built again when it is needed."""
        return {name: part for name, part in vars(self).items() if name != "_built"}

    @cached_property
    def _built(self) -> tuple[Preparation, Landing | None]:
        robot, problem, kernels = self._kernels.arguments["robot"], self.problem, self._kernels
        with kernels.compiling_together():
            prepare = prepare_tasks(
                problem,
                robot,
                kernels,
                bending_steps=self._bending,
                expected_time=self._time,
                fixed_at_goal=self._fixed,
            )
            return prepare, make_landing(problem, kernels, steps=self._landed, fixed_at_goal=self._fixed)

    @one_thread()
    def tasks(self, boundary: Boundary) -> Tasks:
        """Prepare N tasks: what follows from their boundary conditions before any network runs.

        Args:
            boundary: Boundary conditions, shape (N, n) each: arrays, or tensors on the CPU.

        Raises:
            UsageError: A shape is wrong, something is no real number, or the goal's acceleration is given where it was
                said to be free, or the other way round.
        """
        if boundary.fixed_at_goal > self._fixed:
            raise UsageError('goal accelerations are left free, so goal_ddq must be None; goal_acceleration="given"')
        if boundary.fixed_at_goal < self._fixed:
            raise UsageError('goal_ddq is missing: goal_acceleration is "given"')
        arrays = {name: numbers(name, values, differentiable=True) for name, values in boundary.given().items()}
        shape = (len(np.atleast_1d(arrays["start_q"])), len(self.problem.robot.joints))
        for name, array in arrays.items():
            if array.shape != shape:
                raise UsageError(f"{name} must have shape (N, {shape[1]}), N = {shape[0]}, got {array.shape}")
        checked = Boundary(**arrays)
        warn_of_far_joints(self._kernels.arguments["robot"], checked)
        return self._built[0](checked)

    def tops(self, tasks: Tasks) -> Array:
        """Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers): ``tops`` of the loss."""
        return obstacle_tops(self.problem, tasks.start_xyz, tasks.goal_xyz)

    @one_thread()
    def __call__(self, tasks: Tasks, phi: ArrayLike, log_rate: ArrayLike) -> ControlPoints:
        """Compute control points, in float64.

        Args:
            tasks: N tasks.
            phi: The network's say on the path, shape (N, path_outputs); shipped networks end in tanh.
            log_rate: Its say on the rate, shape (N, rate_outputs).

        Raises:
            UsageError: A shape is wrong, or something is no real number.
        """
        points, landing = self._before_landing(tasks, phi, log_rate), self._built[1]
        if landing is None:
            return points
        with np.errstate(all="ignore"):  # what overflows does so in its own row
            return replace(points, path=landing.land(points.path, self.tops(tasks)))

    @one_thread()
    def pull_back(
        self, tasks: Tasks, phi: ArrayLike, log_rate: ArrayLike, *, path_gradient: Array, rate_gradient: Array
    ) -> tuple[Array, Array]:
        """Turn gradients with respect to control points into those with respect to the network's outputs.

        Where control points have overflowed and a finite gradient comes back, 0 is passed on: no plan touches another.

        Args:
            tasks: As for the control points.
            phi: Likewise.
            log_rate: Likewise.
            path_gradient: Gradient with respect to the path control points, shape (N, C, n).
            rate_gradient: Likewise to those of the rate, shape (N, R).

        Returns:
            Gradients with respect to phi and log_rate.
        """
        points, landing = self._before_landing(tasks, phi, log_rate), self._built[1]
        with np.errstate(all="ignore"):
            by_path = landing.pull_back(points.path, self.tops(tasks), path_gradient) if landing else path_gradient
            spec = self.problem.trajectory
            found = control_points.pull_back(
                tasks, points, path_gradient=by_path, rate_gradient=rate_gradient, scale=self._scale, spec=spec
            )
        lost = _finite(path_gradient, rate_gradient) & ~_finite(*found)
        for each in found:
            each[lost] = 0
        return found

    def plans(self, tasks: Tasks, phi: ArrayLike, log_rate: ArrayLike, *, sample_id: ArrayLike | None = None) -> Plans:
        """Make plans of what a network says, to be evaluated, refined or saved.

        Args:
            tasks: As for the control points.
            phi: Likewise.
            log_rate: Likewise.
            sample_id: Which rows of a dataset the tasks are, shape (N,): ``batch["sample_id"]``, after shuffling, too;
                0, 1, ... by default.

        Raises:
            UsageError: A shape is wrong, or something is no real number.
        """
        points = self(tasks, phi, log_rate)
        return make_plans(
            self.problem,
            tasks.boundary,
            path_control_points=points.path,
            rate_control_points=points.rate,
            columns={"start_xyz": tasks.start_xyz, "goal_xyz": tasks.goal_xyz},
            sample_id=sample_id,
        )

    def check_shapes(self, tasks: Tasks, phi: tuple[int, ...], log_rate: tuple[int, ...]) -> None:
        """Refuse outputs by their shapes alone.

        Raises:
            UsageError: A shape is wrong.
        """
        for name, shape, width in (("phi", phi, self.path_outputs), ("log_rate", log_rate, self.rate_outputs)):
            if shape != (len(tasks), width):
                raise UsageError(f"{name} must have shape ({len(tasks)}, {width}), got {shape}")

    def _before_landing(self, tasks: Tasks, phi: ArrayLike, log_rate: ArrayLike) -> ControlPoints:
        phi = numbers("phi", phi, differentiable=True)
        log_rate = numbers("log_rate", log_rate, differentiable=True)
        self.check_shapes(tasks, phi.shape, log_rate.shape)
        with np.errstate(all="ignore"):
            return control_points.control_points(tasks, phi, log_rate, scale=self._scale, spec=self.problem.trajectory)


def _finite(*arrays: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether all numbers of a row are finite, shape (N,)."""
    found = [np.isfinite(array).all(axis=tuple(range(1, array.ndim))) for array in arrays]
    return np.asarray(np.all(found, axis=0))
