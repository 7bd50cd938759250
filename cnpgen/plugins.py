"""Stable import location for plug-ins: contracts of stages, constraints, objectives and exporters."""

from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import CandidateBatch, Stage
from cnpgen.plans.exporter import ExportedSet, Exporter, SampledPlan
from cnpgen.problems.constraints.constraint import Condition, Constraint
from cnpgen.problems.objectives import ObjectiveTerm
from cnpgen.schema.keys import PerJoint, Range, field
from cnpgen.store.field import Field
from cnpgen.world.world import World

__all__ = [
    "CandidateBatch",
    "Condition",
    "Constraint",
    "Context",
    "ExportedSet",
    "Exporter",
    "Field",
    "ObjectiveTerm",
    "PerJoint",
    "Range",
    "SampledPlan",
    "Stage",
    "SymbolicState",
    "World",
    "field",
]
