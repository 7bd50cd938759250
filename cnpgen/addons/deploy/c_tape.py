"""C functions of tapes: straight-line code in double precision, of one point or of all phases of a grid."""

import re
from itertools import accumulate

from cnpgen.addons.deploy.statements import statements
from cnpgen.kernels.tape import Tape

_NAME = re.compile(r"\b[tsc][0-9]+\b")  # values of ``statements``


def point_function(tape: Tape, name: str) -> str:
    """Return ``void name(const double *in, double *out)``: all arguments, and all results, one after another."""
    first_in, first_out = _offsets(tape.inputs), _offsets(tape.outputs)
    body = statements(
        tape,
        read=lambda argument, component: f"in[{first_in[argument] + component}]",
        write=lambda result, component, value: (
            f"out[{first_out[result] + component}]={value};"
        ),
    )
    return f"{_head(tape, name)}\n{_lines(body)}\n}}\n"


def grid_function(tape: Tape, name: str, phases: str) -> str:
    """Return the same for rows of ``phases`` values: arguments and results of all phases."""
    first_in, first_out = _offsets(tape.inputs), _offsets(tape.outputs)
    body = statements(
        tape,
        read=lambda argument, component: (
            f"in[{first_in[argument] + component}*{phases}+k]"
        ),
        write=lambda result, component, value: (
            f"out[{first_out[result] + component}*{phases}+k]={value};"
        ),
    )
    return (
        f"{_head(tape, name)}\nfor(int k=0;k<{phases};k++){{\n{_lines(body)}\n}}\n}}\n"
    )


def _head(tape: Tape, name: str) -> str:
    unused = "" if sum(tape.inputs) else "\n(void)in;"
    return f"static void {name}(const double *restrict in, double *restrict out) {{{unused}"


def _lines(body: str) -> str:
    """Replace the vector types of kernels by numbers, and leave out values that no other line reads."""
    kept: list[str] = []
    read: set[str] = set()
    # Lines read only values of earlier ones: backward, all readers of a value are
    # known.
    for line in reversed(body.splitlines()):
        names = _NAME.findall(line)
        if line.startswith("v ") and not read.intersection(_defined(line)):
            continue
        read.update(names)
        kept.append(_in_doubles(line))
    return "\n".join(reversed(kept))


def _defined(line: str) -> list[str]:
    """Return the values that a line defines: one, or a sine and a cosine."""
    return _NAME.findall(line.partition(";")[0].partition("=")[0])


def _in_doubles(line: str) -> str:
    # Sine and cosine are written by reference, so they are not constant.
    kind = "double " if "vsincos(" in line else "const double "
    line = kind + line.removeprefix("v ") if line.startswith("v ") else line
    return re.sub(r"\bone/", "1.0/", re.sub(r"\bK\(", "(", line))


def _offsets(widths: tuple[int, ...]) -> list[int]:
    return list(accumulate(widths, initial=0))
