"""Proofs that a boundary problem has no solution."""
