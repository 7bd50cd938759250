"""Pipelines: ordered stages that sample boundary problems and reject infeasible ones."""
