/* Dual active-set method for quadratic programs (Goldfarb and Idnani, Mathematical Programming 27, 1983): minimize
x x / 2 + f x subject to low <= a x <= high for every row a. The initial working set is activated at
once; DAQP would add its rows one after the other. Requires arrays.h.

Arrays of rows are padded with zeros to `stride`, with memory for B more numbers. */

#define B 16 /* rows in a block, stored column by column */
#define VECTORS (B / W) /* of a column of a block */
#define MIN_INDEPENDENCE 1e-11 /* fraction of its square that remains of a row that depends on active ones */
#define MAX_ROUNDS 4 /* of repairs; one and a check are nearly always enough */
#define SERIOUS_FRACTION 0.1 /* of the largest violation: rows with smaller ones are added later */

I double sum(const v *x) {
  double s[LANES];
  EACH(part, 0, PARTS) put(s + part * W, x[part]);
  return (s[0] + s[2]) + (s[1] + s[3]);
}
I long padded(long n) { return (n + LANES - 1) / LANES * LANES; }
I void clear(v *x, long n) { EACH(i, 0, n) x[i] = K(0); }

static double dot(const double *a, const double *b, long n) {
  v s[PARTS];
  double rest = 0;
  long i = 0;
  clear(s, PARTS);
  for (; i + LANES <= n; i += LANES) EACH(part, 0, PARTS) s[part] += at(a + i + part * W) * at(b + i + part * W);
  for (; i < n; i++) rest += a[i] * b[i];
  return sum(s) + rest;
}

/* out = rows a, of `length` numbers, padded with zeros. */
static void products(const double *rows, long stride, long count, const double *a, long length, double *out) {
  for (long i = 0; i < count; i += 4) {
    v s[4][PARTS];
    clear(s[0], 4 * PARTS);
    for (long j = 0; j < length; j += LANES) EACH(part, 0, PARTS) EACH(l, 0, 4)
      s[l][part] += at(rows + (i + l) * stride + j + part * W) * at(a + j + part * W);
    EACH(l, 0, 4) out[i + l] = sum(s[l]);
  }
  EACH(i, count, padded(count)) out[i] = 0;
}

/* out = the first `length` numbers of a transposed times rows. */
static void combine(const double *rows, long stride, long count, const double *a, long length, double *out) {
  for (long j = 0; j < length; j += B) {
    v s[VECTORS];
    clear(s, VECTORS);
    EACH(i, 0, count) EACH(l, 0, VECTORS) s[l] += a[i] * at(rows + i * stride + j + l * W);
    EACH(l, 0, VECTORS) put(out + j + l * W, s[l]);
  }
}

typedef struct {
  long dim, stride, count;          /* numbers in a row; padded, with memory for one more; number of rows */
  double *rows, *low, *high, *norm; /* blocks of B rows, (dim, B) each; per row, norm: inverse of its length */
  double *scratch;                  /* (2 dim + B) stride and 8 (stride + B) */
  int *active;                      /* (dim,) */
  long *leading_zeros;              /* of the rows of every block */
} polyhedron;

I double *entry(const polyhedron *p, long row, long i) { return p->rows + (row / B) * p->dim * B + i * B + row % B; }

static void copy(const polyhedron *p, long row, double *a) {
  EACH(i, 0, p->dim) a[i] = *entry(p, row, i);
  EACH(i, p->dim, p->stride) a[i] = 0;
}

/* Working set: active rows a, with signs so that a x <= b, and the lower triangle that makes them orthonormal. */
typedef struct {
  long dim, stride, count;
  double *a, *factor, *b, *sign, *multiplier, *product, *coefficients, *change;
  int *row;
  double *candidates; /* violated rows, with their numbers */
  long number[B], n_candidates;
} working_set;

/* Solve a a' coefficients = product for the active rows a; return the square of the projection. */
static double solve_gram(working_set *s) {
  long count = s->count, stride = s->stride, size;
  for (long i = 0; i < count; i += B) { /* rows of the triangle end at the diagonal, columns begin there */
    size = count - i < B ? count - i : B;
    products(s->factor + i * stride, stride, size, s->product, padded(i + size), s->change + i);
  }
  for (long i = 0; i < count; i += B) {
    size = count - i < B ? count - i : B;
    combine(s->factor + i * stride + i, stride, count - i, s->change + i, size, s->coefficients + i);
  }
  return dot(s->change, s->change, count);
}

/* Project a row on the active ones, with `coefficients`; return the square of the remainder. */
static double project_row(working_set *s, const double *a) {
  products(s->a, s->stride, s->count, a, s->stride, s->product);
  return dot(a, a, s->dim) - solve_gram(s);
}

static void activate(working_set *s, const double *a, double b, double sign, double multiplier, long row,
                     double square) {
  long k = s->count++;
  double *last = s->factor + k * s->stride, scale = 1 / sqrt(square);
  memcpy(s->a + k * s->stride, a, s->stride * sizeof(double));
  EACH(i, 0, s->stride) last[i] = i < k ? -scale * s->coefficients[i] : i == k ? scale : 0;
  s->b[k] = b, s->sign[k] = sign, s->multiplier[k] = multiplier, s->row[k] = (int)row;
}

static void deactivate(working_set *s, long k) {
  long stride = s->stride, rest = --s->count - k;
  memmove(s->a + k * stride, s->a + (k + 1) * stride, rest * stride * sizeof(double));
  double *const numbers[] = {s->b, s->sign, s->multiplier};
  EACH(i, 0, 3) memmove(numbers[i] + k, numbers[i] + k + 1, rest * sizeof(double));
  memmove(s->row + k, s->row + k + 1, rest * sizeof(int));
  EACH(i, k, s->count) { /* Givens rotations of adjacent rows leave a nonzero in the removed column of the last only */
    double *last = s->factor + i * stride, *next = last + stride, f = last[k], g = next[k], size = sqrt(f * f + g * g);
    double c = g / size, d = f / size;
    for (long j = 0; j < i + 2; j += W) {
      v x = at(last + j), y = at(next + j);
      put(last + j, c * x - d * y);
      put(next + j, d * x + c * y);
    }
    memmove(last + k, last + k + 1, (i + 1 - k) * sizeof(double));
    last[i + 1] = 0;
  }
}

/* Activate the rows of an initial working set. */
static void warm_start(const polyhedron *p, working_set *set, const int *first, long count) {
  double a[p->stride];
  EACH(i, 0, count) {
    long row = (first[i] > 0 ? first[i] : -first[i]) - 1;
    double sign = first[i] > 0 ? 1 : -1, b = first[i] > 0 ? p->high[row] : -p->low[row];
    if (!isfinite(b) || set->count == p->dim) continue;
    copy(p, row, a);
    EACH(j, 0, p->dim) a[j] *= sign;
    double square = project_row(set, a);
    if (square > MIN_INDEPENDENCE * dot(a, a, p->dim)) activate(set, a, b, sign, 0, row, square);
  }
}

/* Compute x and the multipliers of the active rows; remove rows with negative multipliers. This corrects the rounding
errors of many updates. */
static void solve_active(const polyhedron *p, working_set *set, const double *f, double *x) {
  double g[p->stride];
  EACH(i, 0, p->stride) g[i] = i < p->dim ? f[i] : 0;
  for (long before = -1; before != set->count;) {
    before = set->count;
    products(set->a, set->stride, before, g, set->stride, set->product);
    EACH(i, 0, before) set->product[i] = -set->b[i] - set->product[i];
    solve_gram(set);
    memcpy(set->multiplier, set->coefficients, before * sizeof(double));
    for (long i = before - 1; i >= 0; i--) if (set->multiplier[i] < 0) deactivate(set, i);
  }
  combine(set->a, set->stride, set->count, set->multiplier, set->dim, set->change);
  EACH(i, 0, p->dim) x[i] = -f[i] - set->change[i];
}

I double row_violation(const polyhedron *p, long row, double value) {
  double over = value - p->high[row], under = p->low[row] - value;
  return (over > under ? over : under) * p->norm[row];
}

/* Find the rows that x violates most, by more than `feasible` times their lengths. */
static void find_violated(const polyhedron *p, working_set *set, const double *x, double feasible) {
  double largest = 0, threshold = feasible, amounts[B], r[B];
  set->n_candidates = 0;
  for (long first = 0; first < p->count; first += B) {
    const double *block = entry(p, first, 0);
    v sums[VECTORS];
    clear(sums, VECTORS);
    EACH(i, p->leading_zeros[first / B], p->dim) EACH(l, 0, VECTORS) sums[l] += x[i] * at(block + i * B + l * W);
    EACH(l, 0, VECTORS) put(r + l * W, sums[l]);
    EACH(i, first, first + B < p->count ? first + B : p->count) {
      double amount = row_violation(p, i, r[i - first]);
      if (!(amount > threshold)) continue;
      long k = 0;
      if (set->n_candidates < B) amounts[k = set->n_candidates++] = 0;
      else EACH(l, 1, B) if (amounts[l] < amounts[k]) k = l;
      if (amounts[k] > amount) continue;
      amounts[k] = amount, set->number[k] = i;
      if (!(amount > largest)) continue;
      largest = amount;
      threshold = largest * SERIOUS_FRACTION > feasible ? largest * SERIOUS_FRACTION : feasible;
    }
  }
  EACH(k, 0, set->n_candidates) copy(p, set->number[k], set->candidates + k * p->stride);
}

/* Return the one of these rows that x violates most now, or -1. */
static long most_violated(const polyhedron *p, const working_set *set, const double *x, double feasible,
                          double *value) {
  long row_index = -1;
  double r[2 * B];
  products(set->candidates, p->stride, set->n_candidates, x, p->stride, r);
  EACH(k, 0, set->n_candidates) {
    double amount = row_violation(p, set->number[k], r[k]);
    if (amount > feasible) feasible = amount, row_index = k, *value = r[k];
  }
  return row_index;
}

/* Activate one violated row and deactivate blocking rows; return 0 if that is impossible. */
static int add_violated(const polyhedron *p, working_set *set, double *x, long candidate, double value, int *changes) {
  long dim = p->dim, row = set->number[candidate];
  double a[p->stride], sign = value > p->high[row] ? 1 : -1, b = sign > 0 ? p->high[row] : -p->low[row];
  double violated = sign * value - b, multiplier = 0;
  EACH(j, 0, p->stride) a[j] = sign * set->candidates[candidate * p->stride + j];
  double size = dot(a, a, dim);
  for (; *changes > 0; --*changes) {
    double square = project_row(set, a), blocking_step = INFINITY;
    double full_step = square > MIN_INDEPENDENCE * size ? violated / square : INFINITY;
    long first = -1;
    EACH(i, 0, set->count) if (set->coefficients[i] > 0 && set->multiplier[i] < blocking_step * set->coefficients[i])
      blocking_step = set->multiplier[i] / set->coefficients[i], first = i;
    double t = full_step < blocking_step ? full_step : blocking_step;
    if (!(t < INFINITY)) return 0;
    multiplier += t;
    add(set->multiplier, -t, set->coefficients, set->count);
    if (full_step < INFINITY) { /* otherwise the row depends on active ones and x is unchanged */
      combine(set->a, set->stride, set->count, set->coefficients, dim, set->change);
      add(x, -t, a, dim);
      add(x, t, set->change, dim);
      violated -= t * square;
    }
    if (t == full_step) {
      activate(set, a, b, sign, multiplier, row, square);
      return 1;
    }
    deactivate(set, first);
  }
  return 0;
}

/* Compute the inverse lengths of the rows. */
static void compute_norms(const polyhedron *p) {
  for (long first = 0; first < p->count; first += B) {
    v squares[VECTORS];
    clear(squares, VECTORS);
    EACH(i, p->leading_zeros[first / B], p->dim) EACH(l, 0, VECTORS) {
      v x = at(entry(p, first, i) + l * W);
      squares[l] += x * x;
    }
    EACH(l, 0, VECTORS) put(p->norm + first + l * W, K(1) / vsqrt(squares[l]));
  }
}

/* Compute x, (stride,); return 0 without a solution within so many changes of the working set. No row is violated by
more than `feasible` times its length. Rows of the initial working set are numbered from 1, negative at lower bounds. */
static int solve_qp(const polyhedron *p, const double *f, const int *first, long n_first, double feasible, int changes,
                    double *x, working_set *set) {
  long dim = p->dim, stride = p->stride, length = stride + B;
  double *next = p->scratch, value;
  set->dim = dim, set->stride = stride, set->count = 0, set->row = p->active;
  set->a = next, set->factor = set->a + dim * stride, set->candidates = set->factor + dim * stride;
  set->b = set->candidates + B * stride, set->sign = set->b + length, set->multiplier = set->sign + length;
  set->product = set->multiplier + length, set->coefficients = set->product + length;
  set->change = set->coefficients + length;
  compute_norms(p);
  warm_start(p, set, first, n_first);
  EACH(i, dim, stride) x[i] = 0;
  for (int round = 0; round < MAX_ROUNDS; round++) {
    solve_active(p, set, f, x);
    find_violated(p, set, x, feasible);
    if (!set->n_candidates) return 1;
    for (int moved = 1; set->n_candidates && moved; find_violated(p, set, x, feasible)) {
      moved = 0; /* rounding errors may prevent progress */
      for (long k; (k = most_violated(p, set, x, feasible, &value)) >= 0; moved = 1)
        if (!add_violated(p, set, x, k, value, &changes)) return 0;
    }
  }
  return 1;
}
