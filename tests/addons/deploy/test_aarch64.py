"""The C file on aarch64, compiled by a cross compiler and run by qemu: the plans and codes of this machine."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from tests.addons.deploy.compiled_planner import (
    WARNINGS,
    compiled_planner,
    needs_compiler,
)
from tests.addons.deploy.test_export_planner import VALID, requests_of

CROSS = shutil.which("aarch64-linux-gnu-gcc")
QEMU = shutil.which("qemu-aarch64-static") or shutil.which("qemu-aarch64")
pytestmark = [
    needs_compiler,
    pytest.mark.extended,
    pytest.mark.skipif(CROSS is None, reason="no compiler for aarch64"),
    pytest.mark.skipif(QEMU is None, reason="no qemu for aarch64"),
]
ROWS = 300
_MAIN = """
#include <stdio.h>
#include "driver.c"
static double rows[ROWS * WIDTH], path[ROWS * PATH_POINTS * JOINTS], rate[ROWS * RATE_POINTS], duration[ROWS];
static double violations[ROWS * CONSTRAINTS];
static int code[ROWS];
int main(void) {
  if (fread(rows, sizeof rows, 1, stdin) != 1) return 1;
  batch(ROWS, rows, WIDTH, 0, path, rate, duration, code, violations);
  fwrite(path, sizeof path, 1, stdout);
  fwrite(duration, sizeof duration, 1, stdout);
  fwrite(code, sizeof code, 1, stdout);
  return 0;
}
"""


@pytest.mark.parametrize("model", ["airhockey-hit", "airhockey-tables", "heavy-object"])
def test_plans_on_aarch64_equal_those_of_this_machine(tmp_path: Path, model: str):
    requests = requests_of(draw_boundary_problems(model, ROWS, seed=6).boundary)
    compiled = compiled_planner(model, tmp_path, "-O1")
    here = compiled.plan(requests)
    text = _MAIN.replace("ROWS", str(ROWS)).replace("WIDTH", str(requests.shape[1]))
    (tmp_path / "main.c").write_text(text)
    command = [str(CROSS), *WARNINGS, "-O1", "-static", "main.c", "-o", "main", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    rows = np.ascontiguousarray(requests).tobytes()
    done = subprocess.run(
        [str(QEMU), "./main"], cwd=tmp_path, input=rows, capture_output=True, check=True
    )
    sizes = 8 * np.cumsum([here.path.size, ROWS])
    path, duration = (
        np.frombuffer(part) for part in (done.stdout[: sizes[0]], done.stdout[sizes[0] : sizes[1]])
    )  # fmt: skip
    code = np.frombuffer(done.stdout[sizes[1] :], np.int32)
    both = (code == VALID) & (here.code == VALID)
    assert both.mean() > 0.85
    # Fused operations round otherwise: a violation within 1e-3 of its bound may differ.
    for row in np.flatnonzero(code != here.code):
        assert abs(here.violations[row].max() - 1) < 1e-3
    np.testing.assert_allclose(
        path.reshape(here.path.shape)[both], here.path[both], rtol=0, atol=1e-6
    )
    np.testing.assert_allclose(duration[both], here.duration[both], rtol=1e-5)
