"""Verdicts on sampled trajectories: the curve of an interpolation, or every curve that the samples allow."""
