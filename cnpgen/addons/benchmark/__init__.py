"""Benchmarks: suites, planners, the simulator and the report."""

from cnpgen.schema.public_names import lazy_exports

NEEDS = ("manual", "paper", "scene_files", "trajectories")

__getattr__, __dir__ = lazy_exports(__name__, __file__)
