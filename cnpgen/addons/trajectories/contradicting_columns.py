"""Velocities that are not the derivative of the positions: which error of the recording explains them.

Mean velocities between positions are compared with the mean of both recorded velocities.
An explanation is named if it lowers the difference to a small part. The order of the
explanations is that of the table ``_explanations``.
"""

from collections.abc import Iterator

import numpy as np

from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.arrays import Array
from cnpgen.documents import Names

CONTRADICTION = "velocities are not the derivative of the positions"
EXPLAINED_SHARE = 0.3  # of the difference, that may remain after a correction
MAX_REMAINDER = 0.15  # of the velocities' root mean square, beside the noise
FACTOR_TOLERANCE = 0.05  # relative, of a factor that is named as a unit or a sign
DEGREES = 180 / np.pi


def explain_velocities(
    trajectory: Trajectory,
    errors: SampleErrors,
    joint: int,
    joint_names: Names,
) -> str:
    """Return the error of recording that explains the velocities of a joint; empty if none does."""
    assert trajectory.dq is not None
    h = np.diff(trajectory.t)
    mean = np.diff(trajectory.q, axis=0) / h[:, None]
    # A mean velocity has an error of 2 e / h from both positions.
    noise = 2 * errors.q / float(np.median(h)) + errors.dq
    size = _rms(mean[:, joint])
    if size <= noise:
        # A joint at rest explains nothing.
        return ""
    if not trajectory.dq[:, joint].any():
        return f"those of {joint_names[joint]} are 0 while it moves"
    difference = _rms(mean[:, joint] - _mean_of_neighbors(trajectory.dq[:, joint]))
    largest = min(EXPLAINED_SHARE * difference, MAX_REMAINDER * size + noise)
    for text, found, rows in _explanations(trajectory.dq, mean, joint, joint_names):
        if _rms(mean[rows, joint] - _mean_of_neighbors(found)) <= largest:
            return text
    return ""


def _explanations(
    dq: Array, mean: Array, joint: int, joint_names: Names
) -> Iterator[tuple[str, Array, slice]]:
    """Yield explanations, the velocities that each corrects, and the spans that these cover."""
    # Shifted velocities lack one span at an end of the motion; other explanations cover
    # all.
    name = joint_names[joint]
    own = dq[:, joint]
    every = slice(None)
    between = _mean_of_neighbors(own)
    # Least squares: recorded velocity = factor * true velocity.
    factor = float(between @ mean[:, joint]) / float(mean[:, joint] @ mean[:, joint])
    if abs(factor / DEGREES - 1) < FACTOR_TOLERANCE:
        yield f"those of {name} are in degrees", own / DEGREES, every
    if abs(factor + 1) < FACTOR_TOLERANCE:
        yield f"those of {name} have the opposite sign", -own, every
    yield f"those of {name} are one sample late", own[1:], slice(0, -1)
    yield f"those of {name} are one sample early", own[:-1], slice(1, None)
    for other, other_name in enumerate(joint_names):
        if other != joint:
            text = f"those of {name} are in the column of {other_name}"
            yield text, dq[:, other], every
    # Any other factor is the last explanation: units and signs name the cause.
    if factor:
        yield f"those of {name} are {factor:.3g} times as large", own / factor, every


def _mean_of_neighbors(values: Array) -> Array:
    """Return the means of neighbors."""
    return (values[1:] + values[:-1]) / 2


def _rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else np.inf
