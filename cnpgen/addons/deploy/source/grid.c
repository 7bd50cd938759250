/* The motion at the phases of a grid: columns of PHASES values. */

/* out += factor basis; basis functions are 0 outside of their phases `from` to `to`, which are whole groups. */
static void add(double factor, const double *restrict basis, int from, int to, double *restrict out) {
  for (int k = from; k < to; k += LANES)
    for (int l = 0; l < LANES; l++) out[k + l] += factor * basis[k + l];
}

/* out = points[0] basis[0] + points[1] basis[1] + ..., of r or one of its derivatives. */
static void combine_rates(const double *basis, const double *points, double *out) {
  for (int k = 0; k < PHASES; k++) out[k] = 0;
  for (int j = 0; j < RATE_POINTS; j++) add(points[j], basis + j * PHASES, rate_range[2 * j], rate_range[2 * j + 1], out);
}

/* r, r', ... of control points in the column. */
static void lay_out_rates(const double *rate, NAME_memory *memory) {
  for (int order = 0; order < ORDERS - 1; order++)
    combine_rates(rate_basis + order * RATE_POINTS * PHASES, rate, memory->column + (ORDERS * JOINTS + order) * PHASES);
}

/* p, p', ..., r, r', ..., and the scene, which is the same at all phases. */
static void lay_out(const NAME_motion *motion, NAME_memory *memory) {
  for (int order = 0; order < ORDERS; order++)
    for (int i = 0; i < JOINTS; i++) {
      double *out = memory->column + (order * JOINTS + i) * PHASES;
      const double *basis = path_basis + order * PATH_POINTS * PHASES;
      for (int k = 0; k < PHASES; k++) out[k] = 0;
      for (int j = 0; j < PATH_POINTS; j++)
        add(motion->path[j][i], basis + j * PHASES, path_range[2 * j], path_range[2 * j + 1], out);
    }
  lay_out_rates(motion->rate, memory);
  for (int i = 0; i < SCENE; i++)
    for (int k = 0; k < PHASES; k++) memory->column[(ORDERS * JOINTS + ORDERS - 1 + i) * PHASES + k] = motion->scene[i];
}

/* The largest of the values, infinite if one of them is nan. */
static double largest(const double *values, int count) {
  double most = values[0];
  int valid = 1;
  for (int k = 0; k < count; k++) {
    valid &= values[k] == values[k];
    most = values[k] > most ? values[k] : most;
  }
  return valid ? most : INFINITY;
}
