"""The paper's rules by their name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cnpgen.arrays import Array
from cnpgen.problems.constraints.constraint import Conditions
from cnpgen.problems.published_rules import PublishedRules

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.problems.constraints.constraint import Constraint
    from cnpgen.problems.problem import Problem
    from cnpgen.world.path import PathWorld


@dataclass(frozen=True)
class PaperRules(PublishedRules):
    """Rules: those of the paper, which are looser than the constraints of the problems."""

    def judge(
        self,
        problem: Problem,
        world: PathWorld,
        obstacle_poses: Array,
        goal_xyz: Array,
    ) -> tuple[bool, tuple[str, ...]]:
        """Judge one motion by ``paper_rule``."""
        from cnpgen.addons.paper.paper_rule import paper_rule

        return paper_rule(problem, world, obstacle_poses, goal_xyz)

    def conditions(self, constraint: Constraint, state: SymbolicState) -> Conditions:
        """Return the ``published_conditions`` of a constraint."""
        from cnpgen.addons.paper.published_conditions import published_conditions

        return published_conditions(constraint, state)
