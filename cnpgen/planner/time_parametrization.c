/* Fit rates to limits, as in time_parametrization.py; arrays.h precedes this file. All bounded values are
g = constant + square r^2 + mixed r r', with coefficients of every row at every phase, and, with the viscous friction
of drives, + linear r. */

typedef struct {
  long joints, pose_width, path_points, points; /* numbers; control points of p and of r */
  long linear;                                  /* whether rows have linear coefficients */
  long phases, rows, first, last, moves;        /* phases in full blocks of LANES; movable control points */
  const double *path, *rate;                    /* bases of p and r, (orders, control points, phases) */
  const double *lower, *upper;                  /* (rows,) */
  const long *path_span, *span;                 /* phases where a point is active, (control points, 2) */
  const long *order;                            /* control points of r in the order of their moves */
  const double *step_fractions;                 /* fractions of the steps up, (moves,) */
  kernel *coefficients, *violation;             /* of the column made by lay_out */
  double max_increase, max_decrease, margin;    /* of a control point, relative; the last decrease of all */
  double min_increase, tolerance;               /* of a control point, for a second sweep; of the violation */
} parametrization;

/* Buffers of one motion; K is the number of phases. */
typedef struct {
  double *column, *r, *r1;      /* p, p', p'', r, r', obstacle poses, (width, K); r and r' are views of it */
  double *coefficients;         /* constant, square, mixed, maybe linear, (3 or 4, rows, K) */
  double *b, *b1;               /* direction of r and r', (K,) */
  double *violations, *before;  /* (K,); control points of r, (points,) */
  double *critical;             /* (rows, LANES) */
} workspace;

/* The smallest x > 0 with q x^2 + l x = margin; infinite if there is none. */
I v smallest(v margin, v l, v q) {
  v below = l + vsqrt(l * l + 4 * q * margin);
  return pick(below > K(0), 2 * margin / below, K(INFINITY));
}

I double smallest_of(double x, v y) {
  EACH(l, 0, W) x = x < y[l] ? x : y[l];
  return x;
}

/* r^2, r r' and r at W phases as quadratics of the step of r along b. */
typedef struct { v square[3], mixed[3], rate[2]; } direction;

I direction direction_at(const workspace *m, long k) {
  v r = at(m->r + k), r1 = at(m->r1 + k), b = at(m->b + k), b1 = at(m->b1 + k);
  return (direction){{r * r, 2 * r * b, b * b}, {r * r1, r * b1 + r1 * b, b * b1}, {r, b}};
}

/* A row at W phases as a quadratic of the step: g + l x + q x^2. */
typedef struct { v g, l, q; } quadratic;

I quadratic along(direction d, const double *a, long size, int has_linear) {
  v constant = at(a), square = at(a + size), mixed = at(a + 2 * size);
  quadratic f = {
    constant + square * d.square[0] + mixed * d.mixed[0],
    square * d.square[1] + mixed * d.mixed[1],
    square * d.square[2] + mixed * d.mixed[2]};
  if (has_linear) {
    v linear = at(a + 3 * size);
    f.g += linear * d.rate[0], f.l += linear * d.rate[1];
  }
  return f;
}

/* Upper bound of the change of a row at a step of at most `up`. */
/* The change of a row within a step of at most `up`: most rows are far from their bounds, and no root is needed. */
I v largest_change(quadratic f, double up) { return up * (vabs(f.l) + up * vabs(f.q)); }

/* Largest allowed and smallest required step per lane, and mask of the violated lanes. */
typedef struct { v up, back; vi violated; } limits;

I limits with_bound(limits found, v margin, v l, v q) {
  vi violated = margin < K(0);
  v step = smallest(vabs(margin), l, pick(violated, -q, q));
  found.up = lesser(pick(violated, K(INFINITY), step), found.up);
  found.back = larger(pick(violated & (step < K(INFINITY)), step, K(0)), found.back);
  found.violated |= violated & ((l != K(0)) | (q != K(0)));
  return found;
}

/* Which of the bounds of a row may be exceeded at LANES phases within steps of `up`: 1 above, 2 below. */
I int may_exceed(const direction *d, const double *a, long size, int has_linear, double low, double high, double up) {
  int bounds = 0;
  EACH(part, 0, PARTS) {
    quadratic f = along(d[part], a + part * W, size, has_linear);
    v change = largest_change(f, up);
    if (any_lane(f.g - high + change > K(0))) bounds |= 1;
    if (any_lane(low - f.g + change > K(0))) bounds |= 2;
  }
  return bounds;
}

/* Largest step of r along b within the bounds, or the required step back: `advance` of time_parametrization.py. The
compiler makes one function for each value of has_linear. */
I double advance_rows(const parametrization *p, const workspace *m, long from, long to, int has_linear) {
  const double *restrict lower = p->lower, *restrict upper = p->upper, *restrict coefficients = m->coefficients;
  double *restrict critical = m->critical, up = p->max_increase, back = 0;
  long rows = p->rows, phases = p->phases, size = rows * phases, steps = (to - from) / LANES;
  limits found[PARTS];
  EACH(part, 0, PARTS) found[part] = (limits){K(up), K(0), K(0) != K(0)};
  EACH(i, 0, steps) { /* from the centre outwards: outer phases rarely limit the step further */
    long k = from + (steps / 2 + (i % 2 ? -(i + 1) / 2 : i / 2)) * LANES;
    direction d[PARTS];
    v worst = K(-1);
    EACH(part, 0, PARTS) {
      d[part] = direction_at(m, k + part * W);
      EACH(row, 0, rows) {
        quadratic f = along(d[part], coefficients + row * phases + k + part * W, size, has_linear);
        v violation = larger(f.g - upper[row], lower[row] - f.g) + largest_change(f, up);
        put(critical + row * LANES + part * W, violation);
        worst = larger(violation, worst);
      }
    }
    if (!any_lane(worst > K(0))) continue;
    EACH(row, 0, rows) { /* few are critical: roots and divisions take most of the time */
      const double *a = coefficients + row * phases + k;
      int is_critical = 0;
      EACH(part, 0, PARTS) is_critical |= any_lane(at(critical + row * LANES + part * W) > K(0));
      if (!is_critical) continue;
      int bounds = may_exceed(d, a, size, has_linear, lower[row], upper[row], up);
      EACH(part, 0, PARTS) {
        quadratic f = along(d[part], a + part * W, size, has_linear);
        if (bounds & 1) found[part] = with_bound(found[part], upper[row] - f.g, f.l, f.q);
        if (bounds & 2) found[part] = with_bound(found[part], f.g - lower[row], -f.l, -f.q);
        up = smallest_of(up, found[part].up);
      }
    }
  }
  int violated = 0;
  EACH(part, 0, PARTS) violated |= any_lane(found[part].violated), back = smallest_of(back, -found[part].back);
  if (!violated) return up;
  return back > p->max_decrease ? back : p->max_decrease;
}

static double advance(const parametrization *p, const workspace *m, long from, long to) {
  return p->linear ? advance_rows(p, m, from, to, 1) : advance_rows(p, m, from, to, 0);
}

/* out = c[first] basis[first] + ...; `stride` is the distance between control points. */
static void combine(const double *basis, const long *span, long phases, const double *c, long stride, long first, long last,
                    double *out) {
  EACH(k, 0, phases) out[k] = 0;
  EACH(j, first, last) {
    long from = span[2 * j], to = span[2 * j + 1];
    add(out + from, c[j * stride], basis + j * phases + from, to - from);
  }
}

static void combine_rates(const parametrization *p, const double *c, long first, long last, double *r, double *r1) {
  combine(p->rate, p->span, p->phases, c, 1, first, last, r);
  combine(p->rate + p->points * p->phases, p->span, p->phases, c, 1, first, last, r1);
}

static void lay_out(const parametrization *p, const double *path, const double *obstacle_poses, const workspace *m) {
  EACH(order, 0, 3) EACH(i, 0, p->joints) {
    const double *basis = p->path + order * p->path_points * p->phases;
    double *out = m->column + (order * p->joints + i) * p->phases;
    combine(basis, p->path_span, p->phases, path + i, p->joints, 0, p->path_points, out);
  }
  EACH(i, 0, p->pose_width) EACH(k, 0, p->phases) m->r1[(1 + i) * p->phases + k] = obstacle_poses[i];
}

static void run(kernel *function, const parametrization *p, const workspace *m, double *const *out) {
  function(p->phases, (const double *const[]){m->column}, &p->phases, out);
}

/* Largest violation at the phases; NaN if a value is NaN. */
static double max_violation(const parametrization *p, const workspace *m, const double *c) {
  combine_rates(p, c, 0, p->points, m->r, m->r1);
  run(p->violation, p, m, (double *const[]){m->violations});
  double worst = m->violations[0];
  /* A nan is kept: it fails every comparison of the caller. */
  EACH(k, 1, p->phases) if (!(m->violations[k] <= worst) && worst == worst) worst = m->violations[k];
  return worst;
}

/* Move the control points of r in their order; return the largest relative change of one. */
static double sweep(const parametrization *p, double *c, const workspace *m) {
  double *r = m->r, *r1 = m->r1, *b = m->b, *b1 = m->b1, max_change = 0;
  EACH(move, 0, p->moves) {
    long j = p->order[move];
    const double *basis = p->rate + j * p->phases, *derivative = basis + p->points * p->phases;
    long from = p->span[2 * j], to = p->span[2 * j + 1];
    for (long k = from; k < to; k += W) put(b + k, c[j] * at(basis + k)), put(b1 + k, c[j] * at(derivative + k));
    double x = advance(p, m, from, to);
    if (x > 0) x *= p->step_fractions[move];
    /* r and r' are updated in place: only the phases where the control point acts. */
    add(r + from, x, b + from, to - from), add(r1 + from, x, b1 + from, to - from);
    c[j] += x * c[j];
    if (x > max_change) max_change = x;
  }
  return max_change;
}

/* Fit the rate of a motion; return whether its control points moved twice. */
static int parametrize_motion(const parametrization *p, double *c, const workspace *m) {
  double *a = m->coefficients;
  long size = p->rows * p->phases;
  run(p->coefficients, p, m, (double *const[]){a, a + size, a + 2 * size, a + 3 * size});
  combine_rates(p, c, 0, p->points, m->r, m->r1);
  int twice = sweep(p, c, m) > p->min_increase;
  if (twice) sweep(p, c, m);
  combine_rates(p, c, p->first, p->last, m->b, m->b1);
  double factor = (1 + advance(p, m, 0, p->phases)) * (1 - p->margin);
  EACH(j, p->first, p->last) c[j] *= factor;
  return twice;
}

/* Fit the rates of motions, (count, points), in place, and return their largest violations, (count,). */
void parametrize_rates(const parametrization *p, long count, const double *path, const double *obstacle_poses,
                       double *rate, double *violation, double *memory) {
  long phases = p->phases, numbers = 3 * p->joints;
  /* Aligned to vectors. */
  memory += -((size_t)memory / sizeof(double)) % LANES;
  workspace m = {.column = memory, .r = memory + numbers * phases};
  m.r1 = m.r + phases, m.coefficients = m.r1 + (1 + p->pose_width) * phases;
  m.b = m.coefficients + (3 + p->linear) * p->rows * phases, m.b1 = m.b + phases, m.violations = m.b1 + phases;
  m.critical = m.violations + phases, m.before = m.critical + p->rows * LANES;
  EACH(motion, 0, count) {
    double *c = rate + motion * p->points;
    memcpy(m.before, c, p->points * sizeof(double));
    lay_out(p, path + motion * p->path_points * p->joints, obstacle_poses + motion * p->pose_width, &m);
    int twice = parametrize_motion(p, c, &m);
    double worst = max_violation(p, &m, c);
    if (!(worst <= p->tolerance)) {
      double before = max_violation(p, &m, m.before);
      /* The fit is taken only if it does not increase the violation. */
      if (!(worst <= before)) memcpy(c, m.before, p->points * sizeof(double)), worst = before;
    }
    violation[motion] = twice ? INFINITY : worst; /* which has larger excesses between the phases */
  }
}
