"""Contract of other definitions of a valid plan, such as the one that a publication used for its tables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from cnpgen.arrays import Array
from cnpgen.problems.constraints.constraint import Conditions
from cnpgen.schema import registry

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.problems.constraints.constraint import Constraint
    from cnpgen.problems.problem import Problem
    from cnpgen.world.path import PathWorld


class PublishedRules(ABC):
    """Conditions of a publication.

    Packages register them in the group ``cnpgen.rules``.
    """

    @abstractmethod
    def judge(
        self,
        problem: Problem,
        world: PathWorld,
        obstacle_poses: Array,
        goal_xyz: Array,
    ) -> tuple[bool, tuple[str, ...]]:
        """Judge one motion whose samples the world has.

        Args:
            problem: The problem.
            world: The robot among its obstacles at the samples of the motion.
            obstacle_poses: Poses of the obstacles, shape (width,).
            goal_xyz: Position of the tip at the goal [m], shape (3,).

        Returns:
            Whether the motion ends at the goal, and the reasons of the violated
            constraints.
        """

    @abstractmethod
    def conditions(self, constraint: Constraint, state: SymbolicState) -> Conditions:
        """Return the conditions of a constraint that the loss of the publication penalizes."""


def load_rules(name: str) -> PublishedRules:
    """Load the rules of a publication.

    Raise MissingAddonError if their add-on is missing.
    """
    rules: PublishedRules = registry.load(registry.RULES, name)()
    return rules


def find_rules(name: str) -> PublishedRules | None:
    """Load the rules of a publication; None if no package or add-on has them."""
    return load_rules(name) if name in registry.names(registry.RULES) else None
