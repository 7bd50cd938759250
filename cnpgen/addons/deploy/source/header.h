/* @INTRODUCTION@ */
#ifndef UPPER_H
#define UPPER_H

#ifdef __cplusplus
extern "C" {
#endif

@CONSTANTS@
/* Codes. A motion is written for code 0 only; otherwise its duration is 0 and all of its positions are the start. */
@CODES@
/* Boundary conditions of a motion. */
typedef struct {
@REQUEST@} NAME_request;

/* A motion q(t) = p(s(t)) of two B-splines on clamped uniform knots from 0 to 1. */
typedef struct {
@MOTION@} NAME_motion;

/* Working memory of one call, given by the caller: its content is private, needs no initialization and is not kept. Calls
at the same time need one each. */
typedef struct {
@MEMORY@} NAME_memory;

extern const char *const NAME_joint_names[@N@];
extern const char *const NAME_constraint_names[@M@];

/* Plan a motion and check it; return the code. The boundary conditions hold to rounding. */
int NAME_plan(const NAME_request *request, NAME_motion *motion, NAME_memory *memory);

/* The duration of a motion [s]. */
double NAME_duration(const NAME_motion *motion);

/* The state at a time since the start [s]; return 1 inside of the motion. Before it and after it the state is that end of
the motion at rest, and 0 is returned. */
int NAME_state(const NAME_motion *motion, double time, double q[@N@], double dq[@N@], double ddq[@N@]);

/* Check a motion at the phases of the grid: write the largest violation of every constraint, in its tolerances, and return
the largest of them. The motion is valid on the grid up to 1. */
double NAME_check(const NAME_motion *motion, NAME_memory *memory, double violations[@M@]);
@STOP@
#ifdef __cplusplus
}
#endif
#endif
