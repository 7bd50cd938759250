"""C statements of a tape over the vector types of ``vectors.h``: one lane per sample, for GCC or Clang."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cnpgen.kernels.tape import NAMES, Tape

VECTORS = Path(__file__).with_name("vectors.h")

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


def prelude(dtype: str) -> str:
    """Return the C source that defines vectors of ``dtype`` and their functions."""
    return ("#define SINGLE\n" if dtype == "float32" else "") + VECTORS.read_text(
        encoding="utf-8"
    )


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
    angles: set[int] = set()
    never_nan: set[int] = set()
    columns = (tape.operation, tape.a, tape.b, tape.constant)
    for k, (code, a, b, constant) in enumerate(
        zip(*(column.tolist() for column in columns), strict=True)
    ):
        name = NAMES[code]
        if name == "CONST":
            names[k] = f"K({_literal(constant)})"
            never_nan |= set() if np.isnan(constant) else {k}
            continue
        if name == "OUTPUT":
            lines.append(write(b, int(constant), names[a]))
            continue
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
            plain = name not in _WITHOUT_NAN or b not in never_nan
            templates = _EXPRESSIONS if plain else _WITHOUT_NAN
            expression = templates[name].format(names[a], names[b])
            never_nan |= {k} if name in _WITHOUT_NAN and never_nan & {a, b} else set()
        names[k] = f"t{k}"
        lines.append(f"v t{k}={expression};")
    return "\n".join(lines)


def _literal(constant: float) -> str:
    """Return a number as a C literal."""
    if np.isnan(constant):
        return "NAN"
    return (
        repr(constant)
        if np.isfinite(constant)
        else f"{'-' if constant < 0 else ''}INFINITY"
    )
