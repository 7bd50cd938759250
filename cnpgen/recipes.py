"""Recipes of problems, pipelines and datasets, and the classes of their tables."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
