"""Stage: the torque that holds the arm and its payload still, by inverse dynamics."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.kernels.symbolic.dynamics import inverse_dynamics
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Round, Stage, Work
from cnpgen.schema.keys import field
from cnpgen.store.field import Field

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class GravityTorque(Stage):
    """Rejects configurations in which holding still needs more torque than the limit, at one end."""

    end: str = field("which end is looked at", choices=("start", "goal"))

    @property
    def needs(self) -> tuple[str, ...]:
        """The configuration."""
        return (f"{self.end}_q",)

    def describe(self) -> str:
        """Say where."""
        return (
            f"require that the torque that holds the {self.end} configuration, payload included, is within its limits"
        )

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The largest torque as a fraction of its limit."""
        del context
        text = f"largest holding torque at the {self.end}, as a fraction of its planning limit"
        return (Field(f"{self.end}_torque_ratio", "1", text, role="diagnostic", valid_min=(0.0,), valid_max=(1.0,)),)

    def prepare(self, context: Context) -> Work:
        """Load the kernel."""
        kernel = context.kernels.load(torque_ratio)

        def work(draws: Round, _random: np.random.Generator) -> None:
            (ratio,) = kernel(draws[f"{self.end}_q"])
            draws[f"{self.end}_torque_ratio"] = ratio
            draws.reject(ratio[0] <= 1.0, f"joint torque limit at the {self.end}")

        return work


def torque_ratio(robot: "Robot") -> Any:
    """Build ``q -> max_i |gravity torque_i| / limit_i``."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    zero = [0.0] * robot.n
    largest = ca.SX(0)
    for torque, limit in zip(inverse_dynamics(robot.chain, q, zero, zero), robot.torque_limit, strict=True):
        largest = ca.fmax(largest, ca.fabs(torque) / float(limit))
    return ca.Function("torque_ratio", [q_sx], [largest])
