"""C functions of tapes: straight-line code in double precision, of one point or of all phases of a grid."""

import re
from itertools import accumulate

from cnpgen.addons.deploy.planner_parts import LANES
from cnpgen.addons.deploy.statements import statements
from cnpgen.kernels.tape import Tape

_NAME = re.compile(r"\b[tsc][0-9]+\b")  # values of ``statements``
_ANGLE = re.compile(r"vsincos\((.*?),&")


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
    return f"{_head(tape, name)}\n{_with_angles_together(_lines(body))}\n}}\n"


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


def _with_angles_together(body: str) -> str:
    """Compute sines and cosines of all angles that need no other ones in one loop, which becomes vector instructions."""
    lines = body.splitlines()
    later: set[str] = set()  # values that need a sine or cosine
    together: list[str] = []
    for line in lines:
        own, *read = _NAME.findall(line) or [""]
        if "vsincos(" in line:
            together += [] if later.intersection(_angle(line)) else [line]
            later.update(_defined(line))
        elif later.intersection(read):
            later.add(own)
    # Backward, all values that these angles need are known.
    needed = {name for line in together for name in _angle(line)}
    before: list[str] = []
    for line in reversed(lines):
        if needed.intersection(_defined(line)) and line not in together:
            before.append(line)
            needed.update(_NAME.findall(line))
    count = len(together) + -len(together) % LANES
    loop = [
        f"double angle[{count}]={{0}},sine[{count}],cosine[{count}];",
        *(f"angle[{i}]={_ANGLE.search(line)[1]};" for i, line in enumerate(together)),  # type: ignore[index]
        f"for(int i=0;i<{count};i++) vsincos(angle[i],&sine[i],&cosine[i]);",
    ]
    values = {
        line: "const double {}=sine[{i}],{}=cosine[{i}];".format(*_defined(line), i=i)
        for i, line in enumerate(together)
    }
    first = set(before)
    rest = [values.get(line, line) for line in lines if line not in first]
    return "\n".join([*reversed(before), *(loop if together else []), *rest])


def _angle(line: str) -> list[str]:
    """Return the value in a line of a sine and a cosine, or none for a constant angle."""
    return _NAME.findall(_ANGLE.search(line)[1])  # type: ignore[index]


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
