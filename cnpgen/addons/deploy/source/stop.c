/* Stops along the path of a motion q(t): q(sigma(t)) with the speed u = d sigma / dt = 1 - 3 x^2 + 2 x^3 of the share x of
the braking time, so that accelerations are continuous at both ends: dq = q' u and ddq = q'' u^2 + q' du/dt. */

static const double stop_delay[] = {0, 0.02, 0.05, 0.1, 0.15}; /* before braking [s] */
#define STOP_DELAYS ((int)(sizeof stop_delay / sizeof *stop_delay))
#define STOP_BISECTIONS 9
#define MIN_BRAKING_TIME 4e-3 /* s */
#define MAX_BRAKING_TIME 1.5

/* The state at a share of the braking time. */
static void braking_state(const NAME_motion *motion, const NAME_stop *stop, double x, double *q, double *dq, double *ddq) {
  double travel = x - x * x * x + 0.5 * x * x * x * x, u = 1 - (3 - 2 * x) * x * x;
  double change = -6 * x * (1 - x) / stop->braking_time, time = stop->begin + stop->braking_time * travel;
  state_at(motion, time < motion->duration ? phase_at(motion, time) : 1, q, dq, ddq);
  for (int i = 0; i < JOINTS; i++) {
    ddq[i] = ddq[i] * u * u + dq[i] * change;
    dq[i] *= u;
  }
}

/* Whether a stop meets the conditions that depend on velocity at PHASES times. With r = 1 and r' = 0 the derivatives of the
path in a column are those of time. */
static int is_feasible(const NAME_motion *motion, const NAME_stop *stop, NAME_memory *memory) {
  double *column = memory->column, q[JOINTS], dq[JOINTS], ddq[JOINTS];
  for (int k = 0; k < PHASES; k++) {
    braking_state(motion, stop, (double)k / (PHASES - 1), q, dq, ddq);
    for (int i = 0; i < JOINTS; i++) {
      column[i * PHASES + k] = q[i];
      column[(JOINTS + i) * PHASES + k] = dq[i];
      column[(2 * JOINTS + i) * PHASES + k] = ddq[i];
    }
    column[ORDERS * JOINTS * PHASES + k] = 1;
    column[(ORDERS * JOINTS + 1) * PHASES + k] = 0;
    for (int i = 0; i < SCENE; i++) column[(ORDERS * JOINTS + ORDERS - 1 + i) * PHASES + k] = motion->scene[i];
  }
  int feasible = 1;
#if MOVING_ROWS
  moving_violations(column, memory->rows);
  for (int row = 0; row < MOVING_ROWS; row++) feasible &= largest(memory->rows + row * PHASES, PHASES) <= 1;
#endif
  return feasible;
}

int NAME_find_stop(const NAME_motion *motion, double time, NAME_memory *memory, NAME_stop *stop) {
  double earliest = motion->duration;
  stop->begin = motion->duration;
  stop->braking_time = 0;
  if (!(motion->duration > 0 && time >= 0 && time < motion->duration)) return 0;
  for (int d = 0; d < STOP_DELAYS; d++) {
    NAME_stop found = {time + stop_delay[d], 0};
    double low = MIN_BRAKING_TIME, left = 2 * (motion->duration - found.begin); /* half of a braking time is travelled */
    double high = left < MAX_BRAKING_TIME ? left : MAX_BRAKING_TIME;
    if (!(high > low)) continue;
    found.braking_time = high;
    int feasible = is_feasible(motion, &found, memory);
    for (int i = 0; i < STOP_BISECTIONS; i++) {
      found.braking_time = (low + high) / 2;
      int shorter = is_feasible(motion, &found, memory);
      feasible |= shorter;
      low = shorter ? low : found.braking_time;
      high = shorter ? found.braking_time : high;
    }
    found.braking_time = high;
    if (!feasible || !(found.begin + high < earliest)) continue;
    earliest = found.begin + high;
    *stop = found;
  }
  return earliest < motion->duration;
}

int NAME_stop_state(const NAME_motion *motion, const NAME_stop *stop, double time, double q[JOINTS], double dq[JOINTS],
                    double ddq[JOINTS]) {
  double x = (time - stop->begin) / stop->braking_time;
  int stopped = !(stop->braking_time > 0) || !(x < 1);
  if (!stopped && !(x > 0)) return NAME_state(motion, time, q, dq, ddq);
  if (stop->braking_time > 0) braking_state(motion, stop, stopped ? 1 : x, q, dq, ddq);
  else NAME_state(motion, stop->begin, q, dq, ddq);
  for (int i = 0; i < JOINTS && stopped; i++) dq[i] = ddq[i] = 0;
  return !stopped;
}
