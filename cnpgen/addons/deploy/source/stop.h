
/* A stop on the path of a motion: it begins at a time of the motion [s], and takes the braking time [s]. */
typedef struct { double begin, braking_time; } NAME_stop;

/* Find the earliest stop after a time of the motion [s] that meets the conditions on velocities, accelerations and torques at
the times of a grid; return 1 if there is one. Otherwise no stop of the family ends before the motion: 0 is returned, and the
stop is the end of the motion. It takes at most 50 checks, so it is for a thread beside the control loop. */
int NAME_find_stop(const NAME_motion *motion, double time, NAME_memory *memory, NAME_stop *stop);

/* The state at a time since the start of the motion [s], before, in and after a stop; return 0 from the end of the stop on,
when the robot is at rest. */
int NAME_stop_state(const NAME_motion *motion, const NAME_stop *stop, double time, double q[@N@], double dq[@N@], double ddq[@N@]);
