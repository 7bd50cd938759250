"""Choice of the speed of a chunk: the fastest of a few that meets the limits of velocity, acceleration, torque and jerk."""

from __future__ import annotations

from math import ceil

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.expressions import speed_violation
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.time_scaling import PhaseGrid
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.trajectory.spline import basis, chebyshev
from cnpgen.trajectory.spline_motion import Motion
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

Array = NDArray[np.float64]

SPEED_STEP = 0.125  # between the speeds that are compared
CHECK_INTERVALS = 95  # between the phases at which they are compared


class ChunkSpeeds:
    """Speeds of the chunks of one problem, from the chunk's own timing up to the largest one."""

    def __init__(self, record: ProblemRecord, max_speed: float) -> None:
        self.speeds = np.linspace(1, max_speed, ceil((max_speed - 1) / SPEED_STEP) + 1)
        with loaded_problem(record) as loaded:
            self._violation = loaded.kernels.load(speed_violation)
            self._orders = loaded.problem.path_orders
        self._grids: dict[TrajectorySpec, PhaseGrid] = {}

    def fastest(self, motion: Motion, poses: Array) -> int:
        """Return the index of the fastest of M motions along one path that meets the limits at the phases; 0 if none does.

        The motions have the ``speeds``. Scene values have shape (1, width).
        """
        grid = self.grid(motion.spec)
        column = grid.column(motion, np.repeat(poses, len(motion), axis=0))
        (violation,) = self._violation(column)
        meets = (violation[0].reshape(len(motion), -1) <= 0).all(axis=1)
        return int(np.flatnonzero(meets).max(initial=0))

    def grid(self, spec: TrajectorySpec) -> PhaseGrid:
        """Return the phases of splines of a kind; it is kept."""
        if (grid := self._grids.get(spec)) is None:
            s, degree = chebyshev(CHECK_INTERVALS), spec.degree
            path, rate = (
                np.stack([basis(s, points, degree, order) for order in range(orders)])
                for points, orders in (
                    (spec.path_control_points, self._orders),
                    (spec.rate_control_points, self._orders - 1),
                )
            )
            grid = self._grids[spec] = PhaseGrid(self._violation, path, rate)
        return grid
