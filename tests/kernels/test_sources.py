"""The key of a cached tape covers every module that its builder imports."""

import ast
import shutil
from functools import cache
from pathlib import Path

import casadi as ca
import pytest

from cnpgen.kernels import library as library_module
from cnpgen.kernels.library import (
    BUILDER_PACKAGES,
    PACKAGE_FOLDER,
    KernelLibrary,
    subpackage_of,
)
from cnpgen.pipelines.stages.reach import tip_state
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem

# Modules that builders import and whose changes do not affect tapes.
WITHOUT_EFFECT = {
    "cnpgen.arrays": "types of arrays",
    "cnpgen.documents": "types of tables, names and paths",
    "cnpgen.errors": "the words of exceptions",
    "cnpgen.schema": "how recipes are read: what was read is in the problem's identity",
    "cnpgen.machine.versions": "the processor, which is in no tape",
    "cnpgen.machine.threads": "how many threads sum, which is in no tape",
    "cnpgen.world": "what Pinocchio and Coal measure, which is in no tape",
    "cnpgen.store": "how columns are described and files are written",
}
MODULES = {
    ".".join(
        path.relative_to(PACKAGE_FOLDER.parent).with_suffix("").parts
    ).removesuffix(".__init__"): path
    for path in PACKAGE_FOLDER.rglob("*.py")
}


@cache
def imports(module: str) -> set[str]:
    """Return the modules of the package that a module imports at run time, also inside functions."""
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    blocks = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
    ]
    typing_only = {id(node) for block in blocks for node in ast.walk(block)}
    found: set[str] = set()
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update(
                [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            )
    return found & MODULES.keys()


def closure(module: str) -> set[str]:
    """Return all modules of the package that a module imports, directly or not."""
    seen, waiting = {module}, [module]
    while waiting:
        new = imports(waiting.pop()) - seen
        seen |= new
        waiting += new
    return seen


def makes_functions(module: str) -> bool:
    """Return whether a module calls ``casadi.Function``, as builders do."""
    text = MODULES[module].read_text(encoding="utf-8")
    if "Function(" not in text:
        return False
    calls = (
        node.func for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)
    )
    return any(
        isinstance(call, ast.Attribute) and call.attr == "Function" for call in calls
    )


BUILDERS = sorted(filter(makes_functions, MODULES))


def test_the_builders_of_every_package_are_found() -> None:
    assert {subpackage_of(name) for name in BUILDERS} == {
        "addons/benchmark",
        "addons/deploy",
        "losses",
        "pipelines",
        "planner",
        "refine",
        "kernels",
        "problems",
    }


OF_CORE = [name for name in BUILDERS if not name.startswith("cnpgen.addons.")]


@pytest.mark.parametrize("module", OF_CORE)
def test_all_imports_of_a_builder_are_in_the_key_of_its_tapes(module: str) -> None:
    own = subpackage_of(module).replace("/", ".")
    hashed = tuple(f"cnpgen.{package}" for package in (*BUILDER_PACKAGES, own))
    covered = tuple(f"{package}." for package in (*hashed, *WITHOUT_EFFECT))
    missing = sorted(
        name for name in closure(module) if not f"{name}.".startswith(covered)
    )
    assert not missing, (
        f"{module} imports {missing}, whose changes would not change its tapes"
    )


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of the package's source that replaces it in digests."""
    folder = tmp_path / "cnpgen"
    shutil.copytree(
        PACKAGE_FOLDER, folder, ignore=shutil.ignore_patterns("__pycache__", "*.so")
    )
    monkeypatch.setattr(library_module, "PACKAGE_FOLDER", folder)
    return folder


def tapes(folder: Path) -> set[str]:
    """Return the names of the cached tapes after loading a kernel with the present source."""
    library_module._digest_of.cache_clear()
    KernelLibrary(
        "numpy", folder, "problem", {"robot": load_robot(load_problem("airhockey"))}
    ).load(tip_state)
    return {path.name for path in (folder / "tape").iterdir()}


@pytest.mark.parametrize(
    "changed",
    ["problems/constraints/joint.py", "pipelines/stages/reach.py", "robots/chain.py"],
)
def test_a_change_in_a_subfolder_of_a_package_changes_the_key_of_a_tape(
    copy: Path, tmp_path: Path, changed: str
) -> None:
    before = tapes(tmp_path)
    assert len(before) == 1
    with (copy / changed).open("a", encoding="utf-8") as file:
        file.write("# changed\n")
    assert len(tapes(tmp_path)) == 2


def test_a_change_that_no_builder_imports_changes_no_key(
    copy: Path, tmp_path: Path
) -> None:
    before = tapes(tmp_path)
    (copy / "cli" / "main.py").write_text("")
    (copy / "losses" / "metric.py").write_text("")
    assert tapes(tmp_path) == before


def of_a_plug_in() -> ca.Function:
    """Build a function outside the package."""
    x = ca.SX.sym("x")
    return ca.Function("of_a_plug_in", [x], [2 * x])


def test_the_key_of_a_plug_in_s_tape_covers_the_whole_package(copy: Path) -> None:
    before = library_module._source_digests(of_a_plug_in)
    library_module._digest_of.cache_clear()
    (copy / "cli" / "main.py").write_text("")
    assert library_module._source_digests(of_a_plug_in)[0] != before[0]


def test_losses_depend_on_the_sources_of_published_rules(copy: Path) -> None:
    from cnpgen.losses.integrand import loss_values

    library_module._digest_of.cache_clear()
    before = library_module._source_digests(loss_values)
    with (copy / "addons" / "paper" / "published_conditions.py").open("a") as file:
        file.write("# changed\n")
    library_module._digest_of.cache_clear()
    assert library_module._source_digests(loss_values) != before
