/* Prelude of every compiled kernel: vectors of double, or of float if SINGLE is defined, with one lane per sample.

Comparisons are 1 or 0, as in CasADi. Minima and maxima ignore a nan, as fmin of C and CasADi does; the instructions
(lesser and larger) return their second operand if either is nan. Sine and cosine use Cody-Waite reduction by pi/2 (parts
of 33, 33 and 53 bits as in fdlibm, or of 8, 11, 11 and 24 bits), the exponential by ln 2 in two parts. The polynomials are
those of the Cephes library. Errors are at most 2 ulp: of the exponential everywhere, of sine and cosine for |x| up to
2^20, also next to their zeros (float: up to 2^8, and 3 ulp up to 2^13). */

#include <math.h>
#include <string.h>

#ifdef SINGLE
typedef float real;
typedef int integer;
#define SUFFIX ps /* of instructions */
#define ABS_MASK 0x7fffffff
#define ROUNDING_SHIFT 12582912.0f /* 1.5 * 2^23: x + ROUNDING_SHIFT has the nearest integer in its last bits */
#define TWO_OVER_PI 0.636619772f
#define PI_2_HIGH 1.5703125f
#define PI_2_MEDIUM 4.837512969970703125e-4f
#define PI_2_LOW 7.549533620476723e-8f
#define PI_2_LOWEST 2.5633440682570896e-12f
#define LOG2E 1.44269504f
#define LN2_HIGH 0.693359375f
#define LN2_LOW (-2.12194440e-4f)
#define MAX_EXPONENT 110.0f /* exp(-x) is 0 and exp(x) infinite */
#define BIAS 127
#define MANTISSA 23
#else
typedef double real;
typedef long long integer;
#define SUFFIX pd
#define ABS_MASK 0x7fffffffffffffffLL
#define ROUNDING_SHIFT 6755399441055744.0
#define TWO_OVER_PI 0.63661977236758134308
#define PI_2_HIGH 1.57079632673412561417
#define PI_2_MEDIUM 6.07710050630396597660e-11
#define PI_2_LOW 2.02226624879595063154e-21
#define LOG2E 1.4426950408889634073599
#define LN2_HIGH 6.93145751953125e-1
#define LN2_LOW 1.42860682030941723212e-6
#define MAX_EXPONENT 800.0
#define BIAS 1023
#define MANTISSA 52
#endif

/* GCC's builtin functions, if available: reading immintrin.h takes longer than compiling a small kernel. */
#if defined(__has_builtin) && !defined(__clang__)
#ifdef __AVX__
#if __has_builtin(__builtin_ia32_sqrtpd256) && __has_builtin(__builtin_ia32_maxpd256)
#define HAVE_BUILTINS
#endif
#endif
#endif

#define PASTE(a, b, c, d) a##b##c##d
#define FUNCTION(a, b, c, d) PASTE(a, b, c, d)
#if defined(__AVX__) && !defined(HAVE_BUILTINS)
#include <immintrin.h>
#endif
#ifdef __AVX__
#define BYTES 32
#ifdef HAVE_BUILTINS
#define WIDE(name, ...) FUNCTION(__builtin_ia32_, name, SUFFIX, 256)(__VA_ARGS__)
#else
#define WIDE(name, ...) (v)FUNCTION(_mm256_, name, _, SUFFIX)(__VA_ARGS__)
#endif
#else
#define BYTES 16
#if defined(__aarch64__)
#include <arm_neon.h>
#endif
#endif

#define W ((int)(BYTES / sizeof(real)))
typedef real v __attribute__((vector_size(BYTES)));
typedef real vu __attribute__((vector_size(BYTES), aligned(sizeof(real))));
typedef integer vi __attribute__((vector_size(BYTES)));

#define I static inline __attribute__((always_inline))
I v K(real x) { v y = {0}; return y + x; }
I v pick(vi m, v a, v b) { return (v)((m & (vi)a) | (~m & (vi)b)); }
I v vabs(v x) { return (v)((vi)x & ABS_MASK); }

#ifdef WIDE
I v vsqrt(v x) { return WIDE(sqrt, x); }
I v lesser(v a, v b) { return WIDE(min, a, b); }
I v larger(v a, v b) { return WIDE(max, a, b); }
#else
#if defined(__aarch64__) && defined(SINGLE)
I v vsqrt(v x) { return (v)vsqrtq_f32((float32x4_t)x); }
#elif defined(__aarch64__)
I v vsqrt(v x) { return (v)vsqrtq_f64((float64x2_t)x); }
#else
I v vsqrt(v x) { for (int i = 0; i < W; i++) x[i] = sqrt(x[i]); return x; }
#endif
I v lesser(v a, v b) { return pick(a < b, a, b); }
I v larger(v a, v b) { return pick(a > b, a, b); }
#endif

I v vmin(v a, v b) { return pick(b != b, a, lesser(a, b)); }
I v vmax(v a, v b) { return pick(b != b, a, larger(a, b)); }
I v flag(vi m) { return (v)(m & (vi)K(1)); }
I v vlt(v a, v b) { return flag(a < b); }
I v vle(v a, v b) { return flag(a <= b); }
I v veq(v a, v b) { return flag(a == b); }
I v vne(v a, v b) { return flag(a != b); }
I v vnot(v a) { return flag(a == K(0)); }
I v vand(v a, v b) { return flag((a != K(0)) & (b != K(0))); }
I v vor(v a, v b) { return flag((a != K(0)) | (b != K(0))); }
I v vsel(v c, v b) { return (v)((c != K(0)) & (vi)b); }
I v vsign(v a) { return pick(a != a, a, vlt(K(0), a) - vlt(a, K(0))); }

#ifdef SINGLE
I v reduced_sin(v r, v z) {
  return (((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z) * r + r;
}
I v reduced_cos(v z) {
  return (((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z) * z - 0.5f * z + 1.0f;
}
I v reduced_exp(v r) {
  return (((((1.9875691500e-4f * r + 1.3981999507e-3f) * r + 8.3334519073e-3f) * r + 4.1665795894e-2f) * r
    + 1.6666665459e-1f) * r + 5.0000001201e-1f) * (r * r) + r + 1.0f;
}
#else
I v reduced_sin(v r, v z) {
  return ((((((1.58962301576546568060e-10*z-2.50507477628578072866e-8)*z+2.75573136213857245213e-6)*z
    -1.98412698295895385996e-4)*z+8.33333333332211858878e-3)*z-1.66666666666666307295e-1)*z)*r+r;
}
I v reduced_cos(v z) {
  return (((((((-1.13585365213876817300e-11*z+2.08757008419747316778e-9)*z-2.75573141792967388112e-7)*z
    +2.48015872888517045348e-5)*z-1.38888888888730564116e-3)*z+4.16666666666665929218e-2)*z)*z-0.5*z)+1.0;
}
I v reduced_exp(v r) {
  v z = r * r, p = r * ((1.26177193074810590878e-4 * z + 3.02994407707441961300e-2) * z + 9.99999999999999999910e-1);
  v q = ((3.00198505138664455042e-6 * z + 2.52448340349684104192e-3) * z + 2.27265548208155028766e-1) * z + 2.0;
  return 1.0 + 2.0 * (p / (q - p));
}
#endif

I v power_of_two(vi n) { return (v)((n + BIAS) << MANTISSA); }
I v vexp(v x) {
  v clipped = larger(lesser(x, K(MAX_EXPONENT)), K(-MAX_EXPONENT)), n = clipped * K(LOG2E) + K(ROUNDING_SHIFT);
  /* 2^n in two factors: for n near the ends of the range, 2^n itself has no normal number. */
  vi whole = (vi)n - (vi)K(ROUNDING_SHIFT), half = whole >> 1;
  n -= K(ROUNDING_SHIFT);
  v y = reduced_exp((clipped - n * K(LN2_HIGH)) - n * K(LN2_LOW));
  /* A nan must come through: the clipping above has replaced it by a number. */
  return pick(x != x, x, y * power_of_two(half) * power_of_two(whole - half));
}
I void vsincos(v x, v *s, v *c) {
  v n = x * K(TWO_OVER_PI) + K(ROUNDING_SHIFT);
  vi quadrant = (vi)n;
  n -= K(ROUNDING_SHIFT);
  v r = ((x - n * K(PI_2_HIGH)) - n * K(PI_2_MEDIUM)) - n * K(PI_2_LOW);
#ifdef SINGLE
  r -= n * K(PI_2_LOWEST);
#endif
  v z = r * r, sine = reduced_sin(r, z), cosine = reduced_cos(z);
  /* Odd quadrants exchange sine and cosine; bit 1 of the quadrant is the sign of the sine, that of the next one the sign
     of the cosine. */
  vi odd = -(quadrant & 1);
  v a = pick(odd, cosine, sine), b = pick(odd, sine, cosine);
  int sign = 8 * (int)sizeof(real) - 2;
  *s = (v)((vi)a ^ ((quadrant & 2) << sign));
  *c = (v)((vi)b ^ (((quadrant + 1) & 2) << sign));
}

/* The remaining lanes, fewer than W. They are not inlined, because a kernel may have a thousand loads and stores. */
static __attribute__((noinline, cold)) v load_last(const real *p, long k, long n) {
  v x;
  for (int i = 0; i < W; i++) x[i] = p[k + i < n ? k + i : n - 1];
  return x;
}
static __attribute__((noinline, cold)) void store_last(real *p, long k, long n, v x) {
  for (int i = 0; k + i < n; i++) p[k + i] = x[i];
}
I v load(const real *p, long k, long n) {
  if (k + W <= n) return *(const vu *)(p + k);
  return load_last(p, k, n);
}
I void store(real *p, long k, long n, v x) {
  if (k + W <= n) *(vu *)(p + k) = x;
  else store_last(p, k, n, x);
}
