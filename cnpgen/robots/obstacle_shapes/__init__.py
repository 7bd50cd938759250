"""Shapes of obstacles: a contract, and one file for each shape."""
