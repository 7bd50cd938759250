/* Elementary functions, as in the compiled kernels of cnpgen: errors are at most 2 ulp. Comparisons are 1 or 0, and
minima and maxima ignore a nan. None has a branch, so that loops over them become vector instructions. */

static double vabs(double a) { return fabs(a); }

static double vsqrt(double a) { return sqrt(a); }

static double lesser(double a, double b) { return a < b ? a : b; }

static double larger(double a, double b) { return a > b ? a : b; }

static double vmin(double a, double b) {
  double least = a < b ? a : b;
  return b != b ? a : least;
}

static double vmax(double a, double b) {
  double most = a > b ? a : b;
  return b != b ? a : most;
}

static double vlt(double a, double b) { return a < b ? 1.0 : 0.0; }

static double vle(double a, double b) { return a <= b ? 1.0 : 0.0; }

static double veq(double a, double b) { return a == b ? 1.0 : 0.0; }

static double vne(double a, double b) { return a != b ? 1.0 : 0.0; }

static double vnot(double a) { return a == 0.0 ? 1.0 : 0.0; }

static double vand(double a, double b) { return (a != 0.0) & (b != 0.0) ? 1.0 : 0.0; }

static double vor(double a, double b) { return (a != 0.0) | (b != 0.0) ? 1.0 : 0.0; }

static double vsel(double condition, double b) { return condition != 0.0 ? b : 0.0; }

static double vsign(double a) {
  double sign = (a > 0.0 ? 1.0 : 0.0) - (a < 0.0 ? 1.0 : 0.0);
  return a != a ? a : sign;
}

/* The nearest integer of |x| < 2^51: the sum with 1.5 2^52 has no bits for fractions. */
static double nearest(double x) { return (x + 6755399441055744.0) - 6755399441055744.0; }

/* Sine and cosine: reduction by pi/2 in three parts (Cody and Waite), polynomials of the Cephes library. */
INLINE void vsincos(double x, double *s, double *c) {
  double n = nearest(x * 0.63661977236758134308); /* of quarter turns */
  double r = ((x - n * 1.57079632673412561417) - n * 6.07710050630396597660e-11) - n * 2.02226624879595063154e-21;
  double z = r * r;
  double sine = ((((((1.58962301576546568060e-10 * z - 2.50507477628578072866e-8) * z + 2.75573136213857245213e-6) * z
    - 1.98412698295895385996e-4) * z + 8.33333333332211858878e-3) * z - 1.66666666666666307295e-1) * z) * r + r;
  double cosine = (((((((-1.13585365213876817300e-11 * z + 2.08757008419747316778e-9) * z - 2.75573141792967388112e-7)
    * z + 2.48015872888517045348e-5) * z - 1.38888888888730564116e-3) * z + 4.16666666666665929218e-2) * z) * z
    - 0.5 * z) + 1.0;
  double quarter = n - 4.0 * nearest(0.25 * n); /* -2 to 2 */
  double odd = fabs(quarter);                   /* 1 for an odd number of quarter turns */
  double a = odd == 1.0 ? cosine : sine, b = odd == 1.0 ? sine : cosine;
  double back = odd == 2.0 ? -1.0 : 1.0;        /* half a turn changes both signs */
  double sign_s = quarter == -1.0 ? -1.0 : back, sign_c = quarter == 1.0 ? -1.0 : back;
  *s = sign_s * a;
  *c = sign_c * b;
}

/* 2^n for whole n from -1022 to 1023, from the bits of its exponent. */
static double power_of_two(int n) {
  uint64_t bits = (uint64_t)(n + 1023) << 52;
  double power;
  memcpy(&power, &bits, sizeof power);
  return power;
}

/* exp(x) = 2^n exp(r) with ln 2 in two parts; the rational function is that of the Cephes library. */
static double vexp(double x) {
  double clipped = larger(lesser(x, 800.0), -800.0); /* nan becomes -800 */
  double n = nearest(clipped * 1.4426950408889634073599);
  double r = (clipped - n * 6.93145751953125e-1) - n * 1.42860682030941723212e-6, z = r * r;
  double p = r * ((1.26177193074810590878e-4 * z + 3.02994407707441961300e-2) * z + 9.99999999999999999910e-1);
  double q = ((3.00198505138664455042e-6 * z + 2.52448340349684104192e-3) * z + 2.27265548208155028766e-1) * z + 2.0;
  int whole = (int)n, half = whole / 2; /* two factors, since 2^whole may exceed the range */
  double y = (1.0 + 2.0 * (p / (q - p))) * power_of_two(half) * power_of_two(whole - half);
  return x != x ? x : y;
}
