"""Statements of a tape in C, over the types and functions of ``vectors.h`` or others of these names."""

from collections.abc import Callable

import numpy as np

from cnpgen.kernels.tape import NAMES, Tape

_EXPRESSIONS = {  # of one operand or two
    "NEG": "-{}", "SQ": "{0}*{0}", "TWICE": "{0}+{0}", "INV": "one/{}", "SQRT": "vsqrt({})", "FABS": "vabs({})",
    "SIGN": "vsign({})", "NOT": "vnot({})", "EXP": "vexp({})",
    "ADD": "{}+{}", "SUB": "{}-{}", "MUL": "{}*{}", "DIV": "{}/{}", "FMIN": "vmin({},{})", "FMAX": "vmax({},{})",
    "LT": "vlt({},{})", "LE": "vle({},{})", "EQ": "veq({},{})", "NE": "vne({},{})", "AND": "vand({},{})",
    "OR": "vor({},{})", "IF_ELSE_ZERO": "vsel({},{})",
}  # fmt: skip
# One instruction if the second is not nan.
_WITHOUT_NAN = {
    "FMIN": "lesser({},{})",
    "FMAX": "larger({},{})",
}


def statements(
    tape: Tape,
    *,
    read: Callable[[int, int], str],
    write: Callable[[int, int, str], str],
    numbers: frozenset[int] | set[int] = frozenset(),
) -> str:
    """Return C statements in single-assignment form; sine and cosine of one angle are computed together.

    ``read`` and ``write`` return C code for a component of an argument or result;
    ``numbers`` are arguments that are never nan.
    """
    lines: list[str] = []
    names: dict[int, str] = {}
    angles, never_nan = set[int](), set[int]()
    arrays = tape.operation, tape.a, tape.b, tape.constant
    rows = zip(*(array.tolist() for array in arrays), strict=True)
    for k, (code, a, b, constant) in enumerate(rows):
        name = NAMES[code]
        if name == "CONST":
            names[k] = f"K({_literal(constant)})"
            never_nan |= set() if np.isnan(constant) else {k}
            continue
        if name == "OUTPUT":
            lines.append(write(b, int(constant), names[a]))
            continue
        # Later uses of the same angle take the values that are computed already.
        if name in ("SIN", "COS"):
            if a not in angles:
                lines.append(f"v s{a},c{a};vsincos({names[a]},&s{a},&c{a});")
                angles.add(a)
            names[k] = f"{name[0].lower()}{a}"
            continue
        if name == "INPUT":
            expression = read(a, b)
            never_nan |= {k} if a in numbers else set()
        else:
            expression = _expression(name, names[a], names[b], number=b in never_nan)
            # Minimum and maximum are nan only if both operands are.
            never_nan |= {k} if name in _WITHOUT_NAN and never_nan & {a, b} else set()
        names[k] = f"t{k}"
        lines.append(f"v t{k}={expression};")
    return "\n".join(lines)


def _expression(name: str, a: str, b: str, *, number: bool) -> str:
    """Return an operation of one operand or two; the second is never nan if it is a ``number``."""
    templates = _WITHOUT_NAN if number and name in _WITHOUT_NAN else _EXPRESSIONS
    return templates[name].format(a, b)


def _literal(constant: float) -> str:
    """Return a number as a C literal."""
    if np.isnan(constant):
        return "NAN"
    return (
        repr(constant)
        if np.isfinite(constant)
        else f"{'-' if constant < 0 else ''}INFINITY"
    )
