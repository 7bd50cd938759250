"""Planners as files for robots: a trained model becomes one C file without dependencies."""
