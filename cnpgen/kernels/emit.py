"""C source of a tape, over vector types: one lane per sample, any target that GCC or Clang knows."""

from collections.abc import Callable

import numpy as np

from cnpgen.kernels.tape import NAMES, Tape

_UNARY = {
    "NEG": "-{}", "SQ": "{0}*{0}", "TWICE": "{0}+{0}", "INV": "one/{}", "SQRT": "vsqrt({})", "FABS": "vabs({})",
    "SIGN": "vsign({})", "NOT": "vnot({})", "EXP": "vexp({})",
}  # fmt: skip
_BINARY = {
    "ADD": "{}+{}", "SUB": "{}-{}", "MUL": "{}*{}", "DIV": "{}/{}", "FMIN": "vmin({},{})", "FMAX": "vmax({},{})",
    "LT": "vlt({},{})", "LE": "vle({},{})", "EQ": "veq({},{})", "NE": "vne({},{})", "AND": "vand({},{})",
    "OR": "vor({},{})", "IF_ELSE_ZERO": "vsel({},{})",
}  # fmt: skip

# Vector types, comparisons (results are 1.0 or 0.0, as in CasADi), minima and maxima that ignore a nan (as C's fmin and
# CasADi's do; the instructions return their second operand if either is nan) and sin/cos for |x| up to 2^20 (Cody and
# Waite's reduction by pi/2 in three parts, of 33, 33 and 53 bits as in fdlibm, then the minimax polynomials of the
# Cephes mathematical library: error at most 2 ulp, also beside the zeros).
PRELUDE = r"""
#include <math.h>
#include <string.h>
#if defined(__AVX512F__)
#include <immintrin.h>
#define W 8
#elif defined(__AVX__)
#include <immintrin.h>
#define W 4
#elif defined(__aarch64__)
#include <arm_neon.h>
#define W 2
#else
#define W 2
#endif
typedef double v __attribute__((vector_size(8*W)));
typedef double vu __attribute__((vector_size(8*W), aligned(8)));
typedef long long vi __attribute__((vector_size(8*W)));
#define I static inline __attribute__((always_inline))
I v K(double x){v y={0};return y+x;}
I v pick(vi m,v a,v b){return (v)((m&(vi)a)|(~m&(vi)b));}
I v vabs(v x){return (v)((vi)x&0x7fffffffffffffffLL);}
#if defined(__AVX512F__)
I v vsqrt(v x){return (v)_mm512_sqrt_pd((__m512d)x);}
I v lesser(v a,v b){return (v)_mm512_min_pd((__m512d)a,(__m512d)b);}
I v larger(v a,v b){return (v)_mm512_max_pd((__m512d)a,(__m512d)b);}
#elif defined(__AVX__)
I v vsqrt(v x){return (v)_mm256_sqrt_pd((__m256d)x);}
I v lesser(v a,v b){return (v)_mm256_min_pd((__m256d)a,(__m256d)b);}
I v larger(v a,v b){return (v)_mm256_max_pd((__m256d)a,(__m256d)b);}
#elif defined(__aarch64__)
I v vsqrt(v x){return (v)vsqrtq_f64((float64x2_t)x);}
I v lesser(v a,v b){return pick(a<b,a,b);}
I v larger(v a,v b){return pick(a>b,a,b);}
#else
I v vsqrt(v x){for(int i=0;i<W;i++)x[i]=sqrt(x[i]);return x;}
I v lesser(v a,v b){return pick(a<b,a,b);}
I v larger(v a,v b){return pick(a>b,a,b);}
#endif
I v vmin(v a,v b){return pick(b!=b,a,lesser(a,b));}
I v vmax(v a,v b){return pick(b!=b,a,larger(a,b));}
I v flag(vi m){return (v)(m&(vi)K(1.0));}
I v vlt(v a,v b){return flag(a<b);}
I v vle(v a,v b){return flag(a<=b);}
I v veq(v a,v b){return flag(a==b);}
I v vne(v a,v b){return flag(a!=b);}
I v vnot(v a){return flag(a==0.0);}
I v vand(v a,v b){return flag((a!=0.0)&(b!=0.0));}
I v vor(v a,v b){return flag((a!=0.0)|(b!=0.0));}
I v vsel(v c,v b){return (v)((c!=0.0)&(vi)b);}
I v vsign(v a){return pick(a!=a,a,vlt(K(0.0),a)-vlt(a,K(0.0)));}
I v vexp(v x){for(int i=0;i<W;i++)x[i]=exp(x[i]);return x;}
I void vsincos(v x,v*s,v*c){
  const double magic=6755399441055744.0;
  v n=x*0.63661977236758134308+magic; vi quadrant=(vi)n; n-=magic;
  v r=((x-n*1.57079632673412561417)-n*6.07710050630396597660e-11)-n*2.02226624879595063154e-21;
  v z=r*r;
  v ps=((((((1.58962301576546568060e-10*z-2.50507477628578072866e-8)*z+2.75573136213857245213e-6)*z
    -1.98412698295895385996e-4)*z+8.33333333332211858878e-3)*z-1.66666666666666307295e-1)*z)*r+r;
  v pc=(((((((-1.13585365213876817300e-11*z+2.08757008419747316778e-9)*z-2.75573141792967388112e-7)*z
    +2.48015872888517045348e-5)*z-1.38888888888730564116e-3)*z+4.16666666666665929218e-2)*z)*z-0.5*z)+1.0;
  vi odd=-(quadrant&1);
  v a=pick(odd,pc,ps), b=pick(odd,ps,pc);
  *s=(v)((vi)a^((quadrant&2)<<62)); *c=(v)((vi)b^(((quadrant+1)&2)<<62));
}
I v load(const double*p,long k,long n){
  if(k+W<=n)return *(const vu*)(p+k);
  v x; for(int i=0;i<W;i++)x[i]=p[k+i<n?k+i:n-1]; return x;
}
I void store(double*p,long k,long n,v x){
  if(k+W<=n){*(vu*)(p+k)=x;return;}
  for(int i=0;k+i<n;i++)p[k+i]=x[i];
}
"""


def emit(tape: Tape) -> str:
    """Write the C source of a kernel.

    The function is ``void kernel(long n, const double *const *in, const long *ld, double *const *out)``: n lanes, one
    pointer per argument and the distance between its rows, one pointer per result of contiguous rows.
    """
    return PRELUDE + (_emit_loop(tape) if tape.loop else _emit_once(tape))


def _emit_once(tape: Tape) -> str:
    body = statements(
        tape,
        read=lambda argument, component: f"load(in[{argument}]+{component}*ld[{argument}],k,n)",
        write=lambda result, component, value: f"store(out[{result}]+{component}*n,k,n,{value});",
    )
    return f"""void kernel(long n,const double*const*in,const long*ld,double*const*out){{
const v one=K(1.0);
for(long k=0;k<n;k+=W){{
{body}
}}}}
"""


def _emit_loop(tape: Tape) -> str:
    """The iterated form: state and parameters live in local arrays; converged lanes keep their values."""
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
        write=lambda result, component, value: f"y[{component}]={value};" if result == 0 else f"e={value};",
    )
    return f"""void kernel(long n,const double*const*in,const long*ld,double*const*out){{
const v one=K(1.0);
for(long k=0;k<n;k+=W){{
v x[{total}],y[{width}],e=K(0.0),error=K(0.0);
{loads}
vi active=(K(0.0)==0.0);
for(int step=0;step<{tape.loop.limit};step++){{
{body}
for(int i=0;i<{width};i++)x[i]=pick(active,y[i],x[i]);
error=pick(active,e,error);
active&=~(e<{tape.loop.tolerance!r});
long long any=0;for(int i=0;i<W;i++)any|=active[i];
if(!any)break;
}}
for(int i=0;i<{width};i++)store(out[0]+i*n,k,n,x[i]);
store(out[1],k,n,error);
}}}}
"""


def statements(tape: Tape, *, read: Callable[[int, int], str], write: Callable[[int, int, str], str]) -> str:
    """Turn instructions into C statements in single-assignment form; sin and cos of one angle are computed together."""
    lines: list[str] = []
    names: dict[int, str] = {}
    angles: set[int] = set()
    columns = (tape.operation.tolist(), tape.a.tolist(), tape.b.tolist(), tape.constant.tolist())
    for k, (code, a, b, constant) in enumerate(zip(*columns, strict=True)):
        name = NAMES[code]
        if name == "CONST":
            names[k] = f"K({_literal(constant)})"
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
        elif name in _UNARY:
            expression = _UNARY[name].format(names[a])
        else:
            expression = _BINARY[name].format(names[a], names[b])
        names[k] = f"t{k}"
        lines.append(f"v t{k}={expression};")
    return "\n".join(lines)


def _literal(constant: float) -> str:
    """Write a number in C."""
    if np.isnan(constant):
        return "NAN"
    return repr(constant) if np.isfinite(constant) else f"{'-' if constant < 0 else ''}INFINITY"
