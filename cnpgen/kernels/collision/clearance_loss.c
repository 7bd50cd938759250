/* Huber's losses of the clearances of a robot's convex parts from the obstacles of samples, with their gradients;
collision.c precedes this file. */

enum { SOME_BOX, SOME_SPHERE, SOME_CYLINDER, SOME_CAPSULE, SOME_MESH };

typedef struct { /* obstacles of N samples with M bodies; a negative kind is no body */
  long bodies;
  const long *kind;
  const double *center, *rotation, *size;
  const long *first, *count; /* of the vertices of meshes */
  const double *vertices; /* of the robot, then of meshes */
} sample_obstacles;

/* Fill in the bodies and bounding boxes of a sample; `boxes` has 16 rows of lanes. */
static void place_sample(const sample_obstacles *a, long sample, body *bodies, double *boxes, long lanes) {
  for (long k = 0; k < lanes; k++) {
    long from = sample * a->bodies + k, kind = k < a->bodies ? a->kind[from] : -1;
    for (int row = 0; row < 16; row++) boxes[row * lanes + k] = row < 3 ? 1e6 : 0.0;
    if (k >= a->bodies) continue;
    body *b = bodies + k;
    memset(b, 0, sizeof *b);
    b->kind = BOX;
    b->position[0] = 1e6;
    if (kind < 0) continue;
    const double *size = a->size + 3 * from;
    memcpy(b->position, a->center + 3 * from, sizeof b->position);
    memcpy(b->rotation, a->rotation + 9 * from, sizeof b->rotation);
    if (kind == SOME_BOX) memcpy(b->size, size, sizeof b->size);
    else if (kind >= SOME_MESH) b->kind = HULL, b->first = a->first[kind - SOME_MESH], b->count = a->count[kind - SOME_MESH];
    else if (kind == SOME_CYLINDER) b->kind = CYLINDER, b->size[0] = b->size[1] = size[0], b->size[2] = size[1];
    else b->size[2] = size[1], b->radius = size[0];
    const double *half = kind >= SOME_MESH ? size : b->size;
    for (int i = 0; i < 3; i++) boxes[i * lanes + k] = b->position[i], boxes[(3 + i) * lanes + k] = half[i];
    for (int i = 0; i < 9; i++) boxes[(6 + i) * lanes + k] = b->rotation[i];
    boxes[15 * lanes + k] = b->radius;
  }
}

/* Loss of one state, and its gradient with respect to the joint positions. */
static double state_loss(const robot_scene *s, memory *m, const double *q, double required, contact_list *list,
                         double *gradient) {
  double loss = 0.0;
  for (long j = 0; j < s->n; j++) gradient[j] = 0.0;
  place_robot(s, q, m);
  list->count = 0;
  meet_obstacles(s, m, required, list);
  for (long i = 0; i < list->count && i < list->capacity; i++) {
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

/* Losses (nodes, N) and gradients (nodes, n, N) of states (nodes, n, N); `robot` has no obstacles. */
void clearance_losses(const robot_scene *robot, const sample_obstacles *obstacles, long samples, long nodes,
                      const double *q, double required, double *losses, double *gradients) {
  long capacity = (robot->n_parts + 1) * (obstacles->bodies + 1), n = robot->n;
  robot_scene s = *robot;
  s.n_obstacles = obstacles->bodies, s.lanes = obstacles->bodies + -obstacles->bodies % 8 + (obstacles->bodies % 8 ? 8 : 0);
  body *bodies = malloc((obstacles->bodies + 1) * sizeof *bodies);
  double *boxes = malloc((16 * s.lanes + 8) * sizeof *boxes), *numbers = malloc(10 * capacity * sizeof *numbers);
  long *indices = malloc(2 * capacity * sizeof *indices);
  s.obstacles = bodies, s.boxes = boxes, s.vertices = obstacles->vertices;
  memory *m = make_memory(&s);
  contact_list list = {0, capacity, 0, indices, indices + capacity, numbers, numbers + capacity, numbers + 4 * capacity};
  for (long sample = 0; sample < samples; sample++) {
    place_sample(obstacles, sample, bodies, boxes, s.lanes);
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
  free_memory(m), free(bodies), free(boxes), free(numbers), free(indices);
}
