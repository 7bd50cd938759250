"""Problems and starts of the refiner's benchmark, and what is measured of one plan."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.judges.plans.verdict import Verdict
from cnpgen.plans.plans import Plans
from cnpgen.problems.record import open_problem
from cnpgen.refine.engine import prepare, tasks_of
from cnpgen.refine.jury import Jury
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.polish import refine_task
from cnpgen.refine.proof.tip_bound import Arm
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.task import Refined, Task
from cnpgen.trajectory.boundary import assemble
from cnpgen.trajectory.motion import Motion

Array = NDArray[np.float64]
PUCKS = 81  # problems of the dataset airhockey-pucks
LARGEST_Z, SMALLEST_Z, TOO_FAST = 0.010, 0.002, 1.05  # of a network-like start


@dataclass(frozen=True)
class Made:
    """What came of one plan.

    Attributes:
        refined: The plan.
        ms: CPU time, verdicts included [ms].
        verdict_ms: CPU time of the verdicts [ms].
        duration: Its motion time [s].
    """

    refined: Refined
    ms: float
    verdict_ms: float
    duration: float

    @property
    def valid(self) -> bool:
        """Whether the verdict calls it valid."""
        return self.refined.valid


class WatchedJury(Jury):
    """A jury that knows how long it took."""

    seconds = 0.0

    def verdict(self, task: Task, path: Array, rate: Array) -> Verdict:
        """Judge, and add up the time."""
        start = time.process_time()
        try:
            return super().verdict(task, path, rate)
        finally:
            self.seconds += time.process_time() - start


def make_each(plans: Plans, options: RefineOptions, refiner: Refiner | None = None) -> list[Made]:
    """Refine plans one by one in this process, and watch the clock."""
    tool = prepare(plans, options) if refiner is None else refiner
    problem, robot = open_problem(plans.problem)
    jury = WatchedJury(problem, robot, degree=plans.degree)
    tasks = tasks_of(plans)
    refine_task(tool, jury, tasks[0])  # warms up
    return [_make(tool, jury, task) for task in tasks]


def _make(tool: Refiner, jury: WatchedJury, task: Task) -> Made:
    jury.seconds, start = 0.0, time.process_time()
    refined = refine_task(tool, jury, task)
    ms = 1e3 * (time.process_time() - start)
    duration = float(Motion(refined.path[None], refined.rate[None], tool.spec.degree).duration()[0])
    return Made(refined, ms, 1e3 * jury.seconds, duration)


def like_a_networks(plans: Plans, made: list[Made], seed: int) -> Plans:
    """Disturb plans as a network errs: the tip is 2 to 10 mm too high or low somewhere, velocities are 5 % too high.

    Their ends are exact as those of a network's plans are, which are built from what the rate begins and ends with.
    """
    problem, robot = open_problem(plans.problem)
    random, arm, s = np.random.default_rng(seed), Arm(robot), np.linspace(0, 1, 41)
    paths, rates = [], []
    for index, each in enumerate(made):
        path, rate, boundary = each.refined.path, each.refined.rate, plans.boundary[index : index + 1]
        noise, end = np.zeros_like(path), len(path) - boundary.fixed_at_goal
        noise[3:end] = _smooth(random.normal(size=noise[3:end].shape))
        wanted, size = random.uniform(SMALLEST_Z, LARGEST_Z), 4e-3
        for _ in range(4):
            size *= wanted / _vertical(arm, path, path + size * noise, s)
        bent = path + size * noise
        for _ in range(4):
            speed = np.abs(Motion(bent[None], rate[None], plans.degree).at(s).dq[0]) / robot.velocity_limit
            rate = rate * TOO_FAST / speed.max()
            bent = assemble(boundary, bent[None, 3:end], rate[None], problem.trajectory)[0]
        paths.append(bent)
        rates.append(rate)
    return replace(plans, path_control_points=np.array(paths), rate_control_points=np.array(rates))


def _smooth(values: Array) -> Array:
    for _ in range(2):
        values = np.apply_along_axis(lambda column: np.convolve(column, [0.25, 0.5, 0.25], "same"), 0, values)
    return values


def _vertical(arm: Arm, path: Array, bent: Array, s: Array) -> float:
    """Largest vertical distance between the tips of two paths [m]."""
    q = [Motion(each[None], np.ones((1, 20))).at(s).q[0] for each in (path, bent)]
    return max(abs(float((arm.at(one).position - arm.at(other).position)[2])) for one, other in zip(*q, strict=True))
