"""What packages with stages and constraints of their own import: these names stay here, wherever their modules are."""

from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import CandidateBatch, Stage
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import PerJoint, Range, field
from cnpgen.store.field import Field
from cnpgen.world.world import World

__all__ = [
    "Condition",
    "Constraint",
    "Context",
    "Field",
    "PerJoint",
    "Range",
    "CandidateBatch",
    "Stage",
    "SymbolicState",
    "World",
    "field",
]
