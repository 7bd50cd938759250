"""Observations of scenes: signed distances, point clouds, camera views and object tokens, in NumPy."""
