/* Collision checks of a robot among obstacles at batches of states: forward kinematics, capsules of the links as a broad
phase, and distances of convex parts. convex.c precedes this file. Robot and obstacles are arrays, so that one library
serves all robots and scenes. */

typedef struct {
  long frame;
  double first[3], second[3], radius;
} capsule;

typedef struct {
  long n, n_parts, n_links, n_link_pairs, n_obstacles, lanes; /* lanes: n_obstacles, padded to cache lines */
  const double *place, *axis; /* of the joints: rotation and position (12), unit axis (3) */
  const long *sliding;
  const body *parts;
  const capsule *links;
  const long *first_part, *part_of_link; /* parts of a link: part_of_link[first_part[link]...] */
  const long *link_pairs, *first_pair, *pairs; /* two links; pairs of a link pair from first_pair on; two parts */
  const long *moving, *moving_frames; /* part -> index among the moving parts; their frames */
  const double *added, *pair_added; /* to the limits of links and of link pairs [m]; -INFINITY: not checked */
  const body *obstacles;
  const double *boxes; /* center, half sizes, rotation by rows, radius of bounding boxes: 16 rows of lanes */
  const double *vertices;
} robot_scene;

typedef struct { double R[9], p[3]; } pose;

typedef struct { /* memory of a batch of checks */
  pose *frame;
  double *ends;     /* of the capsules' axes: (n_links, 6) */
  polytope *work;   /* of EPA */
  double *obstacle_normal, *pair_normal; /* last normals in the world frame, the initial guesses */
} memory;

enum { OUT_OF_MEMORY = -1 }; /* result of functions that allocate memory */

static void free_memory(memory *m) {
  if (!m) return;
  free(m->frame), free(m->ends), free(m->work), free(m->obstacle_normal), free(m->pair_normal), free(m);
}

/* Return memory for a batch of checks; null if there is none left. */
static memory *make_memory(const robot_scene *s) {
  long pairs = s->first_pair[s->n_link_pairs];
  memory *m = calloc(1, sizeof *m);
  if (!m) return 0;
  m->frame = malloc((s->n + 1) * sizeof *m->frame);
  m->work = malloc(sizeof *m->work);
  m->ends = malloc((6 * s->n_links + 1) * sizeof(double));
  m->obstacle_normal = calloc(3 * s->n_parts * s->n_obstacles + 1, sizeof(double));
  m->pair_normal = calloc(3 * pairs + 1, sizeof(double));
  if (m->frame && m->work && m->ends && m->obstacle_normal && m->pair_normal) return m;
  free_memory(m);
  return 0;
}

I void transform(const pose *f, const double *x, double *y) {
  turn(f->R, x, y);
  for (int i = 0; i < 3; i++) y[i] += f->p[i];
}

static void place_robot(const robot_scene *s, const double *q, memory *m) {
  static const double eye[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  double sine[64], cosine[64];
  for (long j = 0; j < s->n; j += W) {
    v a, b;
    vsincos(load(q, j, s->n), &a, &b);
    put(sine + j, a), put(cosine + j, b);
  }
  memcpy(m->frame[0].R, eye, sizeof eye);
  memset(m->frame[0].p, 0, sizeof m->frame[0].p);
  for (long j = 0; j < s->n; j++) {
    const pose *before = m->frame + j;
    pose *f = m->frame + j + 1;
    const double *T = s->place + 12 * j, *u = s->axis + 3 * j;
    double base[9], local[9];
    /* T_j = T_{j-1} Place_j Rot(axis_j, q_j): the fixed place of the joint first. */
    transform(before, T + 9, f->p);
    for (int r = 0; r < 3; r++)
      for (int k = 0; k < 3; k++)
        base[3 * r + k] = before->R[3 * r] * T[k] + before->R[3 * r + 1] * T[3 + k] + before->R[3 * r + 2] * T[6 + k];
    if (s->sliding[j]) {
      double along[3];
      turn(base, u, along);
      for (int i = 0; i < 3; i++) f->p[i] += q[j] * along[i];
      memcpy(f->R, base, sizeof base);
      continue;
    }
    /* About z only two columns change, which is cheaper than the general formula. */
    if (u[2] == 1.0) {
      for (int r = 0; r < 3; r++) {
        f->R[3 * r] = cosine[j] * base[3 * r] + sine[j] * base[3 * r + 1];
        f->R[3 * r + 1] = cosine[j] * base[3 * r + 1] - sine[j] * base[3 * r];
        f->R[3 * r + 2] = base[3 * r + 2];
      }
      continue;
    }
    double c = cosine[j], d = sine[j];
    for (int r = 0; r < 3; r++)
      for (int k = 0; k < 3; k++) local[3 * r + k] = (1 - c) * u[r] * u[k] + (r == k ? c : 0.0);
    /* Rodrigues: c I + (1 - c) u u' + d [u]x with c = cos q, d = sin q; this line adds d [u]x. */
    local[1] -= d * u[2], local[2] += d * u[1], local[3] += d * u[2];
    local[5] -= d * u[0], local[6] -= d * u[1], local[7] += d * u[0];
    for (int r = 0; r < 3; r++)
      for (int k = 0; k < 3; k++)
        f->R[3 * r + k] = base[3 * r] * local[k] + base[3 * r + 1] * local[3 + k] + base[3 * r + 2] * local[6 + k];
  }
  for (long l = 0; l < s->n_links; l++) {
    const capsule *link = s->links + l;
    transform(m->frame + link->frame, link->first, m->ends + 6 * l);
    transform(m->frame + link->frame, link->second, m->ends + 6 * l + 3);
  }
}

/* Distances of a capsule's axis from the bounding boxes of W obstacles, from below and squared. */
I v squared_gaps(const double *boxes, long lanes, long o, const double *center, const double *half) {
  v sum = K(0), x[3];
  for (int i = 0; i < 3; i++) x[i] = center[i] - at(boxes + i * lanes + o);
  for (int i = 0; i < 3; i++) {
    /* Separating axes: along a face normal of the box, |x| - (extent of the capsule's axis) - (half size) is a lower
       bound of the distance. The gaps of three orthogonal normals add up as squares. */
    v along = K(0), reach = at(boxes + (3 + i) * lanes + o);
    for (int k = 0; k < 3; k++) {
      v r = at(boxes + (6 + 3 * k + i) * lanes + o);
      along += r * x[k];
    }
    v extent = K(0);
    for (int k = 0; k < 3; k++) extent += at(boxes + (6 + 3 * k + i) * lanes + o) * half[k];
    v gap = larger(vabs(along) - vabs(extent) - reach, K(0));
    sum += gap * gap;
  }
  return sum;
}

static double squared_segment_distance(const double *a, const double *b) { /* Ericson 2005, section 5.1.9 */
  double one[3], two[3], r[3], s = 0.0, t, sum = 0.0;
  less(a + 3, a, one), less(b + 3, b, two), less(a, b, r);
  double aa = dot(one, one), bb = dot(two, two), ab = dot(one, two), ar = dot(one, r), br = dot(two, r);
  /* s and t minimize |r + s one - t two|^2; a t that was clamped changes the best s. */
  double whole = aa * bb - ab * ab;
  if (whole > 1e-18) s = (ab * br - ar * bb) / whole, s = s < 0 ? 0 : s > 1 ? 1 : s;
  t = bb > 1e-18 ? (ab * s + br) / bb : 0.0, t = t < 0 ? 0 : t > 1 ? 1 : t;
  s = aa > 1e-18 ? (ab * t - ar) / aa : 0.0, s = s < 0 ? 0 : s > 1 ? 1 : s;
  for (int i = 0; i < 3; i++) {
    double x = r[i] + s * one[i] - t * two[i];
    sum += x * x;
  }
  return sum;
}

/* Measure a part and another body; the initial guess of the normal and the result are in the world frame. */
static void measure_bodies(const robot_scene *s, const body *a, const pose *fa, const body *b, const pose *fb,
                           double *guess, double limit, int contacts, polytope *work, contact *out) {
  couple c = {a, b, s->vertices};
  c.work = work;
  double between[3], normal[3];
  less(fb->p, fa->p, between);
  turn_back(fa->R, between, c.position);
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++)
      c.rotation[3 * i + k] = fa->R[i] * fb->R[k] + fa->R[3 + i] * fb->R[3 + k] + fa->R[6 + i] * fb->R[6 + k];
  /* The normal of the last state is close to the present one; without one, the line between the origins is as good as
     any. */
  if (dot(guess, guess) > 0) turn_back(fa->R, guess, out->normal);
  else {
    double length = sqrt(dot(c.position, c.position));
    for (int i = 0; i < 3; i++) out->normal[i] = length > 0 ? c.position[i] / length : 0.0;
  }
  /* A limit below minus the radii asks for a depth of the bodies without their radii, which only EPA measures. */
  measure(&c, limit, contacts || limit + a->radius + b->radius < 0, out);
  turn(fa->R, out->normal, normal);
  memcpy(guess, normal, sizeof normal);
}

typedef struct {
  long count, capacity, state; /* contacts of all states; -1 for no list: end at the first contact */
  long *pair, *k;
  double *distance, *normal, *points;
} contact_list;

/* Record a contact; `swapped` where the pair names the bodies in the opposite order. */
static void record(contact_list *list, long pair, const pose *f, const contact *found, const double *normal, int swapped) {
  if (list->count < list->capacity) {
    long i = list->count;
    double points[2][3];
    transform(f, found->on_a, points[swapped]), transform(f, found->on_b, points[!swapped]);
    list->pair[i] = pair, list->k[i] = list->state, list->distance[i] = found->distance;
    for (int m = 0; m < 3; m++) list->normal[3 * i + m] = swapped ? -normal[m] : normal[m];
    memcpy(list->points + 6 * i, points, sizeof points);
  }
  list->count++;
}

/* Whether the bounding spheres of two parts are further apart than `within`, so that the parts are too. */
static int spheres_are_apart(const body *one, const pose *f, const body *two, const pose *g, double within) {
  double a[3], b[3], between[3], reach = one->bound + two->bound + within;
  transform(f, one->position, a), transform(g, two->position, b);
  less(b, a, between);
  return reach < 0 || dot(between, between) > reach * reach;
}

/* Whether the bounding sphere of a part is further from the bounding box of obstacle o than `within`. */
static int sphere_is_clear(const robot_scene *s, const body *part, const pose *f, long o, double within) {
  const double *box = s->boxes + o;
  double center[3], from[3], sum = 0.0, reach = part->bound + box[15 * s->lanes] + within;
  transform(f, part->position, center);
  for (int i = 0; i < 3; i++) from[i] = center[i] - box[i * s->lanes];
  for (int i = 0; i < 3; i++) {
    double along = 0.0;
    for (int k = 0; k < 3; k++) along += box[(6 + 3 * k + i) * s->lanes] * from[k];
    double gap = fabs(along) - box[(3 + i) * s->lanes];
    sum += gap > 0 ? gap * gap : 0.0;
  }
  return reach < 0 || sum > reach * reach;
}

/* Find the contacts of moving parts and obstacles closer than `limit` plus what the link adds; without a list, return 1 at the
first one. */
static int meet_obstacles(const robot_scene *s, memory *m, double limit, contact_list *list) {
  /* From the tip to the base: the outer links sweep the most space, so an early exit comes soon. */
  for (long l = s->n_links - 1; l >= 0; l--) {
    const capsule *link = s->links + l;
    if (!link->frame) continue;
    const double *e = m->ends + 6 * l;
    double center[3], half[3], within = limit + s->added[l], reach = link->radius + within;
    if (!(within > -INFINITY)) continue;
    for (int i = 0; i < 3; i++) center[i] = (e[i] + e[3 + i]) / 2, half[i] = (e[3 + i] - e[i]) / 2;
    for (long o = 0; o < s->lanes; o += W) {
      v range = larger(reach + at(s->boxes + 15 * s->lanes + o), K(0));
      /* W obstacles at once: only bounding boxes closer than the capsule's radius and the limit are measured. */
      vi near = squared_gaps(s->boxes, s->lanes, o, center, half) <= range * range;
      for (int lane = 0; lane < W && o + lane < s->n_obstacles; lane++) {
        if (!near[lane]) continue;
        const body *obstacle = s->obstacles + o + lane;
        pose place;
        memcpy(place.R, obstacle->rotation, sizeof place.R);
        memcpy(place.p, obstacle->position, sizeof place.p);
        for (long i = s->first_part[l]; i < s->first_part[l + 1]; i++) {
          long part = s->part_of_link[i];
          if (sphere_is_clear(s, s->parts + part, m->frame + link->frame, o + lane, within)) continue;
          double *guess = m->obstacle_normal + 3 * (part * s->n_obstacles + o + lane);
          contact found = {0};
          measure_bodies(s, s->parts + part, m->frame + link->frame, obstacle, &place, guess, within, list != 0, m->work, &found);
          if (!(found.distance < within)) continue;
          if (!list) return 1;
          record(list, s->moving[part] * s->n_obstacles + o + lane, m->frame + link->frame, &found, guess, 1);
        }
      }
    }
  }
  return 0;
}

/* Find the contacts of links with each other closer than `limit` plus what the pair adds; see `meet_obstacles`. */
static int meet_itself(const robot_scene *s, memory *m, double limit, contact_list *list) {
  for (long i = 0; i < s->n_link_pairs; i++) {
    long a = s->link_pairs[2 * i], b = s->link_pairs[2 * i + 1];
    double within = limit + s->pair_added[i], reach = s->links[a].radius + s->links[b].radius + within;
    /* Two capsules that are farther apart than their radii and the limit contain parts that are so, too. */
    if (reach < 0 || squared_segment_distance(m->ends + 6 * a, m->ends + 6 * b) > reach * reach) continue;
    for (long k = s->first_pair[i]; k < s->first_pair[i + 1]; k++) {
      const body *one = s->parts + s->pairs[2 * k], *two = s->parts + s->pairs[2 * k + 1];
      const pose *f = m->frame + one->frame, *g = m->frame + two->frame;
      if (spheres_are_apart(one, f, two, g, within)) continue;
      contact found = {0};
      measure_bodies(s, one, f, two, g, m->pair_normal + 3 * k, within, list != 0, m->work, &found);
      if (!(found.distance < within)) continue;
      if (!list) return 1;
      record(list, k, f, &found, m->pair_normal + 3 * k, 0);
    }
  }
  return 0;
}

/* Whether a state keeps the distances; a group with a limit of -INFINITY is not checked. */
static int is_clear(const robot_scene *s, memory *m, const double *q, double obstacle_limit, double self_limit) {
  place_robot(s, q, m);
  if (obstacle_limit > -INFINITY && meet_obstacles(s, m, obstacle_limit, 0)) return 0;
  return !(self_limit > -INFINITY && meet_itself(s, m, self_limit, 0));
}

long clear_states(const robot_scene *s, const double *q, long count, double obstacle_limit, double self_limit,
                  unsigned char *clear) {
  memory *m = make_memory(s);
  if (!m) return OUT_OF_MEMORY;
  for (long k = 0; k < count; k++) clear[k] = is_clear(s, m, q + k * s->n, obstacle_limit, self_limit);
  free_memory(m);
  return 0;
}

/* Contacts of one group within a limit; returns their number, which may exceed the capacity of the arrays. */
long find_contacts(const robot_scene *s, const double *q, long count, double limit, int of_obstacles, long capacity,
                   long *pair, long *k, double *distance, double *normal, double *points) {
  memory *m = make_memory(s);
  if (!m) return OUT_OF_MEMORY;
  contact_list list = {0, capacity, 0, pair, k, distance, normal, points};
  for (; list.state < count; list.state++) {
    place_robot(s, q + list.state * s->n, m);
    if (of_obstacles) meet_obstacles(s, m, limit, &list);
    else meet_itself(s, m, limit, &list);
  }
  free_memory(m);
  return list.count;
}

/* Poses of the joints' frames, for tests: rotation and position, shape (count, n + 1, 12). */
long joint_poses(const robot_scene *s, const double *q, long count, double *out) {
  memory *m = make_memory(s);
  if (!m) return OUT_OF_MEMORY;
  for (long k = 0; k < count; k++) {
    place_robot(s, q + k * s->n, m);
    memcpy(out + 12 * (s->n + 1) * k, m->frame, (s->n + 1) * sizeof(pose));
  }
  free_memory(m);
  return 0;
}
