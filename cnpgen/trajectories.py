"""Sampled trajectories of other planners: files, fitted motions and verdicts ('cnpgen docs trajectories')."""

from cnpgen import _lazy_exports

__all__, __getattr__, __dir__ = _lazy_exports(__name__, __file__)
