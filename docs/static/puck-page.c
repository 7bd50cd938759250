/* Functions of the page of the moved puck: planner_page.py compiles them with an exported planner to WebAssembly. */

#include "airhockey_hit.h"

static airhockey_hit_memory memory;
static airhockey_hit_request request;
static airhockey_hit_motion motion;
static double found[3 * AIRHOCKEY_HIT_JOINTS];

/* The numbers of the request: start_q, start_dq, start_ddq, goal_q, goal_dq. */
double *numbers(void) { return request.start_q; }

int plan(void) { return airhockey_hit_plan(&request, &motion, &memory); }

double duration(void) { return airhockey_hit_duration(&motion); }

double *path(void) { return motion.path[0]; }

double *violations(void) { return motion.violations; }

/* q, dq and ddq at a time [s], one after another. */
double *state(double time) {
  airhockey_hit_state(&motion, time, found, found + AIRHOCKEY_HIT_JOINTS, found + 2 * AIRHOCKEY_HIT_JOINTS);
  return found;
}
