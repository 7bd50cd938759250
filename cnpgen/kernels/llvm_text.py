"""LLVM IR of a tape: the steps of ``lowering`` on vectors with one lane per sample, and the loops around them.

No instruction has a fast-math flag, so LLVM changes no rounding at any optimization
level and for no instruction set. Comparisons are 1 or 0, as in CasADi. Minima and maxima
ignore a nan, as fmin of C and CasADi does; "lesser" and "larger" return their second
operand if either is nan, as the instructions of x86 do.
"""

import struct
from collections.abc import Callable
from functools import cache

import numpy as np

from cnpgen.kernels.steps import UNUSED, ArithmeticStep
from cnpgen.kernels.tape import Tape

Read = Callable[[int, str, int, int], str]  # step, its name, argument, component
Write = Callable[[int, str, int, int], str]  # step, value, result, component

_COMPARE = "%c{k} = fcmp {predicate} <V> {a}, {b}\n{t} = select <B> %c{k}, <V> {one}, <V> {zero}"
_TRUTH = (
    "%l{k} = fcmp une <V> {a}, {zero}\n%r{k} = fcmp une <V> {b}, {zero}\n%c{k} = {operation} <B> %l{k}, %r{k}\n"
    "{t} = select <B> %c{k}, <V> {one}, <V> {zero}"
)
_CHOOSE = (
    "%c{k} = fcmp {predicate} <V> {a}, {b}\n{x} = select <B> %c{k}, <V> {a}, <V> {b}"
)
_IGNORE_NAN = (
    _CHOOSE.replace("{x}", "%m{k}")
    + "\n%n{k} = fcmp uno <V> {b}, {b}\n{t} = select <B> %n{k}, <V> {a}, <V> %m{k}"
)
# Quadrant q of an angle, the last bits of `a`: odd ones exchange sine and cosine, bit 1
# of q (sine) or q + 1 (cosine) is the sign.
_QUADRANT = (
    "%q{k} = bitcast <V> {a} to <I>\n%o{k} = trunc <I> %q{k} to <B>\n"
    "%u{k} = select <B> %o{k}, <V> {first}, <V> {second}\n%p{k} = add <I> %q{k}, splat (<i> {turn})\n"
    "%d{k} = and <I> %p{k}, splat (<i> 2)\n%g{k} = shl <I> %d{k}, splat (<i> SIGN)\n"
    "%b{k} = bitcast <V> %u{k} to <I>\n%x{k} = xor <I> %b{k}, %g{k}\n{t} = bitcast <I> %x{k} to <V>"
)
# c 2^n in two factors, each of them a normal number; n = bits of b - bits of the shift.
_POWER = (
    "%i{k} = bitcast <V> {b} to <I>\n%w{k} = sub <I> %i{k}, splat (<i> SHIFT)\n"
    "%h{k} = ashr <I> %w{k}, splat (<i> 1)\n%r{k} = sub <I> %w{k}, %h{k}\n"
    "%e{k} = add <I> %h{k}, splat (<i> BIAS)\n%f{k} = shl <I> %e{k}, splat (<i> MANTISSA)\n"
    "%g{k} = add <I> %r{k}, splat (<i> BIAS)\n%j{k} = shl <I> %g{k}, splat (<i> MANTISSA)\n"
    "%p{k} = bitcast <I> %f{k} to <V>\n%q{k} = bitcast <I> %j{k} to <V>\n"
    "%y{k} = fmul <V> {c}, %p{k}\n%z{k} = fmul <V> %y{k}, %q{k}\n"
    "%n{k} = fcmp uno <V> {a}, {a}\n{t} = select <B> %n{k}, <V> {a}, <V> %z{k}"
)
_SIGN = (
    "%p{k} = fcmp olt <V> {zero}, {a}\n%m{k} = fcmp olt <V> {a}, {zero}\n"
    "%x{k} = select <B> %p{k}, <V> {one}, <V> {zero}\n%y{k} = select <B> %m{k}, <V> {one}, <V> {zero}\n"
    "%d{k} = fsub <V> %x{k}, %y{k}\n%n{k} = fcmp uno <V> {a}, {a}\n{t} = select <B> %n{k}, <V> {a}, <V> %d{k}"
)
TEMPLATES = {
    "add": "{t} = fadd <V> {a}, {b}", "sub": "{t} = fsub <V> {a}, {b}", "mul": "{t} = fmul <V> {a}, {b}",
    "div": "{t} = fdiv <V> {a}, {b}", "neg": "{t} = fneg <V> {a}",
    "sqrt": "{t} = call <V> @llvm.sqrt.SUFFIX(<V> {a})", "abs": "{t} = call <V> @llvm.fabs.SUFFIX(<V> {a})",
    "lesser": _CHOOSE.replace("{x}", "{t}").replace("{predicate}", "olt"),
    "larger": _CHOOSE.replace("{x}", "{t}").replace("{predicate}", "ogt"),
    "min": _IGNORE_NAN.replace("{predicate}", "olt"), "max": _IGNORE_NAN.replace("{predicate}", "ogt"),
    "lt": _COMPARE.replace("{predicate}", "olt"), "le": _COMPARE.replace("{predicate}", "ole"),
    "eq": _COMPARE.replace("{predicate}", "oeq"), "ne": _COMPARE.replace("{predicate}", "une"),
    "not": _COMPARE.replace("{predicate}", "oeq").replace("{b}", "{zero}"),
    "and": _TRUTH.replace("{operation}", "and"), "or": _TRUTH.replace("{operation}", "or"),
    "if_else_zero": "%c{k} = fcmp une <V> {a}, {zero}\n{t} = select <B> %c{k}, <V> {b}, <V> {zero}",
    "sign": _SIGN, "times_power_of_two": _POWER,
    "quadrant_sine": _QUADRANT.replace("{first}", "{c}").replace("{second}", "{b}").replace("{turn}", "0"),
    "quadrant_cosine": _QUADRANT.replace("{first}", "{b}").replace("{second}", "{c}").replace("{turn}", "1"),
}  # fmt: skip
CONSTANTS = {  # of the templates: type of the mantissa's integers, shift of the sign, bits of the rounding shift, exponent
    "float64": ("double", "i64", "f64", 62, 0x4338000000000000, 1023, 52),
    "float32": ("float", "i32", "f32", 30, 0x4B400000, 127, 23),
}
PAD = """
define internal void @pad(ptr %to, ptr %from, i64 %stride, i64 %width, i64 %rest) {
entry:
  %last = sub i64 %rest, 1
  %none = icmp eq i64 %width, 0
  br i1 %none, label %done, label %row
row:
  %c = phi i64 [0, %entry], [%c1, %next]
  %start = mul i64 %c, %stride
  %place = mul i64 %c, LANES
  br label %lane
lane:
  %i = phi i64 [0, %row], [%i1, %lane]
  %over = icmp ugt i64 %i, %last
  %source = select i1 %over, i64 %last, i64 %i
  %a = add i64 %start, %source
  %b = add i64 %place, %i
  %p = getelementptr REAL, ptr %from, i64 %a
  %q = getelementptr REAL, ptr %to, i64 %b
  %x = load REAL, ptr %p
  store REAL %x, ptr %q
  %i1 = add i64 %i, 1
  %more = icmp ult i64 %i1, LANES
  br i1 %more, label %lane, label %next
next:
  %c1 = add i64 %c, 1
  %rows = icmp ult i64 %c1, %width
  br i1 %rows, label %row, label %done
done:
  ret void
}
define internal void @unpad(ptr %to, i64 %stride, ptr %from, i64 %width, i64 %rest) {
entry:
  %none = icmp eq i64 %width, 0
  br i1 %none, label %done, label %row
row:
  %c = phi i64 [0, %entry], [%c1, %next]
  %start = mul i64 %c, %stride
  %place = mul i64 %c, LANES
  br label %lane
lane:
  %i = phi i64 [0, %row], [%i1, %lane]
  %a = add i64 %start, %i
  %b = add i64 %place, %i
  %p = getelementptr REAL, ptr %to, i64 %a
  %q = getelementptr REAL, ptr %from, i64 %b
  %x = load REAL, ptr %q
  store REAL %x, ptr %p
  %i1 = add i64 %i, 1
  %more = icmp ult i64 %i1, %rest
  br i1 %more, label %lane, label %next
next:
  %c1 = add i64 %c, 1
  %rows = icmp ult i64 %c1, %width
  br i1 %rows, label %row, label %done
done:
  ret void
}
"""


class StepText:
    """Text of steps for one type and number of lanes.

    Attributes:
        real: LLVM's type of one lane.
        vector: That of all lanes.
        flags: That of a comparison.
        size: Bytes of one lane.
        lanes: Lanes of a vector.
    """

    def __init__(self, tape: Tape, lanes: int) -> None:
        self.real, _, suffix, *_ = CONSTANTS[tape.dtype]
        self.lanes = lanes
        self.size = np.dtype(tape.dtype).itemsize
        self.vector = f"<{lanes} x {self.real}>"
        self.flags = f"<{lanes} x i1>"
        self._fma = f"@llvm.fma.v{lanes}{suffix}"
        self._templates = _templates(tape.dtype, lanes)
        self._single = tape.dtype == "float32"

    def number(self, value: float) -> str:
        """Return a number as a constant vector; LLVM writes bits of doubles for both types."""
        rounded = float(np.float32(value)) if self._single else value
        (bits,) = struct.unpack("<Q", struct.pack("<d", rounded))
        return f"splat ({self.real} 0x{bits:016X})"

    def spread(self, name: str, scalar: str, k: int) -> str:
        """Return the instructions that fill a vector with a scalar."""
        # A scalar in lane 0, then a shuffle that copies lane 0 to all lanes.
        return (
            f"%w{k} = insertelement {self.vector} poison, {self.real} {scalar}, i64 0\n"
            f"{name} = shufflevector {self.vector} %w{k}, {self.vector} poison, <{self.lanes} x i32> zeroinitializer"
        )

    def body(self, steps: list[ArithmeticStep], read: Read, write: Write) -> str:
        """Return the instructions of all steps; ``read`` and ``write`` return those of inputs and outputs."""
        lines: list[str] = []
        names: list[str] = []
        for k, step in enumerate(steps):
            name = f"%t{k}"
            operands = step.operands
            constant = step.operation == "constant"
            names.append(self.number(step.value) if constant else name)
            if constant or step is UNUSED:
                continue
            if step.operation == "input":
                lines.append(read(k, name, *operands))
            elif step.operation == "output":
                lines.append(write(k, names[operands[0]], *operands[1:]))
            elif step.operation == "fma":
                lines.append(self._fused(k, step, *(names[i] for i in operands)))
            else:
                values = dict(zip("abc", (names[i] for i in operands), strict=False))
                template = self._templates[step.operation]
                lines.append(template.format(k=k, t=name, **values))
        return "\n".join(lines)

    def _fused(self, k: int, step: ArithmeticStep, a: str, b: str, c: str) -> str:
        """Return ``a b + c`` with one rounding; the signs are exact."""
        v = self.vector
        lines = ""
        if step.signs[0]:
            lines = f"%a{k} = fneg {v} {a}\n"
            a = f"%a{k}"
        if step.signs[1]:
            lines = lines + f"%c{k} = fneg {v} {c}\n"
            c = f"%c{k}"
        return lines + f"%t{k} = call {v} {self._fma}({v} {a}, {v} {b}, {v} {c})"


@cache
def _templates(dtype: str, lanes: int) -> dict[str, str]:
    """Return the templates with the types of a vector in them."""
    real, integer, suffix, sign, shift, bias, mantissa = CONSTANTS[dtype]
    replaced = {
        "<V>": f"<{lanes} x {real}>", "<I>": f"<{lanes} x {integer}>", "<B>": f"<{lanes} x i1>", "<i>": integer,
        "SUFFIX": f"v{lanes}{suffix}", "SIGN": str(sign), "SHIFT": str(shift), "BIAS": str(bias),
        "MANTISSA": str(mantissa), "{one}": f"splat ({real} 1.0)", "{zero}": f"splat ({real} 0.0)",
    }  # fmt: skip
    templates = dict(TEMPLATES)
    for old, new in replaced.items():
        templates = {name: text.replace(old, new) for name, text in templates.items()}
    return templates
