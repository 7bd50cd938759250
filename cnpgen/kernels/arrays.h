/* Arrays of doubles and compiled kernels, for handwritten C source; vectors.h precedes this file. A spline and its
derivatives at the phases of a grid are sums of basis functions times control points: calls of `add`.

Results have the same bits on every processor: products and sums are rounded one by one (-ffp-contract=off), and sums
are formed in LANES lanes, of one vector or of PARTS vectors. */

#define EACH(i, from, to) for (long i = (from); i < (to); i++)
#define LANES 4
#define PARTS (LANES / W)

typedef void kernel(long n, const double *const *in, const long *distances, double *const *out);

I v at(const double *p) { return *(const vu *)p; }
I void put(double *p, v x) { *(vu *)p = x; }

/* Whether a lane of a mask is set. */
I int any_lane(vi mask) {
#ifdef HAVE_BUILTINS
  return !__builtin_ia32_ptestz256(mask, mask);
#else
  integer set = 0;
  EACH(i, 0, (long)(sizeof mask / sizeof set)) set |= mask[i];
  return set != 0;
#endif
}

/* a += f b */
static void add(double *restrict a, double f, const double *restrict b, long n) {
  long i = 0;
  for (; i + W <= n; i += W) put(a + i, at(a + i) + f * at(b + i));
  for (; i < n; i++) a[i] += f * b[i];
}

