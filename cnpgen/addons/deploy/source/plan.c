/* The functions of the header. */

const char *const NAME_joint_names[JOINTS] = {JOINT_NAMES};
const char *const NAME_constraint_names[CONSTRAINTS] = {CONSTRAINT_NAMES};

/* Stay at the start: a motion of duration 0. */
static int refuse(int code, const NAME_request *request, NAME_motion *motion) {
  for (int j = 0; j < PATH_POINTS; j++)
    for (int i = 0; i < JOINTS; i++) motion->path[j][i] = request->start_q[i];
  for (int j = 0; j < RATE_POINTS; j++) motion->rate[j] = 0;
  for (int cell = 0; cell <= CELLS; cell++) motion->time[cell] = 0;
  motion->duration = 0;
  motion->code = code;
  return code;
}

/* The boundary conditions in one column; conditions that were zero in training are set to zero. */
static int read_request(const NAME_request *request, double *ends, double *parameters) {
  const double *conditions[CONDITIONS] = {CONDITION_LIST};
  int finite = 1, zero = 1, within = 1;
  for (int c = 0; c < CONDITIONS; c++)
    for (int i = 0; i < JOINTS; i++) {
      double value = conditions[c][i];
      finite &= isfinite(value) != 0;
      zero &= !must_be_zero[c] || fabs(value) <= zero_tolerance[c * JOINTS + i];
      ends[c * JOINTS + i] = must_be_zero[c] ? 0 : value;
    }
#if PARAMETERS
  for (int i = 0; i < PARAMETERS; i++) {
    double value = request->parameters[i];
    finite &= isfinite(value) != 0;
    within &= value >= parameter_low[i] && value <= parameter_high[i];
    parameters[i] = value;
  }
#else
  parameters[0] = 0;
#endif
  if (!finite) return UPPER_NOT_FINITE;
  if (!within) return UPPER_PARAMETER_OUT_OF_RANGE;
  return zero ? UPPER_VALID : UPPER_MUST_BE_ZERO;
}

/* Standardize the features; return whether all inputs are within the range of the training rows. */
static int standardize(const double *features, float *x) {
  int within = 1;
  for (int i = 0; i < FEATURES; i++) {
    double input = (features[i] - feature_mean[i]) * feature_scale[i];
    within &= input >= input_low[i] && input <= input_high[i];
    x[i] = (float)input;
  }
  for (int i = FEATURES; i < FEATURE_WIDTH; i++) x[i] = 0;
  return within;
}

/* Path and rates from the features, before the rates are fitted to the limits. */
static void shape(const double *ends, double expected_time, NAME_motion *motion, NAME_memory *memory) {
  double *in = memory->in; /* ends, offsets, rates, scene */
  const float *phi, *log_rate;
#if LINE_STEPS
  memcpy(in, ends, ENDS * sizeof *in);
  in[ENDS] = 1 / expected_time;
  for (int i = 0; i < SCENE; i++) in[ENDS + 1 + i] = motion->scene[i];
  line_change(in, memory->line);
#else
  for (int i = 0; i < OFFSETS; i++) memory->line[i] = 0;
#endif
  network(memory, &phi, &log_rate);
  memcpy(in, ends, ENDS * sizeof *in);
  for (int i = 0; i < OFFSETS; i++) in[ENDS + i] = PATH_SCALE * (double)phi[i] + memory->line[i];
  for (int j = 0; j < RATE_POINTS; j++) motion->rate[j] = vexp((double)log_rate[j]) / expected_time;
  memcpy(in + ENDS + OFFSETS, motion->rate, sizeof motion->rate);
  for (int i = 0; i < SCENE; i++) in[ENDS + OFFSETS + RATE_POINTS + i] = motion->scene[i];
  projected_path(in, memory->points);
  for (int j = 0; j < PATH_POINTS; j++)
    for (int i = 0; i < JOINTS; i++) motion->path[j][i] = memory->points[j * JOINTS + i];
}

int NAME_plan(const NAME_request *request, NAME_motion *motion, NAME_memory *memory) {
  double parameters[PARAMETERS + 1], worst[2];
  for (int i = 0; i < SCENE + RELAXED + 1; i++) motion->scene[i] = 0;
  for (int i = 0; i < CONSTRAINTS; i++) motion->violations[i] = INFINITY;
  int code = read_request(request, memory->ends, parameters);
  if (code != UPPER_VALID) return refuse(code, request, motion);
  double *in = memory->in, *out = memory->task; /* expected time, scene, features */
  memcpy(in, memory->ends, ENDS * sizeof *in);
  for (int i = 0; i < PARAMETERS; i++) in[ENDS + i] = parameters[i];
  task(in, out);
  double expected_time = out[0], *features = out + 1 + SCENE + RELAXED;
  for (int i = 0; i < SCENE + RELAXED; i++) motion->scene[i] = out[1 + i];
#if TIME_FEATURE >= 0
  features[TIME_FEATURE] = log(features[TIME_FEATURE]);
#endif
  if (!standardize(features, memory->x) && !request->admit_outside_range)
    return refuse(UPPER_OUTSIDE_TRAINING_RANGE, request, motion);
  shape(memory->ends, expected_time, motion, memory);
  if (!is_usable(motion)) return refuse(UPPER_PATH_NOT_VALID, request, motion);
  lay_out_path(motion, memory);
  FIT_RATES
  check_grid(motion, memory, motion->violations, worst);
  if (!(worst[0] <= 1)) return refuse(UPPER_PATH_NOT_VALID, request, motion);
  if (!(worst[1] <= 1)) return refuse(UPPER_NO_RATE_MEETS_LIMITS, request, motion);
  fill_times(motion);
  motion->code = UPPER_VALID;
  return UPPER_VALID;
}

double NAME_duration(const NAME_motion *motion) { return motion->duration; }

int NAME_state(const NAME_motion *motion, double time, double q[JOINTS], double dq[JOINTS], double ddq[JOINTS]) {
  int inside = motion->duration > 0 && time >= 0 && time <= motion->duration;
  if (inside) {
    state_at(motion, time < motion->duration ? phase_at(motion, time) : 1, q, dq, ddq);
    return 1;
  }
  int point = motion->duration > 0 && time > motion->duration ? PATH_POINTS - 1 : 0; /* nan is before the start */
  for (int i = 0; i < JOINTS; i++) {
    q[i] = motion->path[point][i];
    dq[i] = ddq[i] = 0;
  }
  return 0;
}

double NAME_check(const NAME_motion *motion, NAME_memory *memory, double violations[CONSTRAINTS]) {
  double worst[2];
  lay_out_path(motion, memory);
  check_grid(motion, memory, violations, worst);
  return worst[0] > worst[1] ? worst[0] : worst[1];
}
