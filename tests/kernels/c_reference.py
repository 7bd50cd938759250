"""C source of complete kernels, the reference of machine code: the same steps over vector types, by a C compiler."""

from cnpgen.addons.deploy.statements import statements
from cnpgen.kernels.c_library import VECTORS
from cnpgen.kernels.tape import GridSpec, Tape


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
    single = "#define SINGLE\n" if tape.dtype == "float32" else ""
    return single + VECTORS.read_text(encoding="utf-8") + body


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
    # Lanes that have converged must not change any more: a further step would round the
    # state again, and the result would depend on the other lanes of the vector.
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
