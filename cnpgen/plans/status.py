"""Status of a plan."""

from enum import IntEnum


class PlanStatus(IntEnum):
    """Status of a plan; the first one that applies.

    Files store the names with the values, so that members can be added later.
    """

    UNKNOWN = 0
    VALID = 1
    INVALID = 2
    NOT_FINITE = 3
    NOT_FORWARD = 4

    @property
    def text(self) -> str:
        """Text of the status."""
        return {
            PlanStatus.UNKNOWN: "not checked yet",
            PlanStatus.VALID: "satisfies every constraint and the boundary conditions at every time",
            PlanStatus.INVALID: "violates a constraint or a boundary condition",
            PlanStatus.NOT_FINITE: "a boundary condition or a control point is not a finite number",
            PlanStatus.NOT_FORWARD: "the rate ds/dt is not positive throughout",
        }[self]
