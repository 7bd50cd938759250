/* The point of a polyhedron that is nearest to -f, by the dual method of Goldfarb and Idnani (Mathematical Programming
27, 1983): minimise x x / 2 + f x subject to low <= a x <= high for every row a. It takes DAQP's place. Rows that are
taken to be active at first are so at once, where DAQP adds one after the other. vectors.h comes first.

What is looked at row by row lies row by row, padded with zeros to `stride`; there is room for B numbers more. */

#define EACH(i, from, to) for (long i = (from); i < (to); i++)
#define B (4 * W) /* rows that lie side by side */
#define PARALLEL 1e-11 /* of its square: what is left of a row that depends on active ones */
#define ROUNDS 4 /* one and a look at what it came to are enough nearly always */
#define SERIOUS 0.1 /* of the most that a row is broken by: what is broken by less can wait */

I v at(const double *p) { return *(const vu *)p; }
I void put(double *p, v x) { *(vu *)p = x; }
I double sum(v x) {
  double s[W];
  put(s, x);
  for (int half = W / 2; half; half /= 2) EACH(i, 0, half) s[i] += s[i + half];
  return s[0];
}
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
  for (; i + W <= n; i += W) put(a + i, at(a + i) + f * at(b + i));
  for (; i < n; i++) a[i] += f * b[i];
}

/* out = rows a, of `length` numbers, padded with zeros. */
static void products(const double *rows, long stride, long count, const double *a, long length, double *out) {
  for (long i = 0; i < count; i += 4) {
    v s[4] = {K(0), K(0), K(0), K(0)};
    for (long j = 0; j < length; j += W) EACH(l, 0, 4) s[l] += at(rows + (i + l) * stride + j) * at(a + j);
    EACH(l, 0, 4) out[i + l] = sum(s[l]);
  }
  EACH(i, count, padded(count)) out[i] = 0;
}

/* out = a transposed rows, whose first `length` numbers are wanted. */
static void combine(const double *rows, long stride, long count, const double *a, long length, double *out) {
  for (long j = 0; j < length; j += B) {
    v s[4] = {K(0), K(0), K(0), K(0)};
    EACH(i, 0, count) EACH(l, 0, 4) s[l] += a[i] * at(rows + i * stride + j + l * W);
    EACH(l, 0, 4) put(out + j + l * W, s[l]);
  }
}

typedef struct {
  long dim, stride, count;          /* numbers in a row; padded, with room for one more; rows */
  double *rows, *low, *high, *norm; /* blocks of B rows, (dim, B) each; of every row, norm: 1 over its length */
  double *scratch;                  /* (2 dim + B) stride and 8 (stride + B) */
  int *active;                      /* (dim,) */
  long *begin;                      /* in every block: so many first numbers of its rows are 0 */
} polyhedron;

I double *entry(const polyhedron *p, long row, long i) { return p->rows + (row / B) * p->dim * B + i * B + row % B; }

static void copy(const polyhedron *p, long row, double *a) {
  EACH(i, 0, p->dim) a[i] = *entry(p, row, i);
  EACH(i, p->dim, p->stride) a[i] = 0;
}

/* Active rows a, with signs so that a x <= b, and the lower triangle that makes them orthonormal. */
typedef struct {
  long dim, stride, count;
  double *a, *factor, *b, *sign, *multiplier, *product, *share, *change;
  int *row;
  double *serious; /* rows that were broken, with their numbers */
  long number[B], broken;
} working;

/* Solve a a' share = product, the active rows', and return how much of the square of such a row they make up. */
static double solved(working *s) {
  long count = s->count, stride = s->stride, size;
  for (long i = 0; i < count; i += B) { /* rows of the triangle end at the diagonal, columns begin there */
    size = count - i < B ? count - i : B;
    products(s->factor + i * stride, stride, size, s->product, padded(i + size), s->change + i);
  }
  for (long i = 0; i < count; i += B) {
    size = count - i < B ? count - i : B;
    combine(s->factor + i * stride + i, stride, count - i, s->change + i, size, s->share + i);
  }
  return dot(s->change, s->change, count);
}

/* Express a row that would come next by the active ones: `share` are its coefficients in them, and the square of what
they leave of it is returned. */
static double project(working *s, const double *a) {
  products(s->a, s->stride, s->count, a, s->stride, s->product);
  return dot(a, a, s->dim) - solved(s);
}

static void activate(working *s, const double *a, double b, double sign, double multiplier, long row, double square) {
  long k = s->count++;
  double *last = s->factor + k * s->stride, scale = 1 / sqrt(square);
  memcpy(s->a + k * s->stride, a, s->stride * sizeof(double));
  EACH(i, 0, s->stride) last[i] = i < k ? -scale * s->share[i] : i == k ? scale : 0;
  s->b[k] = b, s->sign[k] = sign, s->multiplier[k] = multiplier, s->row[k] = (int)row;
}

static void release(working *s, long k) {
  long stride = s->stride, rest = --s->count - k;
  memmove(s->a + k * stride, s->a + (k + 1) * stride, rest * stride * sizeof(double));
  double *const numbers[] = {s->b, s->sign, s->multiplier};
  EACH(i, 0, 3) memmove(numbers[i] + k, numbers[i] + k + 1, rest * sizeof(double));
  memmove(s->row + k, s->row + k + 1, rest * sizeof(int));
  EACH(i, k, s->count) { /* rotations of neighbouring rows leave only the last with the column that goes */
    double *one = s->factor + i * stride, *other = one + stride, f = one[k], g = other[k], size = sqrt(f * f + g * g);
    double c = g / size, d = f / size;
    for (long j = 0; j < i + 2; j += W) {
      v x = at(one + j), y = at(other + j);
      put(one + j, c * x - d * y);
      put(other + j, d * x + c * y);
    }
    memmove(one + k, one + k + 1, (i + 1 - k) * sizeof(double));
    one[i + 1] = 0;
  }
}

/* Take rows to be active. */
static void begin(const polyhedron *p, working *set, const int *first, long count) {
  double a[p->stride];
  EACH(i, 0, count) {
    long row = (first[i] > 0 ? first[i] : -first[i]) - 1;
    double sign = first[i] > 0 ? 1 : -1, b = first[i] > 0 ? p->high[row] : -p->low[row];
    if (!isfinite(b) || set->count == p->dim) continue;
    copy(p, row, a);
    EACH(j, 0, p->dim) a[j] *= sign;
    double square = project(set, a);
    if (square > PARALLEL * dot(a, a, p->dim)) activate(set, a, b, sign, 0, row, square);
  }
}

/* Find x and the multipliers of what is active, without what would have to pull; more exactly than many changes leave
them. */
static void settle(const polyhedron *p, working *set, const double *f, double *x) {
  double g[p->stride];
  EACH(i, 0, p->stride) g[i] = i < p->dim ? f[i] : 0;
  for (long before = -1; before != set->count;) {
    before = set->count;
    products(set->a, set->stride, before, g, set->stride, set->product);
    EACH(i, 0, before) set->product[i] = -set->b[i] - set->product[i];
    solved(set);
    memcpy(set->multiplier, set->share, before * sizeof(double));
    for (long i = before - 1; i >= 0; i--) if (set->multiplier[i] < 0) release(set, i);
  }
  combine(set->a, set->stride, set->count, set->multiplier, set->dim, set->change);
  EACH(i, 0, p->dim) x[i] = -f[i] - set->change[i];
}

I double excess(const polyhedron *p, long row, double value) {
  double over = value - p->high[row], under = p->low[row] - value;
  return (over > under ? over : under) * p->norm[row];
}

/* Look for rows that x breaks by more than `feasible` times their lengths: those that it breaks most are kept. */
static void survey(const polyhedron *p, working *set, const double *x, double feasible) {
  double most = 0, least = feasible, worst[B], r[B];
  set->broken = 0;
  for (long first = 0; first < p->count; first += B) {
    const double *block = entry(p, first, 0);
    v sums[4] = {K(0), K(0), K(0), K(0)};
    EACH(i, p->begin[first / B], p->dim) EACH(l, 0, 4) sums[l] += x[i] * at(block + i * B + l * W);
    EACH(l, 0, 4) put(r + l * W, sums[l]);
    EACH(i, first, first + B < p->count ? first + B : p->count) {
      double by = excess(p, i, r[i - first]);
      if (!(by > least)) continue;
      long k = 0;
      if (set->broken < B) worst[k = set->broken++] = 0;
      else EACH(l, 1, B) if (worst[l] < worst[k]) k = l;
      if (worst[k] > by) continue;
      worst[k] = by, set->number[k] = i;
      if (by > most) most = by, least = most * SERIOUS > feasible ? most * SERIOUS : feasible;
    }
  }
  EACH(k, 0, set->broken) copy(p, set->number[k], set->serious + k * p->stride);
}

/* Return which of the rows that were broken most x breaks most now, or -1. */
static long broken(const polyhedron *p, const working *set, const double *x, double feasible, double *value) {
  long found = -1;
  double r[2 * B];
  products(set->serious, p->stride, set->broken, x, p->stride, r);
  EACH(k, 0, set->broken) {
    double by = excess(p, set->number[k], r[k]);
    if (by > feasible) feasible = by, found = k, *value = r[k];
  }
  return found;
}

/* Make one broken row active, others inactive where they are in the way: 0 where that cannot be. */
static int repair(const polyhedron *p, working *set, double *x, long which, double value, int *changes) {
  long dim = p->dim, row = set->number[which];
  double a[p->stride], sign = value > p->high[row] ? 1 : -1, b = sign > 0 ? p->high[row] : -p->low[row];
  double excess = sign * value - b, multiplier = 0;
  EACH(j, 0, p->stride) a[j] = sign * set->serious[which * p->stride + j];
  double size = dot(a, a, dim);
  for (; *changes > 0; --*changes) {
    double square = project(set, a), longest = INFINITY, whole = square > PARALLEL * size ? excess / square : INFINITY;
    long first = -1;
    EACH(i, 0, set->count) if (set->share[i] > 0 && set->multiplier[i] < longest * set->share[i])
      longest = set->multiplier[i] / set->share[i], first = i;
    double t = whole < longest ? whole : longest;
    if (!(t < INFINITY)) return 0;
    multiplier += t;
    add(set->multiplier, -t, set->share, set->count);
    if (whole < INFINITY) { /* else x cannot move */
      combine(set->a, set->stride, set->count, set->share, dim, set->change);
      add(x, -t, a, dim);
      add(x, t, set->change, dim);
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
    EACH(i, p->begin[first / B], p->dim) EACH(l, 0, 4) { v x = at(entry(p, first, i) + l * W); squares[l] += x * x; }
    EACH(l, 0, 4) put(p->norm + first + l * W, K(1) / vsqrt(squares[l]));
  }
}

/* Find x, (stride,): 0 where there is none, or none in so many changes of what is active. No row is exceeded by more
than `feasible` times its length. Rows to be active at first are numbered from 1 on, negative at their lower bounds. */
static int nearest(const polyhedron *p, const double *f, const int *first, long n_first, double feasible, int changes,
                   double *x, working *set) {
  long dim = p->dim, stride = p->stride, room = stride + B;
  double *next = p->scratch, value;
  set->dim = dim, set->stride = stride, set->count = 0, set->row = p->active;
  set->a = next, set->factor = set->a + dim * stride, set->serious = set->factor + dim * stride;
  set->b = set->serious + B * stride, set->sign = set->b + room, set->multiplier = set->sign + room;
  set->product = set->multiplier + room, set->share = set->product + room, set->change = set->share + room;
  measure(p);
  begin(p, set, first, n_first);
  EACH(i, dim, stride) x[i] = 0;
  for (int round = 0; round < ROUNDS; round++) {
    settle(p, set, f, x);
    survey(p, set, x, feasible);
    if (!set->broken) return 1;
    for (int moved = 1; set->broken && moved; survey(p, set, x, feasible)) { /* rounding may say otherwise below */
      moved = 0;
      for (long k; (k = broken(p, set, x, feasible, &value)) >= 0; moved = 1)
        if (!repair(p, set, x, k, value, &changes)) return 0;
    }
  }
  return 1;
}
