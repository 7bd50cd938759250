"""An exported planner, compiled and called through ctypes."""

import ctypes
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cnpgen.addons.deploy.export_planner import planner_files, write_planner
from cnpgen.planner.model_file import find_model

Array = NDArray[np.float64]
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
needs_compiler = pytest.mark.skipif(
    COMPILER is None, reason="there is no C compiler on this machine"
)
WARNINGS = ("-std=c11", "-Wall", "-Wextra", "-pedantic", "-Werror")

# The driver includes the source, so that it can call private functions.
_DRIVER = """
#include "@.c"
void batch(long count, const double *in, int width, int admit, double *path, double *rate, double *duration, int *code,
           double *violations) {
  static @_memory memory;
  for (long i = 0; i < count; i++) {
    @_request request;
    @_motion motion;
    memcpy(&request, in + i * width, (size_t)width * sizeof(double));
    request.admit_outside_range = admit;
    code[i] = @_plan(&request, &motion, &memory);
    memcpy(path + i * PATH_POINTS * JOINTS, motion.path, sizeof motion.path);
    memcpy(rate + i * RATE_POINTS, motion.rate, sizeof motion.rate);
    memcpy(violations + i * CONSTRAINTS, motion.violations, sizeof motion.violations);
    duration[i] = @_duration(&motion);
  }
}
void states(const double *in, int width, long count, const double *time, double *q, double *dq, double *ddq, int *inside) {
  static @_memory memory;
  @_request request;
  @_motion motion;
  memcpy(&request, in, (size_t)width * sizeof(double));
  request.admit_outside_range = 1;
  @_plan(&request, &motion, &memory);
  for (long i = 0; i < count; i++)
    inside[i] = @_state(&motion, time[i], q + i * JOINTS, dq + i * JOINTS, ddq + i * JOINTS);
}
double check(const double *in, int width, double *violations) {
  static @_memory memory;
  @_request request;
  @_motion motion;
  memcpy(&request, in, (size_t)width * sizeof(double));
  request.admit_outside_range = 1;
  @_plan(&request, &motion, &memory);
  return @_check(&motion, &memory, violations);
}
#if !JERK
int stop(const double *in, int width, double time, long count, double *found, double *times, double *q, double *dq,
         double *ddq, int *moves) {
  static @_memory memory;
  @_request request;
  @_motion motion;
  @_stop stop;
  memcpy(&request, in, (size_t)width * sizeof(double));
  request.admit_outside_range = 1;
  @_plan(&request, &motion, &memory);
  int code = @_find_stop(&motion, time, &memory, &stop);
  found[0] = stop.begin;
  found[1] = stop.braking_time;
  for (long i = 0; i < count; i++) {
    times[i] = time + (stop.begin + stop.braking_time + 1e-9 - time) * (double)i / (double)(count - 1);
    moves[i] = @_stop_state(&motion, &stop, times[i], q + i * JOINTS, dq + i * JOINTS, ddq + i * JOINTS);
  }
  return code;
}
#endif
void run_task(const double *in, double *out) { task(in, out); }
#if LINE_STEPS
void run_line(const double *in, double *out) { line_change(in, out); }
#endif
void run_path(const double *in, double *out) { projected_path(in, out); }
void run_moving(const double *in, double *out) { moving_violations(in, out); }
void run_positions(const double *in, double *out) { position_violations(in, out); }
void run_network(const float *x, float *phi, float *log_rate) {
  static @_memory memory;
  const float *p, *r;
  memcpy(memory.x, x, sizeof memory.x);
  network(&memory, &p, &r);
  memcpy(phi, p, sizeof memory.phi);
  memcpy(log_rate, r, sizeof memory.log_rate);
}
"""


@dataclass(frozen=True)
class Planned:
    """Results of a batch."""

    code: NDArray[np.int32]
    path: Array
    rate: Array
    duration: Array
    violations: Array


@dataclass(frozen=True)
class CompiledStop:
    """A stop, and states from the time of its request to its end."""

    exists: bool
    begin: float
    braking_time: float
    times: Array
    q: Array
    dq: Array
    ddq: Array
    moves: NDArray[np.int32]


@dataclass(frozen=True)
class CompiledPlanner:
    """An exported planner as a shared library."""

    name: str
    folder: Path
    library: ctypes.CDLL
    joints: int
    path_points: int
    rate_points: int
    constraints: int

    def plan(self, requests: Array, *, admit: bool = False) -> Planned:
        """Plan every row of requests: boundary conditions and parameters, one after another."""
        rows = np.ascontiguousarray(requests, np.float64)
        n = len(rows)
        planned = Planned(
            np.empty(n, np.int32),
            np.empty((n, self.path_points, self.joints)),
            np.empty((n, self.rate_points)),
            np.empty(n),
            np.empty((n, self.constraints)),
        )
        self.library.batch(
            ctypes.c_long(n),
            pointer(rows),
            rows.shape[1],
            int(admit),
            *map(
                pointer,
                (planned.path, planned.rate, planned.duration, planned.code),
            ),
            pointer(planned.violations),
        )
        return planned

    def states(self, request: Array, times: Array) -> tuple[Array, Array, Array, Array]:
        """Return q, dq, ddq and whether the time is inside, of the motion of one request."""
        times, request = np.array(times, float), np.array(request, float)
        found = [np.empty((len(times), self.joints)) for _ in range(3)]
        inside = np.empty(len(times), np.int32)
        self.library.states(
            pointer(request),
            len(request),
            ctypes.c_long(len(times)),
            pointer(times),
            *map(pointer, (*found, inside)),
        )
        return (*found, inside)

    def check(self, request: Array) -> tuple[float, Array]:
        """Plan one request, and check the motion; return the largest violation, and those of all constraints."""
        request, violations = np.array(request, float), np.empty(self.constraints)
        self.library.check.restype = ctypes.c_double
        worst = self.library.check(pointer(request), len(request), pointer(violations))
        return worst, violations

    def stop(self, request: Array, time: float, count: int) -> "CompiledStop":
        """Plan one request, and stop after a time [s]; return states from then to the end of the stop."""
        request, found, times = np.array(request, float), np.empty(2), np.empty(count)
        states = [np.empty((count, self.joints)) for _ in range(3)]
        moves = np.empty(count, np.int32)
        exists = self.library.stop(
            pointer(request),
            len(request),
            ctypes.c_double(time),
            ctypes.c_long(count),
            *map(pointer, (found, times, *states, moves)),
        )
        return CompiledStop(bool(exists), found[0], found[1], times, *states, moves)

    def run(self, function: str, values: Array, outputs: int) -> Array:
        """Call a private function of one array and one result."""
        values, out = np.array(values, float), np.empty(outputs)
        getattr(self.library, f"run_{function}")(pointer(values), pointer(out))
        return out


def pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def compile_c(source: Path, target: Path, *options: str) -> None:
    """Compile a file; a warning fails the test."""
    assert COMPILER is not None
    command = [COMPILER, *WARNINGS, *options, str(source), "-o", str(target), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:3000]


def compiled_planner(model: str | Path, folder: Path, *options: str) -> CompiledPlanner:
    """Export and compile a model."""
    return compiled_files(planner_files(find_model(model)), folder, *options)


def compiled_files(
    files: dict[str, str], folder: Path, *options: str
) -> CompiledPlanner:
    """Write and compile the files of a planner."""
    write_planner(files, folder)
    name = next(iter(files)).removesuffix(".c")
    driver = folder / "driver.c"
    driver.write_text(_DRIVER.replace("@", name), encoding="utf-8")
    target = folder / "planner.so"
    compile_c(driver, target, *(options or ("-O2",)), "-fPIC", "-shared")
    header = files[f"{name}.h"]
    sizes = [
        int(header.split(f"{name.upper()}_{size} ")[1].split()[0])
        for size in ("JOINTS", "PATH_POINTS", "RATE_POINTS", "CONSTRAINTS")
    ]
    return CompiledPlanner(name, folder, ctypes.CDLL(str(target)), *sizes)
