"""Sampled trajectories of other planners: files, fitted motions and verdicts ('cnpgen docs trajectories')."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
