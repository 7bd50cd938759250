"""SciPy's SLSQP on the refiner's transcription of the first pass: the paper's TrajOpt, but with exact derivatives."""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.transcription import Linearisation, Transcription
from cnpgen.refine.task import Task

Array = NDArray[np.float64]
MAX_ITERATIONS = 200


class OutOfTimeError(Exception):
    """The cap on the CPU time is reached."""


@dataclass
class Function:
    """Objective and bounded residuals, evaluated once per x.

    Attributes:
        motion: The transcription.
        bounds: Bounds of its residuals.
        until: ``time.process_time()`` at which it gives up.
        at: The last evaluation.
    """

    motion: Transcription
    bounds: Bounds
    until: float
    at: Linearisation | None = None

    def __post_init__(self) -> None:
        self.above = np.nonzero(np.isfinite(self.bounds.upper))
        self.below = np.nonzero(np.isfinite(self.bounds.lower))

    def evaluate(self, x: Array) -> Linearisation:
        """Evaluate, or remember.

        Raises:
            OutOfTimeError: It is too late.
        """
        if time.process_time() > self.until:
            raise OutOfTimeError
        if self.at is None or not np.array_equal(self.at.x, x):
            self.at = self.motion.evaluate(x.copy())
        return self.at

    def room(self, x: Array) -> Array:
        """How far the residuals are inside their bounds."""
        g = self.evaluate(x).g
        return np.concatenate([(self.bounds.upper - g)[self.above], (g - self.bounds.lower)[self.below]])

    def room_jacobian(self, x: Array) -> Array:
        """Its Jacobian, shape (m, nx)."""
        at = self.evaluate(x)
        return np.vstack([-self.motion.rows(at, *self.above), self.motion.rows(at, *self.below)])


def minimise_slsqp(refiner: Refiner, task: Task, x: Array, *, cap: float) -> tuple[Array, float]:
    """Minimise from x; return where it ended and the CPU time [s].

    Args:
        refiner: Whose transcription and bounds of the first pass are used.
        task: The boundary problem.
        x: First variables.
        cap: CPU time at which it is stopped [s]; what it last looked at comes back.
    """
    from scipy.optimize import minimize

    which, start = refiner.passes.first, time.process_time()
    motion = refiner.transcription(task, which)
    bounds = refiner.bounds(task, which, motion.end_residuals())
    function = Function(motion, bounds, start + cap)
    try:
        with np.errstate(all="ignore"):
            found = minimize(
                lambda x: function.evaluate(x).cost,
                x,
                jac=lambda x: function.evaluate(x).gradient,
                constraints={"type": "ineq", "fun": function.room, "jac": function.room_jacobian},
                method="SLSQP",
                options={"ftol": which.settings.cost_tolerance / 10, "maxiter": MAX_ITERATIONS},
            )
        end = np.array(found.x)
    except OutOfTimeError:
        end = x if function.at is None else function.at.x
    return end, time.process_time() - start
