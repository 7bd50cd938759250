"""Stage: the torque that holds the arm and its payload still, by inverse dynamics."""

from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field
from cnpgen.store.field import Field, Fields


@dataclass(frozen=True, kw_only=True)
class GravityTorque(Stage):
    """Stage: reject configurations of one end whose holding torque is above the limit."""

    end: str = field("end that is checked", choices=("start", "goal"))

    @property
    def inputs(self) -> tuple[str, ...]:
        return (f"{self.end}_q",)

    def describe(self) -> str:
        return f"require that the torque that holds the {self.end} configuration, payload included, is within its limits"

    def outputs(self, context: Context) -> Fields:
        return (
            Field(
                f"{self.end}_torque_ratio",
                "1",
                f"largest holding torque at the {self.end}, as a fraction of its planning limit",
                role="diagnostic",
                valid_min=(0.0,),
                valid_max=(1.0,),
            ),
        )

    def prepare(self, context: Context) -> StageFunction:
        kernel = context.kernels.load(torque_ratio)

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            # Parameters may change the payload.
            load = [candidates["parameters"]] if context.problem.parameters else []
            (ratio,) = kernel(candidates[f"{self.end}_q"], *load)
            candidates[f"{self.end}_torque_ratio"] = ratio
            candidates.reject(ratio[0] <= 1.0, f"joint torque limit at the {self.end}")

        return work


def torque_ratio(robot: Robot) -> Any:
    """Build ``q -> max_i |gravity torque_i| / limit_i``, with the problem's parameters ``(q, parameters) -> ...``.

    The limit is ``Robot.holding_limit``: friction at rest may act in either direction.
    """
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    parameters_sx, parameters = symbols("parameters", len(robot.parameters))
    zero = [0.0] * robot.n
    # Friction at rest is in the limit, so torques are those of the rigid body.
    torque = SymbolicState(robot, q, zero, zero, parameters, (), None).torque
    ratios = (
        ca.fabs(value) / limit
        for value, limit in zip(torque, robot.holding_limit.tolist(), strict=True)
    )
    arguments = [q_sx, parameters_sx] if parameters else [q_sx]
    return ca.Function("torque_ratio", arguments, [reduce(ca.fmax, ratios, ca.SX(0))])
