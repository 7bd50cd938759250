"""What surrounds the network: preparing tasks before it, slowing motions down behind it. Made once per problem."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary, choose_backend, problem_kernels
from cnpgen.planner.curves import landed_path
from cnpgen.planner.expressions import useful_steps
from cnpgen.planner.model import Meaning, Model
from cnpgen.planner.pacing import Pacing, make_pacing
from cnpgen.planner.preparation import Preparation, ends_of, lanes, prepare_tasks, rows
from cnpgen.planner.slowing import Slowing, make_slowing
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.record import ProblemRecord
from cnpgen.problems.robot import load_robot
from cnpgen.trajectory.boundary import Boundary
from cnpgen.trajectory.motion import Motion

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surroundings:
    """A problem that has been loaded from its record.

    Attributes:
        record: The problem as text.
        problem: The problem; its URDF file exists only inside ``surroundings``.
        robot: Its robot.
        kernels: Where kernels are loaded from.
    """

    record: ProblemRecord
    problem: Problem
    robot: "Robot"
    kernels: KernelLibrary


@contextmanager
def surroundings(record: ProblemRecord, backend: str | None = None) -> Iterator[Surroundings]:
    """Load a problem from its record, for as long as the block lasts.

    Args:
        record: The problem as text.
        backend: Which kernels to run; by default the fastest that works.

    Raises:
        CnpgenError: The record does not fit this cnpgen, or the machine lacks what it needs.
    """
    chosen, folder = choose_backend(backend)
    with record.restored() as problem:
        robot = load_robot(problem)
        yield Surroundings(record, problem, robot, problem_kernels(problem, robot, chosen, folder))


@dataclass(frozen=True)
class Kit:
    """What plans are made with besides the network.

    Attributes:
        prepare: What prepares tasks.
        path: Kernel of ``curves.landed_path``.
        slowing: What slows motions from rest to rest down; None where it must not.
        pacing: What fits rates to the limits; None where it is not wanted.
    """

    prepare: Preparation
    path: Kernel
    slowing: Slowing | None
    pacing: Pacing | None = None

    def plan(
        self,
        model: Model,
        boundary: Boundary,
        *,
        sample_id: NDArray[np.int64] | None = None,
        columns: Mapping[str, Array] | None = None,
    ) -> Plans:
        """Plan N motions.

        Args:
            model: A model of the kit's problem.
            boundary: Boundary conditions, shape (N, n) each, float64 and finite.
            sample_id: Which samples these are, shape (N,); 0, 1, ... by default.
            columns: What else is known of the tasks, as ``Plans.columns``.
        """
        ends = ends_of(boundary)
        tasks = self.prepare(boundary, ends=ends)
        given, tops = model.outputs(tasks), self.prepare.tops(tasks.start_xyz, tasks.goal_xyz)
        (path,) = self.path(ends, lanes(given.offsets), lanes(given.rate), lanes(tops))
        points, degree = rows(path, boundary.start_q.shape[1]), model.problem.trajectory.degree
        return Plans(
            problem=model.problem,
            boundary=boundary,
            path_control_points=points,
            rate_control_points=self._fitted(points, given.rate, degree, tops),
            degree=degree,
            columns={**(columns or {}), "start_xyz": tasks.start_xyz, "goal_xyz": tasks.goal_xyz},
            sample_id=np.arange(len(boundary)) if sample_id is None else sample_id,
            status=np.zeros(len(boundary), np.uint8),  # unknown
        )

    def _fitted(self, path: Array, rate: Array, degree: int, tops: Array) -> Array:
        """Return the rates, fitted to the limits where that is wanted, shape (N, R)."""
        if self.pacing is not None:
            rate = self.pacing.paced(Motion(path, rate, degree), tops).rate
        if self.slowing is not None:
            motion = Motion(path, rate, degree)
            factor = self.slowing.factor(motion, tops)
            rate = rate if factor.max(initial=1.0) <= 1 else motion.slower(factor).rate
        return rate


def make_kit(given: Surroundings, meaning: Meaning, *, slow_down: bool, fixed_at_goal: int = 2) -> Kit:
    """Make the kit of a problem.

    Args:
        given: The problem.
        meaning: What the network's outputs stand for.
        slow_down: Whether motions are slowed down; only for those from rest to rest.
        fixed_at_goal: Number of control points that the goal fixes (``Boundary.fixed_at_goal``).
    """
    problem, robot, kernels = given.problem, given.robot, given.kernels
    with kernels.compiling_together():
        prepare = prepare_tasks(
            problem,
            robot,
            kernels,
            bending_steps=meaning.bending_steps,
            expected_time=meaning.expected_time,
            fixed_at_goal=fixed_at_goal,
            within_limits=meaning.within_limits,
        )
        path = kernels.load(
            landed_path,
            steps=useful_steps(kernels, meaning.landing_steps),
            fixed_at_goal=fixed_at_goal,
            within_limits=meaning.within_limits,
        )
        slowing = make_slowing(problem, robot, kernels) if slow_down else None
        pacing = make_pacing(problem, robot, kernels) if meaning.paced else None
    return Kit(prepare, path, slowing, pacing)
