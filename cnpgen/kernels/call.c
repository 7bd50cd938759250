/* Calls a kernel with NumPy arrays. Shapes, strides and addresses come from Python's buffer protocol, in a quarter of
the time that Python code takes. vectors.h is included before; the declarations of Python are those of its stable ABI. */

typedef struct {
  void *numbers, *owner;
  long bytes, itemsize;
  int readonly, dimensions;
  char *format;
  long *shape, *strides, *suboffsets;
  void *internal;
} array; /* Py_buffer */

int PyObject_GetBuffer(void *, array *, int);
void PyBuffer_Release(array *), PyErr_Clear(void);
void *PyTuple_GetItem(void *, long), *PyList_GetItem(void *, long);
long PyTuple_Size(void *);
void *PyEval_SaveThread(void), PyEval_RestoreThread(void *);

#define STRIDES_AND_FORMAT 0x1c /* PyBUF_STRIDES | PyBUF_FORMAT */

typedef struct {
  void (*kernel)(long n, const real *const *in, const long *strides, real *const *out);
  long inputs, outputs;
  const long *widths; /* of inputs and outputs */
} callee;

/* Returns whether an array is float64 of shape (width, n) with contiguous rows. */
static int fits(const array *a, long width, long n) {
  return a->dimensions == 2 && a->shape[0] == width && a->shape[1] == n && a->format[strspn(a->format, "=")] == 'd' &&
         (n < 2 || a->strides[1] == sizeof(real));
}

/* Runs a kernel on a tuple of arguments and a list of results; returns 0 without running it if one does not match. */
int call(const callee *k, void *arguments, void *results) {
  long count = k->inputs + k->outputs, open = 0, n = 0, strides[count];
  array arrays[count];
  real *numbers[count];
  int fit = PyTuple_Size(arguments) == k->inputs;
  for (long i = 0; fit && i < count; i++) {
    array *a = arrays + i;
    void *object = i < k->inputs ? PyTuple_GetItem(arguments, i) : PyList_GetItem(results, i - k->inputs);
    if (PyObject_GetBuffer(object, a, STRIDES_AND_FORMAT)) {
      PyErr_Clear();
      fit = 0;
      break;
    }
    open++;
    if (i == 0) n = a->dimensions == 2 ? a->shape[1] : 0;
    fit = fits(a, k->widths[i], n);
    if (fit) numbers[i] = a->numbers, strides[i] = a->strides[0] / (long)sizeof(real);
  }
  if (fit && n) {
    void *thread = PyEval_SaveThread();
    k->kernel(n, (const real *const *)numbers, strides, numbers + k->inputs);
    PyEval_RestoreThread(thread);
  }
  while (open) PyBuffer_Release(arrays + --open);
  return fit;
}
