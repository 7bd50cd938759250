"""Arithmetic steps on vectors: what a tape becomes before it is machine code."""

from struct import pack
from typing import Any, NamedTuple

COMMUTATIVE = {"add", "mul", "eq", "ne", "and", "or"}


class ArithmeticStep(NamedTuple):
    """One operation on vectors; a named tuple, since a kernel has thousands.

    Attributes:
        operation: Its name: an entry of ``llvm_text.TEMPLATES``, "constant", "input",
            "output", "fma" or "unused".
        operands: Indices of earlier steps; of an input: argument and component; of an
            output: the value, result and component; of "fma": a, b, c of ``a b + c``.
        value: The number of a constant.
        signs: Of an "fma": whether the product and the addend are negated.
    """

    operation: str
    operands: tuple[int, ...] = ()
    value: float = 0.0
    signs: tuple[bool, bool] = (False, False)


UNUSED = ArithmeticStep("unused")  # has no code


class StepList:
    """Steps in order; an operation on equal operands is entered once."""

    def __init__(self, *, single: bool) -> None:
        self.single = single
        self.steps: list[ArithmeticStep] = []
        self._known: dict[Any, int] = {}

    def add(self, operation: str, *operands: int) -> int:
        """Return the index of an operation's result."""
        # Addition and multiplication commute in floating point too, so one order is
        # enough.
        key = (operation, *operands)
        if operation in COMMUTATIVE and operands[0] > operands[1]:
            key = (operation, operands[1], operands[0])
        return self._enter(key, ArithmeticStep(operation, operands))

    def number(self, value: float) -> int:
        """Return the index of a constant."""
        return self._enter(
            # By bits, since 0.0 == -0.0 and nan != nan.
            pack("d", value),
            ArithmeticStep("constant", (), value),
        )

    def output(self, value: int, result: int, component: int) -> None:
        """Enter a result, which is never merged."""
        self.steps.append(ArithmeticStep("output", (value, result, component)))

    def _enter(self, key: Any, step: ArithmeticStep) -> int:
        index = self._known.setdefault(key, len(self.steps))
        if index == len(self.steps):
            self.steps.append(step)
        return index
