/* Joint-space paths among obstacles by RRT-Connect (Kuffner and LaValle 2000); collision.c precedes this file.

Edges are checked as a whole, in bisection order, so that collisions show early. The required distances grow by a margin away
from all ends, where the clearance may be smaller. Conditions of a robot at rest other than distances of hulls, such as those of
capsules, are bounds of a kernel that evaluates BLOCK states at once. Of several goals every one is a root of the second tree.
Paths are shortened by straight lines between random points if that reduces their estimated duration. */

enum { BLOCK = 16 }; /* states that a kernel evaluates at once */

typedef struct {
  const robot_scene *scene;
  const double *start, *goal, *lower, *upper, *velocity; /* ends, ranges of random configurations, velocity limits */
  double obstacle_distance, self_distance, margin, ramp; /* the margin is complete at a distance `ramp` from the ends */
  double spacing, extension;                             /* of states; largest of a tree */
  long max_extensions, max_nodes, shortcuts;             /* nodes of both trees */
  double corner_time;                                    /* that a corner costs [s] */
  unsigned long long seed;
  long goals; /* rows of `goal` */
  /* Kernel (w, scene) -> g of BLOCK states at rest, w begins with q; the bounds of g, and memory for it. Null for no kernel. */
  kernel *at_rest;
  double *rest_w;
  const double *rest_scene, *rest_lower, *rest_upper;
  double *rest_g;
  long rest_rows;
} tree_settings;

typedef struct {
  long count, capacity, n;
  double *q;
  long *parent;
  int lacks_memory; /* a node could not be added */
} tree;

typedef struct {
  const tree_settings *s;
  memory *m;
  unsigned long long random;
  double *q, *block; /* one state, and BLOCK states as columns, (n, BLOCK) */
} search;

static search make_search(const tree_settings *s) {
  double *states = malloc((1 + BLOCK) * s->scene->n * sizeof(double));
  unsigned long long random = s->seed * 0x9E3779B97F4A7C15ull + 88172645463325252ull;
  return (search){s, make_memory(s->scene), random, states, states ? states + s->scene->n : NULL};
}

static double uniform(search *h) {
  /* xorshift64 (Marsaglia 2003); 53 bits make a number in [0, 1). */
  h->random ^= h->random << 13, h->random ^= h->random >> 7, h->random ^= h->random << 17;
  return (h->random >> 11) * (1.0 / 9007199254740992.0);
}

static double largest_difference(const double *a, const double *b, long n) {
  double largest = 0.0;
  for (long j = 0; j < n; j++) largest = fmax(largest, fabs(a[j] - b[j]));
  return largest;
}

static double squared_difference(const double *a, const double *b, long n) {
  double sum = 0.0;
  for (long j = 0; j < n; j++) sum += (a[j] - b[j]) * (a[j] - b[j]);
  return sum;
}

static int state_is_clear(search *h, const double *q) {
  const tree_settings *s = h->s;
  long n = s->scene->n;
  /* At an end the clearance may be as small as the problem permits; the margin rises linearly with the distance from it. */
  double away = largest_difference(q, s->start, n);
  for (long g = 0; g < s->goals; g++) away = fmin(away, largest_difference(q, s->goal + n * g, n));
  double margin = s->ramp > 0 ? s->margin * fmin(1.0, away / s->ramp) : s->margin;
  return is_clear(s->scene, h->m, q, s->obstacle_distance + margin, s->self_distance + margin);
}

/* Return the number of leading ones of `count` states, q (n, BLOCK), that meet the conditions of a robot at rest. */
static long count_at_rest(const tree_settings *s, const double *q, long count) {
  const long strides[2] = {BLOCK, BLOCK};
  long leading = count;
  if (!s->at_rest || !count) return count;
  memcpy(s->rest_w, q, s->scene->n * BLOCK * sizeof(double));
  s->at_rest(count, (const double *const[]){s->rest_w, s->rest_scene}, strides, (double *const[]){s->rest_g});
  for (long i = 0; i < s->rest_rows; i++)
    for (long k = 0; k < leading; k++) {
      double g = s->rest_g[i * count + k];
      /* A comparison with nan is false, so that a state with one is invalid; the loop ends with k = leading. */
      if (!(g >= s->rest_lower[i] && g <= s->rest_upper[i])) leading = k;
    }
  return leading;
}

static void put_state(search *h, long k, const double *q) {
  for (long j = 0; j < h->s->scene->n; j++) h->block[j * BLOCK + k] = q[j];
}

/* Whether the first `count` states of the block are valid. */
static int block_is_valid(search *h, long count) {
  if (count_at_rest(h->s, h->block, count) < count) return 0;
  for (long k = 0; k < count; k++) {
    for (long j = 0; j < h->s->scene->n; j++) h->q[j] = h->block[j * BLOCK + k];
    if (!state_is_clear(h, h->q)) return 0;
  }
  return 1;
}

/* Whether a straight line is valid, except for its first state and, if it is an end of the path, its last one. */
static int line_is_valid(search *h, const double *a, const double *b, int check_last) {
  long n = h->s->scene->n, count = (long)ceil(largest_difference(a, b, n) / h->s->spacing), step = 1, filled = 0;
  if (check_last) put_state(h, filled++, b);
  /* Van der Corput order: the middle first, then the quarters. An edge in collision is often in collision there. */
  while (2 * step < count) step *= 2;
  for (long stride = step; stride >= 1; stride /= 2)
    for (long k = stride; k < count; k += 2 * stride) {
      for (long j = 0; j < n; j++) h->block[j * BLOCK + filled] = a[j] + (b[j] - a[j]) * k / count;
      if (++filled < BLOCK) continue;
      if (!block_is_valid(h, filled)) return 0;
      filled = 0;
    }
  return block_is_valid(h, filled);
}

static tree make_tree(long n) {
  tree t = {0, 256, n, malloc(256 * n * sizeof(double)), malloc(256 * sizeof(long)), 0};
  t.lacks_memory = !t.q || !t.parent;
  return t;
}

static void free_tree(tree *t) { free(t->q), free(t->parent); }

/* Add a node; return its index, or -1 if there is no memory left. */
static long add_node(tree *t, const double *q, long parent) {
  if (t->lacks_memory) return -1;
  if (t->count == t->capacity) {
    double *states = realloc(t->q, 2 * t->capacity * t->n * sizeof(double));
    if (states) t->q = states;
    long *parents = realloc(t->parent, 2 * t->capacity * sizeof(long));
    if (parents) t->parent = parents;
    if (!states || !parents) return t->lacks_memory = 1, -1;
    t->capacity *= 2;
  }
  memcpy(t->q + t->n * t->count, q, t->n * sizeof(double));
  t->parent[t->count] = parent;
  return t->count++;
}

static long nearest_node(const tree *t, const double *q) {
  long nearest = 0;
  double least = INFINITY;
  for (long i = 0; i < t->count; i++) {
    double distance = squared_difference(t->q + t->n * i, q, t->n);
    if (distance < least) least = distance, nearest = i;
  }
  return nearest;
}

/* Extend a node towards a configuration; return the new node or -1. `reached`: whether it is the configuration. */
static long extend(search *h, tree *t, long node, const double *target, double *fresh, int *reached) {
  const double *from = t->q + t->n * node;
  double distance = sqrt(squared_difference(from, target, t->n));
  /* A longer edge is cut, so that a collision far away does not reject the part before it. */
  *reached = distance <= h->s->extension;
  for (long j = 0; j < t->n; j++)
    fresh[j] = *reached ? target[j] : from[j] + (target[j] - from[j]) * (h->s->extension / distance);
  return line_is_valid(h, from, fresh, 1) ? add_node(t, fresh, node) : -1;
}

/* Add the start and the goals as roots of two trees. */
static void add_roots(tree *trees, const tree_settings *s) {
  add_node(trees, s->start, -1);
  for (long g = 0; g < s->goals; g++) add_node(trees + 1, s->goal + s->scene->n * g, -1);
}

/* Write the path from the root of tree 0 over its node a and node b of tree 1 to the root of b; return its length. */
static long join(const tree *trees, long a, long b, double *path, long max_points) {
  long n = trees->n, count = 0, points = 0;
  for (long i = a; i >= 0; i = trees[0].parent[i]) count++;
  for (long i = b; i >= 0; i = trees[1].parent[i]) points++;
  if (count + points > max_points) return 0;
  /* From the root to a, so it is written backwards; b repeats the last state of a's branch and is left out. */
  long at_index = count;
  for (long i = a; i >= 0; i = trees[0].parent[i]) memcpy(path + n * --at_index, trees[0].q + n * i, n * sizeof(double));
  for (long i = trees[1].parent[b]; i >= 0; i = trees[1].parent[i]) memcpy(path + n * count++, trees[1].q + n * i, n * sizeof(double));
  return count;
}

static double line_time(const tree_settings *s, const double *a, const double *b) {
  double most = 0.0;
  for (long j = 0; j < s->scene->n; j++) most = fmax(most, fabs(a[j] - b[j]) / s->velocity[j]);
  return most;
}

/* Replace sections of a path by straight lines between random points on it; return its number of points, or OUT_OF_MEMORY. */
static long shorten(search *h, double *path, long count, double *copy, long max_points) {
  const tree_settings *s = h->s;
  long n = s->scene->n;
  double *ends = malloc(2 * n * sizeof(double));
  if (!ends) return OUT_OF_MEMORY;
  for (long trial = 0; trial < s->shortcuts && count > 2 && count + 2 <= max_points; trial++) {
    double whole = 0.0, along[2], section;
    /* Random points are uniform in estimated time, not in length: slow sections are shortened more often. */
    for (long i = 0; i + 1 < count; i++) whole += line_time(s, path + n * i, path + n * (i + 1));
    along[0] = whole * uniform(h), along[1] = whole * uniform(h);
    if (along[0] > along[1]) { double x = along[0]; along[0] = along[1], along[1] = x; }
    long index[2];
    for (int e = 0; e < 2; e++) {
      long i = 0;
      double passed = 0.0, length;
      while ((length = line_time(s, path + n * i, path + n * (i + 1))), passed + length < along[e] && i + 2 < count) passed += length, i++;
      double f = length > 0 ? fmin(1.0, (along[e] - passed) / length) : 0.0;
      for (long j = 0; j < n; j++) ends[e * n + j] = path[n * i + j] + f * (path[n * (i + 1) + j] - path[n * i + j]);
      index[e] = i;
    }
    /* Both points on one line: nothing to shorten. */
    if (index[0] == index[1]) continue;
    section = along[1] - along[0] + (index[1] - index[0]) * s->corner_time;
    /* A shortcut costs its line and the two corners that it makes. */
    double straight = line_time(s, ends, ends + n) + 2 * s->corner_time;
    if (straight >= section || !line_is_valid(h, ends, ends + n, 1)) continue;
    put_state(h, 0, ends);
    if (!block_is_valid(h, 1)) continue;
    long kept = index[0] + 1;
    memcpy(copy, path, kept * n * sizeof(double));
    memcpy(copy + n * kept, ends, 2 * n * sizeof(double)), kept += 2;
    memcpy(copy + n * kept, path + n * (index[1] + 1), (count - index[1] - 1) * n * sizeof(double));
    count = kept + count - index[1] - 1;
    memcpy(path, copy, count * n * sizeof(double));
  }
  /* A corner costs time even on a straight line. After a removal the corner before may have become redundant, so go back
     one. */
  for (long i = 1; i + 1 < count;) { /* remove points that are not needed */
    double around = line_time(s, path + n * (i - 1), path + n * i) + line_time(s, path + n * i, path + n * (i + 1));
    double straight = line_time(s, path + n * (i - 1), path + n * (i + 1));
    if (straight < around + s->corner_time && line_is_valid(h, path + n * (i - 1), path + n * (i + 1), 0)) {
      memmove(path + n * i, path + n * (i + 1), (count - i - 1) * n * sizeof(double));
      count--;
      i = i > 1 ? i - 1 : 1;
    } else i++;
  }
  free(ends);
  return count;
}

/* Return the index of the fastest valid straight line from the start to a goal, or -1. */
static long fastest_line(search *h) {
  const tree_settings *s = h->s;
  long n = s->scene->n, fastest = -1;
  double least = INFINITY;
  for (long g = 0; g < s->goals; g++) {
    double duration = line_time(s, s->start, s->goal + n * g);
    if (duration < least && line_is_valid(h, s->start, s->goal + n * g, 0)) least = duration, fastest = g;
  }
  return fastest;
}

/* Search for a path from start to any goal; return its number of points, at most max_points, 0 if there is none, or
OUT_OF_MEMORY. */
long find_path(const tree_settings *s, double *path, long max_points) {
  long n = s->scene->n, count = 0;
  search h = make_search(s);
  double *target = malloc(n * sizeof(double)), *fresh = malloc(n * sizeof(double));
  tree trees[2] = {make_tree(n), make_tree(n)};
  add_roots(trees, s);
  int lacks_memory = !h.m || !h.q || !target || !fresh || trees[0].lacks_memory || trees[1].lacks_memory;
  for (int i = 0; i < 10; i++) uniform(&h);
  /* Most pairs of states need no tree. */
  long line = lacks_memory ? -1 : fastest_line(&h);
  if (lacks_memory) count = OUT_OF_MEMORY;
  else if (line >= 0) {
    memcpy(path, s->start, n * sizeof(double)), memcpy(path + n, s->goal + n * line, n * sizeof(double));
    count = 2;
  }
  for (long trial = 0; trial < s->max_extensions && trees[0].count + trees[1].count < s->max_nodes && !count; trial++) {
    /* Balanced trees: extend the smaller one (Kuffner and LaValle 2000). */
    int own = trees[0].count > trees[1].count, reached;
    for (long j = 0; j < n; j++) target[j] = s->lower[j] + uniform(&h) * (s->upper[j] - s->lower[j]);
    tree *near = trees + own, *other = trees + !own;
    long node = extend(&h, near, nearest_node(near, target), target, fresh, &reached);
    if (near->lacks_memory) count = OUT_OF_MEMORY;
    if (node < 0) continue;
    memcpy(target, fresh, n * sizeof(double));
    long far = nearest_node(other, target);
    /* Connect: the other tree is extended towards the new node until it is reached or blocked. */
    do far = extend(&h, other, far, target, fresh, &reached);
    while (far >= 0 && !reached);
    if (far >= 0) count = own ? join(trees, far, node, path, max_points) : join(trees, node, far, path, max_points);
    if (near->lacks_memory || other->lacks_memory) count = OUT_OF_MEMORY;
  }
  if (count > 2) {
    double *copy = malloc(max_points * n * sizeof(double));
    count = copy ? shorten(&h, path, count, copy, max_points) : OUT_OF_MEMORY;
    free(copy);
  }
  free_tree(trees), free_tree(trees + 1);
  free(target), free(fresh), free(h.q), free_memory(h.m);
  return count;
}
