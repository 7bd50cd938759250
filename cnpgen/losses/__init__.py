"""Losses: the loss of plans, its gradient, its metric and its margins."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
