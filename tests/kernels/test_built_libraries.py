"""Libraries of handwritten C that the build compiles: their files, and equal results on all processors."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cnpgen.kernels import c_library
from cnpgen.kernels.c_library import (
    ARRAYS,
    VARIANTS,
    Variant,
    build_libraries,
    built_file_name,
    find_built,
    load_library,
    this_variants,
)
from cnpgen.kernels.collision import collision_checker
from cnpgen.kernels.compiler import find_compiler
from cnpgen.kernels.observation import compiled_observations
from cnpgen.planner import time_parametrization
from cnpgen.refine.solver import compiled_backend
from tests.conftest import needs_compiler

ROOT = Path(__file__).parents[2]
LIBRARIES = [
    (ARRAYS, *paths)
    for paths in (
        collision_checker.SOURCES,
        [compiled_observations.SOURCE],
        compiled_backend.SOURCES,
        [time_parametrization.SOURCE],
    )
]
RESULTS = """
import hashlib, sys
from pathlib import Path
import numpy as np
import cnpgen
from cnpgen.addons.families.scene_generator import load_family
from cnpgen.kernels import c_library
from cnpgen.plans.scene_plans import scene_plans
from cnpgen.scenes import BasisPoints, CameraCloud, DistanceGrid, SurfaceCloud, observe, scene_bodies

c_library.BUILT_FOLDER = Path(sys.argv[1])
c_library.this_variants = lambda: tuple(v for v in c_library.VARIANTS["x86_64"] if v.name == sys.argv[2])

def show(name, arrays):
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    print(name, digest.hexdigest())

def plans(found):
    return found.path_control_points, found.rate_control_points

for name, n in ("airhockey-hit", 6), ("heavy-object", 2):
    show(name, plans(cnpgen.solve_plans(cnpgen.draw_boundary_problems(name, n, seed=3), workers=1).plans))
pucks = cnpgen.draw_boundary_problems("airhockey-hit", 200, seed=4)
show("time parametrization", plans(cnpgen.Planner("airhockey-online").plan_batch(pucks.boundary)))
family, random = load_family("dresser"), np.random.default_rng(1)
bodies = scene_bodies([family.draw(random).obstacles for _ in range(5)])
for kind in SurfaceCloud(), CameraCloud(), DistanceGrid(), BasisPoints():
    show(type(kind).__name__, observe(bodies, kind).values())
try:
    scenes = cnpgen.scenes.make_scenes("tabletop", "panda", 3, seed=5)
except cnpgen.errors.CnpgenError:  # without the robots of the extra
    pass
else:
    problems = scene_plans(cnpgen.load_problem("panda"), scenes)
    show("scenes", plans(cnpgen.solve_plans(problems, workers=1).plans))
mapped = [Path(line.split()[-1]) for line in open("/proc/self/maps") if line.endswith(".so\\n")]
names = {file.name.rpartition("-")[0] for file in mapped if file.parent == c_library.BUILT_FOLDER}
assert {"step-" + sys.argv[2], "observe-" + sys.argv[2]} <= names, names
"""


def test_the_build_compiles_the_libraries_that_are_loaded() -> None:
    pytest.importorskip("hatchling")
    sys.path.insert(0, str(ROOT))
    try:
        import hatch_build
    finally:
        sys.path.remove(str(ROOT))
    package = ROOT / "cnpgen"
    files = [tuple(package / name for name in names) for names in hatch_build.LIBRARIES]
    assert set(files) == set(LIBRARIES)


def test_every_c_file_of_the_core_is_in_a_library() -> None:
    sources = set((ROOT / "cnpgen").rglob("*.c"))
    core = {path for path in sources if "addons" not in path.parts}
    assert core <= {path for paths in LIBRARIES for path in paths}


@needs_compiler
def test_a_built_library_is_used_until_its_source_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "answer.c"
    source.write_text("int answer(void) { return 42; }\n")
    folder = tmp_path / "built"
    folder.mkdir()
    monkeypatch.setattr(c_library, "BUILT_FOLDER", folder)
    files = build_libraries([[source]], folder)
    assert sorted(files) == sorted(folder.iterdir())
    assert find_built((source,)) == files[0]
    with monkeypatch.context() as context:
        context.setattr(c_library, "run_compiler", None)  # nothing is compiled
        assert build_libraries([[source]], folder) == files
        library = load_library((source,), tmp_path / "unused")
    assert library is not None
    assert library.answer() == 42
    source.write_text("int answer(void) { return 43; }\n")
    assert find_built((source,)) is None
    library = load_library((source,), tmp_path / "cache")
    assert library is not None
    assert library.answer() == 43


@needs_compiler
def test_a_built_library_that_cannot_be_loaded_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "answer.c"
    source.write_text("int answer(void) { return 42; }\n")
    monkeypatch.setattr(c_library, "BUILT_FOLDER", tmp_path)
    name = built_file_name((source,), this_variants()[0])
    (tmp_path / name).write_text("made for another C library")
    library = load_library((source,), tmp_path / "cache")
    assert library is not None
    assert library.answer() == 42


@pytest.mark.parametrize(
    ("flags", "names"),
    [
        (
            "avx avx2 fma bmi1 bmi2 f16c abm movbe avx512f avx512bw avx512cd avx512dq avx512vl",
            ["x86-64-v4", "x86-64-v3", "x86-64"],
        ),
        ("sse2 avx avx2 fma bmi1 bmi2 f16c abm movbe", ["x86-64-v3", "x86-64"]),
        ("sse2 avx avx2 bmi1 bmi2 f16c abm movbe", ["x86-64"]),
        ("", ["x86-64"]),
    ],
)
def test_the_variant_is_the_best_that_the_processor_can_run(
    flags: str, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(c_library.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(c_library, "processor_entry", lambda *_: flags)
    assert [variant.name for variant in this_variants.__wrapped__()] == names


def test_an_architecture_without_variants_has_no_built_libraries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(c_library.platform, "machine", lambda: "riscv64")
    assert build_libraries(LIBRARIES, tmp_path) == []
    assert this_variants.__wrapped__() == ()


def _digests(folder: Path, variant: Variant, cache: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", RESULTS, str(folder), variant.name],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "CC": "/nowhere/cc", "CNPGEN_CACHE": str(cache)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@needs_compiler
@pytest.mark.slow
@pytest.mark.skipif(
    not (find_compiler() and this_variants()[1:]),
    reason="this processor has no variants",
)
def test_all_variants_give_equal_bits_without_a_compiler(tmp_path: Path) -> None:
    folder = tmp_path / "built"
    folder.mkdir()
    files = build_libraries(LIBRARIES, folder)
    assert len(files) == len(LIBRARIES) * len(VARIANTS["x86_64"])
    results = {_digests(folder, one, tmp_path / "cache") for one in this_variants()}
    (text,) = results
    assert len(text.splitlines()) >= 7
