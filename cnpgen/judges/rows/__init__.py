"""Rows of datasets recomputed with Pinocchio and Coal."""
