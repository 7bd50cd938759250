"""What surrounds the network: preparing tasks before it, slowing motions down behind it. Made once per problem."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.library import KernelLibrary, choose_backend, problem_kernels
from cnpgen.planner.curves import landed_path
from cnpgen.planner.detours import Detours, make_detours
from cnpgen.planner.expressions import useful_steps
from cnpgen.planner.model import Meaning, Model
from cnpgen.planner.pacing import Pacing, make_pacing
from cnpgen.planner.preparation import Preparation, ends_of, lanes, prepare_tasks, rows
from cnpgen.planner.slowing import Slowing, make_slowing
from cnpgen.planner.speeds import BLOCK
from cnpgen.planner.tasks import Tasks
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
        detours: What finds other lines where plans break something; None where the model has none.
    """

    prepare: Preparation
    path: Kernel
    slowing: Slowing | None
    pacing: Pacing | None = None
    detours: Detours | None = None

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
        tasks, motion = self.planned(model, boundary)
        return Plans(
            problem=model.problem,
            boundary=boundary,
            path_control_points=motion.path,
            rate_control_points=motion.rate,
            degree=motion.degree,
            columns={**(columns or {}), "start_xyz": tasks.start_xyz, "goal_xyz": tasks.goal_xyz},
            sample_id=np.arange(len(boundary)) if sample_id is None else sample_id,
            status=np.zeros(len(boundary), np.uint8),  # unknown
        )

    def planned(self, model: Model, boundary: Boundary) -> tuple[Tasks, Motion]:
        """Plan N motions; return the tasks, along the lines that were taken, too."""
        ends = ends_of(boundary)
        tasks = self.prepare(boundary, ends=ends)
        tops = self.prepare.tops(tasks.start_xyz, tasks.goal_xyz)
        motion = self._fitted(self._landed(model, tasks, ends, tops), tops)
        return (tasks, motion) if self.detours is None else self._detoured(self.detours, model, tasks, motion, tops)

    def motion(self, model: Model, tasks: Tasks, tops: Array) -> Motion:
        """Ask the network; bend what it gives onto the equalities, and fit it to limits of speeds.

        Args:
            model: A model of the kit's problem.
            tasks: N tasks, as ``prepare`` gives them.
            tops: Where the obstacles are, as ``obstacle_tops`` says, shape (N, numbers).
        """
        return self._fitted(self._landed(model, tasks, ends_of(tasks.boundary), tops), tops)

    def _landed(self, model: Model, tasks: Tasks, ends: Array, tops: Array) -> Motion:
        given = model.outputs(tasks)
        (path,) = self.path(ends, lanes(given.offsets), lanes(given.rate), lanes(tops))
        return Motion(rows(path, tasks.boundary.start_q.shape[1]), given.rate, model.problem.trajectory.degree)

    def _fitted(self, motion: Motion, tops: Array) -> Motion:
        if self.pacing is not None:
            motion = self.pacing.paced(motion, tops)
        if self.slowing is not None:
            factor = self.slowing.factor(motion, tops)
            motion = motion if factor.max(initial=1.0) <= 1 else motion.slower(factor)
        return motion

    def _detoured(
        self, detours: Detours, model: Model, tasks: Tasks, motion: Motion, tops: Array
    ) -> tuple[Tasks, Motion]:
        """Put motions along other lines in the place of those that break something, where they break less."""
        path, rate, before = motion.path.copy(), motion.rate.copy(), detours.broken(motion, tops)
        correction = np.zeros_like(path[:, 3 : path.shape[1] - tasks.boundary.fixed_at_goal])
        correction += 0.0 if tasks.correction is None else tasks.correction
        broken = np.flatnonzero(before > 1)
        for some in (broken[first : first + BLOCK] for first in range(0, len(broken), BLOCK)):
            each = np.repeat(some, len(detours.middles))
            bent = self.prepare(tasks.boundary[each], np.tile(detours.middles, (len(some), 1)))
            assert bent.correction is not None
            others = self._landed(model, bent, ends_of(bent.boundary), tops[each])
            after = detours.broken(others, tops[each])
            worth = detours.worth(after)
            fitted, time = self._fitted(others[worth], tops[each[worth]]), np.full(len(each), np.inf)
            time[worth] = fitted.duration()
            chosen = time.reshape(len(some), -1).argmin(axis=1) + len(detours.middles) * np.arange(len(some))
            less = after[chosen] < before[some]
            here, there = some[less], np.searchsorted(worth, chosen[less])
            path[here], rate[here] = fitted.path[there], fitted.rate[there]
            correction[here] = bent.correction[chosen[less]]
        return replace(tasks, correction=correction), replace(motion, path=path, rate=rate)


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
            corners=bool(meaning.middles),
        )
        path = kernels.load(
            landed_path,
            steps=useful_steps(kernels, meaning.landing_steps),
            fixed_at_goal=fixed_at_goal,
            within_limits=meaning.within_limits,
        )
        slowing = make_slowing(problem, robot, kernels) if slow_down else None
        pacing = make_pacing(problem, robot, kernels) if meaning.paced else None
        detours = make_detours(problem, kernels, np.array(meaning.middles)) if meaning.middles else None
    return Kit(prepare, path, slowing, pacing, detours)
