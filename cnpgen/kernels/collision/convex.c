/* Signed distances of two convex bodies, for handwritten C source; arrays.h precedes this file.

A body is the hull of vertices, a box or a flat cylinder along z, each with a radius around it: spheres and capsules are
boxes of size 0 with a radius. Distances come from GJK (Gilbert, Johnson and Keerthi 1988), penetration depths from EPA
(van den Bergen 2001), both without the radii, which are subtracted. Every returned distance is the separation of the
bodies along the returned normal. It is therefore never above the true distance, also where an iteration stops early. */

#include <stdlib.h>

#define HULL 0
#define BOX 1
#define CYLINDER 2
#define MAX_GJK_STEPS 64
#define MAX_EPA_POINTS 256
#define MAX_EPA_FACETS 1024
#define GJK_TOLERANCE 1e-10      /* m, of decisions */
#define RELATIVE_TOLERANCE 1e-13 /* of distances, whose normals need it */
#define EPA_TOLERANCE 1e-10 /* m */
#define MIN_GAP 1e-9 /* m, below which the bodies count as overlapping */
#define HULL_BLOCK 16 /* vertices of a block; see body_arrays.py */
#define MAX_BLOCKS 1024 /* of one hull */

typedef struct {
  long kind, count, first, frame, link; /* vertices: count, padded to cache lines, from index first on */
  long blocks; /* of a hull with many vertices, whose bounding spheres follow the vertices; otherwise 0 */
  double size[3], radius, rotation[9], position[3];
  double bound; /* of a part of a link: radius of the sphere around `position` that contains it */
} body;

typedef struct { double w[3], a[3]; } vertex; /* of the Minkowski difference a - b, with its point a */

typedef struct {
  double distance, normal[3], on_a[3], on_b[3]; /* unit normal from a to b, points of the bodies without their radii */
} contact;

typedef struct { int p[3]; double normal[3], distance; } facet;

typedef struct {
  vertex p[MAX_EPA_POINTS];
  facet f[MAX_EPA_FACETS];
  int edge[3 * MAX_EPA_FACETS][2];
} polytope;

typedef struct { /* the second body seen from the first one, and both bodies */
  const body *a, *b;
  const double *vertices;
  double rotation[9], position[3];
  polytope *work;
} couple;

I double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
I void less(const double *a, const double *b, double *c) { for (int i = 0; i < 3; i++) c[i] = a[i] - b[i]; }
I void cross(const double *a, const double *b, double *c) {
  c[0] = a[1] * b[2] - a[2] * b[1], c[1] = a[2] * b[0] - a[0] * b[2], c[2] = a[0] * b[1] - a[1] * b[0];
}
I void turn(const double *R, const double *x, double *y) {
  for (int i = 0; i < 3; i++) y[i] = R[3 * i] * x[0] + R[3 * i + 1] * x[1] + R[3 * i + 2] * x[2];
}
I void turn_back(const double *R, const double *x, double *y) {
  for (int i = 0; i < 3; i++) y[i] = R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2];
}

static void furthest_vertex(const double *p, long n, const double *d, double *out) {
  v best = at(p) * d[0] + at(p + n) * d[1] + at(p + 2 * n) * d[2];
  vi where = {0}, index;
  for (int i = 0; i < W; i++) where[i] = i;
  index = where;
  /* Each lane keeps the best of every W-th vertex; the lanes are compared at the end. */
  for (long k = W; k < n; k += W) {
    index += W;
    v reach = at(p + k) * d[0] + at(p + n + k) * d[1] + at(p + 2 * n + k) * d[2];
    vi more = reach > best;
    best = pick(more, reach, best);
    where = (more & index) | (~more & where);
  }
  int lane = 0; /* of equal ones the first vertex is taken, whatever the number of lanes */
  for (int i = 1; i < W; i++) {
    int first = best[i] == best[lane] && where[i] < where[lane];
    lane = best[i] > best[lane] || first ? i : lane;
  }
  for (int i = 0; i < 3; i++) out[i] = p[i * n + where[lane]];
}

/* The furthest of the n vertices p, which are sorted into blocks with bounding spheres (center c, radius r).

No vertex of a block is further than  reach = c . d + r |d|.  The block of the largest reach is searched first; of the
others only those that reach further than the furthest vertex so far. The result is that of a search through all vertices. */
static void furthest_vertex_of_blocks(const double *p, long n, long blocks, const double *d, double *out) {
  const double *sphere = p + 3 * n;
  double reach[MAX_BLOCKS], furthest = -INFINITY, length = sqrt(dot(d, d));
  long widest = 0, where = 0;
  for (long k = 0; k < blocks; k += W)
    put(reach + k, at(sphere + k) * d[0] + at(sphere + blocks + k) * d[1] + at(sphere + 2 * blocks + k) * d[2] +
                       at(sphere + 3 * blocks + k) * length);
  for (long k = 1; k < blocks; k++) widest = reach[k] > reach[widest] ? k : widest;
  for (long turn = -1; turn < blocks; turn++) {
    long block = turn < 0 ? widest : turn;
    if (turn == widest || !(reach[block] >= furthest)) continue;
    double along[HULL_BLOCK];
    for (long k = 0; k < HULL_BLOCK; k += W) {
      const double *x = p + HULL_BLOCK * block + k;
      put(along + k, at(x) * d[0] + at(x + n) * d[1] + at(x + 2 * n) * d[2]);
    }
    for (long k = 0; k < HULL_BLOCK; k++)
      if (along[k] > furthest) furthest = along[k], where = HULL_BLOCK * block + k;
  }
  for (int i = 0; i < 3; i++) out[i] = p[i * n + where];
}

/* The furthest point of a body in direction d, both in its own frame. */
I void support(const body *b, const double *vertices, const double *d, double *out) {
  if (b->kind == HULL && b->blocks) {
    furthest_vertex_of_blocks(vertices + b->first, b->count, b->blocks, d, out);
  } else if (b->kind == HULL) {
    furthest_vertex(vertices + b->first, b->count, d, out);
  } else if (b->kind == BOX) {
    for (int i = 0; i < 3; i++) out[i] = d[i] < 0 ? -b->size[i] : b->size[i];
  } else {
    /* A point on the rim of an end; its center where d is along the axis. */
    double length = sqrt(d[0] * d[0] + d[1] * d[1]), scale = length > 0 ? b->size[0] / length : 0.0;
    out[0] = scale * d[0], out[1] = scale * d[1], out[2] = d[2] < 0 ? -b->size[2] : b->size[2];
  }
}

/* The vertex of the difference that is furthest along -d. */
I void opposite_vertex(const couple *c, const double *d, vertex *p) {
  double back[3] = {-d[0], -d[1], -d[2]}, in_b[3], b[3], turned[3];
  /* In the Minkowski difference A - B, the support along -d is that of A along -d minus that of B along d. */
  support(c->a, c->vertices, back, p->a);
  turn_back(c->rotation, d, in_b);
  support(c->b, c->vertices, in_b, b);
  turn(c->rotation, b, turned);
  for (int i = 0; i < 3; i++) p->w[i] = p->a[i] - turned[i] - c->position[i];
}

/* Closest point to the origin on a triangle (Ericson 2005, section 5.1.5): its weights; returns the mask of vertices. */
static int closest_on_triangle(const double *a, const double *b, const double *c, double *t, double *out) {
  double ab[3], ac[3];
  less(b, a, ab), less(c, a, ac);
  /* d1 to d6 project the origin, seen from each corner, on ab and ac. va, vb, vc are the barycentric coordinates of its
     foot times |ab x ac|^2. Their signs give the Voronoi region: a corner, an edge, or the inside. */
  double d1 = -dot(ab, a), d2 = -dot(ac, a), d3 = -dot(ab, b), d4 = -dot(ac, b), d5 = -dot(ab, c), d6 = -dot(ac, c);
  double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
  t[0] = t[1] = t[2] = 0.0;
  if (d1 <= 0 && d2 <= 0) t[0] = 1;
  else if (d3 >= 0 && d4 <= d3) t[1] = 1;
  else if (vc <= 0 && d1 >= 0 && d3 <= 0) t[1] = d1 / (d1 - d3), t[0] = 1 - t[1];
  else if (d6 >= 0 && d5 <= d6) t[2] = 1;
  else if (vb <= 0 && d2 >= 0 && d6 <= 0) t[2] = d2 / (d2 - d6), t[0] = 1 - t[2];
  else if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) t[2] = (d4 - d3) / ((d4 - d3) + (d5 - d6)), t[1] = 1 - t[2];
  else {
    double whole = va + vb + vc;
    t[1] = vb / whole, t[2] = vc / whole, t[0] = 1 - t[1] - t[2];
  }
  for (int i = 0; i < 3; i++) out[i] = t[0] * a[i] + t[1] * b[i] + t[2] * c[i];
  return (t[0] > 0) | (t[1] > 0) << 1 | (t[2] > 0) << 2;
}

/* Reduce a simplex to the face that is closest to the origin; return 1 if the origin is inside. */
static int reduce(vertex *p, int *n, double *t, double *out) {
  static const int faces[4][4] = {{0, 1, 2, 3}, {0, 2, 3, 1}, {0, 1, 3, 2}, {1, 2, 3, 0}};
  int mask = 1;
  if (*n == 1) {
    t[0] = 1.0;
    memcpy(out, p[0].w, sizeof p[0].w);
  } else if (*n == 2) {
    double ab[3];
    less(p[1].w, p[0].w, ab);
    double along = -dot(p[0].w, ab), whole = dot(ab, ab);
    double f = along <= 0 ? 0.0 : along >= whole ? 1.0 : along / whole;
    for (int i = 0; i < 3; i++) out[i] = p[0].w[i] + f * ab[i];
    t[0] = 1 - f, t[1] = f;
    mask = (f < 1) | (f > 0) << 1;
  } else if (*n == 3) {
    mask = closest_on_triangle(p[0].w, p[1].w, p[2].w, t, out);
  } else {
    double best = INFINITY, weights[4] = {0};
    int outside = 0;
    for (int k = 0; k < 4; k++) {
      const int *f = faces[k];
      double ab[3], ac[3], ad[3], normal[3], w[3], s[3];
      less(p[f[1]].w, p[f[0]].w, ab), less(p[f[2]].w, p[f[0]].w, ac), less(p[f[3]].w, p[f[0]].w, ad);
      cross(ab, ac, normal);
      double origin = -dot(normal, p[f[0]].w), fourth = dot(normal, ad);
      /* The origin is on the same side of this face as the fourth vertex, so the face is not the closest one. If the
         fourth vertex is in the plane of the face, the side is unknown and the face is tested. */
      if (origin * fourth > 0 && fourth * fourth > 1e-24 * dot(normal, normal) * dot(ad, ad)) continue;
      outside = 1;
      int kept = closest_on_triangle(p[f[0]].w, p[f[1]].w, p[f[2]].w, s, w);
      if (dot(w, w) < best) {
        best = dot(w, w);
        mask = 0;
        memset(weights, 0, sizeof weights);
        for (int i = 0; i < 3; i++)
          if (kept >> i & 1) mask |= 1 << f[i], weights[f[i]] = s[i];
        memcpy(out, w, sizeof w);
      }
    }
    if (!outside) return 1;
    memcpy(t, weights, sizeof weights);
  }
  int kept = 0;
  for (int i = 0; i < *n; i++)
    if (mask >> i & 1) p[kept] = p[i], t[kept++] = t[i];
  *n = kept;
  return 0;
}

/* Make a facet with its normal away from a point inside; return 0 if it has no area. */
static int make_facet(facet *f, const vertex *p, int i, int j, int k, const double *inside) {
  double ab[3], ac[3], from[3];
  less(p[j].w, p[i].w, ab), less(p[k].w, p[i].w, ac);
  cross(ab, ac, f->normal);
  double length = sqrt(dot(f->normal, f->normal));
  /* The area relative to the edges: slivers have a normal that is rounding error. */
  if (!(length > 1e-14 * sqrt(dot(ab, ab) * dot(ac, ac)) && length > 1e-20)) return 0;
  for (int m = 0; m < 3; m++) f->normal[m] /= length;
  less(p[i].w, inside, from);
  int flipped = dot(f->normal, from) < 0;
  for (int m = 0; flipped && m < 3; m++) f->normal[m] = -f->normal[m];
  f->p[0] = i, f->p[1] = flipped ? k : j, f->p[2] = flipped ? j : k;
  f->distance = dot(f->normal, p[i].w);
  return 1;
}

/* Extend a simplex of n vertices to a tetrahedron; return whether that is possible. */
static int make_tetrahedron(const couple *c, vertex *p, int n) {
  /* Degenerate simplices grow along directions that are perpendicular to what they span, in both senses. */
  for (int guess = 0; n < 4 && guess < 12; guess++) {
    double d[3] = {0};
    if (n < 3) {
      double e[3] = {0}, line[3] = {0.3, -0.5, 0.8};
      e[guess / 2 % 3] = 1.0;
      if (n == 2) less(p[1].w, p[0].w, line);
      cross(line, e, d);
      if (n < 2) memcpy(d, e, sizeof d);
    } else {
      double ab[3], ac[3];
      less(p[1].w, p[0].w, ab), less(p[2].w, p[0].w, ac);
      cross(ab, ac, d);
    }
    for (int i = 0; guess % 2 && i < 3; i++) d[i] = -d[i];
    double length = sqrt(dot(d, d)), from[3], off[3];
    if (!(length > 1e-16)) continue;
    for (int i = 0; i < 3; i++) d[i] /= length;
    opposite_vertex(c, d, p + n);
    less(p[n].w, p[0].w, from);
    double height;
    if (n == 1) height = sqrt(dot(from, from));
    else if (n == 2) {
      double ab[3];
      less(p[1].w, p[0].w, ab);
      cross(ab, from, off);
      height = sqrt(dot(off, off) / dot(ab, ab));
    } else height = fabs(dot(from, d));
    /* A vertex in the span of the others adds no dimension; try the next direction. */
    if (height > 1e-9) n++, guess = -1;
  }
  return n == 4;
}

/* Points of both bodies for a facet; coplanar facets may contain the foot of the origin in its place. */
static void find_points(const polytope *work, int facets, const facet *near, double depth, contact *out) {
  double least = INFINITY;
  for (int k = 0; k < facets; k++) {
    const facet *f = work->f + k;
    const vertex *p[3] = {work->p + f->p[0], work->p + f->p[1], work->p + f->p[2]};
    double t[3], from[3][3], off[3];
    /* Coplanar facets have equal distances up to rounding. */
    if (f->distance > near->distance + EPA_TOLERANCE) continue;
    for (int m = 0; m < 3; m++)
      for (int i = 0; i < 3; i++) from[m][i] = p[m]->w[i] - near->distance * near->normal[i];
    closest_on_triangle(from[0], from[1], from[2], t, off);
    if (dot(off, off) >= least) continue;
    least = dot(off, off);
    for (int i = 0; i < 3; i++) {
      out->on_a[i] = t[0] * p[0]->a[i] + t[1] * p[1]->a[i] + t[2] * p[2]->a[i];
      /* The points of both bodies differ by the depth along the normal. */
      out->on_b[i] = out->on_a[i] - depth * near->normal[i];
    }
  }
}

/* Penetration of two bodies from the last simplex of GJK; return 0 if no tetrahedron contains the origin. */
static int penetration(const couple *c, const vertex *simplex, int n, contact *out) {
  polytope *work = c->work;
  vertex *p = work->p;
  facet *f = work->f;
  int points = 4, facets = 0;
  memcpy(p, simplex, n * sizeof *p);
  if (!make_tetrahedron(c, p, n)) return 0;
  double inside[3];
  for (int i = 0; i < 3; i++) inside[i] = (p[0].w[i] + p[1].w[i] + p[2].w[i] + p[3].w[i]) / 4;
  for (int i = 0; i < 4; i++) facets += make_facet(f + facets, p, i, (i + 1) % 4, (i + 2) % 4, inside);
  double best = INFINITY;
  /* Expanding polytope: the facet nearest to the origin bounds the depth from below, its support point from above. */
  while (facets == 4 || points > 4) {
    int least = 0;
    for (int i = 1; i < facets; i++) least = f[i].distance < f[least].distance ? i : least;
    facet near = f[least];
    double back[3] = {-near.normal[0], -near.normal[1], -near.normal[2]};
    vertex *fresh = p + points;
    opposite_vertex(c, back, fresh);
    double reach = dot(near.normal, fresh->w);
    /* The separation along any normal is an upper bound of the depth: keep the best one, and its points. */
    if (reach < best || reach - near.distance <= EPA_TOLERANCE) {
      best = reach, out->distance = -reach;
      memcpy(out->normal, near.normal, sizeof near.normal);
      find_points(work, facets, &near, reach, out);
    }
    if (reach - near.distance <= EPA_TOLERANCE || points == MAX_EPA_POINTS - 1) break;
    /* Remove the facets that see the new vertex. An edge of two removed facets occurs in both directions; the edges that
       occur once are the outline, which the new facets join to the vertex. */
    int edges = 0, kept = 0, full = 0;
    for (int i = 0; i < facets; i++) {
      if (dot(f[i].normal, fresh->w) - f[i].distance <= 1e-14) { f[kept++] = f[i]; continue; }
      for (int m = 0; m < 3; m++) {
        int from = f[i].p[m], to = f[i].p[(m + 1) % 3], twin = -1;
        for (int e = 0; e < edges && twin < 0; e++)
          if (work->edge[e][0] == to && work->edge[e][1] == from) twin = e;
        if (twin >= 0) {
          edges--;
          work->edge[twin][0] = work->edge[edges][0], work->edge[twin][1] = work->edge[edges][1];
        } else work->edge[edges][0] = from, work->edge[edges][1] = to, edges++;
      }
    }
    facets = kept, points++;
    for (int e = 0; e < edges && !full; e++) {
      if (facets == MAX_EPA_FACETS) full = 1;
      else facets += make_facet(f + facets, p, work->edge[e][0], work->edge[e][1], points - 1, inside);
    }
    if (!edges || full || !facets) break;
  }
  return best < INFINITY;
}

/* Signed distance of two bodies, with normal and points in the frame of the first one.

Where it exceeds `limit`, only a lower bound above the limit and its normal are returned. `normal` is the initial guess. With
`contacts` 0, overlaps of the bodies without their radii have distance -INFINITY, and there are no points. */
static void measure(const couple *c, double limit, int contacts, contact *out) {
  vertex p[5];
  double d[3], t[4], radii = c->a->radius + c->b->radius, best = -INFINITY, core = limit + radii, old = INFINITY;
  int n = 0, overlap = 0;
  /* The last normal of this pair starts the iteration: from state to state it changes little, and one step often
     decides. */
  for (int i = 0; i < 3; i++) d[i] = -out->normal[i];
  if (!(dot(d, d) > 0.5)) d[0] = 1.0, d[1] = d[2] = 0.0;
  for (int step = 0; step < MAX_GJK_STEPS; step++) {
    double size = sqrt(dot(d, d));
    opposite_vertex(c, d, p + n);
    /* The support plane of d separates the origin from the difference: a lower bound of the distance. */
    double lower = dot(d, p[n].w) / size;
    if (lower > best) {
      best = lower;
      for (int i = 0; i < 3; i++) out->normal[i] = -d[i] / size;
      if (best > core) break;
    }
    /* Upper bound |d| and lower bound agree. */
    if (n && size - lower <= (contacts ? RELATIVE_TOLERANCE * size : GJK_TOLERANCE)) break;
    /* A vertex that is known already improves nothing, up to rounding. */
    int known = 0;
    for (int i = 0; i < n; i++) known |= !memcmp(p[i].w, p[n].w, sizeof p[n].w);
    if (known) break;
    n++;
    if ((overlap = reduce(p, &n, t, d))) break;
    double now = dot(d, d);
    if ((overlap = now < MIN_GAP * MIN_GAP)) break;
    /* Only the decision is needed: the upper bound is below the limit. */
    if (!contacts && now <= core * core && core > 0) { best = sqrt(now); break; }
    if (now >= old) break; /* rounding errors */
    old = now;
  }
  if (overlap && contacts) {
    contact inner = {0};
    if (penetration(c, p, n, &inner) && inner.distance >= best - MIN_GAP) {
      *out = inner;
      out->distance -= radii;
      return;
    }
  }
  out->distance = overlap && !contacts ? -INFINITY : best - radii;
  if (best > core || !contacts) return;
  memset(out->on_a, 0, sizeof out->on_a);
  /* The point of A has the weights of the closest point of the simplex; that of B lies the distance farther along the
     normal. */
  double share = 0.0;
  for (int i = 0; i < n; i++) {
    share += t[i];
    for (int m = 0; m < 3; m++) out->on_a[m] += t[i] * p[i].a[m];
  }
  for (int m = 0; m < 3; m++) out->on_a[m] /= share, out->on_b[m] = out->on_a[m] + best * out->normal[m];
}
