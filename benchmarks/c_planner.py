"""Planners in C: time per plan as a fraction of ``Planner.plan``, and instructions per plan.

Python and C plan the same boundary problems in turn, in one run and one thread of this
machine; the clock is the CPU time. C times include the check of every motion, which
``Planner.plan`` does not have. The ratio compares blocks of all problems, so that the
clock does not count; percentiles are those of single calls. Instructions are counted by
callgrind where valgrind is installed, of a program compiled with ``COUNTED_OPTIONS``:
their relative spread over the inputs is (p99 - p1) / median, without refusals of inputs
outside of the training range, which end early.

    python benchmarks/c_planner.py
    python benchmarks/c_planner.py --model airhockey-hit --calls 1000000 --repeat 5
    python benchmarks/c_planner.py --model airhockey-online --options "-O2"
    python benchmarks/c_planner.py --earlier ../earlier-cnpgen

``--earlier`` compares with the ``Planner.plan`` of another source tree too: the tree's
package plans the same problems in a process of its own in the same run, each time right
before that of this package.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, cpu_of, median, report, table

from cnpgen.addons.deploy.export_planner import planner_files, write_planner
from cnpgen.kernels.compiler import require_compiler
from cnpgen.machine.threads import one_thread
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import find_model
from cnpgen.planner.planner import Planner
from cnpgen.trajectory.boundary import Boundary

MODELS = ("airhockey-hit", "airhockey-online", "heavy-object")
PROBLEMS = 200
INSTRUCTION_PROBLEMS = 40
SHARED_OPTIONS = "-fno-math-errno -fno-trapping-math"
OPTIONS = f"-O3 -march=native -ffp-contract=fast {SHARED_OPTIONS}"
COUNTED_OPTIONS = f"-O2 {SHARED_OPTIONS}"  # instructions that valgrind knows
DRIVER = r"""
#define _POSIX_C_SOURCE 200809L
#include "@.h"
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
static @_memory memory;
static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}
int main(int count, char **arguments) {
  @_motion motion;
  static @_request requests[@COUNT];
  double numbers[@WIDTH];
  int n = 0, only = count > 2 ? atoi(arguments[2]) : -1;
  FILE *file = fopen("requests.bin", "rb");
  while (file && n < @COUNT && fread(numbers, sizeof numbers, 1, file) == 1)
    memcpy(&requests[n++], numbers, sizeof numbers);
  if (only >= 0) {
    requests[only].admit_outside_range = 1; /* a refusal takes fewer instructions */
    return @_plan(&requests[only], &motion, &memory) > 6;
  }
  long calls = atol(arguments[1]);
  double began = now();
  for (long i = 0; i < calls; i++) @_plan(&requests[i % n], &motion, &memory);
  if (calls) printf("%.4f\n", (now() - began) / (double)calls);
  for (long i = 0; i < calls; i++) {
    double start = now();
    @_plan(&requests[i % n], &motion, &memory);
    printf("%.3f\n", now() - start);
  }
  return 0;
}
"""

# Print the CPU time per plan [s] of the package that PYTHONPATH selects.
ONE_BY_ONE = r"""
import sys, time
import numpy as np
from cnpgen.machine.threads import one_thread
from cnpgen.planner.planner import Planner
with np.load(sys.argv[2]) as file:
    columns = dict(file)
planner = Planner(sys.argv[1])
rows = [dict(zip(columns, values)) for values in zip(*columns.values())]
with one_thread():
    for row in rows[:20]:
        planner.plan(**row)
    began = time.process_time()
    for row in rows:
        planner.plan(**row)
    print((time.process_time() - began) / len(rows))
"""


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model", action="append", help=f"default: {', '.join(MODELS)}"
    )
    parser.add_argument("--calls", type=int, default=20_000, help="calls in C")
    parser.add_argument("--repeat", type=int, default=5, help="repetitions")
    parser.add_argument(
        "--earlier", type=Path, help="source tree whose Planner.plan is timed as well"
    )
    parser.add_argument(
        "--options", default=OPTIONS, help=f"of the compiler (default: {OPTIONS})"
    )


def write_sources(model: str, folder: Path, boundary: Boundary) -> list[str]:
    """Export a planner; write it, a program that times it, and the requests; return the names of the sources."""
    files = planner_files(find_model(model))
    write_planner(files, folder)
    name = next(iter(files)).removesuffix(".c")
    columns = list(boundary.conditions().values())
    if boundary.parameters is not None:
        columns.append(boundary.parameters)
    rows = np.concatenate(columns, axis=1)
    rows.tofile(folder / "requests.bin")
    text = DRIVER.replace("@COUNT", str(len(rows))).replace(
        "@WIDTH", str(rows.shape[1])
    )
    (folder / "time.c").write_text(text.replace("@", name))
    return ["time.c", f"{name}.c"]


def build(sources: list[str], folder: Path, options: str) -> Path:
    """Compile the program."""
    command = [*shlex.split(require_compiler()), "-std=c11", *shlex.split(options)]
    subprocess.run([*command, *sources, "-o", "time", "-lm"], cwd=folder, check=True)
    return folder / "time"


def one_by_one(planner: Planner, rows: list[dict[str, Any]]) -> None:
    for row in rows:
        planner.plan(**row)


def time_of_tree(tree: Path, model: str, boundary: Boundary, folder: Path) -> float:
    """Return the CPU time per plan of another source tree's ``Planner.plan`` [s].

    The model is the shipped one of the tree.
    """
    np.savez(folder / "rows.npz", **boundary.arrays())  # type: ignore[arg-type]
    out = subprocess.run(
        [sys.executable, "-c", ONE_BY_ONE, model, str(folder / "rows.npz")],
        env=os.environ | {"PYTHONPATH": str(tree.resolve())},
        cwd=folder, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return float(out.stdout)


def spread_of_instructions(program: Path) -> tuple[float | None, float | None]:
    """Return the median of the instructions of a plan, and their relative spread over problems.

    None if valgrind does not know an instruction of the program.
    """
    counts = []
    for row in range(-1, INSTRUCTION_PROBLEMS):
        # Row -1 makes no call: its instructions are those of the program around it.
        calls = ["0"] if row < 0 else ["0", str(row)]
        out = subprocess.run(
            ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", str(program), *calls],
            cwd=program.parent, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if "Collected :" not in out.stderr or out.returncode < 0:
            return None, None
        counts.append(int(out.stderr.split("Collected :")[1].split()[0]))
    own = np.array(counts[1:]) - counts[0]
    low, high = np.percentile(own, [1, 99])
    return float(np.median(own)), float((high - low) / np.median(own))


def ratio_of(times: list[float], others: list[float]) -> float | None:
    """Return the median ratio of the times of each repetition; None without times."""
    if not times or not others:
        return None
    return median(a / b for a, b in zip(times, others, strict=True))


@one_thread()
def measure(model: str, folder: Path, given: argparse.Namespace) -> dict[str, Any]:
    planner = Planner(model)
    dataset = planner.model.training["dataset"]["name"]
    boundary = draw_boundary_problems(dataset, PROBLEMS, seed=3).boundary
    boundary = planner._checked(boundary)
    sources = write_sources(model, folder, boundary)
    program = build(sources, folder, given.options)
    python, earlier, c, block = [], [], [], []
    columns = boundary.arrays()
    rows = [
        dict(zip(columns, row, strict=True))
        for row in zip(*columns.values(), strict=True)
    ]
    for _ in range(given.repeat):
        if given.earlier is not None:
            earlier.append(time_of_tree(given.earlier, model, boundary, folder))
        one_by_one(planner, rows[:20])
        python.append(cpu_of(partial(one_by_one, planner, rows)) / PROBLEMS)
        lines = subprocess.run(
            [str(program), str(given.calls // given.repeat)],
            cwd=folder, capture_output=True, text=True, check=True,
        ).stdout.split()  # fmt: skip
        block.append(float(lines[0]) * 1e-6)
        c.append(np.array(lines[1:], float) * 1e-6)
    every = np.concatenate(c)
    result = {
        "model": model,
        "Python / C": ratio_of(python, block),
        "earlier / C": ratio_of(earlier, block),
        "Python / earlier": ratio_of(python, earlier),
        "p99 / median": float(np.quantile(every, 0.99) / np.median(every)),
        "p99.99 / median": float(np.quantile(every, 0.9999) / np.median(every)),
        "instructions": None,
        "spread": None,
    }
    if shutil.which("valgrind"):
        program = build(sources, folder, COUNTED_OPTIONS)
        result["instructions"], result["spread"] = spread_of_instructions(program)
    return result


def main() -> None:
    given = arguments(__doc__, add_options)
    results = []
    for model in given.model or MODELS:
        with tempfile.TemporaryDirectory() as folder:
            results.append(measure(model, Path(folder), given))
    head, *rows = show(results)
    report(
        {"options": given.options, "c_planner": results},
        [table(f"planners in C, {given.options}", head, rows)],
        as_json=given.json,
    )


def show(results: list[dict[str, Any]]) -> list[list[str]]:
    """Return the head and the rows of the table."""
    rows = [list(results[0])]
    for result in results:
        count, spread = result["instructions"], result["spread"]
        ratios = [result[name] for name in list(result)[1:6]]
        numbers = ["-" if ratio is None else f"{ratio:.2f}" for ratio in ratios]
        counted = ["-", "-"] if count is None else [f"{count:,.0f}", f"{spread:.1%}"]
        rows.append([result["model"], *numbers, *counted])
    return rows


if __name__ == "__main__":
    main()
