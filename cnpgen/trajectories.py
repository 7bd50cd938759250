"""Sampled trajectories of other planners: files, motions fitted to them, and their verdicts (docs/trajectories.md)."""

from cnpgen.judges.trajectories.trajectory_verdict import ConditionDecision, Decision, TrajectoryVerdict
from cnpgen.plans.evaluate_trajectories import TrajectoryEvaluation
from cnpgen.plans.load_trajectories import LoadedTrajectories, load_trajectories
from cnpgen.trajectory.fit import fit_motion, largest_error
from cnpgen.trajectory.sampled_trajectory import Trajectory

__all__ = [
    "ConditionDecision",
    "Decision",
    "LoadedTrajectories",
    "Trajectory",
    "TrajectoryEvaluation",
    "TrajectoryVerdict",
    "fit_motion",
    "largest_error",
    "load_trajectories",
]
