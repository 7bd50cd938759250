/* Splines: q(t) = p(s(t)) with ds/dt = r(s). */

/* Basis functions that are not 0 at an offset from the left knot of a span, and their first derivatives: values of
order 0, 1 and 2, (3, DEGREE + 1), from Taylor coefficients of each function at that knot. */
static void basis_at(const double *taylor, double offset, double values[3][DEGREE + 1]) {
  for (int j = 0; j <= DEGREE; j++) {
    double value = 0, first = 0, second = 0; /* Horner's rule for a polynomial and its derivatives */
    for (int k = DEGREE; k >= 0; k--) {
      second = second * offset + 2 * first;
      first = first * offset + value;
      value = value * offset + taylor[k * (DEGREE + 1) + j];
    }
    values[0][j] = value;
    values[1][j] = first;
    values[2][j] = second;
  }
}

/* Taylor coefficients of r in a span, from its control points. */
static void rate_coefficients(const double *rate, int span, double coefficients[DEGREE + 1]) {
  const double *taylor = rate_taylor + (size_t)span * (DEGREE + 1) * (DEGREE + 1);
  for (int k = 0; k <= DEGREE; k++) {
    double sum = 0;
    for (int j = 0; j <= DEGREE; j++) sum += taylor[k * (DEGREE + 1) + j] * rate[span + j];
    coefficients[k] = sum;
  }
}

/* The time from `offset` to `offset + width` [s], the integral of 1 / r by Gauss's rule of NODES points. */
static double time_of(const double *coefficients, double offset, double width) {
  double x[NODES], r[NODES] = {0}, sum = 0;
  for (int i = 0; i < NODES; i++) x[i] = offset + width * node[i];
  for (int k = DEGREE; k >= 0; k--)
    for (int i = 0; i < NODES; i++) r[i] = r[i] * x[i] + coefficients[k];
  for (int i = 0; i < NODES; i++) x[i] = node_weight[i] / r[i];
  for (int i = 0; i < NODES; i++) sum += x[i];
  return sum * width;
}

/* Fill the table of times at the edges of the cells, from which states at a time are found. All nodes are divided
together: a division of vectors takes as long as one of numbers. */
static void fill_times(NAME_motion *motion) {
  double coefficients[DEGREE + 1], part[CELLS * NODES], time = 0;
  for (int cell = 0, last = -1; cell < CELLS; cell++) {
    if (cell_span[cell] != last) rate_coefficients(motion->rate, cell_span[cell], coefficients);
    last = cell_span[cell];
    double r[NODES] = {0};
    for (int k = DEGREE; k >= 0; k--)
      for (int i = 0; i < NODES; i++) r[i] = r[i] * node_offset[cell * NODES + i] + coefficients[k];
    for (int i = 0; i < NODES; i++) part[cell * NODES + i] = r[i];
  }
  for (int i = 0; i < CELLS * NODES; i++) part[i] = node_width[i] / part[i];
  motion->time[0] = 0;
  for (int cell = 0; cell < CELLS; cell++) {
    double sum = 0; /* of a cell alone: sums of cells do not wait for each other */
    for (int i = 0; i < NODES; i++) sum += part[cell * NODES + i];
    time += sum;
    motion->time[cell + 1] = time;
  }
  motion->duration = time;
}

/* The phase at a time inside of the motion: the cell by bisection, then Newton's method on t(s) inside of it. */
static double phase_at(const NAME_motion *motion, double time) {
  int first = 0, last = CELLS; /* the cell is at or after the first, and before the last */
  for (int step = 0; step < CELL_STEPS; step++) {
    int midpoint = (first + last) / 2;
    if (motion->time[midpoint] <= time && midpoint < CELLS) first = midpoint;
    else last = midpoint;
  }
  double coefficients[DEGREE + 1], low = cell_edge[first], width = cell_edge[first + 1] - low;
  double left = time - motion->time[first], whole = motion->time[first + 1] - motion->time[first];
  rate_coefficients(motion->rate, cell_span[first], coefficients);
  double offset = low - (double)cell_span[first] / RATE_SPANS, ahead = width * left / whole;
  for (int step = 0; step < NEWTON_STEPS; step++) {
    double r = 0;
    for (int k = DEGREE; k >= 0; k--) r = r * (offset + ahead) + coefficients[k];
    ahead += (left - time_of(coefficients, offset, ahead)) * r; /* dt/ds = 1 / r */
    ahead = ahead < 0 ? 0 : ahead;
    ahead = ahead > width ? width : ahead;
  }
  return low + ahead;
}

/* Position, velocity and acceleration at a phase: dq = p' r and ddq = (p'' r + p' r') r. */
static void state_at(const NAME_motion *motion, double s, double *q, double *dq, double *ddq) {
  double p[3][DEGREE + 1], r[3][DEGREE + 1], rate[2] = {0, 0};
  int path_span = (int)(s * PATH_SPANS), rate_span = (int)(s * RATE_SPANS);
  path_span = path_span < PATH_SPANS ? path_span : PATH_SPANS - 1;
  rate_span = rate_span < RATE_SPANS ? rate_span : RATE_SPANS - 1;
  basis_at(path_taylor + (size_t)path_span * (DEGREE + 1) * (DEGREE + 1), s - (double)path_span / PATH_SPANS, p);
  basis_at(rate_taylor + (size_t)rate_span * (DEGREE + 1) * (DEGREE + 1), s - (double)rate_span / RATE_SPANS, r);
  for (int j = 0; j <= DEGREE; j++) {
    rate[0] += r[0][j] * motion->rate[rate_span + j];
    rate[1] += r[1][j] * motion->rate[rate_span + j];
  }
  for (int i = 0; i < JOINTS; i++) {
    double value = 0, first = 0, second = 0;
    for (int j = 0; j <= DEGREE; j++) {
      double point = motion->path[path_span + j][i];
      value += p[0][j] * point;
      first += p[1][j] * point;
      second += p[2][j] * point;
    }
    q[i] = value;
    dq[i] = first * rate[0];
    ddq[i] = (second * rate[0] + first * rate[1]) * rate[0];
  }
}
