"""Numeric robot model: Pinocchio model, kinematic chain, limits and specification."""
