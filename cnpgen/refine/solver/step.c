/* One step of the sequential quadratic programming of one motion: the compiled form of transcription.py and
qp_subproblem.py, over the same compiled kernels.

Arrays are of doubles; the last index is contiguous. K grid points, m residuals, C path and R rate control points, n
joints, nx variables; w = (p, p', ..., r, r', ...) of `width` components. Requires active_set.c. */

#define TILE 8 /* grid points whose Jacobians are computed at once: they fit in the L1 cache */

typedef struct { /* a spline basis at some phases: three or four orders of the path */
  long orders, points;
  const double *path, *rate;         /* (orders, C, points), (orders - 1, R, points) */
  const double *path_at, *rate_at;   /* (points, C, orders), (points, orders - 1, R) */
  const long *path_from, *rate_from; /* first of the `support` control points of a phase, (points,) */
} bases;

typedef struct {
  long n, path, rate, support, fixed, nx, stride, m; /* stride: of rows of nx + 1 */
  long n_time_nodes, n_cost_residuals, n_cost_groups, thinning;
  bases grid, cost_bases;
  kernel *values, *jacobian, *cost_residuals;
  const double *start_q, *start_dq, *start_ddq, *goal_q, *goal_dq, *goal_ddq; /* (n,); goal_ddq may be NULL */
  const double *obstacle_poses;             /* (width, K) */
  const double *time_basis, *time_weights;  /* basis of r at the nodes of the time integral (nodes, R), their weights */
  const double *cost_weights;               /* (cost_bases.points,) */
  const double *cost_groups;                /* (n_cost_groups, 3): number of residuals, smoothing and weight of a term */
  const double *smoothing;                  /* (R, R) */
  const double *lower, *upper;              /* (m, K) */
  const unsigned char *nonsmooth;           /* (m, K) */
  const unsigned char *accelerated;         /* (m,) */
  double *control, *rates, *derivative, *w; /* (C, n), (R,), (6, padded n) with zeros, (width, K) */
  double *gradient, *hessian, *factor;      /* (nx,); above and below the diagonal, (nx, stride) each */
  double *scratch;
  int *index, *initial; /* row nx + 1 + j is of residual i at point k: index[j] = i K + k; memory for as many */
  polyhedron program;   /* of the box, (nx,), the elastic variable, and the selected residuals */
  double eta, beta, rate_eta, violation, gain, remaining;
  long point[6], variable[6], n_derivatives, n_selected;
} motion;

/* ---- The motion of variables x: control points, states, objective (Transcription) ---- */

/* Control points at an end, from its state, and their derivatives (trajectory/boundary.py). */
static void end(motion *s, const double *q, const double *dq, const double *ddq, double sign, long last, long step) {
  long inner = last + step, edge = step > 0 ? 0 : s->path - 1;
  double r = s->rates[last], eta = s->eta;
  double rise = ddq ? s->rate_eta * (s->rates[inner] - r) : 0;
  double *c = s->control + edge * s->n, *c1 = c + step * s->n, *c2 = c1 + step * s->n;
  long wide = padded(s->n);
  double *d = s->derivative + s->n_derivatives * wide;
  EACH(j, 0, s->n) {
    double v0 = sign * dq[j], first = v0 / r, d1 = -v0 / (r * r * eta);
    c[j] = q[j];
    c1[j] = q[j] + first / eta;
    d[j] = d1;
    if (ddq) {
      c2[j] = (ddq[j] - first * rise * r) / (r * r) / s->beta - 2 * q[j] + 3 * c1[j];
      d[wide + j] = (-2 * (ddq[j] - v0 * rise) / r + v0 * s->rate_eta) / (r * r) / s->beta + 3 * d1;
      d[2 * wide + j] = -v0 * s->rate_eta / (r * r * s->beta);
    }
  }
  EACH(i, 0, ddq ? 3 : 1) {
    s->point[s->n_derivatives] = edge + (i ? 2 : 1) * step;
    s->variable[s->n_derivatives++] = i == 2 ? inner : last;
  }
}

static void unpack(motion *s, const double *x) {
  long split = s->nx - s->rate;
  EACH(i, 0, s->rate) s->rates[i] = vexp(K(x[split + i]))[0];
  memcpy(s->control + 3 * s->n, x, split * sizeof(double));
  s->n_derivatives = 0;
  memset(s->derivative, 0, 6 * padded(s->n) * sizeof(double));
  end(s, s->start_q, s->start_dq, s->start_ddq, 1, 0, 1);
  end(s, s->goal_q, s->goal_dq, s->goal_ddq, -1, s->rate - 1, -1);
}

static void states(const motion *s, const bases *b, double *w) {
  long n = s->n, points = b->points;
  memset(w, 0, (b->orders * n + b->orders - 1) * points * sizeof(double));
  EACH(o, 0, b->orders) EACH(c, 0, s->path) EACH(j, 0, n)
    add(w + (o * n + j) * points, s->control[c * n + j], b->path + (o * s->path + c) * points, points);
  EACH(o, 0, b->orders - 1) EACH(c, 0, s->rate)
    add(w + (b->orders * n + o) * points, s->rates[c], b->rate + (o * s->rate + c) * points, points);
}

/* Gather the gradient in w of residual i at phase k from a Jacobian: joints (orders, padded n), then rates. */
static void gather(const motion *s, long orders, const double *jacobian, long count, long i, long points, long k,
                   double *J) {
  long n = s->n, stride = padded(n);
  EACH(o, 0, orders) EACH(j, 0, n) J[o * stride + j] = jacobian[((o * n + j) * count + i) * points + k];
  EACH(o, 0, orders - 1) J[orders * stride + o] = jacobian[((orders * n + o) * count + i) * points + k];
}

I const double *rate_at(const motion *s, const bases *b, long k, long order) {
  return b->rate_at + (k * (b->orders - 1) + order) * s->rate;
}

/* Gradient in the variables of a function with gradient J in w at phase k. J is padded with zeros, so that numbers
written after a control point are 0; `row` has memory for LANES more. */
static void chain(const motion *s, const bases *b, long k, const double *J, double *restrict row) {
  long n = s->n, orders = b->orders, split = s->nx - s->rate, stride = padded(n);
  long first = b->path_from[k], behind = first + s->support, from = b->rate_from[k];
  double ends[6 * stride];
  memset(row, 0, s->nx * sizeof(double));
  EACH(c, first, behind) {
    const double *path = b->path_at + (k * s->path + c) * orders;
    double *control = c < 3 ? ends + c * stride : c < s->fixed ? row + (c - 3) * n : ends + (c - s->fixed + 3) * stride;
    for (long j = 0; j < n; j += W) {
      v x = path[0] * at(J + j) + path[1] * at(J + stride + j) + path[2] * at(J + 2 * stride + j);
      put(control + j, orders > 3 ? x + path[3] * at(J + 3 * stride + j) : x);
    }
  }
  EACH(o, 0, orders - 1) add(row + split + from, J[orders * stride + o], rate_at(s, b, k, o) + from, s->support);
  EACH(i, from, from + s->support) row[split + i] *= s->rates[i];
  EACH(e, 0, s->n_derivatives) {
    long c = s->point[e] < 3 ? s->point[e] : s->point[e] - s->fixed + 3;
    if (s->point[e] < first || s->point[e] >= behind) continue;
    const double *control = ends + c * stride, *derivative = s->derivative + e * stride;
    v x[PARTS];
    clear(x, PARTS);
    for (long j = 0; j < n; j += LANES) EACH(part, 0, PARTS)
      x[part] += at(control + j + part * W) * at(derivative + j + part * W);
    row[split + s->variable[e]] += sum(x) * s->rates[s->variable[e]];
  }
}

/* Add the Gram matrix of the first `size` numbers of rows to the upper triangle of a matrix. */
static void gram(const double *rows, long stride, long count, long size, double *matrix, long wide) {
  for (long j = 0; j < size; j += 4) for (long l = j / W * W; l < size; l += 2 * W) {
    v x[4] = {K(0), K(0), K(0), K(0)}, y[4] = {K(0), K(0), K(0), K(0)};
    EACH(i, 0, count) {
      const double *row = rows + i * stride;
      EACH(e, 0, 4) x[e] += row[j + e] * at(row + l), y[e] += row[j + e] * at(row + l + W);
    }
    EACH(e, 0, size - j < 4 ? size - j : 4) {
      double sums[2 * W];
      put(sums, x[e]), put(sums + W, y[e]);
      add(matrix + (j + e) * wide + l, 1, sums, size - l < 2 * W ? size - l : 2 * W);
    }
  }
}

/* Integral of the cost term; adds its gradient and Gauss-Newton Hessian if `derivatives`. */
static double cost_term(motion *s, int derivatives) {
  const bases *b = &s->cost_bases;
  long n = s->n, width = b->orders * n + b->orders - 1, count = s->n_cost_residuals, points = b->points;
  long nx = s->nx, stride = s->stride;
  double *w = s->scratch, *e = w + width * points, *jacobian = e + count * points;
  double *weighted = jacobian + width * count * points, *rows = weighted + count * points, *gradient = rows;
  double J[width + b->orders * LANES], cost = 0;
  memset(J, 0, sizeof J);
  states(s, b, w);
  s->cost_residuals(points, (const double *const[]){w}, &points, (double *const[]){e, jacobian});
  EACH(k, 0, points) {
    double r = w[b->orders * n * points + k], total = 0;
    long first = 0;
    EACH(g, 0, s->n_cost_groups) {
      const double *group = s->cost_groups + 3 * g;
      long behind = first + (long)group[0];
      double smoothing = group[1], weight = group[2] * s->cost_weights[k] / r, squares = 0;
      EACH(i, first, behind) squares += e[i * points + k] * e[i * points + k];
      double size = sqrt(squares + smoothing * smoothing);
      double root = sqrt(weight * (smoothing > 0 ? 1 / size : 2));
      total += weight * (smoothing > 0 ? size - smoothing : squares);
      if (derivatives) EACH(i, first, behind) {
        gather(s, b->orders, jacobian, count, i, points, k, J);
        for (long j = 0; j < b->orders * padded(n) + b->orders - 1; j++) J[j] *= root;
        chain(s, b, k, J, gradient);
        weighted[k * count + i] = root * e[i * points + k];
        gradient += stride;
      }
      first = behind;
    }
    cost += total;
    if (derivatives) EACH(i, 0, s->rate)
      s->gradient[nx - s->rate + i] -= total / r * rate_at(s, b, k, 0)[i] * s->rates[i];
  }
  if (!derivatives) return cost;
  gram(rows, stride, count * points, nx, s->hessian, stride);
  combine(rows, stride, count * points, weighted, nx, gradient);
  add(s->gradient, 1, gradient, nx);
  return cost;
}

/* Duration and regularization; sets their gradient and curvature if `derivatives`. */
static double duration(motion *s, const double *log, int derivatives) {
  long nx = s->nx, split = nx - s->rate, stride = s->stride, wide = padded(s->rate);
  double cost = 0, *weighted = s->scratch, *rows = weighted + s->n_time_nodes;
  double *gradient = rows + s->n_time_nodes * wide;
  EACH(i, 0, s->rate) {
    double derivative = dot(s->smoothing + i * s->rate, log, s->rate);
    cost += 0.5 * log[i] * derivative;
    if (!derivatives) continue;
    s->gradient[split + i] = derivative;
    memcpy(s->hessian + (split + i) * stride + split, s->smoothing + i * s->rate, s->rate * sizeof(double));
  }
  EACH(q, 0, s->n_time_nodes) {
    const double *basis = s->time_basis + q * s->rate;
    double inverse = 1 / dot(basis, s->rates, s->rate), weight = s->time_weights[q] * inverse;
    cost += weight;
    if (!derivatives) continue;
    double root = inverse * sqrt(2 * weight);
    EACH(i, 0, s->rate) rows[q * wide + i] = root * basis[i] * s->rates[i];
    weighted[q] = -weight * inverse / root;
  }
  if (!derivatives) return cost;
  gram(rows, wide, s->n_time_nodes, s->rate, s->hessian + split * stride + split, stride);
  combine(rows, wide, s->n_time_nodes, weighted, s->rate, gradient);
  add(s->gradient + split, 1, gradient, s->rate);
  return cost;
}

/* Violation by residual number i of those at all points. */
I double residual_violation(const motion *s, const double *g, long i) {
  double over = g[i] - s->upper[i], under = s->lower[i] - g[i];
  return over > under ? over : under;
}

static double max_violation(const motion *s, const double *g) {
  double worst = 0;
  EACH(i, 0, s->m * s->grid.points) {
    double violation = residual_violation(s, g, i);
    if (violation != violation) return INFINITY;
    if (violation > worst) worst = violation;
  }
  return worst;
}

/* Residuals (m, K) and the objective of variables x; sets `violation` to the largest violation. */
double evaluate(motion *s, const double *x, double *g) {
  unpack(s, x);
  states(s, &s->grid, s->w);
  long points = s->grid.points, ld[2] = {points, points};
  s->values(points, (const double *const[]){s->w, s->obstacle_poses}, ld, (double *const[]){g});
  s->violation = max_violation(s, g);
  return duration(s, x + s->nx - s->rate, 0) + (s->cost_residuals ? cost_term(s, 0) : 0);
}

/* ---- Quadratic subproblem (qp_subproblem.py) ---- */

/* Factor the Hessian with the proximal term, with inverted diagonal. Rows divided by the factor are those of variables
with unit Hessian. */
static int factor(motion *s, double proximal) {
  long nx = s->nx, stride = s->stride;
  EACH(k, 0, nx) {
    long from = k / W * W;
    double *row = s->hessian + k * stride, *known = s->scratch;
    combine(s->hessian + from, stride, k, s->factor + k * stride, nx - from, s->scratch);
    double pivot = row[k] + proximal - known[k - from], scale = 1 / sqrt(pivot);
    if (!(pivot > 0)) return 0;
    EACH(i, k + 1, nx) s->factor[i * stride + k] = row[i] = scale * (row[i] - known[i - from]);
    s->factor[k * stride + k] = scale;
  }
  return 1;
}

/* Divide a block of B rows, (nx, B), by the factor; their first `from` entries are 0. */
static void whiten(const motion *s, double *block, long from) {
  for (long i = from; i < s->nx; i += 2) {
    const double *row = s->factor + i * s->stride, *other = row + (i + 1 < s->nx ? s->stride : 0);
    v x[VECTORS], y[VECTORS];
    EACH(l, 0, VECTORS) x[l] = at(block + i * B + l * W), y[l] = at(block + (i + 1) * B + l * W);
    EACH(j, from, i) EACH(l, 0, VECTORS) {
      v above = at(block + j * B + l * W);
      x[l] -= row[j] * above;
      y[l] -= other[j] * above;
    }
    EACH(l, 0, VECTORS) {
      put(block + i * B + l * W, x[l] *= row[i]);
      if (other != row) put(block + (i + 1) * B + l * W, (y[l] - other[i] * x[l]) * other[i + 1]);
    }
  }
}

static double largest(const double *a, long n) {
  double result = -INFINITY, lanes[W];
  v maxima = K(-INFINITY);
  long i = 0;
  for (; i + W <= n; i += W) maxima = vmax(maxima, at(a + i));
  put(lanes, maxima);
  for (; i < n; i++) result = a[i] > result ? a[i] : result;
  EACH(l, 0, W) result = lanes[l] > result ? lanes[l] : result;
  return result;
}

static int any(const unsigned char *a, const unsigned char *b, long n) {
  int result = 0;
  EACH(i, 0, n) result |= a[i] | b[i];
  return result;
}

/* Mark local maxima along the motion, their neighbors and the thinned grid, within `distance` of a bound. */
static void mark_maxima(const motion *s, const double *violations, double distance, unsigned char *mask) {
  long points = s->grid.points;
  unsigned char peak[points + 2];
  memset(mask, 0, points);
  if (!(largest(violations, points) > -distance)) return;
  memset(peak, 1, points + 2);
  EACH(k, 1, points) peak[k + 1] = violations[k] >= violations[k - 1];
  EACH(k, 0, points - 1) peak[k + 1] &= violations[k] >= violations[k + 1];
  peak[0] = peak[points + 1] = 0;
  EACH(k, 0, points) mask[k] = (peak[k] | peak[k + 1] | peak[k + 2]) & (violations[k] > -distance);
  for (long k = 0; k < points; k += s->thinning) mask[k] = violations[k] > -distance;
}

static double linearization_error(const motion *s, long k, const double *J, double step) {
  const bases *b = &s->grid;
  double error = 0;
  EACH(o, 1, b->orders - 1) {
    double change = 0;
    EACH(i, 0, s->rate) change += fabs(rate_at(s, b, k, o)[i]) * s->rates[i];
    error += fabs(J[b->orders * padded(s->n) + o]) * change * step;
  }
  return error;
}

/* Evaluate the motion at x, and gradient and factor of its objective; return 0 if the Hessian is not positive. */
static int objective(motion *s, const double *x, double proximal) {
  unpack(s, x);
  states(s, &s->grid, s->w);
  memset(s->gradient, 0, s->nx * sizeof(double));
  memset(s->hessian, 0, s->nx * s->stride * sizeof(double));
  duration(s, x + s->nx - s->rate, 1);
  if (s->cost_residuals) cost_term(s, 1);
  return factor(s, proximal);
}

/* Number of leading zeros of a row of the program. */
static long leading_zeros(const motion *s, long row) {
  if (row <= s->nx) return row;
  long zeros = (s->grid.path_from[s->index[row - s->nx - 1] % s->grid.points] - 3) * s->n;
  return zeros > 0 ? zeros : 0;
}

/* Build the subproblem at x with residuals g. Selected are the residuals within `distance` of a bound, or within
`speed_distance` if it is smaller and they do not depend on accelerations; those that may cross a bound if no log r
changes by more than `step`; those in `missed`, and those with multipliers. `selected` returns the mask. */
void build_subproblem(motion *s, const double *x, const double *g, double proximal, double distance,
                      double speed_distance, double step, const unsigned char *missed,
                      const double *multipliers, unsigned char *selected) {
  long nx = s->nx, points = s->grid.points, width = s->grid.orders * s->n + s->grid.orders - 1, m = s->m;
  polyhedron *p = &s->program;
  if (!(p->count = objective(s, x, proximal))) return;
  double *violations = s->scratch, *values = violations + m * points, *jacobian = values + m * TILE;
  double *row = jacobian + width * m * TILE, J[width + s->grid.orders * LANES];
  memset(J, 0, sizeof J);
  EACH(i, 0, m * points) violations[i] = residual_violation(s, g, i);
  EACH(i, 0, m) {
    double limit = s->accelerated[i] || distance < speed_distance ? distance : speed_distance;
    mark_maxima(s, violations + i * points, limit, selected + i * points);
  }
  EACH(i, 0, m * points) selected[i] |= missed[i];
  if (multipliers) EACH(i, 0, m * points) selected[i] |= multipliers[i] != 0;

  long count = nx + 1;
  memset(p->rows, 0, (count + B) / B * count * B * sizeof(double));
  EACH(i, 0, nx) *entry(p, i, i) = 1;
  for (long first = 0; first < points; first += TILE) {
    long tile = points - first < TILE ? points - first : TILE, ld[2] = {points, points};
    const double *const inputs[] = {s->w + first, s->obstacle_poses + first};
    s->jacobian(tile, inputs, ld, (double *const[]){values, jacobian});
    EACH(i, 0, m) if (any(selected + i * points + first, s->nonsmooth + i * points + first, tile)) EACH(t, 0, tile) {
      long k = first + t, number = i * points + k;
      if (!selected[number] && !s->nonsmooth[number]) continue;
      gather(s, s->grid.orders, jacobian, m, i, tile, t, J);
      if (!selected[number] && !(violations[number] > -linearization_error(s, k, J, step))) continue;
      selected[number] = 1;
      s->index[count - nx - 1] = number;
      chain(s, &s->grid, k, J, row);
      if (count % B == 0) memset(entry(p, count, 0), 0, (nx + 1) * B * sizeof(double));
      EACH(j, 0, nx) *entry(p, count, j) = row[j];
      count++;
    }
  }
  s->n_selected = count - nx - 1, p->count = count;
  for (long block = 0; block * B < count; block++) {
    p->leading_zeros[block] = nx;
    EACH(row, block * B, (block + 1) * B < count ? (block + 1) * B : count) {
      long zeros = leading_zeros(s, row);
      if (zeros < p->leading_zeros[block]) p->leading_zeros[block] = zeros;
    }
    whiten(s, entry(p, block * B, 0), p->leading_zeros[block]);
  }
}

/* Bounds of the rows and their coefficients of the elastic variable. */
static void bound(motion *s, const double *g, const double *box, double curvature_root, int relax) {
  long dim = s->nx + 1;
  const polyhedron *p = &s->program;
  EACH(i, 0, s->nx) p->high[i] = box[i], p->low[i] = -box[i];
  *entry(p, s->nx, s->nx) = 1 / curvature_root, p->low[s->nx] = 0, p->high[s->nx] = 1;
  EACH(i, 0, s->n_selected) {
    long at = s->index[i];
    double rise = s->upper[at] - g[at], fall = s->lower[at] - g[at], above = rise < 0, below = fall > 0, elastic;
    if (relax) above = rise < -fall, below = !above, elastic = above ? -s->violation : s->violation;
    else elastic = above ? rise : below ? fall : 0;
    p->high[dim + i] = below ? INFINITY : rise;
    p->low[dim + i] = above ? -INFINITY : fall;
    *entry(p, dim + i, s->nx) = elastic / curvature_root;
  }
}

/* Solve the program of `build_subproblem`; return 0 without a solution within so many working-set changes.

The step is within the box, (nx,), and costs `penalty` times the fraction of the violations that remains; all rows may
use that fraction if `relax`. `before` are multipliers, (m, K); rows with larger ones than `threshold` are initially
active. `multipliers` are those of the solution. */
int solve_subproblem(motion *s, const double *g, const double *box, double penalty, double curvature_root, int relax,
                     const double *before, double threshold, double feasible, int changes, double *dx,
                     double *multipliers) {
  long nx = s->nx, dim = nx + 1, stride = s->stride, count = 0;
  double linear[dim], x[stride];
  if (!s->program.count) return 0;
  bound(s, g, box, curvature_root, relax);
  EACH(i, 0, nx) linear[i] = (s->gradient[i] - dot(s->factor + i * stride, linear, i)) * s->factor[i * stride + i];
  linear[nx] = penalty / curvature_root;
  if (before) EACH(i, 0, s->n_selected) {
    double was = before[s->index[i]];
    if (fabs(was) > threshold) s->initial[count++] = (int)(was > 0 ? dim + i + 1 : -(dim + i + 1));
  }
  working_set set;
  if (!solve_qp(&s->program, linear, s->initial, count, feasible, changes, x, &set)) return 0;
  EACH(i, 0, set.count) if (set.row[i] >= dim)
    multipliers[s->index[set.row[i] - dim]] = set.sign[i] * set.multiplier[i];
  s->gain = -dot(linear, x, nx) - 0.5 * dot(x, x, nx);
  s->remaining = x[nx] / curvature_root;
  memcpy(dx, x, nx * sizeof(double));
  for (long i = nx - 1; i >= 0; i--) {
    dx[i] *= s->factor[i * stride + i];
    add(dx, -dx[i], s->factor + i * stride, i);
  }
  return 1;
}
