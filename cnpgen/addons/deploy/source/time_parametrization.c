/* Time parametrization: rates as large as the limits allow. On a fixed path a bounded value is
g = constant + square r^2 + mixed r r', so a quadratic of each control point of the rate (Bobrow et al., 1985). */

/* The smallest x > 0 with square x^2 + linear x = margin; infinite if there is none. */
static double smallest(double margin, double linear, double square) {
  double below = linear + sqrt(linear * linear + 4 * square * margin);
  return below > 0 ? 2 * margin / below : INFINITY;
}

/* Allowed step up and required step back so far. */
typedef struct { double up, back; int violated; } steps;

static void with_bound(steps *found, double margin, double linear, double square) {
  int violated = margin < 0;
  double step = smallest(fabs(margin), linear, violated ? -square : square);
  if (!violated) {
    if (step < found->up) found->up = step;
    return;
  }
  if (step < INFINITY && step > found->back) found->back = step;
  found->violated |= linear != 0 || square != 0;
}

/* The quadratics of all rows at LANES phases from k on along the direction b of r; return whether a row may exceed a
bound within a step of `up`: |change| <= up (|linear| + up |square|). */
static int quadratics(NAME_memory *memory, int k, double up) {
  const double *r = memory->column + ORDERS * JOINTS * PHASES + k, *r1 = memory->column + (ORDERS * JOINTS + 1) * PHASES + k;
  const double *b = memory->direction[0] + k, *b1 = memory->direction[1] + k;
  double worst[LANES], rr[LANES], rr1[LANES], rb[LANES], rb1[LANES], bb[LANES], bb1[LANES];
  for (int l = 0; l < LANES; l++) { /* products that all rows share */
    worst[l] = -1;
    rr[l] = r[l] * r[l];
    rr1[l] = r[l] * r1[l];
    rb[l] = 2 * r[l] * b[l];
    rb1[l] = r[l] * b1[l] + r1[l] * b[l];
    bb[l] = b[l] * b[l];
    bb1[l] = b[l] * b1[l];
  }
  for (int row = 0; row < ROWS; row++) {
    const double *constant = memory->coefficients + row * PHASES + k, *square = constant + ROWS * PHASES;
    const double *mixed = square + ROWS * PHASES;
    double *g = memory->quadratic[row][0], *linear = memory->quadratic[row][1], *power = memory->quadratic[row][2];
    for (int l = 0; l < LANES; l++) {
      g[l] = constant[l] + square[l] * rr[l] + mixed[l] * rr1[l];
      linear[l] = square[l] * rb[l] + mixed[l] * rb1[l];
      power[l] = square[l] * bb[l] + mixed[l] * bb1[l];
      double above = g[l] - upper_bound[row], below = lower_bound[row] - g[l];
      double excess = (above > below ? above : below) + up * (fabs(linear[l]) + up * fabs(power[l]));
      worst[l] = excess > worst[l] ? excess : worst[l];
    }
  }
  return largest(worst, LANES) > 0;
}

/* The largest step of r along its direction within the bounds, or the required step back if one is violated. */
static double advance(NAME_memory *memory, int from, int to) {
  steps found = {MAX_INCREASE, 0, 0};
  int blocks = (to - from) / LANES;
  for (int i = 0; i < blocks; i++) { /* from the midpoint outwards: outer phases rarely limit the step further */
    int k = from + (blocks / 2 + (i % 2 ? -(i + 1) / 2 : i / 2)) * LANES;
    if (!quadratics(memory, k, found.up)) continue;
    for (int row = 0; row < ROWS; row++)
      for (int l = 0; l < LANES; l++) {
        double g = memory->quadratic[row][0][l], linear = memory->quadratic[row][1][l];
        double square = memory->quadratic[row][2][l];
        double above = g - upper_bound[row], below = lower_bound[row] - g;
        double change = found.up * (fabs(linear) + found.up * fabs(square));
        if (above + change > 0) with_bound(&found, -above, linear, square);
        if (below + change > 0) with_bound(&found, -below, -linear, -square);
      }
  }
  if (!found.violated) return found.up;
  return -found.back > MAX_DECREASE ? -found.back : MAX_DECREASE;
}

/* Move the control points of r in their order; return the largest relative increase of one. */
static double sweep(double *rate, NAME_memory *memory) {
  double increase = 0, *r = memory->column + ORDERS * JOINTS * PHASES, *r1 = r + PHASES;
  for (int move = 0; move < MOVES; move++) {
    int j = move_order[move], from = move_range[2 * j], to = move_range[2 * j + 1];
    const double *basis = rate_basis + j * PHASES, *derivative = basis + RATE_POINTS * PHASES;
    for (int k = from; k < to; k++) {
      memory->direction[0][k] = rate[j] * basis[k];
      memory->direction[1][k] = rate[j] * derivative[k];
    }
    double x = advance(memory, from, to);
    if (x > 0) x *= step_fraction[move];
    for (int k = from; k < to; k++) {
      r[k] += x * memory->direction[0][k];
      r1[k] += x * memory->direction[1][k];
    }
    rate[j] += x * rate[j];
    increase = x > increase ? x : increase;
  }
  return increase;
}

/* The largest violation with rates, infinite if a value is nan. */
static double violation_of(const double *rate, NAME_memory *memory) {
  lay_out_rates(rate, memory);
  speed_violation(memory->column, memory->violation);
  return largest(memory->violation, PHASES);
}

/* Fit the rates in place; return whether they meet the limits. A motion whose largest violation would grow stays. */
static int parametrize(NAME_motion *motion, NAME_memory *memory) {
  double *rate = motion->rate, before[RATE_POINTS], movable[RATE_POINTS];
  memcpy(before, rate, sizeof before);
  lay_out_rates(rate, memory);
  speed_coefficients(memory->column, memory->coefficients);
  int twice = sweep(rate, memory) > MIN_INCREASE;
  if (twice) sweep(rate, memory);
  for (int j = 0; j < RATE_POINTS; j++) movable[j] = j >= FIXED_RATES && j < RATE_POINTS - FIXED_RATES ? rate[j] : 0;
  lay_out_rates(rate, memory);
  combine_rates(rate_basis, movable, memory->direction[0]);
  combine_rates(rate_basis + RATE_POINTS * PHASES, movable, memory->direction[1]);
  double factor = (1 + advance(memory, 0, PHASES)) * (1 - RATE_MARGIN);
  for (int j = FIXED_RATES; j < RATE_POINTS - FIXED_RATES; j++) rate[j] *= factor;
  double worst = violation_of(rate, memory);
  if (!(worst <= BOUND_TOLERANCE)) {
    double earlier = violation_of(before, memory);
    if (!(worst <= earlier)) {
      memcpy(rate, before, sizeof before);
      worst = earlier;
    }
  }
  return !twice && worst <= BOUND_TOLERANCE;
}
