"""The contract of a constraint: a named condition on a robot state, in two independent forms."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from cnpgen.schema.keys import field

if TYPE_CHECKING:
    from cnpgen.kernels.symbolic.state import SymbolicState
    from cnpgen.world.path import PathWorld
    from cnpgen.world.state import World

End = Literal["start", "goal"]

FINEST = 1e-9  # what solvers and planners take a tolerance of zero for

# How exactly a boundary state must meet its conditions, by the type that it is stored in. Limits are relative, the
# rest is SI.
EXACTNESS: dict[str, dict[str, float]] = {
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
    """``lower <= g <= upper`` on one state.

    Attributes:
        name: What it is about, for messages and reports.
        unit: SI unit of g, or one per value, as ``units_of_joints`` names them.
        g: m values: SX scalars in the symbolic form, floats in the measured form.
        lower: Lower bounds, shape (m,), -inf where there is none.
        upper: Upper bounds, shape (m,); equal to ``lower`` for equalities.
        exactness: Key of ``EXACTNESS``: how exactly a boundary state must meet it.
        parts: Names of the values, m of them, or none: they are numbered then.
        sufficient: Whether it asks for more than is meant: only the measured form tells what does not meet it.
    """

    name: str
    unit: str
    g: list[Any]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    exactness: str
    parts: tuple[str, ...] = ()
    sufficient: bool = False

    @property
    def is_equality(self) -> bool:
        """Whether it allows one value only."""
        return bool(np.array_equal(self.lower, self.upper))

    def slack(self, dtype: str) -> NDArray[np.float64]:
        """How far g may be outside its bounds on a boundary state stored as ``dtype``, in the unit of g, shape (m,)."""
        exact = EXACTNESS[dtype][self.exactness]
        if self.exactness != "limit":
            return np.full(len(self.g), exact)
        size = np.maximum(
            np.abs(np.nan_to_num(self.lower, posinf=0, neginf=0)), np.abs(np.nan_to_num(self.upper, posinf=0, neginf=0))
        )
        return exact * np.maximum(size, 1.0)

    def violation(self) -> float:
        """Return the worst ``max(lower - g, g - upper, 0)`` of a measured condition; nan counts as infinite."""
        g = np.array(self.g, float)
        worst = float(np.max(np.maximum(self.lower - g, g - self.upper), initial=0.0))
        return worst if np.isfinite(worst) else np.inf


@dataclass(frozen=True, kw_only=True)
class Constraint(ABC):
    """One term of the constraint manifold: a condition on every state of a motion, and on its ends.

    A kind is a frozen dataclass whose fields are the keys of its ``[[constraint]]`` table in ``problem.toml``; it is
    registered under a name in cnpgen's registry or by a package's entry point in the group ``cnpgen.constraints``.

    ``tolerance`` has another unit in every kind (of the condition, or a fraction of a limit), so a kind declares it
    again with ``cnpgen.plugins.field``.

    Attributes:
        reason: The name under which a sample that breaks the constraint is counted.
        kinks: Phases at which its ``funnel`` is not smooth; the verdict looks there.
        uses_jerk: Whether it is about the jerk, which is computed only where a constraint of the problem is.
        tolerance: How far a motion may be outside the condition and still be called valid.
        budget: Acceptable violation while training.
        weight: First weight of the violation while training.
    """

    reason: ClassVar[str]
    kinks: ClassVar[tuple[float, ...]] = ()
    uses_jerk: ClassVar[bool] = False

    tolerance: float
    budget: float = field("acceptable violation while training (the paper's C-bar^2)", low=0.0, default=0.0)
    weight: float = field("first weight while training (the paper's e^alpha)", low=1e-12, default=1.0)

    def allowed(self, condition: Condition) -> NDArray[np.float64]:
        """Return how far a motion may be outside a condition and still be called valid, in its unit, shape (m,)."""
        return np.full(len(condition.g), self.tolerance)

    def funnel(
        self, condition: Condition, s: NDArray[np.float64], start_tip: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return how much wider than its bounds a condition is at phases s of motions, in its unit, shape (..., K).

        By default nothing; a constraint that motions may begin outside of lets them in here.

        Args:
            condition: One of the conditions of ``measured``.
            s: Phases, shape (K,).
            start_tip: Positions of the tip at the start [m], shape (..., 3): of one motion or of many.
        """
        del condition
        return np.zeros((*start_tip.shape[:-1], len(s)))

    @abstractmethod
    def symbolic(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State the condition on a motion as SX expressions of the symbolic state."""

    def penalised(self, state: "SymbolicState") -> tuple[Condition, ...]:
        """State what training penalises: by default ``symbolic``.

        The same condition; overridden where the violation that ``symbolic`` states is hard to descend.
        """
        return self.symbolic(state)

    @abstractmethod
    def measured(self, world: "World") -> tuple[Condition, ...]:
        """Evaluate the same condition with Pinocchio and Coal at the state, or at the K states, that ``world`` holds.

        It is written for one state, and is also given a ``cnpgen.world.path.PathWorld``, whose arrays have a trailing
        axis of K states: ``world.q`` of shape (n, K), ``world.tip_position`` (3, K), distances (K,). So it counts
        indices from the front and uses elementwise operations only: no ``if`` on a value, no ``float()``, ``max()`` or
        ``sum()`` over a vector. Every entry of a condition's ``g`` is then a float or an array of shape (K,); bounds do
        not depend on the state.
        """

    def met(self, path: "PathWorld", slack: float) -> NDArray[np.bool_] | None:  # noqa: ARG002
        """Say at which of the K states that a path holds ``measured`` is met up to a slack, if it is cheaper to ask so.

        By default nothing is said; overridden where many states are settled together.

        Args:
            path: The states; obstacles stand where they stand in all of them.
            slack: How far values may be outside their bounds [unit of the condition].
        """
        return None

    def solved(self, world: "World") -> tuple[Condition, ...]:
        """Return the conditions of ``symbolic`` with numbers in the place of expressions; solvers read bounds off them.

        By default ``measured``; overridden where the two forms state different conditions.
        """
        return self.measured(world)

    def symbolic_at(self, state: "SymbolicState", end: End) -> tuple[Condition, ...]:  # noqa: ARG002
        """State what a boundary state must meet; by default what every state must."""
        return self.symbolic(state)

    def measured_at(self, world: "World", end: End) -> tuple[Condition, ...]:  # noqa: ARG002
        """Evaluate what a boundary state must meet, with Pinocchio and Coal; ``world`` holds one state."""
        return self.measured(world)
