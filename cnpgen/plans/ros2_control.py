"""Export format of ros2_control: the goal of a joint trajectory controller, as YAML."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from cnpgen.plans.exporter import ExportedSet, Exporter, SampledPlan
from cnpgen.plans.formats import point_text
from cnpgen.store.files.atomic import write_file


@dataclass(frozen=True)
class TrajectoryControllerGoal(Exporter):
    """A folder with one goal of ``control_msgs/action/FollowJointTrajectory`` per plan, as YAML.

    ``ros2 action send_goal`` takes the content as its goal.
    """

    suffix = ".yaml"

    def write(self, path: Path, plans: Iterable[SampledPlan], exported: ExportedSet) -> None:
        """Write a goal; see ``Exporter.write``."""
        (plan,) = plans
        lines = [
            "trajectory:",
            f"  joint_names: {json.dumps(exported.joint_names)}",
            "  points:",
            *(f"    - {point_text(plan, k, effort=False)}" for k in range(len(plan.t))),
        ]
        write_file(path, "\n".join(lines) + "\n")
