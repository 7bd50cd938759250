"""C source of a tape over vector types: one lane per sample, for any target of GCC or Clang."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from cnpgen.kernels.tape import NAMES, GridSpec, Tape

VECTORS = Path(__file__).with_name("vectors.h")

_EXPRESSIONS = {  # of one operand or two
    "NEG": "-{}", "SQ": "{0}*{0}", "TWICE": "{0}+{0}", "INV": "one/{}", "SQRT": "vsqrt({})", "FABS": "vabs({})",
    "SIGN": "vsign({})", "NOT": "vnot({})", "EXP": "vexp({})",
    "ADD": "{}+{}", "SUB": "{}-{}", "MUL": "{}*{}", "DIV": "{}/{}", "FMIN": "vmin({},{})", "FMAX": "vmax({},{})",
    "LT": "vlt({},{})", "LE": "vle({},{})", "EQ": "veq({},{})", "NE": "vne({},{})", "AND": "vand({},{})",
    "OR": "vor({},{})", "IF_ELSE_ZERO": "vsel({},{})",
}  # fmt: skip
_WITHOUT_NAN = {
    "FMIN": "lesser({},{})",
    "FMAX": "larger({},{})",
}  # one instruction if the second is not nan


def prelude(dtype: str) -> str:
    """Return the C source that defines vectors of ``dtype`` and their functions."""
    return ("#define SINGLE\n" if dtype == "float32" else "") + VECTORS.read_text(
        encoding="utf-8"
    )


def emit(tape: Tape) -> str:
    """Return the C source of a kernel.

    Without a grid the function is ``void kernel(long n, const real *const *in, const
    long *ld, real *const *out)``: n lanes, one pointer and one row stride per argument,
    one pointer per result of contiguous rows. With a grid it is ``void kernel(long
    nodes, long n, const real *const *in, const long *ld, real *const *out, const long
    *lo)``: two strides per argument and result, between components and between nodes.
    Sums are added to the values in ``out``.
    """
    body = (
        _emit_loop(tape)
        if tape.loop
        else _emit_grid(tape, tape.grid)
        if tape.grid
        else _emit_once(tape)
    )
    return prelude(tape.dtype) + body


def _emit_once(tape: Tape) -> str:
    body = statements(
        tape,
        read=lambda argument, component: (
            f"load(in[{argument}]+{component}*ld[{argument}],k,n)"
        ),
        write=lambda result, component, value: (
            f"store(out[{result}]+{component}*n,k,n,{value});"
        ),
    )
    return f"""void kernel(long n,const real*const*in,const long*ld,real*const*out){{
const v one=K(1);
for(long k=0;k<n;k+=W){{
{body}
}}}}
"""


def _emit_loop(tape: Tape) -> str:
    """Return the source of an iteration: state and parameters are local arrays.

    Converged lanes keep their values.
    """
    assert tape.loop is not None
    first = [sum(tape.inputs[:index]) for index in range(len(tape.inputs))]
    width, total = tape.inputs[0], sum(tape.inputs)
    loads = "\n".join(
        f"for(int i=0;i<{size};i++)x[{start}+i]=load(in[{index}]+i*ld[{index}],k,n);"
        for index, (start, size) in enumerate(zip(first, tape.inputs, strict=True))
    )
    body = statements(
        tape,
        read=lambda argument, component: f"x[{first[argument] + component}]",
        write=lambda result, component, value: (
            f"y[{component}]={value};" if result == 0 else f"e={value};"
        ),
    )
    return f"""void kernel(long n,const real*const*in,const long*ld,real*const*out){{
const v one=K(1);
for(long k=0;k<n;k+=W){{
v x[{total}],y[{width}],e=K(0),error=K(0);
{loads}
vi active=(K(0)==K(0));
for(int step=0;step<{tape.loop.limit};step++){{
{body}
for(int i=0;i<{width};i++)x[i]=pick(active,y[i],x[i]);
error=pick(active,e,error);
active&=~(e<K({tape.loop.tolerance!r}));
integer any=0;for(int i=0;i<W;i++)any|=active[i];
if(!any)break;
}}
for(int i=0;i<{width};i++)store(out[0]+i*n,k,n,x[i]);
store(out[1],k,n,error);
}}}}
"""


def _emit_grid(tape: Tape, grid: GridSpec) -> str:
    """Return the source of a grid: lanes are the inner loop, so that rows are read contiguously."""

    def read(argument: int, component: int) -> str:
        axes = grid.arguments[argument]
        node = f"+k*ld[{2 * argument + 1}]" if axes in ("point", "node") else ""
        row = f"in[{argument}]+{component}*ld[{2 * argument}]{node}"
        return f"load({row},i,n)" if axes in ("point", "lane") else f"K(*({row}))"

    def write(result: int, component: int, value: str) -> str:
        row = f"out[{result}]+{component}*lo[{2 * result}]"
        if grid.results[result] == "lane":
            return f"store({row},i,n,load({row},i,n)+{value});"
        return f"store({row}+k*lo[{2 * result + 1}],i,n,{value});"

    uniform = {
        index for index, axes in enumerate(grid.arguments) if axes in ("node", "fixed")
    }
    body = statements(tape, read=read, write=write, numbers=uniform)
    return f"""void kernel(long nodes,long n,const real*const*in,const long*ld,real*const*out,const long*lo){{
const v one=K(1);
for(long k=0;k<nodes;k++)for(long i=0;i<n;i+=W){{
{body}
}}}}
"""


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
    columns = (
        tape.operation.tolist(),
        tape.a.tolist(),
        tape.b.tolist(),
        tape.constant.tolist(),
    )
    for k, (code, a, b, constant) in enumerate(zip(*columns, strict=True)):
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
            templates = (
                _WITHOUT_NAN
                if name in _WITHOUT_NAN and b in never_nan
                else _EXPRESSIONS
            )
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
