"""Sine, cosine and exponential as steps of arithmetic, equal to those of vectors.h operation by operation.

Sine and cosine use Cody-Waite reduction by pi/2 (parts of 33, 33 and 53 bits as in
fdlibm, or of 8, 11, 11 and 24 bits in single precision), the exponential by ln 2 in two
parts. The polynomials are those of the Cephes library. Errors are at most 2 ulp: of the
exponential everywhere, of sine and cosine for |x| up to 2^20, also next to their zeros
(single precision: up to 2^8, and 3 ulp up to 2^13).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from cnpgen.kernels.steps import StepList


@dataclass(frozen=True)
class Precision:
    """Constants of one floating-point type.

    Attributes:
        rounding_shift: 1.5 * 2^(mantissa bits): x + shift has the nearest integer in
            its last bits.
        two_over_pi: 2 / pi.
        pi_2: Parts of pi / 2, the largest first.
        sine: Coefficients of sin(r) / r - 1 in r^2, the highest first.
        cosine: Those of (cos(r) - 1 + r^2 / 2) / r^2.
        log2e: log2(e).
        ln2: Parts of ln 2.
        max_exponent: exp(-x) is 0 and exp(x) infinite beyond it.
    """

    rounding_shift: float
    two_over_pi: float
    pi_2: Sequence[float]
    sine: Sequence[float]
    cosine: Sequence[float]
    log2e: float
    ln2: Sequence[float]
    max_exponent: float


DOUBLE = Precision(
    rounding_shift=6755399441055744.0,
    two_over_pi=0.63661977236758134308,
    pi_2=(1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21),
    sine=(
        1.58962301576546568060e-10, -2.50507477628578072866e-8, 2.75573136213857245213e-6,
        -1.98412698295895385996e-4, 8.33333333332211858878e-3, -1.66666666666666307295e-1,
    ),
    cosine=(
        -1.13585365213876817300e-11, 2.08757008419747316778e-9, -2.75573141792967388112e-7,
        2.48015872888517045348e-5, -1.38888888888730564116e-3, 4.16666666666665929218e-2,
    ),
    log2e=1.4426950408889634073599,
    ln2=(6.93145751953125e-1, 1.42860682030941723212e-6),
    max_exponent=800.0,
)  # fmt: skip
SINGLE = Precision(
    rounding_shift=12582912.0,
    two_over_pi=0.636619772,
    pi_2=(1.5703125, 4.837512969970703125e-4, 7.549533620476723e-8, 2.5633440682570896e-12),
    sine=(-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1),
    cosine=(2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2),
    log2e=1.44269504,
    ln2=(0.693359375, -2.12194440e-4),
    max_exponent=110.0,
)  # fmt: skip
EXP_SINGLE = (
    1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1,
    5.0000001201e-1,
)  # fmt: skip
EXP_P = (
    1.26177193074810590878e-4,
    3.02994407707441961300e-2,
    9.99999999999999999910e-1,
)
EXP_Q = (
    3.00198505138664455042e-6, 2.52448340349684104192e-3, 2.27265548208155028766e-1, 2.0,
)  # fmt: skip


def sine_and_cosine(steps: StepList, x: int) -> tuple[int, int]:
    """Enter the sine and the cosine of one angle; the one that is not used is removed later."""
    p = SINGLE if steps.single else DOUBLE
    shift = steps.number(p.rounding_shift)
    shifted = steps.add("add", steps.add("mul", x, steps.number(p.two_over_pi)), shift)
    # n = round(2 x / pi): the sum with the shift has no fraction bits left.
    n = steps.add("sub", shifted, shift)
    # In [-pi/4, pi/4]: x - n pi / 2, one part of pi / 2 after the other.
    r = x
    for part in p.pi_2:
        r = steps.add("sub", r, steps.add("mul", n, steps.number(part)))
    z = steps.add("mul", r, r)
    # sin(r) = S(z) z r + r; cos(r) = C(z) z z - z / 2 + 1
    scaled = steps.add("mul", polynomial(steps, z, p.sine), z)
    sine = steps.add("add", steps.add("mul", scaled, r), r)
    fourth = steps.add("mul", steps.add("mul", polynomial(steps, z, p.cosine), z), z)
    half = steps.add("mul", steps.number(0.5), z)
    cosine = steps.add("add", steps.add("sub", fourth, half), steps.number(1.0))
    return (
        steps.add("quadrant_sine", shifted, sine, cosine),
        steps.add("quadrant_cosine", shifted, sine, cosine),
    )


def exponential(steps: StepList, x: int) -> int:
    """Enter the exponential: exp(x) = 2^n exp(r) with r = x - n ln 2."""
    p = SINGLE if steps.single else DOUBLE
    shift = steps.number(p.rounding_shift)
    limit = steps.number(p.max_exponent)
    # The result is 0 or infinite beyond the limit, so clipping does not change it.
    clipped = steps.add("lesser", x, limit)
    clipped = steps.add("larger", clipped, steps.number(-p.max_exponent))
    shifted = steps.add("add", steps.add("mul", clipped, steps.number(p.log2e)), shift)
    # n = round(x / ln 2), and r = x - n ln 2, one part of ln 2 after the other.
    n = steps.add("sub", shifted, shift)
    r = clipped
    for part in p.ln2:
        r = steps.add("sub", r, steps.add("mul", n, steps.number(part)))
    reduced = _reduced_single(steps, r) if steps.single else _reduced_double(steps, r)
    return steps.add("times_power_of_two", x, shifted, reduced)


def _reduced_single(steps: StepList, r: int) -> int:
    """Enter exp(r) = P(r) r^2 + r + 1."""
    square = steps.add("mul", r, r)
    tail = steps.add("mul", polynomial(steps, r, EXP_SINGLE), square)
    return steps.add("add", steps.add("add", tail, r), steps.number(1.0))


def _reduced_double(steps: StepList, r: int) -> int:
    """Enter exp(r) = 1 + 2 p / (q - p) with p = r P(r^2), q = Q(r^2)."""
    z = steps.add("mul", r, r)
    p = steps.add("mul", r, polynomial(steps, z, EXP_P))
    q = polynomial(steps, z, EXP_Q)
    ratio = steps.add("div", p, steps.add("sub", q, p))
    twice = steps.add("mul", steps.number(2.0), ratio)
    return steps.add("add", steps.number(1.0), twice)


def polynomial(steps: StepList, x: int, coefficients: Sequence[float]) -> int:
    """Enter a polynomial by Horner's rule; its coefficients begin with the highest."""
    value = steps.number(coefficients[0])
    for coefficient in coefficients[1:]:
        value = steps.add("add", steps.add("mul", value, x), steps.number(coefficient))
    return value
