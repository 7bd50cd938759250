/* Functions of an interactive page: planner_pages.py puts the exported planner and the function of torques before them. */

static NAME_memory memory;
static NAME_request request;
static NAME_motion motion;
static double moving[4 * JOINTS]; /* q, dq, ddq and torques, one after another */
static double column[3 * JOINTS + SCENE + 1];

/* The numbers of the request: boundary conditions in their order, and parameters. */
double *numbers(void) { return request.start_q; }

int plan(void) { return NAME_plan(&request, &motion, &memory); }

double duration(void) { return NAME_duration(&motion); }

double *path(void) { return motion.path[0]; }

double *violations(void) { return motion.violations; }

/* q, dq and ddq at a time [s], and the torques of the rigid body with its load [N m]. */
double *state(double time) {
  NAME_state(&motion, time, moving, moving + JOINTS, moving + 2 * JOINTS);
  memcpy(column, moving, 3 * JOINTS * sizeof(double));
  memcpy(column + 3 * JOINTS, motion.scene, SCENE * sizeof(double));
  torque(column, moving + 3 * JOINTS);
  return moving;
}
