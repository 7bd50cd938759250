"""Base class of constraints: named conditions on a robot state, in two independent forms."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
    from cnpgen.world.path import PathWorld
    from cnpgen.world.world import World

End = Literal["start", "goal"]

MIN_TOLERANCE = 1e-9  # replaces a tolerance of zero in solvers and planners

# Tolerances of conditions on boundary states, by stored float type: relative for limits, otherwise in SI units.
# Positions stored as float32 have a relative rounding error of 6e-8, so that their
# conditions hold less exactly.
BOUNDARY_TOLERANCES: dict[str, dict[str, float]] = {
    "float64": {
        "limit": 1e-12,
        "position": 1e-8,
        "angle": 1e-8,
        "direction": 1e-9,
        "velocity": 1e-9,
        "acceleration": 1e-9,
    },
    "float32": {
        "limit": 1e-12,
        "position": 1e-6,
        "angle": 1e-5,
        "direction": 1e-5,
        "velocity": 1e-5,
        "acceleration": 1e-4,
    },
}  # fmt: skip


@dataclass(frozen=True)
class Condition:
    """Condition ``lower <= g <= upper`` on one state.

    Attributes:
        name: Name in messages and reports.
        unit: SI unit of g, or one per value, as ``units_of_joints`` names them.
        g: m values: SX scalars in the symbolic form, floats in the measured form.
        lower: Lower bounds, shape (m,), -inf for no bound.
        upper: Upper bounds, shape (m,); equal to ``lower`` for equalities.
        tolerance_kind: Kind of its tolerance on boundary states, a key of
            ``BOUNDARY_TOLERANCES``: "limit", "position", "angle", "direction",
            "velocity" or "acceleration".
        parts: Names of the m values; empty for numbered values.
        sufficient: Whether the condition is conservative: only the measured form can
            prove a violation.
        accepted: Violation that a valid motion may have if it differs from sample to
            sample, shape (m,).
        projected: Whether searches of paths project states onto it, as onto equalities.
    """

    name: str
    unit: str
    g: list[Any]
    lower: Array
    upper: Array
    tolerance_kind: str
    parts: tuple[str, ...] = ()
    sufficient: bool = False
    accepted: Array | None = None
    projected: bool = False

    def __post_init__(self) -> None:
        """Refuse an unknown kind of tolerance."""
        if self.tolerance_kind not in BOUNDARY_TOLERANCES["float64"]:
            raise ValueError(
                f"tolerance_kind of the condition {self.name!r} must be one of"
                f" {', '.join(BOUNDARY_TOLERANCES['float64'])}, got {self.tolerance_kind!r}"
            )

    @property
    def is_equality(self) -> bool:
        """Whether it is an equality."""
        return bool(np.array_equal(self.lower, self.upper))

    @property
    def middle(self) -> tuple[Array, Array]:
        """Middle and half width of the bounds, shape (m,) each."""
        return (self.upper + self.lower) / 2, (self.upper - self.lower) / 2

    def tolerance(self, dtype: str) -> Array:
        """Return the tolerance of g on a boundary state stored as ``dtype``, in the unit of g, shape (m,)."""
        # Limits have relative tolerances, at least those of a limit of 1; infinite
        # bounds have no size.
        exact = BOUNDARY_TOLERANCES[dtype][self.tolerance_kind]
        if self.tolerance_kind != "limit":
            return np.full(len(self.g), exact)
        size = np.maximum(
            np.abs(np.nan_to_num(self.lower, posinf=0, neginf=0)),
            np.abs(np.nan_to_num(self.upper, posinf=0, neginf=0)),
        )
        return exact * np.maximum(size, 1.0)

    def violation(self) -> float:
        """Return the maximum of ``max(lower - g, g - upper, 0)`` of a measured condition; nan counts as infinite."""
        g = np.array(self.g, float)
        # The maximum of values with nan is nan.
        worst = float(np.max(np.maximum(self.lower - g, g - self.upper), initial=0.0))
        return worst if np.isfinite(worst) else np.inf


Conditions = tuple[Condition, ...]
"""The conditions of a constraint on one state."""


@dataclass(frozen=True, kw_only=True)
class Constraint(ABC):
    """Constraint on every state of a motion, and on its ends.

    A kind is a frozen dataclass whose fields are the keys of its ``[[constraint]]``
    table in ``problem.toml``. It is registered under a name in cnpgen's registry or by
    a package's entry point in the group ``cnpgen.constraints``.

    The unit of ``tolerance`` depends on the kind (unit of the condition, or fraction of
    a limit), so a kind declares it again with ``cnpgen.plugins.field``.

    Attributes:
        reason: Rejection reason of samples that violate the constraint.
        boundary_reason: Rejection reason of samples whose ends violate it; by default
            ``reason``.
        kinks: Phases at which its ``bound_relaxation`` is not smooth; the verdict
            checks these.
        uses_jerk: Whether it uses the jerk, which is computed only for problems with
            such a constraint.
        training_weight: Initial weight of the violation in training; None for
            ``WEIGHT_FACTOR`` times ``weight``.
        training_factor: Factor of the limits during training, in (0, 1].
        training_inset: Distance by which other bounds are moved inwards during training
            [unit of the condition].
        has_solver_margin: Whether ``solved`` has a margin for states between grid
            points; otherwise solvers add one.
        reads: Keys of the problem beside its own that ``measured`` depends on, such as
            "limits.jerk"; by default any.
        uses_obstacles: Whether ``measured`` depends on obstacles; otherwise ``met``
            checks states of different scenes.
        scene_width: Number of values that it needs for each motion, see
            ``scene_values``.
        tolerance: Maximum violation of a valid motion.
        budget: Acceptable violation in training.
        weight: Initial weight of the violation in training, before scaling.
    """

    reason: ClassVar[str]
    boundary_reason: ClassVar[str] = ""
    kinks: ClassVar[tuple[float, ...]] = ()
    uses_jerk: ClassVar[bool] = False
    reads: ClassVar[tuple[str, ...] | None] = None
    training_weight: ClassVar[float | None] = None
    training_factor: ClassVar[float] = 1.0
    training_inset: ClassVar[float] = 0.0
    has_solver_margin: ClassVar[bool] = False
    uses_obstacles: ClassVar[bool] = True
    scene_width: ClassVar[int] = 0

    tolerance: float
    budget: float = field(
        "accepted violation during training (the paper's C-bar^2)", low=0.0, default=0.0
    )
    weight: float = field(
        "initial weight during training (the paper's e^alpha)", low=1e-12, default=1.0
    )

    def allowed(self, condition: Condition) -> Array:
        """Return the tolerance of a condition for valid motions, in its unit, shape (m,)."""
        return np.full(len(condition.g), self.effective_tolerance)

    @property
    def effective_tolerance(self) -> float:
        """Violation that a valid motion may have: ``tolerance``, or less where it would permit penetration."""
        return self.tolerance

    def bound_relaxation(
        self, condition: Condition, s: Array, start_tip: Array
    ) -> Array:
        """Return the relaxation of a condition's bounds at phases s of motions, in its unit, shape (..., K).

        By default zero; constraints that motions may violate at the start override it.

        Args:
            condition: One of the conditions of ``measured``.
            s: Phases, shape (K,).
            start_tip: Positions of the tip at the start [m], shape (..., 3): for one
                motion or many.
        """
        del condition
        return np.zeros((*start_tip.shape[:-1], len(s)))

    def scene_values(self, goal_xyz: Array, goal_velocity: Array) -> Array:  # noqa: ARG002
        """Return the values of N motions that the constraint depends on, shape (N, scene_width).

        The forms read them as ``scene_values`` of states and worlds. One constraint of
        a problem may have them.

        Args:
            goal_xyz: Tip positions at the goal [m], shape (N, 3).
            goal_velocity: Tip velocities at the goal [m/s], shape (N, 3).
        """
        return np.empty((len(goal_xyz), 0))

    def initial_tip_paths(self, values: Array, start_xyz: Array) -> list[Array]:
        """Return tip paths for initial guesses where the straight line violates the constraint, by default none.

        Args:
            values: ``scene_values`` of one motion, shape (scene_width,).
            start_xyz: Tip position at the start [m], shape (3,).

        Returns:
            Polylines from start to goal [m], shape (K, 3) each, in the order of their
            use.
        """
        del values, start_xyz
        return []

    @abstractmethod
    def symbolic(self, state: SymbolicState) -> tuple[Condition, ...]:
        """State the condition on a motion as SX expressions of the symbolic state."""

    def penalized(self, state: SymbolicState) -> tuple[Condition, ...]:
        """State the condition for the training loss, by default ``symbolic``.

        It must be equivalent; override it if the violation of ``symbolic`` has poor
        gradients.
        """
        return self.symbolic(state)

    @abstractmethod
    def measured(self, world: World) -> tuple[Condition, ...]:
        """Evaluate the same condition with Pinocchio and Coal at the state, or at the K states, that ``world`` holds.

        It is written for one state, and also called with
        ``cnpgen.world.path.PathWorld``, whose arrays have a trailing axis of K states:
        ``world.q`` of shape (n, K), ``world.tip_position`` (3, K), distances (K,). So
        it counts indices from the front and uses elementwise operations only: no ``if``
        on a value, no ``float()``, ``max()`` or ``sum()`` over a vector. Every entry of
        a condition's ``g`` is then a float or an array of shape (K,); bounds do not
        depend on the state.
        """

    def judged(self, world: World) -> tuple[Condition, ...]:
        """Evaluate the conditions whose violations the verdict limits, by default ``measured``.

        Override it if solvers need several values of one quantity, such as the
        components of an angle.
        """
        return self.measured(world)

    def met(self, path: PathWorld, tolerance: float) -> Mask | None:  # noqa: ARG002
        """Return a mask of the K states that satisfy ``measured`` up to a tolerance, or None without a fast check.

        The default is None; constraints with a batched check override it.

        Args:
            path: States of a path; the obstacles are the same in all of them.
            tolerance: Allowed violation [unit of the condition].
        """
        return None

    def solved(self, world: World) -> tuple[Condition, ...]:
        """Return the conditions of ``symbolic`` with numeric values, from which solvers read bounds.

        The default is ``measured``; override it if the two forms state different
        conditions.
        """
        return self.measured(world)

    def symbolic_at(self, state: SymbolicState, end: End) -> tuple[Condition, ...]:  # noqa: ARG002
        """State the conditions on a boundary state, by default those on every state."""
        return self.symbolic(state)

    def measured_at(self, world: World, end: End) -> tuple[Condition, ...]:  # noqa: ARG002
        """Evaluate the conditions on a boundary state with Pinocchio and Coal.

        ``world`` holds one state.
        """
        return self.measured(world)


@dataclass(frozen=True, kw_only=True)
class LinkConstraint(Constraint):
    """Base class of constraints on a link in the world, whose frame a request may place.

    Attributes:
        link: The link.
    """

    link: str

    @abstractmethod
    def moved(self, position: Array, rotation: Array) -> Self:
        """Return the constraint after the motion of its frame by a pose, shapes (3,) and (3, 3)."""
