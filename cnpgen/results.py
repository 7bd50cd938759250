"""Classes that public functions return, values of objectives, and the execution of plans (``PlanRuntime``)."""

from cnpgen import _lazy_exports

__all__, __getattr__, __dir__ = _lazy_exports(__name__, __file__)
