"""Robots: the numeric model behind Pinocchio, and the same chain as CasADi SX expressions."""
