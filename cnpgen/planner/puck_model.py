"""Motion of a puck on the table, and its contact with the mallet: restitution and Coulomb friction of two discs.

The mallet is much heavier than the puck. At the contact, the velocity of the mallet relative to the puck has a normal
part, which the contact reverses by the restitution, and a tangential part, which friction reduces at most to rolling
(Stronge, Impact Mechanics, 2000, chapter 3). The puck is a homogeneous disc: rolling transfers a third of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError
from cnpgen.schema.argument_types import check_fields

Array = NDArray[np.float64]

ROLLING_SHARE = 1 / 3  # of the tangential velocity that a homogeneous disc takes over when it rolls
MAX_BOUNCES = 4  # on the bands, of one prediction
ANGLE_ITERATIONS = 8


@dataclass(frozen=True, kw_only=True)
class PuckModel:
    """Motion and contacts of a puck; the defaults are those of the simulator's plants.

    Attributes:
        drag: Deceleration over velocity on the table [1/s].
        restitution: Speed of separation over speed of approach, for mallet and puck.
        friction: Coefficient of friction of mallet and puck.
        band_restitution: The restitution of bands and puck.
        band_loss: Fraction of the velocity along a band that a bounce takes.
        half_width: Distance of the puck's centre from the table's centre line at a side band [m].
        home_edge: Coordinate x of the puck's centre at the band of the arm's side [m].

    Raises:
        UsageError: A parameter is negative or not finite.
    """

    drag: float = 0.5
    restitution: float = 0.75
    friction: float = 0.0
    band_restitution: float = 0.75
    band_loss: float = 0.0
    half_width: float = 0.48735
    home_edge: float = 0.56165

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0):
                raise UsageError(f"must be finite and not negative, got {value:g}", argument=name)

    def predict(self, position: Array, velocity: Array, time: Array) -> tuple[Array, Array]:
        """Predict N pucks, with bounces on the two side bands and the band of the arm's side.

        Args:
            position: Positions of the centres now [m], shape (N, 2).
            velocity: Velocities now [m/s], shape (N, 2).
            time: Times from now [s], shape (N,).

        Returns:
            Positions and velocities at these times, shape (N, 2) each.
        """
        # The path over the velocity that a puck still covers [s].
        left = np.array(time, np.float64) if self.drag == 0 else -np.expm1(-self.drag * time) / self.drag
        position, velocity = position.copy(), velocity.copy()
        low, high = np.array([self.home_edge, -self.half_width]), np.array([np.inf, self.half_width])
        for _ in range(MAX_BOUNCES):
            with np.errstate(divide="ignore", invalid="ignore"):
                bound = np.where(velocity > 0, high, low)
                share = np.where(velocity == 0, np.inf, np.maximum((bound - position) / velocity, 0.0))
            axis = np.argmin(share, axis=1)
            rows = np.arange(len(share))
            bounces = share[rows, axis] < left
            step = np.where(bounces, share[rows, axis], left)
            position += velocity * step[:, None]
            decay = 1 - self.drag * step
            velocity *= decay[:, None]
            left = (left - step) / decay
            if not bounces.any():
                break
            factors = np.full(velocity.shape, 1 - self.band_loss)
            factors[rows, axis] = -self.band_restitution
            velocity = np.where(bounces[:, None], velocity * factors, velocity)
        return position, velocity

    def velocity_after(self, velocity: Array, mallet_velocity: Array, normal: Array) -> Array:
        """Compute the velocities of N pucks after the contact [m/s], shape (N, 2).

        Args:
            velocity: Velocities before the contact [m/s], shape (N, 2).
            mallet_velocity: Velocities of the mallet [m/s], shape (N, 2).
            normal: Unit vectors from the mallet's centre to the puck's, shape (N, 2).
        """
        relative = mallet_velocity - velocity
        approach = np.maximum(np.sum(relative * normal, axis=1), 0.0)
        tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
        sliding = np.sum(relative * tangent, axis=1)
        impulse = (1 + self.restitution) * approach
        dragged = np.clip(ROLLING_SHARE * sliding, -self.friction * impulse, self.friction * impulse)
        after: Array = velocity + impulse[:, None] * normal + dragged[:, None] * tangent
        return after

    def hit_angle(self, velocity: Array, speed: Array, direction: Array) -> Array:
        """Compute the directions of N hits that send moving pucks in given directions [rad], shape (N,).

        The mallet moves along the line to the puck's centre.

        Args:
            velocity: Velocities of the pucks before the contact [m/s], shape (N, 2).
            speed: Speeds of the mallet [m/s], shape (N,).
            direction: Directions of the pucks after the contact, shape (N, 2), of any length.
        """
        wanted = np.arctan2(direction[:, 1], direction[:, 0])
        angle = wanted.copy()
        for _ in range(ANGLE_ITERATIONS):
            normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            after = self.velocity_after(velocity, speed[:, None] * normal, normal)
            error = np.arctan2(after[:, 1], after[:, 0]) - wanted
            angle -= (error + np.pi) % (2 * np.pi) - np.pi
        return angle
