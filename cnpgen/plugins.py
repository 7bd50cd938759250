"""Stable import location for plug-ins: contracts of stages, constraints, objectives and exporters."""

from cnpgen import _lazy_exports

__all__, __getattr__, __dir__ = _lazy_exports(__name__, __file__)
