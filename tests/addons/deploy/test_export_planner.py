"""A planner in C plans as Python does, refuses what it must, and compiles without warnings."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from cnpgen.addons.deploy.export_planner import planner_files
from cnpgen.errors import UsageError
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import find_model
from cnpgen.planner.network.architecture import forward
from cnpgen.planner.network.features import raw_features
from cnpgen.planner.planner import Planner
from cnpgen.planner.tasks import ends_of, lanes
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.plans import Plans
from cnpgen.trajectory.boundary import Boundary
from tests.addons.deploy.compiled_planner import (
    COMPILER,
    WARNINGS,
    CompiledPlanner,
    Planned,
    compile_c,
    compiled_planner,
    needs_compiler,
)

pytestmark = needs_compiler

VALID, NOT_FINITE, MUST_BE_ZERO, OUTSIDE, PARAMETER, NO_RATE, NO_PATH = range(7)
ROWS = 300
MANY_ROWS = 10_000


def assert_equal_motions(planned: Planned, plans: Plans, chosen: np.ndarray) -> None:
    """Compare the control points of paths [rad] and the relative ones of rates, of some plans."""
    np.testing.assert_allclose(
        planned.path[chosen], plans.path_control_points[chosen], rtol=0, atol=1e-6
    )
    np.testing.assert_allclose(
        planned.rate[chosen], plans.rate_control_points[chosen], rtol=1e-5
    )


def requests_of(boundary: Boundary) -> np.ndarray:
    """Return the numbers of requests: conditions, then parameters."""
    columns = list(boundary.conditions().values())
    if boundary.parameters is not None:
        columns.append(boundary.parameters)
    return np.concatenate(columns, axis=1)


@pytest.fixture(scope="module")
def hits() -> Planner:
    return Planner("airhockey-hit")


@pytest.fixture(scope="module")
def boundary() -> Boundary:
    return draw_boundary_problems("airhockey-hit", ROWS, seed=5).boundary


@pytest.fixture(scope="module")
def plans(hits, boundary) -> Plans:
    return hits.plan_batch(boundary)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory) -> CompiledPlanner:
    return compiled_planner("airhockey-hit", tmp_path_factory.mktemp("hits"), "-O1")


@pytest.fixture(scope="module")
def planned(compiled, boundary) -> Planned:
    return compiled.plan(requests_of(boundary))


def test_plans_equal_those_of_python(planned, plans):
    valid = planned.code == VALID
    assert valid.mean() > 0.95
    assert_equal_motions(planned, plans, valid)
    np.testing.assert_allclose(
        planned.duration[valid], plans.duration[valid], rtol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("options", ["-O2", "-O3 -march=native -ffp-contract=fast"])
def test_plans_of_many_rows_equal_those_of_python(hits, tmp_path: Path, options: str):
    boundary = draw_boundary_problems("airhockey-hit", MANY_ROWS, seed=11).boundary
    planned = compiled_planner("airhockey-hit", tmp_path, *options.split()).plan(
        requests_of(boundary)
    )
    plans, valid = hits.plan_batch(boundary), planned.code == VALID
    assert valid.mean() > 0.95
    assert_equal_motions(planned, plans, valid)


def test_the_duration_is_that_of_its_own_rates(planned, plans):
    """The quadrature has the cells of Python, and half of its nodes."""
    from cnpgen.trajectory.spline_motion import Motion

    valid = planned.code == VALID
    own = Motion(planned.path[valid], planned.rate[valid], plans.degree)
    np.testing.assert_allclose(planned.duration[valid], own.duration(), rtol=1e-8)


def test_code_0_agrees_with_the_verdict(planned, plans):
    """The check is on a grid, so it may accept a violation between the phases, but rarely does."""
    valid = evaluate_plans(plans).valid
    checked = np.isfinite(planned.violations[:, 0])
    assert np.mean((planned.code == VALID)[checked] == valid[checked]) > 0.99
    assert np.all(planned.violations[planned.code == VALID] <= 1)


def test_the_task_and_the_kernels_equal_those_of_python(compiled, hits, boundary):
    tasks = hits._inference.prepare(boundary)
    ends, features = ends_of(boundary), raw_features(tasks, hits.model.features.blocks)
    for row in range(20):
        width = 1 + 5 + features.shape[1]
        out = compiled.run("task", ends[:, row], width)
        assert out[0] == pytest.approx(tasks.expected_time[row], rel=1e-12)
        np.testing.assert_allclose(out[1:5], tasks.scene.poses[row], rtol=1e-12)
        own = out[6:]
        own[-1] = np.log(own[-1])  # the C code takes the logarithm later
        np.testing.assert_allclose(own, features[row], rtol=1e-12, atol=1e-12)
        line = np.concatenate([ends[:, row], [1 / out[0]], out[1:5]])
        np.testing.assert_allclose(
            compiled.run("line", line, 60), tasks.correction[row].ravel(), atol=1e-12
        )
    outputs = hits.model.outputs(tasks)
    (path,) = hits._inference.path(
        ends, lanes(outputs.offsets), lanes(outputs.rate), tasks.scene.lanes
    )
    arguments = (ends, lanes(outputs.offsets), lanes(outputs.rate), tasks.scene.lanes)
    column = np.concatenate(arguments)
    for row in range(20):
        own = compiled.run("path", column[:, row], 90)
        np.testing.assert_allclose(own, path[:, row], rtol=0, atol=1e-12)


def test_the_network_equals_python(compiled, hits, boundary):
    import ctypes

    from tests.addons.deploy.compiled_planner import pointer

    features = hits.model.features.of(hits._inference.prepare(boundary))
    expected = forward(hits.model._weights, features)
    for row in range(50):
        x = np.zeros(64, np.float32)
        x[:61] = features[row]
        phi, log_rate = np.zeros(64, np.float32), np.zeros(32, np.float32)
        compiled.library.run_network(*map(pointer, (x, phi, log_rate)))
        np.testing.assert_allclose(phi[:60], expected.path[row], rtol=0, atol=2e-6)
        np.testing.assert_allclose(
            log_rate[:20], expected.log_rate[row], rtol=2e-6, atol=2e-6
        )
    assert isinstance(compiled.library, ctypes.CDLL)


def test_states_equal_those_of_python(compiled, planned, plans, boundary):
    row = int(np.flatnonzero(planned.code == VALID)[0])
    request, duration = requests_of(boundary)[row], planned.duration[row]
    times = np.linspace(0, duration, 201)
    q, dq, ddq, inside = compiled.states(request, times)
    expected = plans[[row]].motion.at_times(times)
    assert inside.all()
    np.testing.assert_allclose(q, expected.q[0], atol=1e-6)
    np.testing.assert_allclose(dq, expected.dq[0], atol=1e-5)
    np.testing.assert_allclose(ddq, expected.ddq[0], atol=1e-3)
    np.testing.assert_allclose(q[0], boundary.start_q[row], atol=1e-12)
    np.testing.assert_allclose(q[-1], boundary.goal_q[row], atol=1e-9)
    np.testing.assert_allclose(dq[-1], boundary.goal_dq[row], atol=1e-9)
    np.testing.assert_allclose(dq[0], 0, atol=1e-9)
    np.testing.assert_allclose(ddq[0], 0, atol=1e-9)


def test_outside_of_its_duration_a_motion_is_at_rest_at_its_ends(
    compiled, planned, boundary
):
    row = int(np.flatnonzero(planned.code == VALID)[0])
    request, duration = requests_of(boundary)[row], planned.duration[row]
    times = [-1.0, -np.inf, np.nan, np.nextafter(duration, 9), 9.0, np.inf]
    q, dq, ddq, inside = compiled.states(request, times)
    assert not inside.any()
    assert not dq.any()
    assert not ddq.any()
    np.testing.assert_array_equal(q[:3], np.tile(boundary.start_q[row], (3, 1)))
    np.testing.assert_allclose(q[3:], np.tile(boundary.goal_q[row], (3, 1)), atol=1e-12)


CHANGES = {  # code -> column of a request and its new value
    "nan": (0, np.nan, NOT_FINITE),
    "infinite goal": (20, np.inf, NOT_FINITE),
    "infinite velocity": (7, -np.inf, NOT_FINITE),
    "start velocity": (8, 0.01, MUST_BE_ZERO),
    "start acceleration": (14, -0.5, MUST_BE_ZERO),
    "start far away": (0, 9.0, OUTSIDE),
    "degrees": (20, 90.0, OUTSIDE),
    "fast goal": (25, 40.0, OUTSIDE),
    "huge": (24, 1e300, OUTSIDE),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_request_is_refused_by_its_code(compiled, planned, boundary, change):
    row = int(np.flatnonzero(planned.code == VALID)[0])
    request = requests_of(boundary)[row].copy()
    column, value, code = CHANGES[change]
    request[column] = value
    found = compiled.plan(request[None])
    assert found.code[0] == code
    assert found.duration[0] == 0
    start = np.tile(request[:6], (15, 1))
    np.testing.assert_array_equal(found.path[0], start)
    assert not found.rate.any()
    assert np.isinf(found.violations).all()
    q, dq, ddq, inside = compiled.states(request, [0.0, 0.5]) if code < OUTSIDE else (
        start[:2], np.zeros(1), np.zeros(1), np.zeros(1))  # fmt: skip
    np.testing.assert_array_equal(q, start[:2])
    assert not dq.any() and not ddq.any() and not inside.any()  # noqa: PT018


def test_the_flag_admits_values_outside_of_the_range_but_not_an_invalid_motion(
    compiled, planned, boundary
):
    row = int(np.flatnonzero(planned.code == VALID)[0])
    request = requests_of(boundary)[row].copy()
    request[0] += 4.0  # outside the joint's limits
    assert compiled.plan(request[None]).code[0] == OUTSIDE
    found = compiled.plan(request[None], admit=True)
    assert found.code[0] == NO_PATH
    assert found.violations[0, 0] > 1  # joint positions
    assert found.duration[0] == 0
    fast = requests_of(boundary)[row].copy()
    fast[24:30] *= 20
    found = compiled.plan(fast[None], admit=True)
    assert found.code[0] in {NO_RATE, NO_PATH}
    assert compiled.plan(requests_of(boundary)[[row]], admit=True).code[0] == VALID


def test_a_rate_outside_the_limits_has_its_own_code(compiled, planned, boundary, plans):
    """Plans that Python's verdict calls too fast get the code of rates, without a motion."""
    requests = requests_of(boundary)[planned.code == VALID]
    requests[:, 24:30] *= np.linspace(1.0, 1.6, len(requests))[:, None]
    found = compiled.plan(requests, admit=True)
    too_fast = found.code == NO_RATE
    assert too_fast.any()
    assert np.all(found.violations[too_fast][:, 1:4].max(axis=1) > 1)
    assert np.all(found.duration[too_fast] == 0)


def test_rounding_errors_of_conditions_that_must_be_zero_are_removed(
    compiled, planned, boundary
):
    row = int(np.flatnonzero(planned.code == VALID)[0])
    request = requests_of(boundary)[row].copy()
    request[6:12] = 1e-11
    found = compiled.plan(request[None])
    assert found.code[0] == VALID
    np.testing.assert_array_equal(found.path[0], planned.path[row])


def test_a_motion_can_be_checked_again(compiled, planned, boundary):
    row = int(np.flatnonzero(planned.code == VALID)[0])
    worst, violations = compiled.check(requests_of(boundary)[row])
    np.testing.assert_array_equal(violations, planned.violations[row])
    assert worst == violations.max() <= 1


def test_equal_models_give_equal_files():
    path = find_model("airhockey-hit")
    assert planner_files(path) == planner_files(path)


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        ("panda-scenes", "its samples place obstacles"),
        ("heavy-object-anywhere", "via points"),
        ("heavy-object-drive", "its problem has drives"),
    ],
)
def test_models_that_c_files_do_not_support_are_refused(model, reason):
    with pytest.raises(UsageError, match=reason):
        planner_files(find_model(model))


def test_the_object_needs_no_memory_and_no_library_but_mathematics(
    compiled, tmp_path: Path
):
    if shutil.which("nm") is None:
        pytest.skip("there is no nm on this machine")
    target = tmp_path / "planner.o"
    source = compiled.folder / f"{compiled.name}.c"
    compile_c(source, target, "-O1", "-fno-stack-protector", "-c")
    symbols = subprocess.run(
        ["nm", "-u", str(target)], capture_output=True, text=True, check=True
    ).stdout.split()
    undefined = set(symbols) - {"U", "w"}
    allowed = {"sqrt", "log", "cbrt", "memcpy", "memset", "_GLOBAL_OFFSET_TABLE_"}
    assert undefined <= allowed, undefined


def test_the_header_is_valid_in_cpp(compiled, tmp_path: Path):
    if shutil.which("g++") is None:
        pytest.skip("there is no C++ compiler on this machine")
    source = tmp_path / "use.cpp"
    source.write_text(
        f'#include "{compiled.name}.h"\nint use(const {compiled.name}_request &request, {compiled.name}_motion &motion,'
        f" {compiled.name}_memory &memory) {{ return {compiled.name}_plan(&request, &motion, &memory); }}\n"
    )
    options = ["-std=c++17", *WARNINGS[1:], "-fsyntax-only", f"-I{compiled.folder}"]
    subprocess.run(["g++", *options, str(source)], check=True)


_SANITIZED = """
#include "@.h"
#include <stdio.h>
static @_memory memory;
int main(void) {
  @_request request;
  @_motion motion;
  double sum = 0, q[JOINTS], dq[JOINTS], ddq[JOINTS], numbers[NUMBERS], violations[@_CONSTRAINTS_];
  FILE *file = fopen("requests.bin", "rb");
  while (file && fread(numbers, sizeof numbers, 1, file) == 1) {
    double *target = request.start_q;
    for (int i = 0; i < JOINTS; i++) target[i] = numbers[i];
    for (int i = 0; i < JOINTS; i++) request.start_dq[i] = numbers[JOINTS + i];
    for (int i = 0; i < JOINTS; i++) request.start_ddq[i] = numbers[2 * JOINTS + i];
    for (int i = 0; i < JOINTS; i++) request.goal_q[i] = numbers[3 * JOINTS + i];
    for (int i = 0; i < JOINTS; i++) request.goal_dq[i] = numbers[4 * JOINTS + i];
    for (request.admit_outside_range = 0; request.admit_outside_range < 2; request.admit_outside_range++) {
      @_plan(&request, &motion, &memory);
      for (int k = -2; k < 40; k++) sum += @_state(&motion, 0.05 * k, q, dq, ddq) + q[0];
      sum += @_check(&motion, &memory, violations) > 1;
      for (int k = -1; k < 4; k++) {
        @_stop stop;
        sum += @_find_stop(&motion, 0.2 * k, &memory, &stop) + @_stop_state(&motion, &stop, 0.3 * k, q, dq, ddq);
      }
    }
  }
  return sum == 12345;
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("model", ["airhockey-hit", "airhockey-online"])
def test_sanitizers_find_nothing(tmp_path: Path, model: str):
    from cnpgen.addons.deploy.export_planner import write_planner

    files = planner_files(find_model(model))
    write_planner(files, tmp_path)
    name = next(iter(files)).removesuffix(".c")
    random = np.random.default_rng(3)
    rows = requests_of(draw_boundary_problems(model, 40, seed=2).boundary)
    wild = random.normal(size=(40, 30)) * 10.0 ** random.integers(-3, 300, (40, 1))
    odd = rows[:20].copy()
    odd[np.arange(20), random.integers(0, 30, 20)] = random.choice(
        [np.nan, np.inf, -np.inf, 1e308, 5e-324], 20
    )
    np.concatenate([rows, wild, odd]).tofile(tmp_path / "requests.bin")
    main = _SANITIZED.replace("@_CONSTRAINTS_", f"{name.upper()}_CONSTRAINTS")
    (tmp_path / "main.c").write_text(
        main.replace("@", name).replace("JOINTS", "6").replace("NUMBERS", "30")
    )
    sanitizers = "-fsanitize=address,undefined,float-cast-overflow"
    options = ["-O1", "-g", sanitizers, "-fno-sanitize-recover=all"]
    command = [str(COMPILER), *WARNINGS, *options, "main.c", f"{name}.c", "-o", "main"]
    subprocess.run([*command, "-lm"], cwd=tmp_path, check=True)
    done = subprocess.run(
        ["./main"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
