/* Time scaling of motions from rest to rest: at r / k a bounded value is g = static + b / k + c / k^2, and static +
d / k^3 if it depends on the jerk, so the smallest k within the bounds follows in closed form. */

/* The smallest k >= 1 with linear / k + square / k^2 <= margin; 1 if there is no margin at rest. */
static double smallest_scale(double margin, double linear, double square) {
  double discriminant = linear * linear + 4 * square * margin;
  double k = (linear + sqrt(discriminant > 0 ? discriminant : 0)) / (2 * margin);
  return linear + square > margin && margin > 0 && isfinite(k) && k > 1 ? k : 1;
}

/* The smallest k >= 1 with change / k^3 <= margin; 1 if there is no margin at rest. */
static double smallest_cubic_scale(double margin, double change) {
  double k = cbrt(change / margin);
  return change > margin && margin > 0 && isfinite(k) && k > 1 ? k : 1;
}

/* Bounded values at a phase, with time scaled by 1 / slowness; at rest if it is 0. */
static void residuals_at(const NAME_memory *memory, int k, double slowness, double *values) {
  double in[ORDERS * JOINTS + SCENE + 1], r[ORDERS];
  for (int order = 0; order < ORDERS - 1; order++) r[order] = memory->column[(ORDERS * JOINTS + order) * PHASES + k];
  for (int i = 0; i < JOINTS; i++) {
    double p1 = memory->column[(JOINTS + i) * PHASES + k], p2 = memory->column[(2 * JOINTS + i) * PHASES + k], scale = slowness;
    in[i] = memory->column[i * PHASES + k];
    in[JOINTS + i] = p1 * r[0] * scale;
    scale *= slowness;
    in[2 * JOINTS + i] = (p2 * r[0] + p1 * r[1]) * r[0] * scale;
#if JERK
    double p3 = memory->column[(3 * JOINTS + i) * PHASES + k];
    scale *= slowness;
    in[3 * JOINTS + i] = ((p3 * r[0] + 3 * p2 * r[1]) * r[0] + p1 * (r[2] * r[0] + r[1] * r[1])) * r[0] * scale;
#endif
  }
  for (int i = 0; i < SCENE; i++) in[ORDERS * JOINTS + i] = memory->column[(ORDERS * JOINTS + ORDERS - 1 + i) * PHASES + k];
  speed_residuals(in, values);
}

/* The smallest time scale at a phase. */
static double scale_at(const NAME_memory *memory, int k) {
  double fast[RESIDUALS], slow[RESIDUALS], still[RESIDUALS], needed = 1;
  residuals_at(memory, k, 1, fast);
  residuals_at(memory, k, 0.5, slow);
  residuals_at(memory, k, 0, still);
  for (int row = 0; row < RESIDUALS; row++)
    for (int side = 0; side < 2; side++) {
      double sign = side ? -1 : 1, bound = side ? residual_lower[row] : residual_upper[row];
      if (!(sign * fast[row] > sign * bound)) continue;
      double margin = sign * (bound - still[row]), change = sign * (fast[row] - still[row]);
      double half = sign * (slow[row] - still[row]);
      double square = 2 * (change - 2 * half); /* from g(1) = static + b + c and g(2) = static + b / 2 + c / 4 */
      double scale = is_cubic[row] ? smallest_cubic_scale(margin, change)
                                   : smallest_scale(margin, change - square, square);
      needed = scale > needed ? scale : needed;
    }
  return needed;
}

/* Divide the rates by the smallest scale of time at which the motion meets its limits. */
static void scale_time(NAME_motion *motion, NAME_memory *memory) {
  double factor = 1;
  lay_out(motion, memory);
  speed_violation(memory->column, memory->violation);
  for (int k = 0; k < PHASES; k++)
    if (memory->violation[k] > 0) {
      double scale = scale_at(memory, k);
      factor = scale > factor ? scale : factor;
    }
  if (!(factor > 1)) return;
  factor *= 1 + SCALE_MARGIN;
  factor = factor < MAX_SCALE ? factor : MAX_SCALE;
  for (int j = 0; j < RATE_POINTS; j++) motion->rate[j] /= factor;
}
