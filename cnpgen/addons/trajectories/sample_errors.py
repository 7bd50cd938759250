"""Errors of samples: those that are stated, and the rounding that the numbers themselves show.

Text has a last decimal, an encoder a step, and most recordings the spacing of float32.
Half a unit is the largest error of rounding. It is a lower bound of the error of a
sensor, which numbers do not show.
"""

from dataclasses import dataclass

import numpy as np

from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array

EXACT_DECIMALS = 9  # numbers with so many are not rounded
MIN_STEPS = 20  # changes of a value that show the step of an encoder
MAX_STEPS = 2**16  # of an encoder between two samples
STEP_TOLERANCE = 0.02  # of a step
DEGREE = float(np.pi / 180)
NEGLIGIBLE_SHARE = 0.02  # of an acceleration limit, that rounding may change


@dataclass(frozen=True)
class SampleErrors:
    """Largest errors of the samples of a trajectory.

    Attributes:
        q: Of positions [rad].
        dq: Of velocities [rad/s].
        ddq: Of accelerations [rad/s^2].
        t: Of times [s].
        source: How the errors are known, for the output.
    """

    q: float
    dq: float
    ddq: float
    t: float
    source: str

    @property
    def values(self) -> Array:
        """Errors of positions, velocities and accelerations, shape (3,)."""
        return np.array([self.q, self.dq, self.ddq])


def errors_of(
    trajectory: Trajectory, noise: Array | None, jitter: float | None
) -> SampleErrors:
    """Return the stated errors of samples, and the visible rounding in place of those that are not stated.

    The noise is that of positions, velocities and accelerations, shape (3,).
    """
    found = []
    if noise is None:
        kinds = {"positions": trajectory.q}
        kinds |= {} if trajectory.dq is None else {"velocities": trajectory.dq}
        kinds |= {} if trajectory.ddq is None else {"accelerations": trajectory.ddq}
        units = zip(("rad", "rad/s", "rad/s^2"), kinds.items(), strict=False)
        values = np.zeros(3)
        for order, (unit, (name, columns)) in enumerate(units):
            kind, values[order] = rounding(columns)
            if kind:
                found.append(f"{name} have {kind}: noise {values[order]:.2g} {unit}")
        noise = values
    if jitter is None:
        kind, jitter = time_rounding(trajectory.t)
        if kind:
            found.append(f"times have {kind}: jitter {jitter:.2g} s")
    q, dq, ddq = noise.tolist()
    return SampleErrors(q, dq, ddq, jitter, "; ".join(found))


def is_negligible(
    errors: SampleErrors, trajectory: Trajectory, max_acceleration: Array
) -> bool:
    """Return whether errors change accelerations by so little that samples are read as exact.

    Errors e of positions and e_v of velocities change them by 4 e / h^2 and 2 e_v / h.
    The limits [rad/s^2] have shape (n,).
    """
    if not (errors.values.any() or errors.t):
        return True
    if not errors.source or errors.t:
        # Stated errors are always used.
        return False
    h = float(np.median(np.diff(trajectory.t)))
    change = max(4 * errors.q / h**2, 2 * errors.dq / h, errors.ddq)
    return change <= NEGLIGIBLE_SHARE * float(max_acceleration.min())


def rounding(columns: Array) -> tuple[str, float]:
    """Return the kind of the rounding of columns, shape (K, n), and half its unit; empty for exact numbers.

    Columns of one value alone show nothing. Angles may be rounded in radians or degrees.
    """
    # Constant columns have few decimals by chance.
    moving = columns[:, np.ptp(columns, axis=0) > 0]
    if not moving.size:
        return "", 0.0
    single = ""
    half_spacing = 0.0
    # Decimals of radians are tried before those of degrees.
    for unit, name in ((1.0, ""), (DEGREE, " of a degree")):
        values = columns / unit
        spacing = _float32_spacing(values)
        decimals = _decimals(values, spacing)
        if decimals is not None:
            half = (0.5 * 10.0**-decimals + spacing / 2) * unit
            return f"{_counted(decimals)}{name}", half
        if spacing and not single:
            single = "the precision of float32"
            half_spacing = spacing / 2 * unit
    # All moving joints must show the steps of an encoder.
    steps = [_step(column) for column in moving.T]
    known = [step for step in steps if step is not None]
    if known and len(known) == len(steps):
        return f"steps of {max(known):.3g} rad", max(known) / 2
    return single, half_spacing


def time_rounding(t: Array) -> tuple[str, float]:
    """Return the kind of the rounding of times [s], shape (K,), and half its unit; empty for exact times.

    Equal steps are a grid: its times are exact, however few decimals they have.
    """
    # The last step of a motion is often shorter.
    steps = np.diff(t)[:-1]
    spacing = _float32_spacing(t[:, None])
    # Equal steps up to rounding are computed times.
    if not len(steps) or np.ptp(steps) <= 2 * spacing + 1e-12:
        return "", 0.0
    decimals = _decimals(t[:, None], spacing)
    if decimals is not None:
        return _counted(decimals), 0.5 * 10.0**-decimals + spacing / 2
    return ("the precision of float32", spacing / 2) if spacing else ("", 0.0)


def _counted(decimals: int) -> str:
    return "1 decimal" if decimals == 1 else f"{decimals} decimals"


def _float32_spacing(values: Array) -> float:
    """Return the largest spacing of values that are numbers of float32; otherwise 0."""
    single = values.astype(np.float32)
    close = 4 * np.finfo(float).eps * np.abs(values)  # of a change of units
    if not (np.abs(single - values) <= close).all():
        return 0.0
    return float(np.spacing(np.abs(single)).max())


def _decimals(values: Array, spacing: float) -> int | None:
    """Return the smallest number of decimals that all values have; None for numbers that are not rounded.

    Numbers of float32 have decimals up to their spacing only.
    """
    for decimals in range(EXACT_DECIMALS):
        unit = 10.0**-decimals
        # A unit near the spacing of float32 is no sign of rounded decimals.
        if unit < 64 * spacing:
            return None
        units = values / unit
        close = 8 * np.finfo(float).eps * np.abs(units) + 1e-12 + spacing / unit
        if (np.abs(units - np.round(units)) <= close).all():
            return decimals
    return None


def _step(column: Array) -> float | None:
    """Return the step of an encoder: the smallest change, if all others are multiples of it."""
    changes = np.abs(np.diff(column))
    # Differences between levels show the step where fast joints skip levels.
    levels = np.diff(np.unique(column))
    changes = np.concatenate([changes, levels])
    changes = changes[changes > 1e-9]
    if len(changes) < MIN_STEPS:
        return None
    # The median of changes near the smallest one averages their rounding.
    step = float(np.median(changes[changes < 1.5 * changes.min()]))
    counts = changes / step
    regular = np.abs(counts - np.round(counts)) < STEP_TOLERANCE
    return step if regular.all() and counts.max() < MAX_STEPS else None
