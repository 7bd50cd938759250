/* Observations of scenes of boxes, spheres, flat cylinders, capsules and convex meshes: signed distances of points, points on
surfaces, and depth images. arrays.h precedes this file. Loops run over points, in single precision. */

#include <stdint.h>
#include <stdlib.h>

#define BLOCK 512 /* points whose temporary arrays stay in the cache */
#define BOX 0
#define CYLINDER 2
#define MESH 4 /* the first mesh */
#define MAX_PATCHES 6 /* of a body that is no mesh */
#define UNIT (1.0f / 16777216.0f) /* 24 bits */

typedef struct { /* arrays of N scenes with M bodies; a negative kind is no body */
  long scenes, bodies;
  const long *kind;
  const double *center, *rotation, *size;
  const long *first_triangle, *first_plane; /* of each mesh, and after the last one */
  const float *triangles, *planes; /* a corner and two edges (9); normal and offset (4) */
} scene_arrays;

typedef struct { float c[3], R[9], s[3]; long kind, triangles, planes; const float *triangle, *plane; } primitive;

I primitive primitive_of(const scene_arrays *a, long index) {
  primitive b = {.kind = a->kind[index]};
  if (b.kind >= MESH) {
    const long *triangle = a->first_triangle + b.kind - MESH, *plane = a->first_plane + b.kind - MESH;
    b.triangle = a->triangles + 9 * triangle[0], b.triangles = triangle[1] - triangle[0];
    b.plane = a->planes + 4 * plane[0], b.planes = plane[1] - plane[0];
  }
  for (int i = 0; i < 3; i++) b.c[i] = a->center[3 * index + i], b.s[i] = a->size[3 * index + i];
  for (int i = 0; i < 9; i++) b.R[i] = a->rotation[9 * index + i];
  return b;
}

I float most(float a, float b) { return a > b ? a : b; }
I float least(float a, float b) { return a < b ? a : b; }

/* Smallest squared distances of n points from the triangles of a mesh, in its frame. */
static void triangle_distances(const primitive *b, const float *x, const float *y, const float *z, long n, float *squared) {
  EACH(i, 0, n) squared[i] = INFINITY;
  for (long t = 0; t < b->triangles; t++) {
    const float *corner = b->triangle + 9 * t, *e = corner + 3, *f = corner + 6;
    /* The normal and edges need no square root: side planes of the edges decide whether the foot of a point is in the
       triangle. */
    float normal[3] = {e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]};
    float starts[3][3], edges[3][3], sides[3][3], lengths[3], area = 0;
    for (int m = 0; m < 3; m++) {
      starts[0][m] = corner[m], starts[1][m] = corner[m] + e[m], starts[2][m] = corner[m] + f[m];
      edges[0][m] = e[m], edges[1][m] = f[m] - e[m], edges[2][m] = -f[m];
      area += normal[m] * normal[m];
    }
    for (int k = 0; k < 3; k++) {
      const float *g = edges[k];
      for (int m = 0; m < 3; m++) sides[k][m] = normal[(m + 1) % 3] * g[(m + 2) % 3] - normal[(m + 2) % 3] * g[(m + 1) % 3];
      lengths[k] = 1 / (g[0] * g[0] + g[1] * g[1] + g[2] * g[2]);
    }
    EACH(i, 0, n) {
      float nearest = INFINITY, above = 1, plane = 0;
      for (int k = 0; k < 3; k++) {
        const float *g = edges[k], *s = sides[k];
        float u = x[i] - starts[k][0], v = y[i] - starts[k][1], w = z[i] - starts[k][2];
        float along = least(most((u * g[0] + v * g[1] + w * g[2]) * lengths[k], 0.0f), 1.0f);
        /* The foot is inside if the point is on the inner side of all three planes through an edge and along the normal. */
        above = u * s[0] + v * s[1] + w * s[2] >= 0 ? above : 0;
        if (k == 0) plane = u * normal[0] + v * normal[1] + w * normal[2];
        u -= along * g[0], v -= along * g[1], w -= along * g[2];
        nearest = least(nearest, u * u + v * v + w * w);
      }
      /* Inside, the squared distance from the plane is (n . u)^2 / |n|^2; else the nearest edge counts. */
      squared[i] = least(squared[i], above > 0 ? plane * plane / area : nearest);
    }
  }
}

#define LOCAL(i, k) \
  float p##k = b->R[k] * (x[i] - b->c[0]) + b->R[3 + k] * (y[i] - b->c[1]) + b->R[6 + k] * (z[i] - b->c[2]);

/* Lower the distances of n points, at most BLOCK, to those of a mesh; its arrays would slow down the loops of other kinds. */
static __attribute__((noinline)) void lower_mesh_distances(const primitive *b, const float *x, const float *y, const float *z,
                                                           long n, float *distance) {
  float px[BLOCK], py[BLOCK], pz[BLOCK], depth[BLOCK], squared[BLOCK];
  int outside = 0;
  EACH(i, 0, n) {
    LOCAL(i, 0) LOCAL(i, 1) LOCAL(i, 2)
    px[i] = p0, py[i] = p1, pz[i] = p2, depth[i] = -INFINITY;
  }
  /* Inside the hull the depth is the largest signed distance from a plane, and exact. */
  for (const float *c = b->plane; c < b->plane + 4 * b->planes; c += 4)
    EACH(i, 0, n) depth[i] = most(depth[i], c[0] * px[i] + c[1] * py[i] + c[2] * pz[i] + c[3]);
  EACH(i, 0, n) outside |= depth[i] > 0 && depth[i] < distance[i]; /* planes are never farther than the mesh */
  if (outside) triangle_distances(b, px, py, pz, n, squared);
  EACH(i, 0, n) distance[i] = least(distance[i], outside && depth[i] > 0 ? sqrtf(squared[i]) : depth[i]);
}

/* Lower the distances of n points, at most BLOCK, to those of a body that is no mesh. */
static void lower_distances(const primitive *b, const float *x, const float *y, const float *z, long n, float *distance) {
  float r = b->s[0], h = b->s[1];
  if (b->kind == BOX) {
    EACH(i, 0, n) {
      LOCAL(i, 0) LOCAL(i, 1) LOCAL(i, 2)
      /* |p| - size along each axis: outside, the positive parts are the vector to the box; inside, the largest is the
         depth. */
      float u = fabsf(p0) - b->s[0], v = fabsf(p1) - b->s[1], w = fabsf(p2) - b->s[2];
      float inside = least(most(most(u, v), w), 0.0f);
      u = most(u, 0.0f), v = most(v, 0.0f), w = most(w, 0.0f);
      distance[i] = least(distance[i], sqrtf(u * u + v * v + w * w) + inside);
    }
  } else if (b->kind == CYLINDER) {
    EACH(i, 0, n) {
      LOCAL(i, 0) LOCAL(i, 1) LOCAL(i, 2)
      /* A box in the coordinates (distance from the axis, height). */
      float u = sqrtf(p0 * p0 + p1 * p1) - r, w = fabsf(p2) - h, inside = least(most(u, w), 0.0f);
      u = most(u, 0.0f), w = most(w, 0.0f);
      distance[i] = least(distance[i], sqrtf(u * u + w * w) + inside);
    }
  } else {
    EACH(i, 0, n) {
      LOCAL(i, 0) LOCAL(i, 1) LOCAL(i, 2)
      /* Distance from the axis segment minus the radius; a sphere has h = 0. */
      float w = most(fabsf(p2) - h, 0.0f);
      distance[i] = least(distance[i], sqrtf(p0 * p0 + p1 * p1 + w * w) - r);
    }
  }
#undef LOCAL
}

/* Smallest signed distances of points from the bodies of each scene; points: coordinates by rows, of each scene or shared. */
void scene_distances(const scene_arrays *a, const float *points, long count, int shared, float *distance) {
  EACH(scene, 0, a->scenes) {
    const float *x = points + (shared ? 0 : 3 * count * scene);
    float *out = distance + scene * count;
    for (long first = 0; first < count; first += BLOCK) {
      long n = count - first < BLOCK ? count - first : BLOCK;
      EACH(i, 0, n) out[first + i] = INFINITY;
      EACH(body, 0, a->bodies) {
        primitive b = primitive_of(a, scene * a->bodies + body);
        const float *from[3] = {x + first, x + count + first, x + 2 * count + first};
        if (b.kind >= MESH) lower_mesh_distances(&b, from[0], from[1], from[2], n, out + first);
        else if (b.kind >= 0) lower_distances(&b, from[0], from[1], from[2], n, out + first);
      }
    }
  }
}

I uint64_t mixed(uint64_t x) { /* finalizer of splitmix64 (Steele et al. 2014) */
  x += 0x9e3779b97f4a7c15u;
  x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9u;
  x = (x ^ x >> 27) * 0x94d049bb133111ebu;
  return x ^ x >> 31;
}

typedef struct { /* base + u U + v V; if round, base + radius(v) (cos, sin)(2 pi u) in the axes U, V + height(v) Z */
  float base[3], U[3], V[3], Z[3], r, h;
  int form; /* 0 flat, 1 side of a cylinder, 2 disc, 3 half of a sphere, 4 triangle */
  double area;
} patch;

/* Patches of the surface of a body; returns their number. */
static int patches_of(const primitive *b, patch *p) {
  double r = b->s[0], h = b->s[1], pi = 3.14159265358979323846;
  for (const float *c = b->triangle; b->kind >= MESH && c < b->triangle + 9 * b->triangles; c += 9, p++) {
    const float *e = c + 3, *f = c + 6;
    double x = e[1] * f[2] - e[2] * f[1], y = e[2] * f[0] - e[0] * f[2], z = e[0] * f[1] - e[1] * f[0];
    /* Half the length of the cross product of two edges. */
    p->form = 4, p->area = sqrt(x * x + y * y + z * z) / 2;
    for (int m = 0; m < 3; m++) {
      const float *R = b->R + 3 * m;
      p->base[m] = b->c[m] + R[0] * c[0] + R[1] * c[1] + R[2] * c[2];
      p->U[m] = R[0] * e[0] + R[1] * e[1] + R[2] * e[2], p->V[m] = R[0] * f[0] + R[1] * f[1] + R[2] * f[2];
    }
  }
  if (b->kind >= MESH) return b->triangles;
  if (b->kind == BOX) {
    for (int k = 0; k < 3; k++) {
      int i = (k + 1) % 3, j = (k + 2) % 3;
      for (int side = 0; side < 2; side++, p++) {
        p->form = 0, p->area = 4.0 * b->s[i] * b->s[j];
        for (int m = 0; m < 3; m++) {
          float U = b->R[3 * m + i] * b->s[i], V = b->R[3 * m + j] * b->s[j];
          p->base[m] = b->c[m] + (side ? 1 : -1) * b->R[3 * m + k] * b->s[k] - U - V;
          p->U[m] = 2 * U, p->V[m] = 2 * V;
        }
      }
    }
    return 6;
  }
  for (int k = 0; k < 3; k++, p++) {
    float side = k == 0 ? 0.0f : k == 1 ? -1.0f : 1.0f;
    p->form = k == 0 ? 1 : b->kind == CYLINDER ? 2 : 3;
    /* Lateral area 2 pi r (2 h), an end pi r^2, half a sphere 2 pi r^2. */
    p->area = k == 0 ? 4 * pi * r * h : b->kind == CYLINDER ? pi * r * r : 2 * pi * r * r;
    p->r = r, p->h = k == 0 ? 2 * h : side * r;
    for (int m = 0; m < 3; m++) {
      p->U[m] = b->R[3 * m], p->V[m] = b->R[3 * m + 1], p->Z[m] = b->R[3 * m + 2];
      p->base[m] = b->c[m] + (k == 0 ? -(float)h : side * (float)h) * p->Z[m];
    }
  }
  return 3;
}

/* Write n points of a patch: a Kronecker sequence of two irrational steps from a random start. */
static void scatter(const patch *p, uint64_t start, long n, float *out) {
  uint32_t first = start >> 32, second = start;
  float x[BLOCK], y[BLOCK], z[BLOCK], limit = p->form == 4 ? 1.0f : 3.0f; /* of u + v in a triangle */
  int flat = p->form == 0 || p->form == 4;
  for (long done = 0; done < n; done += BLOCK) {
    long count = n - done < BLOCK ? n - done : BLOCK;
    EACH(i, 0, count) {
      /* Wrapping integers are the fractional parts: alpha = 2^32 / phi and 2^32 / phi^2 of the plastic number (Roberts
         2018). */
      uint32_t k = done + i;
      float u = (float)(int32_t)((first + k * 3242174889u) >> 8) * UNIT;
      float v = (float)(int32_t)((second + k * 2447445414u) >> 8) * UNIT;
      if (flat) {
        /* Points in the other half of the parallelogram are reflected into the triangle, which keeps them uniform. */
        int far = u > limit - v;
        u = far ? 1 - u : u, v = far ? 1 - v : v;
        x[i] = p->base[0] + u * p->U[0] + v * p->V[0];
        y[i] = p->base[1] + u * p->U[1] + v * p->V[1];
        z[i] = p->base[2] + u * p->U[2] + v * p->V[2];
      } else {
        /* cos and sin of half the angle by Taylor polynomials on [-pi/2, pi/2], then the double angle: no call, so the
           loop vectorizes. */
        float t = 3.14159265f * (u - 0.5f), q = t * t;
        float s = t * (1 + q * (-1 / 6.0f + q * (1 / 120.0f + q * (-1 / 5040.0f + q * (1 / 362880.0f - q / 39916800.0f)))));
        float c = 1 + q * (-0.5f + q * (1 / 24.0f + q * (-1 / 720.0f + q * (1 / 40320.0f - q / 3628800.0f))));
        /* Uniform in area: radius sqrt(v) on a disc; on a sphere the height is uniform (Archimedes). */
        float scale = p->form == 1 ? 1.0f : p->form == 2 ? sqrtf(v) : sqrtf(1 - v * v);
        float height = p->form == 2 ? 0.0f : v * p->h;
        float a = p->r * scale * (c * c - s * s), b = 2 * p->r * scale * s * c;
        x[i] = p->base[0] + a * p->U[0] + b * p->V[0] + height * p->Z[0];
        y[i] = p->base[1] + a * p->U[1] + b * p->V[1] + height * p->Z[1];
        z[i] = p->base[2] + a * p->U[2] + b * p->V[2] + height * p->Z[2];
      }
    }
    float *to = out + 3 * done;
    EACH(i, 0, count) to[3 * i] = x[i], to[3 * i + 1] = y[i], to[3 * i + 2] = z[i];
  }
}

enum { OUT_OF_MEMORY = -1 }; /* result of functions that allocate memory */

/* Points on the surfaces of each scene, in proportion to the areas of the patches; nan for a scene without bodies. */
long scene_clouds(const scene_arrays *a, const uint64_t *seed, long count, float *points) {
  long most_patches = 0;
  EACH(scene, 0, a->scenes) {
    long sum = 0;
    EACH(body, 0, a->bodies) {
      long mesh = a->kind[scene * a->bodies + body] - MESH;
      sum += mesh >= 0 ? a->first_triangle[mesh + 1] - a->first_triangle[mesh] : MAX_PATCHES;
    }
    most_patches = sum > most_patches ? sum : most_patches;
  }
  patch *p = malloc((most_patches + 1) * sizeof *p);
  if (!p) return OUT_OF_MEMORY;
  EACH(scene, 0, a->scenes) {
    float *out = points + 3 * count * scene;
    double area = 0, sum = 0, offset = (double)(mixed(seed[scene]) >> 11) / 9007199254740992.0;
    long patches = 0, before = 0;
    EACH(body, 0, a->bodies) {
      primitive b = primitive_of(a, scene * a->bodies + body);
      if (b.kind >= 0) patches += patches_of(&b, p + patches);
    }
    EACH(k, 0, patches) area += p[k].area;
    if (!patches) EACH(i, 0, 3 * count) out[i] = NAN;
    EACH(k, 0, patches) {
      sum += p[k].area;
      /* Systematic rounding: a random offset shared by all patches, so the counts add up and have the right expectation. */
      long end = k == patches - 1 ? count : (long)(sum / area * count + offset);
      end = end > count ? count : end < before ? before : end;
      scatter(p + k, mixed(seed[scene] + k + 1), end - before, out + 3 * before);
      before = end;
    }
  }
  free(p);
  return 0;
}

typedef struct { double origin[3], axes[9]; /* rows: forward, right, down; the last two times half the image's extent */ } view;

/* Range of pixels in which the bounding box of a body is seen; the whole image where a corner is not before the camera. */
static void seen(const primitive *b, const double *o, const double *axes, long width, long height, long *range) {
  double half[3] = {b->s[0], b->s[1], b->s[2]}, low[2] = {INFINITY, INFINITY}, high[2] = {-INFINITY, -INFINITY};
  if (b->kind != BOX && b->kind < MESH) half[0] = half[1] = b->s[0], half[2] = b->s[1] + (b->kind == CYLINDER ? 0 : b->s[0]);
  long behind = 0, size[2] = {width, height};
  for (int corner = 0; corner < 8; corner++) {
    double d[3], along[3];
    for (int m = 0; m < 3; m++) {
      d[m] = o[m];
      for (int k = 0; k < 3; k++) d[m] += b->R[3 * m + k] * (corner >> k & 1 ? half[k] : -half[k]);
    }
    for (int k = 0; k < 3; k++) {
      const double *axis = axes + 3 * k;
      along[k] = (axis[0] * d[0] + axis[1] * d[1] + axis[2] * d[2]) / (axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2]);
    }
    /* A corner behind the camera has no projection; the whole image is then in the range. */
    if (along[0] < 1e-6) { behind++; continue; }
    for (int k = 0; k < 2; k++) {
      double place = along[1 + k] / along[0];
      low[k] = place < low[k] ? place : low[k], high[k] = place > high[k] ? place : high[k];
    }
  }
  for (int k = 0; k < 2; k++) {
    /* One pixel more on each side, because pixels are tested at their centers. */
    double first = behind ? 0 : floor((low[k] + 1) / 2 * size[k] - 1), last = behind ? size[k] : ceil((high[k] + 1) / 2 * size[k] + 1);
    range[2 * k] = behind == 8 || first > size[k] ? size[k] : first < 0 ? 0 : first;
    range[2 * k + 1] = last > size[k] ? size[k] : last < 0 ? 0 : last;
  }
}

/* Lower the depths of the pixels first to last of a row; o, d: the camera and the ray of pixel 0, e: its change per pixel. */
static void lower_depths(const primitive *b, const float *o, const float *d, const float *e, long first, long last, float *depth) {
  float r = b->s[0], h = b->s[1];
/* A ray parallel to a face has no intersection with it; a tiny slope replaces the division by 0. */
#define RAY(i, k) float d##k = d[k] + (float)(int)(i) * e[k]; d##k = fabsf(d##k) < 1e-9f ? 1e-9f : d##k;
#define HIT(i, near, far) depth[i] = (near) <= (far) && (near) > 0 && (near) < depth[i] ? (near) : depth[i];
  if (b->kind == BOX) {
    EACH(i, first, last) {
      RAY(i, 0) RAY(i, 1) RAY(i, 2)
      /* Slab method: the ray is inside a box between the last entry and the first exit. |1 / d| size is half the time of
         a slab. */
      float x = 1 / d0, y = 1 / d1, z = 1 / d2, mx = -o[0] * x, my = -o[1] * y, mz = -o[2] * z;
      float wx = fabsf(x) * b->s[0], wy = fabsf(y) * b->s[1], wz = fabsf(z) * b->s[2];
      float near = most(most(mx - wx, my - wy), mz - wz), far = least(least(mx + wx, my + wy), mz + wz);
      HIT(i, near, far)
    }
    return;
  }
  if (b->kind >= MESH) {
    EACH(i, first, last) {
      RAY(i, 0) RAY(i, 1) RAY(i, 2)
      float near = -INFINITY, far = INFINITY;
      for (long k = 0; k < b->planes; k++) {
        const float *c = b->plane + 4 * k;
        float speed = c[0] * d0 + c[1] * d1 + c[2] * d2, height = c[0] * o[0] + c[1] * o[1] + c[2] * o[2] + c[3];
        /* Planes that the ray enters bound the hit from below, those that it leaves from above. */
        float crossing = -height / (fabsf(speed) < 1e-9f ? (speed < 0 ? -1e-9f : 1e-9f) : speed);
        near = speed < 0 ? most(near, crossing) : near;
        far = speed < 0 ? far : least(far, crossing);
      }
      HIT(i, near, far)
    }
    return;
  }
  EACH(i, first, last) {
    RAY(i, 0) RAY(i, 1) RAY(i, 2)
    float a = d0 * d0 + d1 * d1, f = o[0] * d0 + o[1] * d1, z = 1 / d2, mid = -o[2] * z, width = fabsf(z) * h;
    /* Quadratic a t^2 + 2 f t + |o|^2 - r^2 = 0. Its discriminant is a r^2 - (o x d)^2, without cancellation for distant
       cameras. */
    float cross = o[0] * d1 - o[1] * d0, root = a * r * r - cross * cross; /* Lagrange's identity */
    float s = sqrtf(most(root, 0.0f)), enter = (-f - s) / a, leave = (-f + s) / a;
    if (b->kind == CYLINDER) {
      float near = most(enter, mid - width), far = root < 0 ? -1.0f : least(leave, mid + width);
      HIT(i, near, far)
    } else {
      /* A capsule: its side where the hit lies between the ends, and the spheres around both ends. */
      float there = fabsf(o[2] + enter * d2) <= h && root >= 0 ? enter : -1.0f;
      HIT(i, there, there)
      float whole = a + d2 * d2;
      for (int end = -1; end <= 1; end += 2) {
        float w = o[2] - end * h, g = f + w * d2, n0 = o[1] * d2 - w * d1, n1 = w * d0 - o[0] * d2;
        float rest = whole * r * r - (n0 * n0 + n1 * n1 + cross * cross);
        float ball = rest < 0 ? -1.0f : (-g - sqrtf(most(rest, 0.0f))) / whole;
        HIT(i, ball, ball)
      }
    }
  }
#undef RAY
#undef HIT
}

/* Distances along the camera's axis at the centers of the pixels, inf where nothing is seen; cameras are inside no body. */
void scene_depths(const scene_arrays *a, const view *camera, long width, long height, float *depth) {
  EACH(scene, 0, a->scenes) {
    float *image = depth + scene * width * height;
    EACH(i, 0, width * height) image[i] = INFINITY;
    EACH(body, 0, a->bodies) {
      primitive b = primitive_of(a, scene * a->bodies + body);
      if (b.kind < 0) continue;
      double from[3], axis[3][3];
      float o[3], d[3], e[3];
      long range[4];
      /* Camera and rays in the frame of the body, where its faces are coordinate planes. */
      for (int m = 0; m < 3; m++) from[m] = a->center[3 * (scene * a->bodies + body) + m] - camera->origin[m];
      seen(&b, from, camera->axes, width, height, range);
      for (int k = 0; k < 3; k++) {
        o[k] = 0;
        for (int m = 0; m < 3; m++) o[k] -= b.R[3 * m + k] * from[m];
        for (int n = 0; n < 3; n++) {
          axis[n][k] = 0;
          for (int m = 0; m < 3; m++) axis[n][k] += b.R[3 * m + k] * camera->axes[3 * n + m];
        }
        e[k] = axis[1][k] * 2 / width;
      }
      EACH(y, range[2], range[3]) {
        for (int k = 0; k < 3; k++)
          d[k] = axis[0][k] + axis[1][k] * (1.0 / width - 1) + axis[2][k] * ((2.0 * y + 1) / height - 1);
        lower_depths(&b, o, d, e, range[0], range[1], image + y * width);
      }
    }
  }
}

/* Points of depth images, evenly distributed over the pixels that see a body; nan if there are none. */
long depth_clouds(long scenes, const view *camera, long width, long height, const float *depth, const uint64_t *seed,
                  long count, float *points) {
  int *pixel = malloc((width * height + 1) * sizeof *pixel);
  if (!pixel) return OUT_OF_MEMORY;
  EACH(scene, 0, scenes) {
    const float *image = depth + scene * width * height;
    float *out = points + 3 * count * scene;
    double offset = (double)(mixed(seed[scene]) >> 11) / 9007199254740992.0;
    long hits = 0;
    EACH(i, 0, width * height) {
      pixel[hits] = i;
      hits += image[i] < INFINITY;
    }
    if (!hits) EACH(i, 0, 3 * count) out[i] = NAN;
    for (long i = 0; hits && i < count; i++) {
      /* Stratified: one point in each of `count` equal sections of the list of pixels that see a body. */
      long place = (i + offset) / count * hits, k = pixel[place < hits ? place : hits - 1];
      double x = (2.0 * (k % width) + 1) / width - 1, y = (2.0 * (k / width) + 1) / height - 1;
      for (int m = 0; m < 3; m++)
        out[3 * i + m] = camera->origin[m] + image[k] * (camera->axes[m] + x * camera->axes[3 + m] + y * camera->axes[6 + m]);
    }
  }
  free(pixel);
  return 0;
}
