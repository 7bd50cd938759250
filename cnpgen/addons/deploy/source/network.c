/* The network, in single precision. Columns of a matrix are stored in blocks of BLOCK, so that one block of outputs
is accumulated while the inputs pass once; the last block is padded with zeros. */

/* tanh by the rational function of Eigen, at most 4 ulp from the exact value; nan stays nan. */
static void hyperbolic_tangent(float *y, int blocks) {
  for (int i = 0; i < blocks * BLOCK; i++) {
    float x = y[i];
    x = x > 7.90531110763549805f ? 7.90531110763549805f : x;
    x = x < -7.90531110763549805f ? -7.90531110763549805f : x;
    float z = x * x;
    float p = -2.76076847742355e-16f * z + 2.00018790482477e-13f;
    p = p * z - 8.60467152213735e-11f;
    p = p * z + 5.12229709037114e-08f;
    p = p * z + 1.48572235717979e-05f;
    p = p * z + 6.37261928875436e-04f;
    p = (p * z + 4.89352455891786e-03f) * x;
    float q = 1.19825839466702e-06f * z + 1.18534705686654e-04f;
    q = q * z + 2.26843463243900e-03f;
    q = q * z + 4.89352518554385e-03f;
    y[i] = p / q;
  }
}

/* y = x W + b. Four inputs pass at once; rows after the last input are zero. */
static void affine(const float *restrict weight, const float *restrict bias, int inputs, int blocks,
                   const float *restrict x, float *restrict y) {
  for (int block = 0; block < blocks; block++) {
    float sums[BLOCK];
    for (int j = 0; j < BLOCK; j++) sums[j] = bias[block * BLOCK + j];
    for (int i = 0; i < inputs; i += INPUTS) {
      const float *rows = weight + (block * inputs + i) * BLOCK;
      for (int j = 0; j < BLOCK; j++)
        sums[j] += (x[i] * rows[j] + x[i + 1] * rows[BLOCK + j])
          + (x[i + 2] * rows[2 * BLOCK + j] + x[i + 3] * rows[3 * BLOCK + j]);
    }
    for (int j = 0; j < BLOCK; j++) y[block * BLOCK + j] = sums[j];
  }
}
