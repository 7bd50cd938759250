"""Sampled trajectories of other planners: files, fitted motions and verdicts ('cnpgen docs trajectories')."""

from cnpgen.judges.trajectories.trajectory_verdict import ConditionDecision, Decision, TrajectoryVerdict
from cnpgen.plans.evaluate_trajectories import TrajectoryEvaluation
from cnpgen.plans.import_trajectories import ImportedTrajectories, import_trajectories
from cnpgen.plans.load_trajectories import LoadedTrajectories, load_trajectories
from cnpgen.trajectory.fit import fit_motion, largest_error
from cnpgen.trajectory.sampled_trajectory import Trajectory

__all__ = [
    "ConditionDecision",
    "Decision",
    "ImportedTrajectories",
    "LoadedTrajectories",
    "Trajectory",
    "TrajectoryEvaluation",
    "TrajectoryVerdict",
    "fit_motion",
    "import_trajectories",
    "largest_error",
    "load_trajectories",
]
