"""Observations of scenes in compiled code."""
