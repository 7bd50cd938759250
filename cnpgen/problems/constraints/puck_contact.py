"""Contact of the mallet with the puck: only at the end of a hit, and from behind.

The puck of a motion follows from its goal: its centre is ``contact_distance`` ahead of
the tip there, along the tip's velocity. At this distance the bodies would overlap, so
that the mallet touches the puck shortly before the goal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.documents import NamedErrors
from cnpgen.problems.constraints.constraint import (
    Condition,
    Conditions,
    Constraint,
    End,
)
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.world import World


# So that motions do not touch the puck within a tolerance of this size.


ADDED_RADIUS_M = 1e-4
ROUNDING = 0.02  # of the relaxation near the goal, relative to the overlap
SOLVER_MARGIN_M, STRAIGHT_HIT_MARGIN_M = 1e-3, 1e-4  # from the puck; of straight hits
TRAINING_MARGIN_M = 2e-3
TRAINING_KNEE_M = 5e-4  # larger violations are penalized linearly
PUCK_OUT_OF_REACH_M = 1e3  # coordinates of the puck of a motion whose goal is no hit
MIN_HIT_SPEED_M_S = 1e-6
MIN_SQUARED_PUCK_DISTANCE_M2 = 1e-12  # keeps the derivative of a distance finite
GUESS_CLEARANCE_M = 0.015  # of initial guesses around the puck
APPROACH_LENGTH_M = 0.04  # straight end of these guesses
ARC_STEP_RAD = 0.2
ARC_END_RAD = 0.4  # from the direction opposite to the hit


@dataclass(frozen=True, kw_only=True)
class PuckContact(Constraint):
    """Constraint: the mallet touches the puck only on the last part of a hit, behind the puck.

    The distance of the centres is at least ``ADDED_RADIUS_M`` above the sum of the
    radii. The exception is a disc whose diameter of length ``last`` ends at the goal,
    opposite to the hit. With 10 mm, the mallet is then within 4 degrees of the
    direction of the hit.
    """

    reason = "early contact with the puck"
    boundary_reason = "start touches the puck"
    reads = ()
    training_weight = 3e6
    has_solver_margin = True
    scene_width = 4
    mallet_radius: float = field(
        "radius of the mallet", unit="m", low=1e-6, plausible=0.5
    )
    puck_radius: float = field("radius of the puck", unit="m", low=1e-6, plausible=0.5)
    contact_distance: float = field(
        "distance of the centres of mallet and puck at the goal",
        unit="m",
        low=0.0,
        plausible=1.0,
    )
    last: float = field(
        "length of the end of the path on which contact is allowed",
        unit="m",
        low=1e-6,
        plausible=0.5,
    )
    tolerance: float = field(
        "violation that a valid motion may have", unit="m", low=0.0, plausible=0.5
    )

    def validate(self) -> NamedErrors:
        """Yield (key, error) pairs."""
        if not 0 < self.overlap < self.last - ADDED_RADIUS_M:
            yield (
                "contact_distance",
                f"is {self.contact_distance:g} m, expected less than the sum of the radii, {self.contact_range:g} m,"
                f" by less than 'last', {self.last:g} m",
            )

    @property
    def contact_range(self) -> float:
        """Distance of the centres at which mallet and puck touch [m]."""
        return self.mallet_radius + self.puck_radius

    @property
    def overlap(self) -> float:
        """Planned overlap of mallet and puck at the goal [m]."""
        return self.contact_range - self.contact_distance

    def scene_values(self, goal_xyz: Array, goal_velocity: Array) -> Array:
        """Return the goal and the puck of N motions: x and y of both [m], shape (N, 4); out of reach if at rest."""
        goal = goal_xyz[:, :2]
        velocity = goal_velocity[:, :2]
        speed = np.hypot(velocity[:, :1], velocity[:, 1:])
        is_hit = speed > MIN_HIT_SPEED_M_S
        # Ahead of the tip along its velocity; the floor only avoids a division by zero.
        puck = goal + self.contact_distance * velocity / np.maximum(
            speed, MIN_HIT_SPEED_M_S
        )
        values = np.concatenate([goal, puck], axis=1)
        if np.count_nonzero(is_hit) < len(is_hit):
            values[~is_hit[:, 0]] = PUCK_OUT_OF_REACH_M
        return values

    def symbolic(self, state: SymbolicState) -> Conditions:
        """State the distance of the centres [m] in the form for solvers."""
        return self._cone(*self._symbolic_distances(state), SOLVER_MARGIN_M)

    def penalized(self, state: SymbolicState) -> Conditions:
        """State the distance for the training loss: the square of a large violation grows linearly."""
        import casadi as ca

        (condition,) = self._cone(*self._symbolic_distances(state), TRAINING_MARGIN_M)
        # e / sqrt(1 + e / k): like e below the knee k, like sqrt(k e) above, so the
        # square of it grows linearly.
        violation = ca.fmax(0, condition.lower[0] - condition.g[0])
        return (
            replace(
                condition,
                g=[
                    condition.lower[0]
                    - violation / ca.sqrt(1 + violation / TRAINING_KNEE_M)
                ],
            ),
        )

    def symbolic_at(self, state: SymbolicState, end: End) -> Conditions:
        """State the distance at the start [m], where no contact is allowed.

        The goal is in contact.
        """
        # At the goal the bodies overlap by construction.
        if end == "goal":
            return ()
        return _at_least(
            self.contact_range + ADDED_RADIUS_M, self._symbolic_distances(state)[1]
        )

    def measured(self, world: World) -> Conditions:
        """Evaluate the distance of the centres with Pinocchio's tip position [m]."""
        return self._condition(*self._measured_distances(world))

    def measured_at(self, world: World, end: End) -> Conditions:
        """Evaluate the distance at the start, where no contact is allowed.

        The goal is in contact.
        """
        if end == "goal":
            return ()
        return _at_least(
            self.contact_range + ADDED_RADIUS_M, self._measured_distances(world)[1]
        )

    def touches(self, tip: Array, scene_values: Array) -> Mask:
        """Return whether the mallet touches the pucks of ``scene_values`` at N tip positions [m], shape (N, 3)."""
        touching: Mask = (
            np.hypot(*(tip[:, :2] - scene_values[:, 2:]).T) < self.contact_range
        )
        return touching

    def distances_from_contact_region(self, world: World) -> Array:
        """Return the distances of K tips from the disc of permitted contact [m], shape (K,); 0 within it.

        The disc touches the goal, and its diameter of length ``last`` is opposite to
        the hit.
        """
        x, y = world.parameters.on_table(world.tip_position)[:2]
        values = world.scene_values
        # Without values there is no puck.
        if not len(values):
            return np.full(np.shape(x), PUCK_OUT_OF_REACH_M)
        goal = np.asarray(values[:2])
        puck = np.asarray(values[2:4])
        # Center of the disc: half its diameter behind the goal, opposite to the hit.
        center = goal - (puck - goal) * (self.last / 2 / self.contact_distance)
        distance = np.hypot(x - center[0], y - center[1])
        return np.asarray(np.maximum(distance - self.last / 2, 0.0))

    def solved(self, world: World) -> Conditions:
        """Return the form for solvers."""
        return self._cone(*self._measured_distances(world), SOLVER_MARGIN_M)

    def _symbolic_distances(self, state: SymbolicState) -> tuple[Any, Any]:
        """Return the squared distance of the tip from the goal [m^2] and the distance of the centres [m]."""
        import casadi as ca

        tip = state.on_table(state.kinematics.tip)
        values = state.scene_values or [PUCK_OUT_OF_REACH_M] * self.scene_width
        from_goal, from_puck = (
            (tip[0] - x) ** 2 + (tip[1] - y) ** 2 for x, y in (values[:2], values[2:])
        )
        return from_goal, ca.sqrt(from_puck + MIN_SQUARED_PUCK_DISTANCE_M2)

    def _measured_distances(self, world: World) -> tuple[Any, Any]:
        values = (
            world.scene_values
            if len(world.scene_values)
            else [PUCK_OUT_OF_REACH_M] * self.scene_width
        )
        x, y = world.parameters.on_table(world.tip_position)[:2]
        goal_x, goal_y, puck_x, puck_y = values
        return (x - goal_x) ** 2 + (y - goal_y) ** 2, np.hypot(x - puck_x, y - puck_y)

    def _condition(self, from_goal: Any, distance: Any) -> Conditions:
        """State the distance of the centres, larger by a relaxation near the goal.

        The relaxation ``h max(1 - rho^2 / (h l), 0)`` at a distance rho from the goal,
        for the overlap h and the length l, permits contact in the disc of diameter l.
        The maximum is rounded, so that the verdict finds local maxima.
        """
        # At the goal the distance is the range less the overlap, so that the sum below
        # equals the bound.
        overlap = self.overlap + ADDED_RADIUS_M
        relaxation = overlap * _positive_part(1 - from_goal / (overlap * self.last))
        return _at_least(self.contact_range + ADDED_RADIUS_M, distance + relaxation)

    def _cone(self, from_goal: Any, distance: Any, margin: float) -> Conditions:
        """State a stricter condition, by a margin [m], that limits all of the last states, not only the first contact.

        The relaxation decreases linearly with the distance from the goal, so that a
        straight hit has the same margin at all of them. Solvers, which check grid
        points only, would miss the first contact.
        """
        # The relaxation h max(1 + (m - rho) / h, 0) is h + m at the goal and falls with
        # slope one.
        overlap = self.overlap + ADDED_RADIUS_M + margin
        rho = (from_goal + MIN_SQUARED_PUCK_DISTANCE_M2) ** 0.5
        relaxation = overlap * _positive_part(
            1 + (STRAIGHT_HIT_MARGIN_M - rho) / overlap
        )
        return _at_least(
            self.contact_range + ADDED_RADIUS_M + margin, distance + relaxation
        )

    def initial_tip_paths(self, values: Array, start_xyz: Array) -> list[Array]:
        """Return tip paths around the puck on either side, the shorter one first.

        None if it is not in the way.
        """
        goal, puck, start = values[:2], values[2:], start_xyz[:2]
        hit = (puck - goal) / self.contact_distance
        # The straight path is free if it passes the puck's near side outside the
        # contact range.
        entry = puck - (self.contact_range + self.overlap) * hit
        if distances_from_segments(puck, start, entry) >= self.contact_range:
            return []
        radius = self.contact_range + GUESS_CLEARANCE_M
        offset = start - puck
        # Within the circle there is no tangent: acos(radius / distance) is then zero.
        distance = max(float(np.hypot(*offset)), radius)
        # 0 behind the puck
        angle = math.atan2(
            -hit[0] * offset[1] + hit[1] * offset[0], -float(hit @ offset)
        )
        paths = []
        # Both ways round: by the angle, and by the rest of the full turn.
        for begin in (angle, angle - math.copysign(2 * math.pi, angle)):
            side = math.copysign(1.0, begin)
            # From the start, a tangent meets the circle at this angle (right triangle
            # with the radius).
            tangent = abs(begin) - math.acos(radius / distance)
            angles = side * np.linspace(
                max(tangent, ARC_END_RAD),
                ARC_END_RAD,
                max(2, math.ceil((tangent - ARC_END_RAD) / ARC_STEP_RAD)),
            )
            across = np.array([-hit[1], hit[0]])
            arc = puck - radius * (
                np.cos(angles)[:, None] * hit + np.sin(angles)[:, None] * across
            )
            path = np.stack([start, *arc, goal - APPROACH_LENGTH_M * hit, goal])
            paths.append(np.column_stack([path, np.full(len(path), start_xyz[2])]))
        return sorted(
            paths,
            key=lambda path: float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        )


def _positive_part(value: Any) -> Any:
    """Return ``max(value, 0)``, rounded."""
    # (x + sqrt(x^2 + r^2)) / 2: it exceeds max(x, 0) by at most r / 2.
    return (value + (value * value + ROUNDING**2) ** 0.5) / 2


def _at_least(bound: float, distance: Any) -> Conditions:
    return (
        Condition(
            "puck distance",
            "m",
            [distance],
            np.array([bound]),
            np.array([np.inf]),
            "position",
        ),
    )


def distances_from_segments(point: Array, first: Array, second: Array) -> Array:
    """Return the distances of points from segments between two ends [m], for arrays of shape (..., 2)."""
    along = second - first
    # Nearest point at the share t = (p - a) . d / |d|^2, clipped to the segment; a
    # segment may be a point.
    length = np.maximum(np.sum(along**2, axis=-1), 1e-12)
    share = np.clip(np.sum((point - first) * along, axis=-1) / length, 0.0, 1.0)
    return np.asarray(np.linalg.norm(point - first - share[..., None] * along, axis=-1))
