"""Problems and initial guesses of the refiner's benchmark, and the measurements of one plan."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.verdict import Verdict
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.proof.tip_bound import ArmKinematics
from cnpgen.refine.refine_engine import prepare, tasks_of
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.strategy import PlanChecker, refine_task
from cnpgen.refine.task import Attempt, RefinementTask
from cnpgen.trajectory.boundary import assemble
from cnpgen.trajectory.spline_motion import Motion

Array = NDArray[np.float64]
PUCKS = 81  # problems of the dataset airhockey-pucks
MAX_Z_ERROR_M, MIN_Z_ERROR_M, SPEED_FACTOR = (
    0.010,
    0.002,
    1.05,
)  # of a network-like initial guess


@dataclass(frozen=True)
class Made:
    """Measurements of one plan.

    Attributes:
        refined: Result of the refiner.
        ms: CPU time, verdicts included [ms].
        verdict_ms: CPU time of the verdicts [ms].
        duration: Motion time [s].
    """

    refined: Attempt
    ms: float
    verdict_ms: float
    duration: float

    @property
    def valid(self) -> bool:
        """Whether the verdict accepts the plan."""
        return self.refined.valid


class TimedChecker(PlanChecker):
    """Plan checker that measures its CPU time."""

    seconds = 0.0

    def verdict(self, task: RefinementTask, path: Array, rate: Array) -> Verdict:
        """Judge a plan and add the time."""
        start = time.process_time()
        try:
            return super().verdict(task, path, rate)
        finally:
            self.seconds += time.process_time() - start


def make_each(
    plans: Plans, options: RefineOptions, refiner: Refiner | None = None
) -> list[Made]:
    """Refine plans one by one in this process and measure the CPU time."""
    refiner = prepare(plans, options) if refiner is None else refiner
    problem, robot = open_problem(plans.problem)
    checker = TimedChecker(problem, robot, degree=plans.degree)
    tasks = tasks_of(plans)
    refine_task(refiner, checker, tasks[0])  # warm-up
    return [_make(refiner, checker, task) for task in tasks]


def _make(refiner: Refiner, checker: TimedChecker, task: RefinementTask) -> Made:
    checker.seconds, start = 0.0, time.process_time()
    refined = refine_task(refiner, checker, task)
    ms = 1e3 * (time.process_time() - start)
    duration = float(
        Motion(refined.path[None], refined.rate[None], refiner.spec.degree).duration()[
            0
        ]
    )
    return Made(refined, ms, 1e3 * checker.seconds, duration)


def network_like_plans(plans: Plans, results: list[Made], seed: int) -> Plans:
    """Perturb plans like a network: height errors of 2 to 10 mm and velocities that are 5 % too high.

    The boundary conditions remain exact, like those of a network.
    """
    problem, robot = open_problem(plans.problem)
    random, arm, s = (
        np.random.default_rng(seed),
        ArmKinematics(robot),
        np.linspace(0, 1, 41),
    )
    paths, rates = [], []
    for index, result in enumerate(results):
        path, rate, boundary = (
            result.refined.path,
            result.refined.rate,
            plans.boundary[index : index + 1],
        )
        noise, end = np.zeros_like(path), len(path) - boundary.fixed_at_goal
        noise[3:end] = _smooth(random.normal(size=noise[3:end].shape))
        target, size = random.uniform(MIN_Z_ERROR_M, MAX_Z_ERROR_M), 4e-3
        for _ in range(4):
            size *= target / _vertical(arm, path, path + size * noise, s)
        perturbed = path + size * noise
        for _ in range(4):
            speed = (
                np.abs(Motion(perturbed[None], rate[None], plans.degree).at(s).dq[0])
                / robot.velocity_limit
            )
            rate = rate * SPEED_FACTOR / speed.max()
            perturbed = assemble(
                boundary, perturbed[None, 3:end], rate[None], problem.trajectory
            )[0]
        paths.append(perturbed)
        rates.append(rate)
    return replace(
        plans, path_control_points=np.array(paths), rate_control_points=np.array(rates)
    )


def _smooth(values: Array) -> Array:
    for _ in range(2):
        values = np.apply_along_axis(
            lambda column: np.convolve(column, [0.25, 0.5, 0.25], "same"), 0, values
        )
    return values


def _vertical(arm: ArmKinematics, path: Array, perturbed: Array, s: Array) -> float:
    """Return the largest vertical distance between the tips of two paths [m]."""
    q = [
        Motion(control_points[None], np.ones((1, 20))).at(s).q[0]
        for control_points in (path, perturbed)
    ]
    return max(
        abs(float((arm.at(a).position - arm.at(b).position)[2]))
        for a, b in zip(*q, strict=True)
    )
