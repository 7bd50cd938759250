"""Benchmarks: suites, planners, the simulator and the report (the add-on ``cnpgen.addons.benchmark``)."""

from cnpgen.schema.public_names import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)
