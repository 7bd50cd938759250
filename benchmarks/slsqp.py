"""SciPy's SLSQP on the refiner's transcription of the coarse level: the paper's TrajOpt, but with exact derivatives."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from numpy_transcription import Linearization, evaluate, residual_gradients

from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.refine.task import RefinementTask

Array = NDArray[np.float64]
MAX_ITERATIONS = 200


class OutOfTimeError(Exception):
    """The limit of the CPU time is reached."""


@dataclass
class Function:
    """Objective and bounded residuals, evaluated once per x.

    Attributes:
        motion: The transcription.
        bounds: Bounds of its residuals.
        until: Limit of ``time.process_time()`` [s].
        at: Last evaluation.
    """

    motion: Transcription
    bounds: Bounds
    until: float
    at: Linearization | None = None

    def __post_init__(self) -> None:
        self.above = np.nonzero(np.isfinite(self.bounds.upper))
        self.below = np.nonzero(np.isfinite(self.bounds.lower))

    def evaluate(self, x: Array) -> Linearization:
        """Evaluate at x, or return the last evaluation.

        Raises:
            OutOfTimeError: The limit of the CPU time is reached.
        """
        if time.process_time() > self.until:
            raise OutOfTimeError
        if self.at is None or not np.array_equal(self.at.x, x):
            self.at = evaluate(self.motion, x.copy())
        return self.at

    def margins(self, x: Array) -> Array:
        """Return the margins of the residuals to their bounds."""
        g = self.evaluate(x).g
        return np.concatenate(
            [(self.bounds.upper - g)[self.above], (g - self.bounds.lower)[self.below]]
        )

    def margins_jacobian(self, x: Array) -> Array:
        """Return the Jacobian of the margins, shape (m, nx)."""
        at = self.evaluate(x)
        return np.vstack(
            [
                -residual_gradients(self.motion, at, *self.above),
                residual_gradients(self.motion, at, *self.below),
            ]
        )


def minimize_slsqp(
    refiner: Refiner, task: RefinementTask, x: Array, *, cap: float
) -> tuple[Array, float]:
    """Minimize from x; return the last iterate and the CPU time [s].

    Args:
        refiner: Refiner whose transcription and bounds of the coarse level are used.
        task: The boundary problem.
        x: Initial variables.
        cap: Limit of the CPU time [s], after which the last evaluated iterate is returned.
    """
    from scipy.optimize import minimize

    level, start = refiner.levels.coarse, time.process_time()
    motion = refiner.transcription(task, level)
    bounds = refiner.bounds(task, level, motion.end_residuals())
    function = Function(motion, bounds, start + cap)
    try:
        with np.errstate(all="ignore"):
            solution = minimize(
                lambda x: function.evaluate(x).cost,
                x,
                jac=lambda x: function.evaluate(x).gradient,
                constraints={
                    "type": "ineq",
                    "fun": function.margins,
                    "jac": function.margins_jacobian,
                },
                method="SLSQP",
                options={
                    "ftol": level.settings.cost_tolerance / 10,
                    "maxiter": MAX_ITERATIONS,
                },
            )
        end = np.array(solution.x)
    except OutOfTimeError:
        end = x if function.at is None else function.at.x
    return end, time.process_time() - start
