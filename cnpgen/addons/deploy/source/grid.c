/* The motion at the phases of a grid: columns of PHASES values, in groups of LANES phases. */

/* out = points[0] basis[0] + points[stride] basis[1] + ..., of the basis functions that are not 0 in a group. A sum of
one group stays in registers. */
static void combine(const double *restrict basis, const int *restrict support, const double *restrict points, int stride,
                    double *restrict out) {
  for (int k = 0; k < PHASES; k += LANES, support += 2) {
    double sum[LANES] = {0};
    for (int j = support[0]; j < support[1]; j++)
      for (int l = 0; l < LANES; l++) sum[l] += points[j * stride] * basis[j * PHASES + k + l];
    for (int l = 0; l < LANES; l++) out[k + l] = sum[l];
  }
}

/* r or one of its derivatives. */
static void combine_rates(const double *basis, const double *points, double *out) {
  combine(basis, rate_support, points, 1, out);
}

/* r, r', ... of control points in the column. */
static void lay_out_rates(const double *rate, NAME_memory *memory) {
  for (int order = 0; order < ORDERS - 1; order++)
    combine_rates(rate_basis + order * RATE_POINTS * PHASES, rate, memory->column + (ORDERS * JOINTS + order) * PHASES);
}

/* p, p', ..., and the scene, which is the same at all phases: the part of the column that rates do not change. */
static void lay_out_path(const NAME_motion *motion, NAME_memory *memory) {
  for (int order = 0; order < ORDERS; order++)
    for (int i = 0; i < JOINTS; i++)
      combine(path_basis + order * PATH_POINTS * PHASES, path_support, motion->path[0] + i, JOINTS,
              memory->column + (order * JOINTS + i) * PHASES);
  for (int i = 0; i < SCENE; i++)
    for (int k = 0; k < PHASES; k++) memory->column[(ORDERS * JOINTS + ORDERS - 1 + i) * PHASES + k] = motion->scene[i];
}

/* The largest of whole groups of values, infinite if one of them is nan. */
static double largest(const double *values, int count) {
  double most[LANES], is_nan[LANES] = {0};
  for (int l = 0; l < LANES; l++) most[l] = -INFINITY;
  for (int k = 0; k < count; k += LANES)
    for (int l = 0; l < LANES; l++) {
      double value = values[k + l];
      most[l] = value > most[l] ? value : most[l];
      is_nan[l] = value != value ? 1.0 : is_nan[l];
    }
  double result = most[0], invalid = is_nan[0];
  for (int l = 1; l < LANES; l++) {
    result = most[l] > result ? most[l] : result;
    invalid += is_nan[l];
  }
  return invalid > 0 ? INFINITY : result;
}
