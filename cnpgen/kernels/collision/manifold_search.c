/* Joint-space paths among obstacles on a manifold of equalities by RRT-Connect, whose states are projected by Gauss-Newton steps
(CBiRRT, Berenson et al. 2009); tree_search.c precedes this file. All states of an edge are nodes, since the straight line between
two distant states leaves the manifold. */

enum { MAX_EQUALITIES = 64, MAX_PROJECTIONS = 5 }; /* rows; steps */
#define MAX_STRETCH 3.0      /* of the spacing, between projected states */
#define MAX_STEP 0.5         /* of a joint [rad or m] */
#define RELATIVE_DAMPING 1e-6

typedef struct {
  kernel *residuals; /* q, scene -> r, d(r)/d(q) column by column */
  const double *scene; /* values of the scene, each for BLOCK states */
  long rows;
  double accuracy; /* largest residual */
  double *q, *r, *jacobian; /* of BLOCK states */
} manifold;

/* Solve (J J' + damping) x = r with the rows of J (rows, n) by a Cholesky factorization. */
static void solve_square(const double *J, long rows, long n, double *x) {
  /* Gauss-Newton step of least norm: dq = -J' (J J' + lambda I)^-1 r, with lambda relative to the trace, so that it has
     the unit of J J'. */
  double A[MAX_EQUALITIES][MAX_EQUALITIES], trace = 0.0;
  for (long a = 0; a < rows; a++)
    for (long b = 0; b <= a; b++) {
      A[a][b] = 0.0;
      for (long j = 0; j < n; j++) A[a][b] += J[a * n + j] * J[b * n + j];
      if (a == b) trace += A[a][a];
    }
  for (long a = 0; a < rows; a++) {
    A[a][a] += RELATIVE_DAMPING * (1 + trace);
    for (long b = 0; b <= a; b++) {
      for (long k = 0; k < b; k++) A[a][b] -= A[a][k] * A[b][k];
      A[a][b] = a == b ? sqrt(A[a][a]) : A[a][b] / A[b][b];
    }
  }
  for (long a = 0; a < rows; a++) {
    for (long k = 0; k < a; k++) x[a] -= A[a][k] * x[k];
    x[a] /= A[a][a];
  }
  for (long a = rows - 1; a >= 0; a--) {
    for (long k = a + 1; k < rows; k++) x[a] -= A[k][a] * x[k];
    x[a] /= A[a][a];
  }
}

/* Project `count` states, m->q (n, BLOCK); return the number of leading ones on the manifold. Joints that reach a limit stay. */
static long project(const tree_settings *s, manifold *m, long count) {
  long n = s->scene->n, strides[2] = {BLOCK, BLOCK}, met = 0;
  for (long j = 0; j < n; j++)
    /* Into the box first, so that a joint at a limit is recognized by its value. */
    for (long k = 0; k < count; k++) m->q[j * BLOCK + k] = fmin(fmax(m->q[j * BLOCK + k], s->lower[j]), s->upper[j]);
  for (int step = 0; step <= MAX_PROJECTIONS; step++) {
    m->residuals(count, (const double *const[]){m->q, m->scene}, strides, (double *const[]){m->r, m->jacobian});
    met = count;
    /* Backwards, so that `met` ends as the first state that misses the equalities. */
    for (long k = count - 1; k >= 0; k--) {
      double J[MAX_EQUALITIES * 64], x[MAX_EQUALITIES], largest = 0.0;
      for (long a = 0; a < m->rows; a++) {
        x[a] = m->r[a * count + k];
        largest = fmax(largest, fabs(x[a]));
        /* fmax ignores a nan, so a state with one is marked as infinitely far. */
        if (!(fabs(x[a]) < INFINITY)) largest = INFINITY;
      }
      if (largest <= m->accuracy) continue;
      met = k;
      if (step == MAX_PROJECTIONS || largest == INFINITY) continue;
      /* Active set of the box: columns of joints at a limit are zero, and the other joints make up for them. */
      for (long j = 0; j < n; j++) {
        double value = m->q[j * BLOCK + k];
        int moves = value > s->lower[j] && value < s->upper[j];
        for (long a = 0; a < m->rows; a++) J[a * n + j] = moves ? m->jacobian[(j * m->rows + a) * count + k] : 0.0;
      }
      solve_square(J, m->rows, n, x);
      for (long j = 0; j < n; j++) {
        double change = 0.0, *value = m->q + j * BLOCK + k;
        for (long a = 0; a < m->rows; a++) change += J[a * n + j] * x[a];
        /* Far from the manifold the linear model is wrong: the step of a joint is limited. */
        *value = fmin(fmax(*value - fmin(fmax(change, -MAX_STEP), MAX_STEP), s->lower[j]), s->upper[j]);
      }
    }
    if (met == count) break;
  }
  return met;
}

/* Append the valid projected states of the line from a node towards a configuration to a tree; return the last one, or -1 if the
first state is invalid. `reached`: whether it is the configuration, which is not checked if the length is unlimited. */
static long follow(search *h, manifold *m, tree *t, long node, const double *target, double length, int *reached) {
  const tree_settings *s = h->s;
  long n = t->n, last = -1;
  int is_root = t->parent[node] < 0; /* an end may miss the equalities, so that its neighbor is farther */
  double from[64], before[64], distance = sqrt(squared_difference(t->q + n * node, target, n));
  double share = distance > length ? length / distance : 1.0;
  memcpy(from, t->q + n * node, n * sizeof(double)), memcpy(before, from, n * sizeof(double));
  /* The states of a block are projected together, one lane of the kernel for each. */
  long count = (long)ceil(share * largest_difference(from, target, n) / s->spacing);
  if (count < 1) count = 1;
  *reached = 0;
  for (long first = 1; first <= count; first += BLOCK) {
    long block = count - first + 1 < BLOCK ? count - first + 1 : BLOCK;
    for (long k = 0; k < block; k++)
      for (long j = 0; j < n; j++)
        m->q[j * BLOCK + k] = from[j] + (target[j] - from[j]) * (share * (first + k) / count);
    long met = project(s, m, block), resting = count_at_rest(s, m->q, met);
    for (long k = 0; k < block; k++) {
      for (long j = 0; j < n; j++) h->q[j] = m->q[j * BLOCK + k];
      int valid = length == INFINITY && first + k == count;
      /* Projections of neighbors may be far apart where the manifold bends away; then the straight line between them was
         not checked. */
      int jumps = largest_difference(h->q, before, n) > MAX_STRETCH * s->spacing;
      if (k >= met || (jumps && !(is_root && last < 0))) return last;
      if (!valid && (k >= resting || !state_is_clear(h, h->q))) return last;
      memcpy(before, h->q, n * sizeof(double));
      if ((last = add_node(t, h->q, last < 0 ? node : last)) < 0) return -1;
    }
  }
  *reached = share == 1.0;
  return last;
}

/* Replace sections of a path by shorter projected lines; return its number of points, or OUT_OF_MEMORY. */
static long shorten_on_manifold(search *h, manifold *m, double *path, long count) {
  long n = h->s->scene->n;
  tree line = make_tree(n);
  for (long trial = 0; trial < h->s->shortcuts && count > 2 && !line.lacks_memory; trial++) {
    long a = (long)(uniform(h) * count), b = (long)(uniform(h) * count);
    if (a > b) { long x = a; a = b, b = x; }
    /* Shorter only if the line needs fewer states than the section has. */
    double limit = (b - a - 1) * h->s->spacing;
    if (b - a < 2 || largest_difference(path + n * a, path + n * b, n) > limit) continue;
    int reached;
    line.count = 0;
    add_node(&line, path + n * a, -1);
    follow(h, m, &line, 0, path + n * b, INFINITY, &reached);
    /* The target was not reached, or the projected line is longer than the straight one. */
    if (!reached || line.count - 1 >= b - a) continue;
    memcpy(path + n * (a + 1), line.q + n, (line.count - 1) * n * sizeof(double));
    memmove(path + n * (a + line.count), path + n * (b + 1), (count - b - 1) * n * sizeof(double));
    count -= b - a - (line.count - 1);
  }
  if (line.lacks_memory) count = OUT_OF_MEMORY;
  free_tree(&line);
  return count;
}

/* Search for a path of projected states from start to any goal; see `find_path`. `scene` are the values for BLOCK states. */
long find_manifold_path(const tree_settings *s, kernel *residuals, const double *scene, long rows, double accuracy,
                        double *path, long max_points) {
  long n = s->scene->n, count = 0;
  if (rows > MAX_EQUALITIES) return 0;
  search h = make_search(s);
  double *numbers = malloc(BLOCK * (n + rows + rows * n) * sizeof(double)), *target = malloc(n * sizeof(double));
  manifold m = {residuals, scene, rows, accuracy, numbers, numbers + BLOCK * n, numbers + BLOCK * (n + rows)};
  tree trees[2] = {make_tree(n), make_tree(n)};
  int reached = 0, lacks_memory = !h.m || !h.q || !numbers || !target;
  add_roots(trees, s);
  lacks_memory |= trees[0].lacks_memory || trees[1].lacks_memory;
  /* Similar seeds give similar first numbers of xorshift; they are discarded. */
  for (int i = 0; i < 10; i++) uniform(&h);
  long end = -1, last = 0;
  for (long g = 0; g < s->goals && !lacks_memory && !reached; g++)
    last = g, end = follow(&h, &m, trees, 0, s->goal + n * g, INFINITY, &reached);
  if (lacks_memory || trees[0].lacks_memory) count = OUT_OF_MEMORY;
  else if (reached) count = join(trees, end, last, path, max_points);
  for (long trial = 0; trial < s->max_extensions && trees[0].count + trees[1].count < s->max_nodes && !count; trial++) {
    /* The trees take turns. */
    int own = trial % 2;
    for (long j = 0; j < n; j++) target[j] = s->lower[j] + uniform(&h) * (s->upper[j] - s->lower[j]);
    tree *near = trees + own, *other = trees + !own;
    long node = follow(&h, &m, near, nearest_node(near, target), target, s->extension, &reached);
    if (near->lacks_memory) count = OUT_OF_MEMORY;
    if (node < 0) continue;
    memcpy(target, near->q + n * node, n * sizeof(double));
    long far = follow(&h, &m, other, nearest_node(other, target), target, INFINITY, &reached);
    if (near->lacks_memory || other->lacks_memory) count = OUT_OF_MEMORY;
    if (count || !reached) continue;
    count = own ? join(trees, far, node, path, max_points) : join(trees, node, far, path, max_points);
  }
  if (count > 2) count = shorten_on_manifold(&h, &m, path, count);
  /* The last state is on the manifold up to the tolerance only; the path must end at the goal itself: the nearest one. */
  tree goals = {s->goals, s->goals, n, (double *)s->goal, NULL, 0};
  if (count > 0) memcpy(path + n * (count - 1), s->goal + n * nearest_node(&goals, path + n * (count - 1)), n * sizeof(double));
  free_tree(trees), free_tree(trees + 1);
  free(target), free(numbers), free(h.q), free_memory(h.m);
  return count;
}
