/* Rates that limits bound, as pacing.py says; vectors.h comes first. All values that are bounded are
g = rest + linear r + square r^2 + mixed r r', with coefficients of every row at every phase. */

#define EACH(i, from, to) for (long i = (from); i < (to); i++)

typedef struct {
  long count, phases, rows, points, first, last, sweeps; /* motions; rate control points; those that may move */
  const double *rest, *linear, *square, *mixed;          /* (rows, count * phases) each */
  const double *lower, *upper;                           /* (rows,) */
  const double *basis, *slope;                           /* of r and r', (points, phases) */
  const long *span;                                      /* phases that a control point counts at, (points, 2) */
  double share, most, least;
  double *rate, *scratch; /* (count, points), changed in place; 5 * phases */
} pacing;

/* The smallest x > 0 with q x^2 + l x = room; infinite if there is none. */
static double smallest(double room, double l, double q) {
  double inner = l * l + 4 * q * room, below = l + sqrt(inner);
  return inner >= 0 && below > 0 ? 2 * room / below : INFINITY;
}

/* How far r may go along b, or has to go back: what `advance` of pacing.py gives, for one motion. */
static double advance(const pacing *p, long motion, const double *restrict r, const double *restrict r1,
                      const double *restrict b, const double *restrict b1, long from, long to) {
  double *restrict critical = p->scratch + 4 * p->phases, up = p->most, back = 0;
  int out = 0;
  EACH(row, 0, p->rows) {
    long at = (row * p->count + motion) * p->phases;
    const double *restrict rest = p->rest + at, *restrict linear = p->linear + at;
    const double *restrict square = p->square + at, *restrict mixed = p->mixed + at;
    double low = p->lower[row], high = p->upper[row], reach = up;
#define VALUE (rest[k] + (linear[k] + square[k] * r[k] + mixed[k] * r1[k]) * r[k])
#define LINEAR ((linear[k] + 2 * square[k] * r[k] + mixed[k] * r1[k]) * b[k] + mixed[k] * r[k] * b1[k])
#define SQUARE ((square[k] * b[k] + mixed[k] * b1[k]) * b[k])
    EACH(k, from, to) { /* whether a bound can be met at all until `up` */
      double g = VALUE, l = LINEAR * reach, q = SQUARE * reach * reach;
      double above = (l > 0 ? l : 0) + (q > 0 ? q : 0) - (high - g), below = (l < 0 ? -l : 0) + (q < 0 ? -q : 0) - (g - low);
      critical[k] = above > below ? above : below;
    }
    EACH(k, from, to) if (critical[k] > 0) {
      double g = VALUE, l = LINEAR, q = SQUARE;
      EACH(side, 0, 2) {
        double room = side ? g - low : high - g, sign = side ? -1 : 1;
        double x = room < 0 ? smallest(-room, sign * l, -sign * q) : smallest(room, sign * l, sign * q);
        if (room >= 0) up = x < up ? x : up;
        else if (l != 0 || q != 0) {
          out = 1;
          if (x < INFINITY) back = -x < back ? -x : back;
        }
      }
    }
  }
  return out ? (back > p->least ? back : p->least) : up;
}

static void add(double *r, double x, const double *b, long from, long to) { EACH(k, from, to) r[k] += x * b[k]; }

/* Change the rates of all motions. */
void pace(const pacing *p) {
  double *r = p->scratch, *r1 = r + p->phases, *b = r1 + p->phases, *b1 = b + p->phases;
  EACH(motion, 0, p->count) {
    double *c = p->rate + motion * p->points;
    EACH(k, 0, 2 * p->phases) r[k] = 0;
    EACH(j, 0, p->points) {
      add(r, c[j], p->basis + j * p->phases, 0, p->phases);
      add(r1, c[j], p->slope + j * p->phases, 0, p->phases);
    }
    EACH(sweep, 0, p->sweeps) EACH(j, p->first, p->last) {
      const double *basis = p->basis + j * p->phases, *slope = p->slope + j * p->phases;
      long from = p->span[2 * j], to = p->span[2 * j + 1];
      EACH(k, from, to) b[k] = c[j] * basis[k], b1[k] = c[j] * slope[k];
      double x = advance(p, motion, r, r1, b, b1, from, to);
      if (x > 0) x *= p->share;
      add(r, x, b, from, to), add(r1, x, b1, from, to);
      c[j] += x * c[j];
    }
    EACH(k, 0, 2 * p->phases) b[k] = 0;
    EACH(j, p->first, p->last) {
      add(b, c[j], p->basis + j * p->phases, 0, p->phases);
      add(b1, c[j], p->slope + j * p->phases, 0, p->phases);
    }
    double x = advance(p, motion, r, r1, b, b1, 0, p->phases);
    EACH(j, p->first, p->last) c[j] += x * c[j];
  }
}
