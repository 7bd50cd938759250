"""What packages with stages and constraints of their own import: these names stay here, wherever their modules are."""

from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Round, Stage
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.schema.keys import PerJoint, Range, field
from cnpgen.store.field import Field
from cnpgen.world.state import World

__all__ = [
    "Condition",
    "Constraint",
    "Context",
    "Field",
    "PerJoint",
    "Range",
    "Round",
    "Stage",
    "SymbolicState",
    "World",
    "field",
]
