/* Kernels that append the distances of a robot's convex parts, one row per link and obstacle or pair of links, to the rows of
another kernel; collision.c precedes this file. They have the interface of compiled kernels (arrays.h). Their context is set
before, for each thread. */

#define FAR_RESIDUAL 100.0 /* of columns out of the measured range: solvers select only residuals near their bounds */

typedef struct {
  kernel *values, *jacobian; /* of the other rows: w, poses -> g, d(g)/d(w) column by column */
  const robot_scene *scene;
  double *scratch; /* 11 numbers and 2 indices for each contact, then values and gradients of one state, then rows */
  const double *required; /* distances of the columns [m] */
  const long *obstacle_column, *pair_column; /* pair of bodies -> column */
  long rows, columns, width; /* other rows, rows of distances, numbers in w */
  long capacity, generation; /* contacts of a state; unique number of the context */
  double range, scale;       /* measured distance above the required one [m]; distance of a residual of 1 [m] */
  double obstacle_distance, self_distance; /* -INFINITY without such a constraint */
} row_context;

static _Thread_local row_context *current;
static _Thread_local long generation;
static _Thread_local memory *kept; /* of `current` */
static _Thread_local int lacked_memory; /* the last derivatives are nan */

/* Set the context of this thread; return OUT_OF_MEMORY if there is none for it, or was none for the last derivatives. */
long set_row_context(row_context *context) {
  if (lacked_memory) return lacked_memory = 0, OUT_OF_MEMORY;
  /* The same address may hold a new context, so the unique number is compared as well. */
  if (context == current && (!context || context->generation == generation)) return 0;
  free_memory(kept);
  kept = context ? make_memory(context->scene) : 0;
  current = kept ? context : 0;
  generation = kept ? context->generation : 0;
  return context && !kept ? OUT_OF_MEMORY : 0;
}

/* Rate of the distance along a normal if joint j moves a point. */
static double rate(const robot_scene *s, const memory *m, long j, const double *point, const double *normal) {
  double axis[3], arm[3], speed[3];
  const pose *f = m->frame + j + 1;
  /* d/dq_j of a point that moves with joint j: z_j x (x - o_j), or z_j if it is prismatic. */
  turn(f->R, s->axis + 3 * j, axis);
  if (s->sliding[j]) return dot(axis, normal);
  less(point, f->p, arm);
  cross(axis, arm, speed);
  return dot(speed, normal);
}

/* Distances of all columns at one state, divided by the scale, and unless null the gradients (columns, n) of those within the
range. */
static void measure_columns(const row_context *c, const double *q, double *values, double *gradients) {
  const robot_scene *s = c->scene;
  long n = s->n;
  int finite = 1;
  for (long j = 0; j < n; j++) finite &= isfinite(q[j]);
  /* Rows beyond the range are constant: a solver selects no row whose gradient it does not know. */
  for (long i = 0; i < c->columns; i++) values[i] = finite ? FAR_RESIDUAL : NAN;
  if (!finite) return;
  double *distance = c->scratch, *normal = distance + c->capacity, *points = normal + 3 * c->capacity;
  long *pair = (long *)(points + 6 * c->capacity), *k = pair + c->capacity;
  place_robot(s, q, kept);
  for (int group = 0; group < 2; group++) {
    double required = group ? c->self_distance : c->obstacle_distance;
    if (!(required > -INFINITY)) continue;
    contact_list list = {0, c->capacity, 0, pair, k, distance, normal, points};
    if (group) meet_itself(s, kept, required + c->range, &list);
    else meet_obstacles(s, kept, required + c->range, &list);
    for (long i = 0; i < list.count && i < c->capacity; i++) {
      long column = group ? c->pair_column[pair[i]] : c->obstacle_column[pair[i]], first = 0, second;
      double value = distance[i] / c->scale;
      /* A row is the smallest distance of its pairs; its gradient is that of the pair which attains it (Danskin). */
      if (!(value < values[column]) || value * c->scale >= c->required[column] + c->range) continue;
      values[column] = value;
      if (!gradients) continue;
      if (group) first = s->parts[s->pairs[2 * pair[i]]].frame, second = s->parts[s->pairs[2 * pair[i] + 1]].frame;
      else second = s->moving_frames[pair[i] / s->n_obstacles];
      for (long j = 0; j < n; j++) {
        /* Joints up to `second` move the second body, those up to `first` the first one as well. */
        double rise = j < second ? rate(s, kept, j, points + 6 * i + 3, normal + 3 * i) : 0.0;
        if (j < first) rise -= rate(s, kept, j, points + 6 * i, normal + 3 * i);
        gradients[column * n + j] = rise / c->scale;
      }
    }
  }
}

static void append_columns(long points, const double *const *in, const long *strides, double *g, double *jacobian) {
  const row_context *c = current;
  long n = c->scene->n, rows = c->rows + c->columns;
  double *values = c->scratch + 12 * c->capacity, *gradients = jacobian ? values + c->columns : 0, q[64];
  for (long j = 0; jacobian && j < c->width; j++)
    memset(jacobian + (j * rows + c->rows) * points, 0, c->columns * points * sizeof(double));
  for (long k = 0; k < points; k++) {
    for (long j = 0; j < n; j++) q[j] = in[0][j * strides[0] + k];
    measure_columns(c, q, values, gradients);
    for (long i = 0; i < c->columns; i++) {
      g[(c->rows + i) * points + k] = values[i];
      if (!jacobian || !(values[i] < FAR_RESIDUAL)) continue;
      for (long j = 0; j < n; j++) jacobian[(j * rows + c->rows + i) * points + k] = gradients[i * n + j];
    }
  }
}

void row_values(long points, const double *const *in, const long *strides, double *const *out) {
  current->values(points, in, strides, out);
  append_columns(points, in, strides, out[0], 0);
}

void row_jacobian(long points, const double *const *in, const long *strides, double *const *out) {
  const row_context *c = current;
  long rows = c->rows + c->columns;
  double *inner = malloc((c->rows * c->width * points + 1) * sizeof(double));
  if (!inner) {
    lacked_memory = 1;
    for (long i = 0; i < rows * points; i++) out[0][i] = NAN;
    for (long i = 0; i < rows * c->width * points; i++) out[1][i] = NAN;
    return;
  }
  /* The inner Jacobian has fewer rows, so its columns are copied to the stride of the complete one. */
  c->jacobian(points, in, strides, (double *const[]){out[0], inner});
  for (long j = 0; j < c->width; j++)
    memcpy(out[1] + j * rows * points, inner + j * c->rows * points, c->rows * points * sizeof(double));
  free(inner);
  append_columns(points, in, strides, out[0], out[1]);
}
