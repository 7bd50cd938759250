"""Context of a stage: the problem, its robot and the kernels."""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from cnpgen.errors import RecipeError
from cnpgen.kernels.library import Backend, KernelLibrary, problem_kernels
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.schema import registry
from cnpgen.store.field import Field

Kind = TypeVar("Kind", bound=Constraint)


@dataclass(frozen=True)
class Context:
    """Loaded problem of a stage.

    Attributes:
        problem: Definition of a valid motion.
        robot: Robot with its planning limits.
        kernels: Library of compiled kernels.
        dtype: Float type of stored rows.
    """

    problem: Problem
    robot: Robot
    kernels: KernelLibrary
    dtype: str = "float64"

    def constraint(self, kind: type[Kind]) -> Kind:
        """Return the problem's constraint of a kind.

        Raises:
            RecipeError: The problem has no constraint of this kind.
        """
        if (constraint := self.problem.first(kind)) is not None:
            return constraint
        name = registry.name_of(registry.CONSTRAINTS, kind)
        raise RecipeError([f"needs a constraint {name!r}, which the problem {self.problem.path} does not have"])

    def joint_field(self, name: str, unit: str, long_name: str, role: str = "input") -> Field:
        """Describe a field with one column per planned joint, bounded by the planning limits of its unit.

        Args:
            name: Name of the field.
            unit: Unit for revolute joints: "rad", "rad/s" or "rad/s^2".
            long_name: Short description of the field.
            role: Role of the field, see ``Field``.
        """
        robot = self.robot
        bounds = {
            "rad": (robot.position_lower, robot.position_upper),
            "rad/s": (-robot.velocity_limit, robot.velocity_limit),
            "rad/s^2": (-robot.acceleration_limit, robot.acceleration_limit),
        }[unit]
        low, high = (tuple(float(x) for x in bound) for bound in bounds)
        return Field(
            name, robot.units(unit), long_name, robot.n, robot.joint_names, role, valid_min=low, valid_max=high
        )


def load_context(problem: Problem, backend: Backend, cache_folder: Path, dtype: str = "float64") -> Context:
    """Load the robot of a problem and open its kernel library."""
    robot = load_robot(problem)
    return Context(problem, robot, problem_kernels(problem, robot, backend, cache_folder), dtype)
