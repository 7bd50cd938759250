"""What is known of a plan."""

from enum import IntEnum


class PlanStatus(IntEnum):
    """What is known of a plan; the first that applies.

    Files keep the names beside the numbers, so that members can be added, and numbers mean the same when they are read.
    """

    UNKNOWN = 0
    VALID = 1
    INVALID = 2
    NOT_FINITE = 3
    NOT_FORWARD = 4

    @property
    def text(self) -> str:
        """The status in words."""
        return {
            PlanStatus.UNKNOWN: "not checked yet",
            PlanStatus.VALID: "meets every constraint and its boundary conditions at every moment",
            PlanStatus.INVALID: "breaks a constraint or a boundary condition",
            PlanStatus.NOT_FINITE: "a boundary condition or a control point is not a finite number",
            PlanStatus.NOT_FORWARD: "the rate ds/dt is not positive throughout: the motion never arrives",
        }[self]
