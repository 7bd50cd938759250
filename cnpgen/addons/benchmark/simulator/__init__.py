"""Execution of plans in MuJoCo: the arm, its environment, and a controller with a nominal model."""
