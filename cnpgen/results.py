"""Classes that public functions return, values of objectives, and the execution of plans (``PlanRuntime``)."""

from cnpgen.judges.plans.verdict import Margin, Metrics, PaperRule, Reason, Verdict
from cnpgen.judges.rows.row_report import Check, RowReport
from cnpgen.loader.batch import Batch
from cnpgen.loader.batches import Batches
from cnpgen.loader.gather import RowError, Split
from cnpgen.loader.normalization import Normalization
from cnpgen.machine.times import Times
from cnpgen.make.complete import Completed
from cnpgen.make.make_dataset import MadeDataset
from cnpgen.planner.control_points import ControlPoints
from cnpgen.planner.model import ModelConfig, Outputs
from cnpgen.planner.network.architecture import Architecture, Layer
from cnpgen.planner.network.features import Features
from cnpgen.planner.plan_hits import PlannedHits
from cnpgen.planner.plan_runtime import PlanRuntime, Switch, SwitchOutcome
from cnpgen.planner.puck_model import PuckModel
from cnpgen.planner.set_points import SetPoint
from cnpgen.planner.tasks import Tasks
from cnpgen.plans.evaluate import Evaluation
from cnpgen.plans.export import Exported
from cnpgen.plans.join import JoinedPlans
from cnpgen.plans.plans import PlanIndexError
from cnpgen.plans.status import PlanStatus
from cnpgen.problems.robot_model import ConstraintValues
from cnpgen.refine.objective_values import objective_values
from cnpgen.refine.proof.explain import Explanation, Feasibility
from cnpgen.refine.refinement import Refinement
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.robots.solid import Solid
from cnpgen.store.check import Finding
from cnpgen.store.dataset_spec import DatasetSpec, ShardTask, StoredProblem
from cnpgen.store.dataset_summary import DatasetSummary
from cnpgen.store.inspection import Inspection
from cnpgen.store.sampling_statistics import DensityMap, SamplingStatistics
from cnpgen.store.shard_record import ShardRecord
from cnpgen.store.statistics import FieldStatistics
from cnpgen.training.train import Trained
from cnpgen.trajectory.joined import JoinedMotion
from cnpgen.trajectory.spline_motion import States
from cnpgen.validate.machine import MachineReport
from cnpgen.validate.validate_dataset import ValidationReport

__all__ = [
    "Architecture",
    "Attempt",
    "Batch",
    "Batches",
    "Check",
    "Completed",
    "ConstraintValues",
    "ControlPoints",
    "DatasetSpec",
    "DatasetSummary",
    "DensityMap",
    "Evaluation",
    "Explanation",
    "Exported",
    "Feasibility",
    "Features",
    "FieldStatistics",
    "Finding",
    "Inspection",
    "JoinedMotion",
    "JoinedPlans",
    "Layer",
    "MachineReport",
    "MadeDataset",
    "Margin",
    "Metrics",
    "ModelConfig",
    "Normalization",
    "Outcome",
    "Outputs",
    "PaperRule",
    "PlanIndexError",
    "PlanRuntime",
    "PlanStatus",
    "PlannedHits",
    "PuckModel",
    "Reason",
    "Refinement",
    "RowError",
    "RowReport",
    "SamplingStatistics",
    "SetPoint",
    "ShardRecord",
    "ShardTask",
    "Solid",
    "Split",
    "States",
    "StoredProblem",
    "Switch",
    "SwitchOutcome",
    "Tasks",
    "Times",
    "Trained",
    "ValidationReport",
    "Verdict",
    "objective_values",
]
