"""The same C file as WebAssembly, compiled by zig and run in node: no imports, and the plans of Python."""

import json
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.deploy.export_planner import planner_files, write_planner
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import find_model
from cnpgen.planner.planner import Planner
from tests.addons.deploy.test_export_planner import requests_of

pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(find_spec("ziglang") is None, reason="needs cnpgen[compiler]"),
    pytest.mark.skipif(shutil.which("node") is None, reason="there is no node"),
]
ROWS = 50
PATH_NUMBERS = 90  # 15 control points of 6 joints
_EXPORTS = """
#include "airhockey_hit.h"
static airhockey_hit_memory memory;
static airhockey_hit_request request;
static airhockey_hit_motion motion;
double *numbers(void) { return request.start_q; }
double *path(void) { return motion.path[0]; }
double duration(void) { return airhockey_hit_duration(&motion); }
int plan(void) { return airhockey_hit_plan(&request, &motion, &memory); }
"""
_SCRIPT = """
const fs = require('fs');
const module_ = new WebAssembly.Module(fs.readFileSync('planner.wasm'));
if (WebAssembly.Module.imports(module_).length) throw new Error('the module has imports');
const e = new WebAssembly.Instance(module_).exports;
if (e._initialize) e._initialize();
const plans = JSON.parse(fs.readFileSync('requests.json')).map((row) => {
  new Float64Array(e.memory.buffer, e.numbers(), row.length).set(row);
  const code = e.plan();
  return [code, e.duration(), ...new Float64Array(e.memory.buffer, e.path(), 90)];
});
console.log(JSON.stringify(plans));
"""


def test_plans_in_node_equal_those_of_python(tmp_path: Path):
    write_planner(planner_files(find_model("airhockey-hit")), tmp_path)
    (tmp_path / "exports.c").write_text(_EXPORTS)
    (tmp_path / "run.js").write_text(_SCRIPT)
    boundary = draw_boundary_problems("airhockey-hit", ROWS, seed=8).boundary
    (tmp_path / "requests.json").write_text(json.dumps(requests_of(boundary).tolist()))
    names = ("numbers", "path", "duration", "plan")
    command = [sys.executable, "-m", "ziglang", "cc", "-target", "wasm32-wasi"]
    command += ["-mexec-model=reactor", "-std=c11", "-O1", "-o", "planner.wasm"]
    command += ["airhockey_hit.c", "exports.c"]
    command += [f"-Wl,--export={name}" for name in names]
    subprocess.run(command, cwd=tmp_path, check=True)
    done = subprocess.run(
        ["node", "run.js"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    found = np.array(json.loads(done.stdout))
    plans = Planner("airhockey-hit").plan_batch(boundary)
    valid = found[:, 0] == 0
    assert valid.mean() > 0.9
    np.testing.assert_allclose(found[valid, 1], plans.duration[valid], rtol=1e-5)
    paths = plans.path_control_points.reshape(ROWS, PATH_NUMBERS)
    np.testing.assert_allclose(found[valid, 2:], paths[valid], rtol=0, atol=1e-6)
