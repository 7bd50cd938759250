/* The check of a motion at the phases of the grid. */

/* Whether the control points can be evaluated: finite, and rates positive. */
static int is_usable(const NAME_motion *motion) {
  int usable = 1;
  for (int j = 0; j < PATH_POINTS; j++)
    for (int i = 0; i < JOINTS; i++) usable &= fabs(motion->path[j][i]) < MAX_POSITION;
  for (int j = 0; j < RATE_POINTS; j++) usable &= motion->rate[j] > MIN_RATE && motion->rate[j] < MAX_RATE;
  for (int i = 0; i < SCENE + RELAXED; i++) usable &= isfinite(motion->scene[i]) != 0;
  return usable;
}

/* The columns of the position check: p, the phase, and the scene at every phase of it. */
static void lay_out_positions(const NAME_motion *motion, NAME_memory *memory) {
  double *out = memory->positions;
  for (int k = 0; k < CHECKED_PHASES; k++) {
    for (int i = 0; i < JOINTS; i++) out[i * CHECKED_PHASES + k] = memory->column[i * PHASES + checked_phase[k]];
    out[JOINTS * CHECKED_PHASES + k] = phase[checked_phase[k]];
    for (int i = 0; i < SCENE + RELAXED; i++) out[(JOINTS + 1 + i) * CHECKED_PHASES + k] = motion->scene[i];
  }
}

/* Write the largest violation of every constraint, in tolerances of valid motions; return the largest of them by
conditions on positions, and by those that depend on velocity. The path is laid out already. */
static void check_grid(const NAME_motion *motion, NAME_memory *memory, double *violations, double worst[2]) {
  worst[0] = worst[1] = -INFINITY;
  for (int i = 0; i < CONSTRAINTS; i++) violations[i] = -INFINITY;
  if (!is_usable(motion)) {
    for (int i = 0; i < CONSTRAINTS; i++) violations[i] = INFINITY;
    worst[0] = INFINITY;
    return;
  }
  lay_out_rates(motion->rate, memory);
#if POSITION_ROWS
  lay_out_positions(motion, memory);
  position_violations(memory->positions, memory->rows);
  for (int row = 0; row < POSITION_ROWS; row++) {
    double value = largest(memory->rows + row * CHECKED_PHASES, CHECKED_PHASES);
    violations[position_constraint[row]] = value;
    worst[0] = value > worst[0] ? value : worst[0];
  }
#endif
#if MOVING_ROWS
  moving_violations(memory->column, memory->rows);
  for (int row = 0; row < MOVING_ROWS; row++) {
    double value = largest(memory->rows + row * PHASES, PHASES), *violation = violations + moving_constraint[row];
    *violation = value > *violation ? value : *violation;
    worst[1] = value > worst[1] ? value : worst[1];
  }
#endif
}
