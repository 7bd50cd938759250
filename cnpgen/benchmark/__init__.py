"""Planners compared: the same problems, the same judge, the same simulator."""
