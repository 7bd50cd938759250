"""Sampled trajectories: readers, verdicts, plans of them, and datasets of LeRobot."""
