"""LLVM module of a kernel: the functions around the steps of a tape, with the interface of compiled kernels.

Without a grid the function is ``void kernel(long n, const real *const *in, const long
*ld, real *const *out)``: n lanes, one pointer and one row stride per argument, one
pointer per result of contiguous rows. With a grid it is ``void kernel(long nodes, long n,
const real *const *in, const long *ld, real *const *out, const long *lo)``: two strides
per argument and result, between components and between nodes. Sums are added to the
values in ``out``.

``lanes`` evaluates full vectors only. The remaining lanes, fewer than a vector has, are
copied to the stack, filled up with the last lane, evaluated, and copied back.
"""

import numpy as np

from cnpgen.kernels.kernel import axis_names
from cnpgen.kernels.llvm_text import CONSTANTS, PAD, StepText
from cnpgen.kernels.lowering import lower, uniform_arguments
from cnpgen.kernels.steps import ArithmeticStep
from cnpgen.kernels.tape import Axes, Loop, Tape

ONCE = "i64 %n, ptr %in, ptr %ld, ptr %out"
GRID = "i64 %nodes, i64 %n, ptr %in, ptr %ld, ptr %out, ptr %lo"


def module_text(tape: Tape, vector_bytes: int, *, replaceable: bool = False) -> str:
    """Return the LLVM IR of a tape for vectors of a size.

    Args:
        tape: The tape.
        vector_bytes: Size of a vector.
        replaceable: Add ``dispatch``, a function like ``kernel`` that jumps to the
            address in the variable ``target``, at first that of ``kernel``.
    """
    real, _, suffix, *_ = CONSTANTS[tape.dtype]
    lanes = vector_bytes // np.dtype(tape.dtype).itemsize
    text = StepText(tape, lanes)
    steps = lower(tape)
    vector = f"<{lanes} x {real}>"
    functions = [
        f"declare {vector} @llvm.sqrt.v{lanes}{suffix}({vector})",
        f"declare {vector} @llvm.fabs.v{lanes}{suffix}({vector})",
        f"declare {vector} @llvm.fma.v{lanes}{suffix}({vector}, {vector}, {vector})",
        PAD.replace("LANES", str(lanes)).replace("REAL", real),
        _iterated_lanes(tape, steps, text) if tape.loop else _lanes(tape, steps, text),
        _tail(tape, lanes, real),
        _run(lanes),
        _grid_kernel(tape, real) if tape.grid else _plain_kernel(tape),
    ]
    if replaceable:
        functions.append(_dispatch(GRID if tape.grid else ONCE))
    return "\n".join(functions)


def _dispatch(parameters: str) -> str:
    # A monotonic load is an ordinary load on the processors at hand, but LLVM may not
    # keep the address in a register across calls.
    return f"""@target = global ptr @kernel
define void @dispatch({parameters}) {{
  %function = load atomic ptr, ptr @target monotonic, align 8
  tail call void %function({parameters})
  ret void
}}"""


def _bases(name: str, strides: str, count: int, size: int) -> str:
    """Return the loads of pointers and strides in bytes: %in0, %ld0, %in1, ..."""
    return "\n".join(
        f"%{name}p{i} = getelementptr ptr, ptr %{name}, i64 {i}\n%{name}{i} = load ptr, ptr %{name}p{i}\n"
        f"%{strides}p{i} = getelementptr i64, ptr %{strides}, i64 {i}\n"
        f"%{strides}e{i} = load i64, ptr %{strides}p{i}\n%{strides}{i} = mul i64 %{strides}e{i}, {size}"
        for i in range(count)
    )


def _address(name: str, row: str, component: int, offset: str) -> str:
    """Return the address %name of a component of a row %row0 with stride %row1 and an offset in bytes."""
    base, stride = row.split()
    return (
        f"%{name}s = mul i64 {stride}, {component}\n%{name}r = getelementptr i8, ptr {base}, i64 %{name}s\n"
        f"%{name} = getelementptr i8, ptr %{name}r, i64 {offset}\n"
    )


def _head(tape: Tape, text: StepText) -> str:
    return f"""define internal void @lanes(i64 %n, ptr %in, ptr %ld, ptr %out, ptr %lo) {{
entry:
{_bases("in", "ld", len(tape.inputs), text.size)}
{_bases("out", "lo", len(tape.outputs), text.size)}
%end = mul i64 %n, {text.size}
br label %block
"""


def _lanes(tape: Tape, steps: list[ArithmeticStep], text: StepText) -> str:
    """Return the function that evaluates full vectors of lanes once."""
    uniform = uniform_arguments(tape)
    summed = _summed(tape)

    def read(k: int, name: str, argument: int, component: int) -> str:
        row = f"%in{argument} %ld{argument}"
        # A uniform argument is one number for all lanes: load it once and spread it.
        if argument in uniform:
            return (
                _address(f"a{k}", row, component, "0")
                + f"%v{k} = load {text.real}, ptr %a{k}\n"
                + text.spread(name, f"%v{k}", k)
            )
        return (
            _address(f"a{k}", row, component, "%k")
            + f"{name} = load {text.vector}, ptr %a{k}, align {text.size}"
        )

    def write(k: int, value: str, result: int, component: int) -> str:
        lines = _address(f"a{k}", f"%out{result} %lo{result}", component, "%k")
        if result in summed:
            # Sums over nodes accumulate in the result, in the order of the nodes.
            lines += f"%v{k} = load {text.vector}, ptr %a{k}, align {text.size}\n"
            lines += f"%t{k} = fadd {text.vector} %v{k}, {value}\n"
            value = f"%t{k}"
        return lines + f"store {text.vector} {value}, ptr %a{k}, align {text.size}"

    return f"""{_head(tape, text)}
block:
%k = phi i64 [0, %entry], [%k1, %block]
{text.body(steps, read, write)}
%k1 = add i64 %k, {text.size * text.lanes}
%more = icmp ult i64 %k1, %end
br i1 %more, label %block, label %done
done:
ret void
}}"""


def _iterated_lanes(tape: Tape, steps: list[ArithmeticStep], text: StepText) -> str:
    """Return the function that iterates full vectors of lanes; converged lanes keep their values."""
    width = tape.inputs[0]
    # State and parameters are loaded once; only the state changes between steps.
    names = {
        (argument, component): f"%i{argument}_{component}"
        for argument, count in enumerate(tape.inputs)
        for component in range(count)
    }
    loads = "\n".join(
        _address(f"a{a}_{c}", f"%in{a} %ld{a}", c, "%k")
        + f"{name} = load {text.vector}, ptr %a{a}_{c}, align {text.size}"
        for (a, c), name in names.items()
    )
    stores = "\n".join(
        _address(f"end{i}", "%out0 %lo0", i, "%k")
        + f"store {text.vector} %next{i}, ptr %end{i}, align {text.size}"
        for i in range(width)
    )
    return f"""{_head(tape, text)}
block:
%k = phi i64 [0, %entry], [%k1, %finished]
{loads}
br label %step
{_iteration(tape, steps, text, names)}
finished:
{stores}
{_address("enderror", "%out1 %lo1", 0, "%k")}
store {text.vector} %error1, ptr %enderror, align {text.size}
%k1 = add i64 %k, {text.size * text.lanes}
%more = icmp ult i64 %k1, %end
br i1 %more, label %block, label %done
done:
ret void
}}"""


def _iteration(
    tape: Tape,
    steps: list[ArithmeticStep],
    text: StepText,
    names: dict[tuple[int, int], str],
) -> str:
    """Return the block of one step of the iteration, from the loaded state and parameters."""
    assert tape.loop is not None
    vector = text.vector
    results: dict[tuple[int, int], str] = {}

    def read(_: int, name: str, argument: int, component: int) -> str:
        source = f"%state{component}" if argument == 0 else names[argument, component]
        return f"{name} = bitcast {vector} {source} to {vector}"

    def write(_: int, value: str, result: int, component: int) -> str:
        results[result, component] = value
        return ""

    body = text.body(steps, read, write)
    states = []
    choices = []
    for i in range(tape.inputs[0]):
        # SSA form: the state is a phi of its loaded value and the value after the last
        # step.
        initial = names[0, i]
        states.append(
            f"%state{i} = phi {vector} [{initial}, %block], [%next{i}, %step]"
        )
        # next = active ? step(state) : state. The comparison uses the error of the
        # state before the step, so that a lane takes one more step after the tolerance
        # is met.
        values = f"{vector} {results[0, i]}, {vector} %state{i}"
        choices.append(f"%next{i} = select {text.flags} %active, {values}")
    head = f"""step:
%count = phi i64 [0, %block], [%count1, %step]
%active = phi {text.flags} [splat (i1 true), %block], [%remaining, %step]
%error = phi {vector} [zeroinitializer, %block], [%error1, %step]"""
    end = _end_of_step(tape.loop, text, results[1, 0])
    return "\n".join([head, *states, body, *choices, end])


def _end_of_step(loop: Loop, text: StepText, error: str) -> str:
    """Return the end of a step: it is repeated while a lane has not converged."""
    flags = text.flags
    return f"""%error1 = select {flags} %active, {text.vector} {error}, {text.vector} %error
%converged = fcmp olt {text.vector} {error}, {text.number(loop.tolerance)}
%open = xor {flags} %converged, splat (i1 true)
%remaining = and {flags} %active, %open
%bits = bitcast {flags} %remaining to i{text.lanes}
%any = icmp ne i{text.lanes} %bits, 0
%count1 = add i64 %count, 1
%below = icmp slt i64 %count1, {loop.limit}
%again = and i1 %any, %below
br i1 %again, label %step, label %finished"""


def _summed(tape: Tape) -> set[int]:
    """Return the results that are summed over the nodes."""
    axes = tape.grid.results if tape.grid else ()
    return {index for index, name in enumerate(axes) if name == "lane"}


def _tail(tape: Tape, lanes: int, real: str) -> str:
    """Return the function that evaluates fewer lanes than a vector has, from lane %first on."""
    inputs = len(tape.inputs)
    outputs = len(tape.outputs)
    lines = [
        "define internal void @tail(i64 %first, i64 %rest, ptr %in, ptr %ld, ptr %out, ptr %lo) {",
        *(
            f"%{name} = alloca [{max(count, 1)} x {kind}], align {align}"
            for name, count, kind, align in (
                ("inputs", sum(tape.inputs) * lanes, real, 64),
                ("results", sum(tape.outputs) * lanes, real, 64),
                ("in_", inputs, "ptr", 8), ("ld_", inputs, "i64", 8),
                ("out_", outputs, "ptr", 8), ("lo_", outputs, "i64", 8),
            )
        ),
        _bases("in", "ld", inputs, 1),
        _bases("out", "lo", outputs, 1),
    ]  # fmt: skip
    # Copies are packed: every row has as many lanes as a vector, whatever its stride
    # was.
    uniform = uniform_arguments(tape)
    position = 0
    for i, width in enumerate(tape.inputs):
        lines.append(_copied("in", "ld", i, f"inputs, i64 {position}", real))
        # The padding repeats the last lane, so that an iteration ends as soon as the
        # real lanes have converged.
        if i not in uniform:
            lines.append(
                f"call void @pad(ptr %inc{i}, ptr %inf{i}, i64 %ld{i}, i64 {width}, i64 %rest)"
            )
        entry = f"%in{i}", f"%ld{i}"
        pointer, stride = entry if i in uniform else (f"%inc{i}", lanes)
        lines.append(
            f"store ptr {pointer}, ptr %int{i}\nstore i64 {stride}, ptr %ldt{i}"
        )
        position += width * lanes
    before, after = _copied_results(tape, lanes, real)
    call = f"call void @lanes(i64 {lanes}, ptr %in_, ptr %ld_, ptr %out_, ptr %lo_)"
    return "\n".join([*lines, *before, call, *after, "ret void", "}"])


def _copied_results(tape: Tape, lanes: int, real: str) -> tuple[list[str], list[str]]:
    """Return what prepares the copies of results, and what copies them back."""
    summed = _summed(tape)
    before = []
    after = []
    position = 0
    for i, width in enumerate(tape.outputs):
        before.append(_copied("out", "lo", i, f"results, i64 {position}", real))
        # Sums are read before they are written, so their lanes are copied in as well.
        if i in summed:
            before.append(
                f"call void @pad(ptr %outc{i}, ptr %outf{i}, i64 %lo{i}, i64 {width}, i64 %rest)"
            )
        before.append(
            f"store ptr %outc{i}, ptr %outt{i}\nstore i64 {lanes}, ptr %lot{i}"
        )
        after.append(
            f"call void @unpad(ptr %outf{i}, i64 %lo{i}, ptr %outc{i}, i64 {width}, i64 %rest)"
        )
        position += width * lanes
    return before, after


def _copied(name: str, strides: str, i: int, place: str, real: str) -> str:
    """Return the addresses of a copy (c) at a place in memory, of the first lane (f), and of the entries (t)."""
    return (
        f"%{name}c{i} = getelementptr {real}, ptr %{place}\n"
        f"%{name}f{i} = getelementptr {real}, ptr %{name}{i}, i64 %first\n"
        f"%{name}t{i} = getelementptr ptr, ptr %{name}_, i64 {i}\n"
        f"%{strides}t{i} = getelementptr i64, ptr %{strides}_, i64 {i}"
    )


def _run(lanes: int) -> str:
    """Return the function that evaluates all lanes of one node."""
    return f"""define internal void @run(i64 %n, ptr %in, ptr %ld, ptr %out, ptr %lo) {{
entry:
%rest = and i64 %n, {lanes - 1}
%full = sub i64 %n, %rest
%some = icmp ne i64 %full, 0
br i1 %some, label %vectors, label %remaining
vectors:
call void @lanes(i64 %full, ptr %in, ptr %ld, ptr %out, ptr %lo)
br label %remaining
remaining:
%left = icmp ne i64 %rest, 0
br i1 %left, label %last, label %done
last:
call void @tail(i64 %full, i64 %rest, ptr %in, ptr %ld, ptr %out, ptr %lo)
br label %done
done:
ret void
}}"""


def _plain_kernel(tape: Tape) -> str:
    """Return the entry point without a grid: rows of results are contiguous."""
    count = len(tape.outputs)
    stores = "\n".join(
        f"%p{i} = getelementptr i64, ptr %lo, i64 {i}\nstore i64 %n, ptr %p{i}"
        for i in range(count)
    )
    return f"""define void @kernel({ONCE}) {{
%lo = alloca [{max(count, 1)} x i64]
{stores}
call void @run(i64 %n, ptr %in, ptr %ld, ptr %out, ptr %lo)
ret void
}}"""


def _grid_kernel(tape: Tape, real: str) -> str:
    """Return the entry point with a grid: nodes are the outer loop, so that rows are read contiguously."""
    assert tape.grid is not None
    inputs = len(tape.inputs)
    outputs = len(tape.outputs)
    axes = (*tape.grid.arguments, *tape.grid.results)
    rows = [("in", "ld", i) for i in range(inputs)]
    rows += [("out", "lo", i) for i in range(outputs)]
    before = [_row_of_grid(*row) for row in rows]
    inside = [
        _row_of_node(*row, kind, real) for row, kind in zip(rows, axes, strict=True)
    ]
    return f"""define void @kernel({GRID}) {{
entry:
%in_ = alloca [{max(inputs, 1)} x ptr]
%ld_ = alloca [{max(inputs, 1)} x i64]
%out_ = alloca [{max(outputs, 1)} x ptr]
%lo_ = alloca [{max(outputs, 1)} x i64]
{chr(10).join(before)}
%none = icmp eq i64 %nodes, 0
br i1 %none, label %done, label %node
node:
%k = phi i64 [0, %entry], [%k1, %node]
{chr(10).join(inside)}
call void @run(i64 %n, ptr %in_, ptr %ld_, ptr %out_, ptr %lo_)
%k1 = add i64 %k, 1
%more = icmp ult i64 %k1, %nodes
br i1 %more, label %node, label %done
done:
ret void
}}"""


def _row_of_grid(name: str, strides: str, i: int) -> str:
    """Return the loads of a pointer and its strides before the loop over nodes.

    The strides between components are equal for all nodes: they are stored once, and only
    the pointers move from node to node.
    """
    return (
        f"%{name}p{i} = getelementptr ptr, ptr %{name}, i64 {i}\n%{name}b{i} = load ptr, ptr %{name}p{i}\n"
        f"%{strides}p{i} = getelementptr i64, ptr %{strides}, i64 {2 * i}\n"
        f"%{strides}v{i} = load i64, ptr %{strides}p{i}\n"
        f"%{strides}t{i} = getelementptr i64, ptr %{strides}_, i64 {i}\nstore i64 %{strides}v{i}, ptr %{strides}t{i}\n"
        f"%{strides}q{i} = getelementptr i64, ptr %{strides}, i64 {2 * i + 1}\n"
        f"%{strides}n{i} = load i64, ptr %{strides}q{i}\n"
        f"%{name}t{i} = getelementptr ptr, ptr %{name}_, i64 {i}"
    )


def _row_of_node(name: str, strides: str, i: int, kind: Axes, real: str) -> str:
    """Return the store of a pointer to the row of node %k."""
    # An argument without a node axis is read again at the same address.
    stride = f"%{strides}n{i}" if "nodes" in axis_names(kind) else "0"
    return (
        f"%{name}o{i} = mul i64 %k, {stride}\n%{name}x{i} = getelementptr {real}, ptr %{name}b{i}, i64 %{name}o{i}\n"
        f"store ptr %{name}x{i}, ptr %{name}t{i}"
    )
