/* The point of a polyhedron that is nearest to -f, by the dual method of Goldfarb and Idnani (Mathematical Programming
27, 1983): minimise x x / 2 + f x subject to low <= a x <= high for every row a. It takes DAQP's place. Rows that are
taken to be active at first are so at once, where DAQP adds one after the other. vectors.h comes first. */

#define EACH(i, from, to) for (long i = (from); i < (to); i++)
#define B (4 * W) /* rows that lie side by side */
#define PARALLEL 1e-11 /* of its square: what is left of a row that depends on active ones */
#define ROUNDS 4 /* one and a look at what it came to are enough nearly always */

I double sum(v x) { double s = 0; EACH(i, 0, W) s += x[i]; return s; }
I v at(const double *p) { return *(const vu *)p; }
I void put(double *p, v x) { *(vu *)p = x; }
I long padded(long n) { return (n + W - 1) / W * W; }

static double dot(const double *a, const double *b, long n) {
  v s = K(0);
  double rest = 0;
  long i = 0;
  for (; i + W <= n; i += W) s += at(a + i) * at(b + i);
  for (; i < n; i++) rest += a[i] * b[i];
  return sum(s) + rest;
}

static void add(double *restrict a, double f, const double *restrict b, long n) {
  long i = 0;
  for (; i + W <= n; i += W) put(a + i, at(a + i) + K(f) * at(b + i));
  for (; i < n; i++) a[i] += f * b[i];
}

typedef struct {
  long dim, stride, count;          /* numbers in a row; padded, with room for one more; rows */
  double *rows, *low, *high, *norm; /* blocks of B rows, (dim, B) each; of every row, norm: 1 over its length */
  double *scratch;                  /* 2 dim + 8 times stride */
  int *active;                      /* (dim,) */
} polyhedron;

I double *entry(const polyhedron *p, long row, long i) { return p->rows + (row / B) * p->dim * B + i * B + row % B; }

/* Active rows a, with signs so that a x <= b, and the factor of their products, whose diagonal is inverted. */
typedef struct {
  long dim, stride, count;
  double *a, *factor, *b, *sign, *multiplier, *product, *share;
  int *row;
} working;

/* Solve factor x = y, or with the transposed one, in place. */
static void forward(const working *s, double *y) {
  EACH(i, 0, s->count) y[i] = (y[i] - dot(s->factor + i * s->stride, y, i)) * s->factor[i * s->stride + i];
}
static void backward(const working *s, double *y) {
  for (long i = s->count - 1; i >= 0; i--) {
    y[i] *= s->factor[i * s->stride + i];
    add(y, -y[i], s->factor + i * s->stride, i);
  }
}

/* Express a row that would come next by the active ones: `share` are its coefficients in them, and the square of what
they leave of it is returned. */
static double project(working *s, const double *a) {
  EACH(i, 0, s->count) s->product[i] = dot(s->a + i * s->stride, a, s->dim);
  forward(s, s->product);
  memcpy(s->share, s->product, s->count * sizeof(double));
  backward(s, s->share);
  return dot(a, a, s->dim) - dot(s->product, s->product, s->count);
}

static void activate(working *s, const double *a, double b, double sign, double multiplier, long row, double square) {
  long k = s->count++;
  memmove(s->a + k * s->stride, a, s->dim * sizeof(double));
  memcpy(s->factor + k * s->stride, s->product, k * sizeof(double));
  s->factor[k * s->stride + k] = 1 / sqrt(square);
  s->b[k] = b, s->sign[k] = sign, s->multiplier[k] = multiplier, s->row[k] = (int)row;
}

static void release(working *s, long k) {
  long stride = s->stride;
  s->count--;
  EACH(i, k, s->count) { /* rows move up; rotations of neighbouring columns make the factor triangular again */
    memcpy(s->a + i * stride, s->a + (i + 1) * stride, s->dim * sizeof(double));
    memcpy(s->factor + i * stride, s->factor + (i + 1) * stride, (i + 2) * sizeof(double));
    s->b[i] = s->b[i + 1], s->sign[i] = s->sign[i + 1];
    s->multiplier[i] = s->multiplier[i + 1], s->row[i] = s->row[i + 1];
  }
  EACH(i, k, s->count) {
    double *f = s->factor + i * stride, last = 1 / f[i + 1], size = sqrt(f[i] * f[i] + last * last);
    double c = f[i] / size, d = last / size;
    f[i] = 1 / size;
    EACH(j, i + 1, s->count) {
      double *g = s->factor + j * stride, one = g[i], other = g[i + 1];
      g[i] = c * one + d * other;
      g[i + 1] = c * other - d * one;
    }
  }
}

/* Take rows to be active. */
static void begin(const polyhedron *p, working *set, const int *first, long count) {
  double a[p->dim];
  EACH(i, 0, count) {
    long row = (first[i] > 0 ? first[i] : -first[i]) - 1;
    double sign = first[i] > 0 ? 1 : -1, b = first[i] > 0 ? p->high[row] : -p->low[row];
    if (!isfinite(b) || set->count == p->dim) continue;
    EACH(j, 0, p->dim) a[j] = sign * *entry(p, row, j);
    double square = project(set, a);
    if (square > PARALLEL * dot(a, a, p->dim)) activate(set, a, b, sign, 0, row, square);
  }
}

/* Find x and the multipliers of what is active, without what would have to pull; more exactly than many changes leave
them. */
static void settle(const polyhedron *p, working *set, const double *f, double *x) {
  for (long before = -1; before != set->count;) {
    before = set->count;
    EACH(i, 0, before) set->multiplier[i] = -set->b[i] - dot(set->a + i * set->stride, f, p->dim);
    forward(set, set->multiplier);
    backward(set, set->multiplier);
    for (long i = before - 1; i >= 0; i--) if (set->multiplier[i] < 0) release(set, i);
  }
  EACH(i, 0, p->dim) x[i] = -f[i];
  EACH(i, 0, set->count) add(x, -set->multiplier[i], set->a + i * set->stride, p->dim);
}

/* Return the row that x breaks most, in multiples of its norm, or -1 where none is broken by more than `feasible`. */
static long broken(const polyhedron *p, const double *x, double feasible, double *value) {
  long found = -1;
  double most = feasible, r[B];
  for (long first = 0; first < p->count; first += B) {
    const double *block = entry(p, first, 0);
    v sums[4] = {K(0), K(0), K(0), K(0)};
    EACH(i, 0, p->dim) EACH(l, 0, 4) sums[l] += K(x[i]) * at(block + i * B + l * W);
    EACH(l, 0, 4) put(r + l * W, sums[l]);
    EACH(i, first, first + B < p->count ? first + B : p->count) {
      double over = r[i - first] - p->high[i], under = p->low[i] - r[i - first];
      double excess = (over > under ? over : under) * p->norm[i];
      if (excess > most) most = excess, found = i, *value = r[i - first];
    }
  }
  return found;
}

/* Make one broken row active, others inactive where they are in the way: 0 where that cannot be. */
static int repair(const polyhedron *p, working *set, double *x, long row, double value, int *changes) {
  long dim = p->dim;
  double a[dim], sign = value > p->high[row] ? 1 : -1, b = sign > 0 ? p->high[row] : -p->low[row];
  double excess = sign * value - b, multiplier = 0;
  EACH(j, 0, dim) a[j] = sign * *entry(p, row, j);
  double size = dot(a, a, dim);
  for (; *changes > 0; --*changes) {
    double square = project(set, a), longest = INFINITY, whole = square > PARALLEL * size ? excess / square : INFINITY;
    long first = -1;
    EACH(i, 0, set->count) if (set->share[i] > 0 && set->multiplier[i] < longest * set->share[i])
      longest = set->multiplier[i] / set->share[i], first = i;
    double t = whole < longest ? whole : longest;
    if (!(t < INFINITY)) return 0;
    multiplier += t;
    EACH(i, 0, set->count) set->multiplier[i] -= t * set->share[i];
    if (whole < INFINITY) { /* else x cannot move */
      add(x, -t, a, dim);
      EACH(i, 0, set->count) add(x, t * set->share[i], set->a + i * set->stride, dim);
      excess -= t * square;
    }
    if (t == whole) {
      activate(set, a, b, sign, multiplier, row, square);
      return 1;
    }
    release(set, first);
  }
  return 0;
}

/* Measure the rows; they are complete. */
static void measure(const polyhedron *p) {
  for (long first = 0; first < p->count; first += B) {
    v squares[4] = {K(0), K(0), K(0), K(0)};
    EACH(i, 0, p->dim) EACH(l, 0, 4) { v x = at(entry(p, first, i) + l * W); squares[l] += x * x; }
    EACH(l, 0, 4) put(p->norm + first + l * W, K(1) / vsqrt(squares[l]));
  }
}

/* Find x, (dim,): 0 where there is none, or none in so many changes of what is active. No row is exceeded by more than
`feasible` times its length. Rows to be active at first are numbered from 1 on, negative at their lower bounds. */
static int nearest(const polyhedron *p, const double *f, const int *first, long n_first, double feasible, int changes,
                   double *x, working *set) {
  long dim = p->dim, stride = p->stride;
  double *next = p->scratch;
  set->dim = dim, set->stride = stride, set->count = 0;
  set->b = next, set->sign = set->b + stride, set->multiplier = set->sign + stride;
  set->product = set->multiplier + stride, set->share = set->product + stride;
  set->a = set->share + stride, set->factor = set->a + dim * stride;
  set->row = p->active;
  measure(p);
  begin(p, set, first, n_first);
  for (int round = 0; round < ROUNDS; round++) {
    double value;
    long row;
    settle(p, set, f, x);
    if ((row = broken(p, x, feasible, &value)) < 0) return 1;
    for (; row >= 0; row = broken(p, x, feasible, &value))
      if (!repair(p, set, x, row, value, &changes)) return 0;
  }
  return 1;
}
