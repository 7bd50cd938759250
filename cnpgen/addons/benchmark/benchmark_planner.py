"""Contract of the planners of the benchmark: one boundary problem in, a plan or a sampled trajectory out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.documents import JsonMapping
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.robots.robot import Robot
from cnpgen.schema import registry
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.keys import RecipeLocation
from cnpgen.schema.parsing import parse

PLANNERS = "cnpgen.planners"  # the group of entry points

Answer = Plans | Trajectory | None
"""One plan, a trajectory sampled in time, or None if the planner found no plan."""

Plan = Callable[[Plans], Answer]
"""A function of one boundary problem: ``Plans`` of length 1 whose control points are nan."""


@dataclass(frozen=True)
class Setting:
    """Information for a planner before the first problem.

    Attributes:
        problem: Record of the problem.
        model: Name of the shipped model for problems of this kind, or empty.
        time_limit: Planning time per problem [s]; a planner that takes longer has no
            plan and is stopped.
        seed: Seed of random planners.
        repetition: Number of the repetition, from 0.
        parameters: Values of the planner's fields, as in a recipe; the others have
            their defaults.
    """

    problem: ProblemRecord
    model: str = ""
    time_limit: float = 60.0
    seed: int = 0
    repetition: int = 0
    parameters: JsonMapping = field(default_factory=dict)

    @checked_arguments
    def random(self, problem: Plans) -> np.random.Generator:
        """Return the random generator of one boundary problem; it depends on no other problem.

        Args:
            problem: The boundary problem, which is known by its ``sample_id``.
        """
        return np.random.default_rng(
            [self.seed, self.repetition, int(problem.sample_id[0])]
        )


class BenchmarkPlanner(ABC):
    """Planner of the benchmark: a frozen dataclass whose fields are declared with ``cnpgen.plugins.field``.

    Packages register planners under the entry point ``cnpgen.planners``. Each planner
    runs in its own process.
    """

    def describe(self) -> str:
        """Return a description of one line."""
        return (type(self).__doc__ or "").strip().partition("\n")[0]

    @abstractmethod
    def prepare(self, setting: Setting) -> Plan:
        """Load kernels and models; the time is not measured.

        Args:
            setting: The problem and the time limit.

        Returns:
            Function that plans for one boundary problem; its time is measured.

        Raises:
            UsageError: The planner does not support problems of this kind.
        """


def require_rigid_torque(planner: str, problem: Problem, robot: Robot) -> None:
    """Raise UsageError if a problem has drives: the planner limits the torque of the rigid body only."""
    if robot.drive is not None:
        raise UsageError(
            f"{planner} limits the torque of the rigid body only, {problem.name!r} has rotors, friction or motor limits"
            " in [drive]"
        )


def distinct_times(t: Array, min_distance: float) -> Array:
    """Return ascending times without those that are too close to the next one [s]; the last one stays."""
    times = np.unique(t)
    return np.append(times[:-1][np.diff(times) > min_distance], times[-1])


def load_kind(name: str) -> type[BenchmarkPlanner]:
    """Import the class of a planner; errors as of ``registry.load``."""
    return registry.load(PLANNERS, name, BenchmarkPlanner)


def load_planner(name: str, parameters: JsonMapping) -> BenchmarkPlanner:
    """Load a planner by its name, with values of its fields as in a recipe.

    Raises:
        RecipeError: The planner is unknown or cannot be imported.
        UsageError: A parameter is unknown or invalid.
    """
    errors: list[str] = []
    planner = parse(
        load_kind(name), dict(parameters), where=RecipeLocation(name), errors=errors
    )
    if planner is None:
        raise UsageError("; ".join(errors), concerns="parameters")
    assert isinstance(planner, BenchmarkPlanner)
    return planner
