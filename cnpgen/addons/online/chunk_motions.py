"""Motions of action chunks: a path through the samples from a state of the running motion, and its possible speeds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import ceil

import numpy as np

from cnpgen.addons.online.chunk_fit import ChunkFit, chunk_fit
from cnpgen.addons.online.set_points import SetPoint
from cnpgen.arrays import Array
from cnpgen.planner.expressions import speed_violation
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.time_scaling import PhaseGrid
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.trajectory.spline import basis, chebyshev
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec
from cnpgen.world.certified import convex_body

POSITION_INSET_RAD = 5e-3  # of clipped positions: a smooth path overshoots its samples
SPEED_STEP = 0.125  # between the speeds that are compared
SPEED_CHECK_INTERVALS = 95  # between the phases at which they are compared


@dataclass(frozen=True, eq=False)
class ChunkMotion:
    """A motion of a chunk at its own timing, and faster rates along the same path.

    Attributes:
        fit: Matrices of the fit.
        plan: The motion.
        rates: Rate control points of all speeds [1/s], shape (M, R).
        distance: Largest distance from the raw samples [rad].
        others: Other columns of the samples, shape (K, D - n).
    """

    fit: ChunkFit
    plan: Plans
    rates: Array
    distance: float
    others: Array

    def at_speed(self, index: int) -> tuple[Plans, float]:
        """Return the motion at a speed, and its largest speed in units of the chunk's own timing."""
        rate = self.rates[index : index + 1]
        plan = replace(self.plan, rate_control_points=rate)
        return plan, float(rate.max()) * self.fit.duration


class ChunkMotions:
    """Motions of the chunks of one problem, from the chunk's own timing up to a largest speed."""

    def __init__(self, record: ProblemRecord, rate: float, max_speed: float) -> None:
        self._record = record
        self._rate = rate
        self._speeds = np.linspace(1, max_speed, ceil((max_speed - 1) / SPEED_STEP) + 1)
        with loaded_problem(record) as loaded:
            self._violation = loaded.kernels.load(speed_violation)
            self._orders = loaded.problem.path_orders
            robot = loaded.robot
        self._grids: dict[TrajectorySpec, PhaseGrid] = {}
        # Joints with less than two insets of range keep their middle.
        middle = (robot.position_lower + robot.position_upper) / 2
        self._low = np.minimum(robot.position_lower + POSITION_INSET_RAD, middle)
        self._high = np.maximum(robot.position_upper - POSITION_INSET_RAD, middle)
        self._parameters = robot.nominal_parameters if record.parameters else None
        for part in [] if robot.shape is None else robot.shape.convex_parts:
            _ = convex_body(part.vertices, part.radius).shape  # built before verdicts

    def prepare(self, lengths: Iterable[int]) -> list[int]:
        """Compute the matrices of chunks of all lengths; return one length of each parametrization of motions."""
        specs = {chunk_fit(length, self._rate).spec: length for length in lengths}
        for spec in specs:
            self._grid(spec)
        return list(specs.values())

    def motion(self, q: Array, others: Array, state: SetPoint) -> ChunkMotion:
        """Fit a motion from a state to samples, shape (K, n), after clipping them to the position limits."""
        fit = chunk_fit(len(q), self._rate)
        inside = np.clip(q, self._low, self._high)
        # The path depends on the running speed alone, so all speeds share it.
        running = fit.running_speed(inside, state, float(self._speeds[-1]))
        rates = fit.rate(running, self._speeds)
        samples = fit.blended(inside, state, running)
        boundary, path = fit.fit(samples, state, rates[0])
        if self._parameters is not None:
            boundary = replace(boundary, parameters=self._parameters[None])
        plan = make_plans(
            self._record,
            boundary,
            path_control_points=path[None],
            rate_control_points=rates[:1],
            degree=fit.spec.degree,
            source="action chunk",
        )
        # The distance is that from the raw samples, which clipping and blending may
        # change.
        reached = basis(fit.phases, len(path), fit.spec.degree) @ path
        return ChunkMotion(fit, plan, rates, float(np.abs(reached - q).max()), others)

    def fastest(self, motion: ChunkMotion) -> int:
        """Return the index of the fastest rate that meets the limits at the phases of a grid; 0 if none does."""
        if (count := len(motion.rates)) == 1:
            return 0
        path = motion.plan.path_control_points
        # Every speed is one motion, evaluated with the others in one call.
        motions = Motion(
            np.repeat(path, count, axis=0), motion.rates, motion.plan.degree
        )
        poses = np.repeat(motion.plan.scene.poses, count, axis=0)
        (violation,) = self._violation(
            self._grid(motion.fit.spec).column(motions, poses)
        )
        meets = (violation[0].reshape(count, -1) <= 0).all(axis=1)
        return int(np.flatnonzero(meets).max(initial=0))

    def _grid(self, spec: TrajectorySpec) -> PhaseGrid:
        """Return the phases at which splines of a kind are compared with the limits; it is kept."""
        if (grid := self._grids.get(spec)) is None:
            # Chebyshev phases are denser near both ends.
            s = chebyshev(SPEED_CHECK_INTERVALS)
            degree = spec.degree
            path, rate = (
                np.stack([basis(s, points, degree, order) for order in range(orders)])
                for points, orders in (
                    (spec.path_control_points, self._orders),
                    (spec.rate_control_points, self._orders - 1),
                )
            )
            grid = self._grids[spec] = PhaseGrid(self._violation, path, rate)
        return grid
