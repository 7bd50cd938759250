/* Huber's losses of the clearances of a robot's convex parts from the obstacles of samples, with their gradients;
collision.c precedes this file. */

/* Loss of one state, and its gradient with respect to the joint positions. */
static double state_loss(const robot_scene *s, memory *m, const double *q, double required, contact_list *list,
                         double *gradient) {
  double loss = 0.0;
  for (long j = 0; j < s->n; j++) gradient[j] = 0.0;
  place_robot(s, q, m);
  list->count = 0;
  meet_obstacles(s, m, required, list);
  for (long i = 0; i < list->count && i < list->capacity; i++) {
    /* Huber's loss h(v) of v = required - d: v^2 / 2 below 1, else v - 1/2. Its derivative is min(v, 1), and with a
       frozen closest point dd/dq_j = n . (z_j x (x - o_j)). */
    double violation = required - list->distance[i], derivative = violation < 1 ? violation : 1.0;
    const double *normal = list->normal + 3 * i, *point = list->points + 6 * i + 3;
    loss += derivative * (violation - 0.5 * derivative);
    for (long j = 0; j < s->moving_frames[list->pair[i] / s->n_obstacles]; j++) {
      double axis[3], arm[3], speed[3];
      const pose *f = m->frame + j + 1;
      turn(f->R, s->axis + 3 * j, axis);
      less(point, f->p, arm);
      cross(axis, arm, speed);
      gradient[j] -= derivative * dot(s->sliding[j] ? axis : speed, normal);
    }
  }
  return loss;
}

/* Losses (nodes, N) and gradients (nodes, n, N) of states (nodes, n, N); `robot` has the obstacles and boxes of N samples. */
long clearance_losses(const robot_scene *robot, long samples, long nodes, const double *q, double required, double *losses,
                      double *gradients) {
  long capacity = (robot->n_parts + 1) * (robot->n_obstacles + 1), n = robot->n;
  robot_scene s = *robot;
  double *numbers = malloc(10 * capacity * sizeof *numbers);
  long *indices = malloc(2 * capacity * sizeof *indices);
  memory *m = make_memory(robot);
  if (!numbers || !indices || !m) return free_memory(m), free(numbers), free(indices), OUT_OF_MEMORY;
  contact_list list = {0, capacity, 0, indices, indices + capacity, numbers, numbers + capacity, numbers + 4 * capacity};
  for (long sample = 0; sample < samples; sample++) {
    s.obstacles = robot->obstacles + sample * s.n_obstacles, s.boxes = robot->boxes + sample * 16 * s.lanes;
    /* Normals of another sample's obstacles would be wrong initial guesses. */
    memset(m->obstacle_normal, 0, 3 * s.n_parts * s.n_obstacles * sizeof(double));
    for (long node = 0; node < nodes; node++) {
      double state[64], gradient[64];
      int finite = 1;
      for (long j = 0; j < n; j++) state[j] = q[(node * n + j) * samples + sample], finite &= isfinite(state[j]);
      double loss = finite ? state_loss(&s, m, state, required, &list, gradient) : NAN;
      losses[node * samples + sample] = loss;
      for (long j = 0; j < n; j++) gradients[(node * n + j) * samples + sample] = finite ? gradient[j] : NAN;
    }
  }
  free_memory(m), free(numbers), free(indices);
  return 0;
}
