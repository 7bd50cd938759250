/* Rates that limits bound, as pacing.py says; vectors.h comes first. All values that are bounded are
g = rest + square r^2 + mixed r r', with coefficients of every row at every phase. */

#define EACH(i, from, to) for (long i = (from); i < (to); i++)

I v at(const double *p) { return *(const vu *)p; }
I void put(double *p, v x) { *(vu *)p = x; }

typedef void kernel(long n, const double *const *in, const long *distances, double *const *out);

typedef struct {
  long joints, tops, path_points, points;  /* numbers of them; control points of p and of r */
  long phases, rows, first, last, moves;   /* phases: of vectors that are full; control points that may move; moves */
  const double *path, *rate;               /* basis of p, p', p'', and of r, r', (orders, control points, phases) */
  const double *lower, *upper;             /* (rows,) */
  const long *path_span, *span;            /* phases that a control point counts at, (control points, 2) */
  const long *order;                       /* control points of r, one move after the other */
  const double *shares;                    /* that they go of their ways up */
  kernel *coefficients, *excess;           /* of the column that lay_out makes */
  double most, least, slack;               /* of a control point, up and back; excess that is none */
} pacing;

/* What a motion is paced with, in memory of its own; K is the number of phases. */
typedef struct {
  double *column, *r, *r1; /* p, p', p'', r, r', obstacles, (numbers, K); r and r' in it */
  double *coefficients;    /* rest, square, mixed, (3, rows, K) */
  double *b, *b1;          /* the direction that r and r' go in, (K,) */
  double *over, *before;   /* (K,); control points of r, (points,) */
  double *critical;        /* (rows, W) */
} room;

/* The smallest x > 0 with q x^2 + l x = room; infinite where there is none. */
I v smallest(v room, v l, v q) {
  v below = l + vsqrt(l * l + 4 * q * room);
  return pick(below > K(0), 2 * room / below, K(INFINITY));
}

I double largest(v x) {
  double each[W];
  put(each, x);
  for (int half = W / 2; half; half /= 2) EACH(i, 0, half) each[i] = each[i] > each[i + half] ? each[i] : each[i + half];
  return each[0];
}

/* r^2 and r r' at W phases as quadratics of how far r goes along b. */
typedef struct { v square[3], mixed[3]; } direction;

I direction direction_at(const room *m, long k) {
  v r = at(m->r + k), r1 = at(m->r1 + k), b = at(m->b + k), b1 = at(m->b1 + k);
  return (direction){{r * r, 2 * r * b, b * b}, {r * r1, r * b1 + r1 * b, b * b1}};
}

/* A row at W phases likewise: g + l x + q x^2. */
typedef struct { v g, l, q; } quadratic;

I quadratic along(direction d, const double *a, long size) {
  v rest = at(a), square = at(a + size), mixed = at(a + 2 * size);
  return (quadratic){
    rest + square * d.square[0] + mixed * d.mixed[0],
    square * d.square[1] + mixed * d.mixed[1],
    square * d.square[2] + mixed * d.mixed[2]};
}

/* How far values may go and have to go back, lane by lane, and which are out. */
typedef struct { v up, back; vi out; } limits;

I limits met(limits found, v room, v l, v q) {
  vi broken = room < K(0);
  v way = smallest(vabs(room), l, pick(broken, -q, q));
  found.up = lesser(pick(broken, K(INFINITY), way), found.up);
  found.back = larger(pick(broken & (way < K(INFINITY)), way, K(0)), found.back);
  found.out |= broken & ((l != K(0)) | (q != K(0)));
  return found;
}

/* How far r may go along b, or has to go back: what `advance` of pacing.py gives, for one motion. */
static double advance(const pacing *p, const room *m, long from, long to) {
  const double *restrict lower = p->lower, *restrict upper = p->upper, *restrict coefficients = m->coefficients;
  double *restrict critical = m->critical, up = p->most;
  long rows = p->rows, phases = p->phases, size = rows * phases, steps = (to - from) / W;
  limits found = {K(up), K(0), K(0) != K(0)};
  EACH(i, 0, steps) { /* from the middle outwards: what is far from it hardly ever matters then */
    long k = from + (steps / 2 + (i % 2 ? -(i + 1) / 2 : i / 2)) * W;
    direction d = direction_at(m, k);
    v worst = K(-1);
    EACH(row, 0, rows) { /* by how much a bound may be broken at `up` */
      quadratic f = along(d, coefficients + row * phases + k, size);
      v over = larger(f.g - upper[row], lower[row] - f.g) + up * (vabs(f.l) + up * vabs(f.q));
      put(critical + row * W, over);
      worst = larger(over, worst);
    }
    if (!(largest(worst) > 0)) continue;
    EACH(row, 0, rows) if (largest(at(critical + row * W)) > 0) {
      quadratic f = along(d, coefficients + row * phases + k, size);
      found = met(met(found, upper[row] - f.g, f.l, f.q), f.g - lower[row], -f.l, -f.q);
    }
    up = -largest(-found.up);
  }
  if (!(largest(flag(found.out)) > 0)) return up;
  double back = -largest(found.back);
  return back > p->least ? back : p->least;
}

static void add(double *out, double x, const double *b, long from, long to) {
  for (long k = from; k < to; k += W) put(out + k, at(out + k) + x * at(b + k));
}

/* out = c[first] basis[first] + ...; `apart` lies between control points. */
static void combine(const double *basis, const long *span, long phases, const double *c, long apart, long first, long last,
                    double *out) {
  EACH(k, 0, phases) out[k] = 0;
  EACH(j, first, last) add(out, c[j * apart], basis + j * phases, span[2 * j], span[2 * j + 1]);
}

static void combine_rates(const pacing *p, const double *c, long first, long last, double *r, double *r1) {
  combine(p->rate, p->span, p->phases, c, 1, first, last, r);
  combine(p->rate + p->points * p->phases, p->span, p->phases, c, 1, first, last, r1);
}

static void lay_out(const pacing *p, const double *path, const double *tops, const room *m) {
  EACH(order, 0, 3) EACH(i, 0, p->joints) {
    const double *basis = p->path + order * p->path_points * p->phases;
    double *out = m->column + (order * p->joints + i) * p->phases;
    combine(basis, p->path_span, p->phases, path + i, p->joints, 0, p->path_points, out);
  }
  EACH(i, 0, p->tops) EACH(k, 0, p->phases) m->r1[(1 + i) * p->phases + k] = tops[i];
}

static void run(kernel *each, const pacing *p, const room *m, double *const *out) {
  each(p->phases, (const double *const[]){m->column}, &p->phases, out);
}

/* By how much rates are out at worst; not a number if they are none. */
static double excess(const pacing *p, const room *m, const double *c) {
  combine_rates(p, c, 0, p->points, m->r, m->r1);
  run(p->excess, p, m, (double *const[]){m->over});
  double worst = m->over[0];
  EACH(k, 1, p->phases) if (!(m->over[k] <= worst) && worst == worst) worst = m->over[k];
  return worst;
}

static void pace_one(const pacing *p, double *c, const room *m) {
  double *r = m->r, *r1 = m->r1, *b = m->b, *b1 = m->b1, *a = m->coefficients;
  long size = p->rows * p->phases;
  run(p->coefficients, p, m, (double *const[]){a, a + size, a + 2 * size});
  combine_rates(p, c, 0, p->points, r, r1);
  EACH(move, 0, p->moves) {
    long j = p->order[move];
    const double *basis = p->rate + j * p->phases, *slope = basis + p->points * p->phases;
    long from = p->span[2 * j], to = p->span[2 * j + 1];
    for (long k = from; k < to; k += W) put(b + k, c[j] * at(basis + k)), put(b1 + k, c[j] * at(slope + k));
    double x = advance(p, m, from, to);
    if (x > 0) x *= p->shares[move];
    add(r, x, b, from, to), add(r1, x, b1, from, to);
    c[j] += x * c[j];
  }
  combine_rates(p, c, p->first, p->last, b, b1);
  double x = advance(p, m, 0, p->phases);
  EACH(j, p->first, p->last) c[j] += x * c[j];
}

/* Change the rates of motions, (count, points). */
void pace(const pacing *p, long count, const double *path, const double *tops, double *rate, double *memory) {
  long phases = p->phases, numbers = 3 * p->joints;
  memory += -((size_t)memory / sizeof(double)) % W;
  room m = {.column = memory, .r = memory + numbers * phases};
  m.r1 = m.r + phases, m.coefficients = m.r1 + (1 + p->tops) * phases;
  m.b = m.coefficients + 3 * p->rows * phases, m.b1 = m.b + phases, m.over = m.b1 + phases;
  m.critical = m.over + phases, m.before = m.critical + p->rows * W;
  EACH(motion, 0, count) {
    double *c = rate + motion * p->points;
    memcpy(m.before, c, p->points * sizeof(double));
    lay_out(p, path + motion * p->path_points * p->joints, tops + motion * p->tops, &m);
    pace_one(p, c, &m);
    double worst = excess(p, &m, c);
    if (!(worst <= p->slack) && !(worst <= excess(p, &m, m.before))) memcpy(c, m.before, p->points * sizeof(double));
  }
}
