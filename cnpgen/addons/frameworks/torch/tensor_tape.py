"""Tapes in torch: an SX function as elementwise operations on tensors of any device, differentiable repeatedly.

The tape is the one that becomes C code. Each operation runs on all points of a batch,
so that batches of thousands of motions are efficient; ``torch.compile`` fuses the
operations.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch

from cnpgen.kernels.tape import NAMES, OPERATIONS, Tape

Value = Any  # a tensor, or a constant as a Python number
# A denominator ``fmax(x, guard)`` with a smaller constant is that of a closest point.
MAX_GUARD = 1e-12
# Below, segment and face or segment are parallel, and their closest points are
# arbitrary.
MIN_REGULAR_DENOMINATOR_M2 = 1e-6


def _maximum(a: Value, b: Value) -> torch.Tensor:
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return torch.maximum(a, b)
    return (
        torch.clamp(a, min=b) if isinstance(a, torch.Tensor) else torch.clamp(b, min=a)
    )


def _minimum(a: Value, b: Value) -> torch.Tensor:
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return torch.minimum(a, b)
    return (
        torch.clamp(a, max=b) if isinstance(a, torch.Tensor) else torch.clamp(b, max=a)
    )


def _compared(
    compare: Callable[[Value, Value], Any],
) -> Callable[[Value, Value], torch.Tensor]:
    """Return a comparison whose results are 0 and 1 in the type of its operands."""

    def compared(a: Value, b: Value) -> torch.Tensor:
        dtype = a.dtype if isinstance(a, torch.Tensor) else b.dtype
        result: torch.Tensor = compare(a, b).to(dtype)
        return result

    return compared


def _if_else_zero(condition: Value, value: Value) -> torch.Tensor:
    # A product would turn 0 * inf into nan.
    return torch.where(condition != 0, value, 0.0)


def _guarded_quotient(a: Value, b: Value) -> torch.Tensor:
    """Return a / b, constant for differentiation where b is small, so that second derivatives stay finite."""
    regular = b.detach() > MIN_REGULAR_DENOMINATOR_M2
    quotient = (
        a.detach() / b.detach() if isinstance(a, torch.Tensor) else a / b.detach()
    )
    return torch.where(regular, a / torch.where(regular, b, 1.0), quotient)


_APPLY: dict[str, Callable[..., Any]] = {
    "ADD": operator.add, "SUB": operator.sub, "MUL": operator.mul, "DIV": operator.truediv, "NEG": operator.neg,
    "SQ": torch.square, "TWICE": lambda x: x + x, "INV": torch.reciprocal, "SQRT": torch.sqrt, "FABS": torch.abs,
    "SIGN": torch.sign, "SIN": torch.sin, "COS": torch.cos, "EXP": torch.exp, "FMIN": _minimum, "FMAX": _maximum,
    "LT": _compared(operator.lt), "LE": _compared(operator.le), "EQ": _compared(operator.eq),
    "NE": _compared(operator.ne), "NOT": lambda x: (x == 0).to(x.dtype), "IF_ELSE_ZERO": _if_else_zero,
    "AND": _compared(lambda a, b: (a != 0) & (b != 0)), "OR": _compared(lambda a, b: (a != 0) | (b != 0)),
}  # fmt: skip


class TensorTape:
    """A tape that runs on tensors.

    Args:
        tape: The program, without a loop.
        results: Indices of the results to compute; operations that they do not need are
            omitted.
    """

    def __init__(self, tape: Tape, results: Sequence[int] | None = None) -> None:
        self.widths = tape.inputs
        selected = list(range(len(tape.outputs)) if results is None else results)
        self._rows = [[-1] * tape.outputs[index] for index in selected]
        self._constants: dict[int, float] = {}
        self._inputs: list[tuple[int, int, int]] = []  # value, argument, component
        self._steps: list[
            tuple[int, Callable[..., Any], tuple[int, ...], tuple[int, ...]]
        ] = []
        names = [NAMES[code] for code in tape.operation]
        operands = [
            (int(tape.a[k]), int(tape.b[k]))[: OPERATIONS[name]]
            for k, name in enumerate(names)
        ]
        # Value -> the last operation that uses it.
        last: dict[int, int] = {}
        for k in reversed(range(len(tape))):
            if names[k] == "OUTPUT" and int(tape.b[k]) in selected:
                self._rows[selected.index(int(tape.b[k]))][int(tape.constant[k])] = (
                    operands[k][0]
                )
                # Results live to the end, beyond all operations.
                last[operands[k][0]] = len(tape)
            # Backward, the first use that is met is the last one. Unused operations
            # never enter.
            elif k in last:
                for operand in operands[k]:
                    last.setdefault(operand, k)
        for k in sorted(last):
            if names[k] == "CONST":
                self._constants[k] = float(tape.constant[k])
            elif names[k] == "INPUT":
                self._inputs.append((k, int(tape.a[k]), int(tape.b[k])))
            else:
                # Values without a later use free their memory at once.
                uses = set(operands[k])
                dead = tuple(operand for operand in uses if last[operand] == k)
                guarded = _divides_by_guarded(tape, k)
                apply = _guarded_quotient if guarded else _APPLY[names[k]]
                self._steps.append((k, apply, operands[k], dead))

    def __len__(self) -> int:
        return len(self._steps)

    def __call__(self, *arguments: torch.Tensor) -> list[torch.Tensor]:
        """Evaluate the tape.

        Args:
            arguments: One tensor per input of the tape, shape (width, ...); their
                further axes are broadcast.

        Returns:
            One tensor of shape (width, ...) per selected result.
        """
        columns = [argument.unbind(0) for argument in arguments]
        values: dict[int, Value] = dict(self._constants)
        for k, argument, component in self._inputs:
            values[k] = columns[argument][component]
        for k, apply, operands, dead in self._steps:
            values[k] = apply(*[values[operand] for operand in operands])
            for operand in dead:
                del values[operand]
        return [
            _stacked([values[row] for row in rows], arguments) for rows in self._rows
        ]


def _divides_by_guarded(tape: Tape, k: int) -> bool:
    """Return whether an operation is a division by ``fmax(x, guard)`` with a constant of at most ``MAX_GUARD``."""
    if NAMES[tape.operation[k]] != "DIV" or NAMES[tape.operation[tape.b[k]]] != "FMAX":
        return False
    bounds = (tape.a[tape.b[k]], tape.b[tape.b[k]])
    return any(
        NAMES[tape.operation[i]] == "CONST" and 0 < tape.constant[i] <= MAX_GUARD
        for i in bounds
    )


def _stacked(rows: list[Value], arguments: Sequence[torch.Tensor]) -> torch.Tensor:
    """Stack rows, which may be constants, in the shape that the arguments broadcast to."""
    like = arguments[0]
    shape = torch.broadcast_shapes(*(argument.shape[1:] for argument in arguments))
    if not rows:
        return like.new_zeros((0, *shape))
    tensors = [
        row if isinstance(row, torch.Tensor) else like.new_tensor(row) for row in rows
    ]
    return torch.stack([tensor.expand(shape) for tensor in tensors])
