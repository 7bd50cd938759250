"""Stable import location for plug-ins: contracts of stages, constraints, objectives and exporters."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
