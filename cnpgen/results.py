"""Classes that public functions return, values of objectives, and the execution of plans (``PlanRuntime``)."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
