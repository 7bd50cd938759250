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

/* Bounded values at LANES phases from k on, with time scaled by 1 / slowness; at rest if it is 0. */
static void residuals_at(NAME_memory *memory, int k, double slowness, double *values) {
  const double *p = memory->column + k, *r = p + ORDERS * JOINTS * PHASES, *scene = r + (ORDERS - 1) * PHASES;
  double *in = memory->moving, square = slowness * slowness;
  for (int i = 0; i < JOINTS; i++) {
    const double *p1 = p + (JOINTS + i) * PHASES, *p2 = p1 + JOINTS * PHASES, *r1 = r + PHASES;
    double *q = in + i * LANES, *dq = q + JOINTS * LANES, *ddq = dq + JOINTS * LANES;
    for (int l = 0; l < LANES; l++) {
      q[l] = p[i * PHASES + l];
      dq[l] = p1[l] * r[l] * slowness;
      ddq[l] = (p2[l] * r[l] + p1[l] * r1[l]) * r[l] * square;
    }
#if JERK
    const double *p3 = p2 + JOINTS * PHASES, *r2 = r1 + PHASES;
    double *jerk = ddq + JOINTS * LANES;
    for (int l = 0; l < LANES; l++)
      jerk[l] = ((p3[l] * r[l] + 3 * p2[l] * r1[l]) * r[l] + p1[l] * (r2[l] * r[l] + r1[l] * r1[l])) * r[l] * square * slowness;
#endif
  }
  for (int i = 0; i < SCENE; i++)
    for (int l = 0; l < LANES; l++) in[(ORDERS * JOINTS + i) * LANES + l] = scene[i * PHASES + l];
  speed_residuals(in, values);
}

/* The smallest scale at which a value that exceeds its upper bound meets it; a lower bound has the opposite signs. */
static double scale_of(double bound, double fast, double slow, double still, int cubic) {
  double margin = bound - still, change = fast - still, half = slow - still;
  double square = 2 * (change - 2 * half); /* from g(1) = static + b + c and g(2) = static + b / 2 + c / 4 */
  return cubic ? smallest_cubic_scale(margin, change) : smallest_scale(margin, change - square, square);
}

/* The smallest time scale at LANES phases from k on. All values are evaluated for every motion, so that the time hardly
depends on it. */
static double scale_at(NAME_memory *memory, int k) {
  const double *fast = memory->residuals[0], *slow = memory->residuals[1], *still = memory->residuals[2];
  double needed = 1;
  residuals_at(memory, k, 1, memory->residuals[0]);
  residuals_at(memory, k, 0.5, memory->residuals[1]);
  residuals_at(memory, k, 0, memory->residuals[2]);
  for (int row = 0; row < RESIDUALS; row++, fast += LANES, slow += LANES, still += LANES) {
    double low = residual_lower[row], high = residual_upper[row], exceeds[LANES], any = 0;
    for (int l = 0; l < LANES; l++) exceeds[l] = ((fast[l] > high) | (fast[l] < low)) ? 1.0 : 0.0;
    for (int l = 0; l < LANES; l++) any += exceeds[l];
    if (!(any > 0)) continue;
    for (int l = 0; l < LANES; l++) {
      double scale = 1;
      if (fast[l] > high) scale = scale_of(high, fast[l], slow[l], still[l], is_cubic[row]);
      if (fast[l] < low) scale = scale_of(-low, -fast[l], -slow[l], -still[l], is_cubic[row]);
      needed = scale > needed ? scale : needed;
    }
  }
  return needed;
}

/* Divide the rates by the smallest scale of time at which the motion meets its limits. */
static void scale_time(NAME_motion *motion, NAME_memory *memory) {
  double factor = 1;
  lay_out_rates(motion->rate, memory);
  for (int k = 0; k < PHASES; k += LANES) {
    double scale = scale_at(memory, k);
    factor = scale > factor ? scale : factor;
  }
  if (!(factor > 1)) return;
  factor *= 1 + SCALE_MARGIN;
  factor = factor < MAX_SCALE ? factor : MAX_SCALE;
  for (int j = 0; j < RATE_POINTS; j++) motion->rate[j] /= factor;
}
