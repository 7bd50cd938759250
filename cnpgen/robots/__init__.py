"""The numeric robot: its Pinocchio model and chain, its limits, and what a problem file says of it."""
