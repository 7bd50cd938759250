"""Parts of a planner in C: the tapes, tables and bounds of a model, or the reason why it cannot be exported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cnpgen.addons.deploy.check_functions import (
    checked,
    moving_violations,
    position_violations,
    relaxed,
)
from cnpgen.addons.deploy.input_ranges import InputRanges
from cnpgen.addons.deploy.task_functions import CONDITION_NAMES, task
from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.kernels.library import KernelLibrary
from cnpgen.kernels.tape import Tape
from cnpgen.planner.control_point_functions import line_change, projected_path
from cnpgen.planner.expressions import (
    SpeedBounds,
    effective_steps,
    speed_bounds,
    speed_coefficients,
    speed_residuals,
    speed_violation,
)
from cnpgen.planner.inference_pipeline import LoadedProblem
from cnpgen.planner.model import Model
from cnpgen.planner.network.features import SCENE
from cnpgen.planner.planner import REST_TOLERANCE
from cnpgen.planner.time_parametrization import (
    INTERVALS_AT_REST,
    PARAMETRIZATION_INTERVALS,
    TimeParametrization,
    make_time_parametrization,
)
from cnpgen.planner.time_scaling import SCALING_INTERVALS
from cnpgen.problems.problem import Problem
from cnpgen.robots.parameter_ranges import RANGE_ROUNDING
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.spline import chebyshev

LANES = 8  # phases that are evaluated together
CHECK_INTERVALS = 39  # between phases, of models whose rates are not fitted
MAX_POSITION_WORK = (
    60_000  # operations of the position check, above which it has fewer phases
)


@dataclass(frozen=True)
class PlannerParts:
    """Parts of a planner in C; made by ``planner_parts``.

    Attributes:
        model: The model.
        problem: Its problem.
        robot: Its robot.
        tapes: Tapes by the name of their C function; those that the model does not use
            are absent.
        parametrization: Time parametrization, or None.
        scaling: Bounds of the rows of ``speed_residuals`` if time is scaled, or None.
        phases: Phases of the grid, shape (K,).
        checked_phases: Indices of those at which positions are checked.
        ranges: Ranges of the network's inputs.
    """

    model: Model
    problem: Problem
    robot: Robot
    tapes: dict[str, Tape]
    parametrization: TimeParametrization | None
    scaling: SpeedBounds | None
    phases: Array
    checked_phases: list[int]
    ranges: InputRanges

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the boundary conditions of a request, in their order."""
        return CONDITION_NAMES[: 3 + self.model.fixed_at_goal]

    @property
    def position_constraints(self) -> list[int]:
        """Constraints of the rows of ``position_violations``."""
        return checked(self.robot, self.problem, moving=False)

    @property
    def moving_constraints(self) -> list[int]:
        """Constraints of the rows of ``moving_violations``."""
        return checked(self.robot, self.problem, moving=True)

    @property
    def relaxed(self) -> list[int]:
        """Constraints whose bounds are relaxed for a start off the manifold."""
        return relaxed(self.problem)

    @property
    def zero_tolerance(self) -> Array:
        """Rounding errors of conditions that must be zero, by condition and joint, as in ``Planner``."""
        limits = {
            "dq": self.robot.velocity_limit,
            "ddq": self.robot.acceleration_limit,
        }
        rows = [
            # Conditions on positions have no tolerance.
            limits.get(name.partition("_")[2], np.zeros(self.robot.n))
            for name in self.conditions
        ]
        return REST_TOLERANCE * np.array(rows)

    @property
    def parameter_ranges(self) -> tuple[Array, Array]:
        """Bounds of the parameters, relaxed by rounding errors, shape (P,) each."""
        spans = self.problem.parameters.ranges
        # Rounding errors are relative to the larger bound.
        rounding = [RANGE_ROUNDING * max(abs(s.low), abs(s.high)) for s in spans]
        low = [span.low - error for span, error in zip(spans, rounding, strict=True)]
        high = [span.high + error for span, error in zip(spans, rounding, strict=True)]
        return np.array(low), np.array(high)


def check_supported(model: Model, problem: Problem, robot: Robot) -> None:
    """Raise UsageError for a model that cannot be a C file yet, with the reason."""
    reason = ""
    if problem.has_sample_obstacles or SCENE in model.features.blocks:
        reason = "its samples place obstacles (scenes), which C files do not support"
    elif model.config.iterations > 1:
        reason = "its network corrects its own path, which C files do not support"
    elif model.config.via_points:
        reason = "it plans along lines through via points, which C files do not support"
    elif robot.drive is not None:
        reason = "its problem has drives, which C files do not support"
    elif not all(
        np.isfinite(values).all()
        for values in (model.parameters, model.features.mean, model.features.scale)
    ):
        reason = "its parameters are not finite"
    if reason:
        raise UsageError(
            f"a model of {problem.name!r} cannot be exported to C: {reason}"
        )


def planner_parts(
    model: Model, loaded: LoadedProblem, ranges: InputRanges
) -> PlannerParts:
    """Build all tapes and tables of a model that ``check_supported`` accepts."""
    problem, robot, kernels = loaded.problem, loaded.robot, loaded.kernels
    parametrization = (
        make_time_parametrization(
            problem, robot, kernels, at_rest=model.is_rest_to_rest
        )
        if model.config.time_parametrized
        else None
    )
    # Time can be scaled only if both ends are at rest.
    scaling = speed_bounds(robot, problem) if model.is_rest_to_rest else None
    tapes = _tapes(model, kernels, parametrized=parametrization is not None)
    phases = _phases(model)
    stride = _stride(tapes["position_violations"], len(phases))
    return PlannerParts(
        model,
        problem,
        robot,
        tapes,
        parametrization,
        scaling,
        phases,
        _checked_phases(phases, stride),
        ranges,
    )


def _tapes(
    model: Model, kernels: KernelLibrary, *, parametrized: bool
) -> dict[str, Tape]:
    config, fixed = model.config, model.fixed_at_goal
    options: dict[str, Any] = {
        "fixed_at_goal": fixed,
        "within_limits": config.within_limits,
    }
    builders: dict[str, tuple[Any, dict[str, Any]]] = {
        "task": (
            task,
            {
                "fixed_at_goal": fixed,
                "expected_time": config.expected_time,
                "blocks": model.features.blocks,
            },
        ),
        "projected_path": (
            projected_path,
            {"steps": effective_steps(kernels, config.projection_steps), **options},
        ),
        "moving_violations": (moving_violations, {}),
        "position_violations": (position_violations, {}),
    }
    if steps := effective_steps(kernels, config.line_projection_steps):
        own = {"steps": steps, "with_offsets": False, **options}
        builders["line_change"] = line_change, own
    if parametrized:
        builders["speed_violation"] = speed_violation, {}
        builders["speed_coefficients"] = speed_coefficients, {}
    if model.is_rest_to_rest:
        builders["speed_residuals"] = speed_residuals, {}
    return {
        name: kernels.tape(builder, **own) for name, (builder, own) in builders.items()
    }


def _phases(model: Model) -> Array:
    """Return the phases of the grid: those at which Python fits the rates, so that both fit them equally.

    The last one repeats up to whole groups of ``LANES``.
    """
    at_rest, intervals = model.is_rest_to_rest, CHECK_INTERVALS
    if model.config.time_parametrized:
        intervals = INTERVALS_AT_REST if at_rest else PARAMETRIZATION_INTERVALS
    elif at_rest:
        intervals = SCALING_INTERVALS
    phases = chebyshev(intervals)
    # A repeated phase changes no maximum over the grid.
    return np.append(phases, np.ones(-len(phases) % LANES))


def _stride(tape: Tape, phases: int) -> int:
    """Return the distance of the phases at which positions are checked: clearances take most of the time."""
    return next(
        stride
        for stride in (1, 2, 4)
        # The largest stride is used whatever the work is.
        if stride == 4 or len(tape) * phases / stride <= MAX_POSITION_WORK
    )


def _checked_phases(phases: Array, stride: int) -> list[int]:
    """Return the indices of every ``stride``-th phase and the last one, in whole groups of ``LANES``."""
    # The first of the equal last phases.
    last = int(np.argmax(phases))
    indices = sorted({*range(0, last + 1, stride), last})
    return [*indices, *[last] * (-len(indices) % LANES)]
