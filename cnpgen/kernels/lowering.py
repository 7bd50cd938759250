"""Lowering: a tape becomes a list of arithmetic steps whose rounding is decided, before any machine code exists.

Sine, cosine and exponential become polynomials, equal steps are merged, and products are
contracted to fused multiply-adds by a rule of the tape alone. So every vector width,
optimization level and instruction set rounds in the same places and gives equal bits.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.kernel import axis_names
from cnpgen.kernels.steps import UNUSED, ArithmeticStep, StepList
from cnpgen.kernels.tape import NAMES, Tape
from cnpgen.kernels.vector_functions import exponential, sine_and_cosine

MAX_CONTRACTED = 6000  # longer tapes are not contracted: their published digests are those of plain products
MAX_DUPLICATED = 13  # statements of a block of C that GCC duplicates
STATEMENTS = {  # of C for a step; 1 for those that are not listed
    "constant": 0, "input": 0, "output": 0, "min": 6, "max": 6, "lt": 2, "le": 2, "eq": 2, "ne": 2, "not": 2,
    "if_else_zero": 3, "and": 6, "or": 6, "sign": 8,
}  # fmt: skip
SOURCES = "input", "constant"  # steps without operands
ARITHMETIC = {
    "ADD": "add", "SUB": "sub", "MUL": "mul", "DIV": "div", "NEG": "neg", "SQRT": "sqrt", "FABS": "abs",
    "SIGN": "sign", "LT": "lt", "LE": "le", "EQ": "eq", "NE": "ne", "NOT": "not",
    "AND": "and", "OR": "or", "IF_ELSE_ZERO": "if_else_zero",
}  # fmt: skip


def lower(tape: Tape) -> list[ArithmeticStep]:
    """Return the steps of a tape, contracted; those that no result needs become ``UNUSED``."""
    # Instructions are entered in order, so operands are known when they are read.
    # ``StepList`` merges equal operations at once, which keeps its work linear in the
    # length of the tape.
    entered = StepList(single=tape.dtype == "float32")
    uniform = uniform_arguments(tape)
    never_nan: set[int] = set()  # steps
    place: dict[int, int] = {}  # instruction -> step
    columns = (tape.operation, tape.a, tape.b, tape.constant)
    for k, (code, a, b, constant) in enumerate(
        zip(*(column.tolist() for column in columns), strict=True)
    ):
        name = NAMES[code]
        if name == "OUTPUT":
            entered.output(place[a], b, int(constant))
        elif name == "CONST":
            place[k] = entered.number(constant)
            # ``min(a, b)`` must ignore a nan. If b cannot be nan, the instruction of
            # the processor does that, without two more comparisons; constants and
            # uniform arguments qualify.
            never_nan |= set() if np.isnan(constant) else {place[k]}
        elif name == "INPUT":
            place[k] = entered.add("input", a, b)
            never_nan |= {place[k]} if a in uniform else set()
        elif name in ("FMIN", "FMAX"):
            place[k] = _lower_extremum(entered, name, place[a], place[b], never_nan)
        else:
            place[k] = _lower_operation(entered, name, place[a], place[b])
    steps = entered.steps
    # Before unused steps are dropped: whether a product is contracted depends on all of
    # its uses, and ``_contracted`` counts only those that a result needs.
    if len(tape) <= MAX_CONTRACTED:
        steps = _contracted(tape, steps)
    needed = _needed(steps)
    return [step if used else UNUSED for step, used in zip(steps, needed, strict=True)]


def _lower_operation(steps: StepList, name: str, a: int, b: int) -> int:
    if name == "SQ":
        return steps.add("mul", a, a)
    if name == "TWICE":
        return steps.add("add", a, a)
    if name == "INV":
        return steps.add("div", steps.number(1.0), a)
    if name in ("SIN", "COS"):
        return sine_and_cosine(steps, a)[name == "COS"]
    if name == "EXP":
        return exponential(steps, a)
    operation = ARITHMETIC[name]
    unary = operation in ("neg", "sqrt", "abs", "sign", "not")
    return steps.add(operation, a) if unary else steps.add(operation, a, b)


def _lower_extremum(
    steps: StepList, name: str, a: int, b: int, never_nan: set[int]
) -> int:
    """Enter a minimum or maximum: one instruction if the second operand is not nan."""
    if b in never_nan:
        # The instruction returns its second operand if either is nan: a nan in a gives
        # b.
        index = steps.add({"FMIN": "lesser", "FMAX": "larger"}[name], a, b)
    else:
        index = steps.add({"FMIN": "min", "FMAX": "max"}[name], a, b)
    # The result is nan only if both operands are.
    never_nan |= {index} if never_nan & {a, b} else set()
    return index


def uniform_arguments(tape: Tape) -> set[int]:
    """Return the arguments that are equal in all lanes; they must not be nan."""
    axes = tape.grid.arguments if tape.grid else ()
    return {index for index, kind in enumerate(axes) if "lanes" not in axis_names(kind)}


def value_operands(step: ArithmeticStep) -> tuple[int, ...]:
    """Return the steps that a step reads."""
    if step.operation in SOURCES:
        return ()
    return step.operands[:1] if step.operation == "output" else step.operands


def _contracted(tape: Tape, steps: list[ArithmeticStep]) -> list[ArithmeticStep]:
    """Replace products by fused multiply-adds.

    A product is contracted if every use of it is a sum or a difference with another
    value in the same section. Products are visited in order, so that of ``a b + c d`` the
    first one is contracted.
    """
    steps = list(steps)
    needed = [index for index, used in enumerate(_needed(steps)) if used]
    section = _sections(tape, steps, needed)
    # uses[i] lists the steps that read step i, once for each occurrence as an operand.
    uses: list[list[int]] = [[] for _ in steps]
    for index in needed:
        for operand in value_operands(steps[index]):
            uses[operand].append(index)
    for index in needed:
        sums = uses[index]
        # A product that anything else reads must be computed anyway; contracting a part
        # of its uses would save nothing. ``a b - a b`` counts the product twice and
        # stays as it is, since a fused step would give the rounding error of the
        # product instead of 0.
        if steps[index].operation == "mul" and all(
            steps[use].operation in ("add", "sub")
            and steps[use].operands.count(index) == 1
            and section[use] == section[index]
            for use in sums
        ):
            for use in sums:
                steps[use] = _fused(steps[use], index, steps[index].operands)
    return steps


def _sections(
    tape: Tape, steps: list[ArithmeticStep], needed: Sequence[int]
) -> NDArray[np.integer[Any]]:
    """Return the section of every step; products and sums of different sections are not contracted.

    The sections are the basic blocks of the C code that datasets were made with, as GCC 12
    forms them, so that these datasets keep their bits. In a loop, values that do not depend
    on the state are computed before it. Else a block ends at every load and store of lanes,
    which branch at the last lanes; GCC duplicates short blocks for both branches, so that
    neighboring short blocks are one.
    """
    if tape.loop:
        return _computed_before_loop(steps)
    uniform = uniform_arguments(tape)
    branches = [
        step.operation == "output"
        or (step.operation == "input" and step.operands[0] not in uniform)
        for step in steps
    ]
    # block[i] is the number of branches at or before step i.
    block = np.cumsum([0, *branches])[1:]
    length = np.zeros(len(steps) + 1)
    for index in needed:
        length[block[index]] += STATEMENTS.get(steps[index].operation, 1)
    # Block 0, before the first branch, is never duplicated.
    # Two neighboring duplicated blocks run in the same copy and so share a section.
    duplicated = np.append(False, length[1:] <= MAX_DUPLICATED)
    apart = np.append(True, ~(duplicated[1:] & duplicated[:-1]))
    section: NDArray[np.integer[Any]] = np.cumsum(apart)[block]
    return section


def _computed_before_loop(steps: list[ArithmeticStep]) -> NDArray[np.integer[Any]]:
    """Return 1 for steps that do not depend on the state, argument 0 of a loop, else 0."""
    before: list[bool] = []
    for step in steps:
        if step.operation == "input":
            before.append(step.operands[0] != 0)
        else:
            before.append(all(map(before.__getitem__, value_operands(step))))
    return np.array(before, int)


def _fused(
    total: ArithmeticStep, product: int, factors: tuple[int, ...]
) -> ArithmeticStep:
    """Return a sum or difference with one product as one fused step."""
    first, second = total.operands
    # fma(a, b, c) rounds ``a b + c`` once. Negating an operand is exact.
    minus = total.operation == "sub"
    if first == product:
        # A b - c.
        return ArithmeticStep("fma", (*factors, second), signs=(False, minus))
    # c - a b
    return ArithmeticStep("fma", (*factors, first), signs=(minus, False))


def _needed(steps: list[ArithmeticStep]) -> list[bool]:
    """Return whether some result needs each step."""
    needed = [False] * len(steps)
    # Backwards, so that all uses of a step are visited before the step itself.
    for index in range(len(steps) - 1, -1, -1):
        operation, operands, *_ = steps[index]
        if operation == "output":
            needed[index] = needed[operands[0]] = True
        elif needed[index] and operation not in SOURCES:
            for operand in operands:
                needed[operand] = True
    return needed
