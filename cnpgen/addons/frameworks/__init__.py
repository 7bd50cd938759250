"""Bridges to torch, JAX and LeRobot, each imported only if its framework is installed."""

NEEDS = ("online",)  # the step for LeRobot executes chunks
