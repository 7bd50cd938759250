"""Recipes of problems, pipelines and datasets, and the classes of their tables."""

from cnpgen import _lazy_exports

__all__, __getattr__, __dir__ = _lazy_exports(__name__, __file__)
