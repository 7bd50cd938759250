"""Plans as sampled trajectories for robots and simulators: NumPy archives, CSV files or ROS messages."""

from cnpgen.export.plans import FORMS, Exported, Form, export_plans
from cnpgen.export.sampled import Sampled, sample_plan

__all__ = ["FORMS", "Exported", "Form", "Sampled", "export_plans", "sample_plan"]
