"""Import rules: packages import lower layers only, judges are independent, heavy libraries are imported on use."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Collection
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from xml.etree import ElementTree

import pytest

from cnpgen.schema.entry_points import entry_points

PACKAGE = Path(__file__).parents[1] / "cnpgen"

# Layers of packages, lowest first, as in architecture.md: a package imports packages of lower layers only.
LAYERS = (
    ("errors", "arrays", "documents"),
    ("schema", "store"),
    ("machine", "robots", "trajectory"),
    ("kernels", "world"),
    ("problems",),
    ("pipelines", "judges", "losses", "loader"),
    ("plans",),
    ("refine", "planner"),
    ("make", "training"),
    ("validate",),
    (
        "cli",
        "plugins",
        "recipes",
        "results",
        "scenes",
        "trajectories",
        "benchmark",
        "interop",
        "__init__",
    ),
    ("addons",),
    ("__main__",),
)
MAX_PACKAGES = 20  # of the core
# Packages of lower layers that must not be imported: the judge shares no code with the solvers that it checks.
SOLVERS = ("kernels", "pipelines", "losses", "refine", "planner")
INDEPENDENT = {
    "judges": SOLVERS,
    "world": SOLVERS,
    "addons.benchmark.simulator": SOLVERS,
}
HEAVY = (
    "casadi",
    "pinocchio",
    "coal",
    "h5py",
    "joblib",
    "scipy",
    "matplotlib",
    "daqp",
    "mujoco",
    "imageio",
    "ompl",
)
FRAMEWORKS = ("torch", "jax")
MODULES = sorted(
    path.relative_to(PACKAGE).with_suffix("")
    for path in PACKAGE.rglob("*.py")
    if "_recipes" not in path.parts
)


def name(module: Path) -> str:
    """Return the dotted name of a module without "cnpgen.": "store.files.atomic", "store" for its __init__."""
    parts = (
        module.parts[:-1]
        if module.name == "__init__" and len(module.parts) > 1
        else module.parts
    )
    return ".".join(parts)


def package(module: str) -> str:
    return module.partition(".")[0]


def layer(module: str) -> int:
    layers = [
        index for index, packages in enumerate(LAYERS) if package(module) in packages
    ]
    assert len(layers) == 1, (
        f"the package {package(module)!r} is in {len(layers)} layers, expected one"
    )
    return layers[0]


@cache
def source(module: Path) -> ast.Module:
    return ast.parse((PACKAGE / module).with_suffix(".py").read_text(encoding="utf-8"))


@cache
def imports(module: Path, *, everywhere: bool = True) -> frozenset[str]:
    """Return the names that a module imports, at module level or everywhere."""
    nodes = ast.walk(source(module)) if everywhere else iter(source(module).body)
    names: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            if node.module.partition(".")[0] == "cnpgen":
                names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


NAMES = {name(module): module for module in MODULES}


def modules_of(imported: Collection[str]) -> set[str]:
    """Return the package's own modules among imported names."""
    return {
        target
        for target in (item.removeprefix("cnpgen.") for item in imported)
        if target in NAMES
    }


def test_a_module_imports_its_own_package_and_lower_layers_only() -> None:
    for own, module in NAMES.items():
        for target in modules_of(imports(module)):
            inside = package(target) == package(own) != "addons"
            addons = package(own) == package(target) == "addons"
            assert inside or addons or layer(target) < layer(own), (
                f"cnpgen.{own} imports cnpgen.{target}, which is not in a lower layer"
            )


def test_the_docs_list_every_package_in_its_layer() -> None:
    page = (PACKAGE.parent / "docs" / "concepts" / "architecture.md").read_text(
        encoding="utf-8"
    )
    block = page.split("## Import rules")[1].split("```")[1]
    layers = tuple(
        tuple(line.split("  ")[0].split(", "))
        for line in block.splitlines()
        if line.strip()
    )
    assert layers == LAYERS
    folders = {
        name
        for row in layers
        for name in row
        if (PACKAGE / name / "__init__.py").is_file()
    }
    assert len(folders - {"addons"}) <= MAX_PACKAGES
    assert {name for row in LAYERS for name in row} == {
        package(module) for module in NAMES
    }


def test_the_picture_shows_every_package_above_the_layers_that_it_may_import() -> None:
    picture = ElementTree.parse(PACKAGE.parent / "docs" / "images" / "packages.svg")
    texts = [
        text
        for text in picture.iter("{http://www.w3.org/2000/svg}text")
        if text.get("class") == "n"
    ]
    heights = {str(text.text): float(text.get("y", "nan")) for text in texts}
    assert heights.pop("cnpgen") < min(heights.values())  # the title
    drawn = [
        {name for name, y in heights.items() if y == height}
        for height in sorted(set(heights.values()))
    ]
    assert drawn == [set(row) for row in reversed(LAYERS)]


def test_no_import_cycle_exists_not_even_for_types() -> None:
    graph = {own: modules_of(imports(module)) - {own} for own, module in NAMES.items()}
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError
    assert set(order) == set(graph)


@pytest.mark.parametrize("part", INDEPENDENT)
def test_judges_do_not_import_the_solvers_that_they_check(part: str) -> None:
    for own, module in NAMES.items():
        if own == part or own.startswith(f"{part}."):
            shared = {
                target
                for target in modules_of(imports(module))
                if package(target) in INDEPENDENT[part]
            }
            assert not shared, f"cnpgen.{own} imports {shared}"


def test_verdicts_evaluate_splines_by_their_own_code() -> None:
    """Judges of plans import control points and boundary conditions, but no evaluation of motions."""
    data = {"spline_motion", "spline_motion.Motion", "boundary", "boundary.Boundary"}
    for own, module in NAMES.items():
        if own.startswith("judges.plans."):
            prefix = "cnpgen.trajectory."
            shared = {
                item.removeprefix(prefix)
                for item in imports(module)
                if item.startswith(prefix)
            }
            assert shared <= data, f"cnpgen.{own} imports {shared - data}"


def test_every_trace_of_the_docs_needs_at_most_nine_files_and_never_returns_to_one() -> (
    None
):
    """A file of a later step imports none of an earlier step, so that its calls lead forwards only."""
    page = (PACKAGE.parent / "docs" / "concepts" / "architecture.md").read_text(
        encoding="utf-8"
    )
    traces = [
        re.findall(r"`([\w/]+)\.(?:py|c)`", section)
        for section in page.split("\n## ")
        if section[:2] == "A "
    ]
    assert len(traces) == 3
    for files in traces:
        assert len(files) == len(set(files)) <= 9, files
        names = [file.replace("/", ".") for file in files]
        assert set(names) <= set(NAMES), set(names) - set(NAMES)
        for step, own in enumerate(names):
            returns = modules_of(imports(NAMES[own])) & set(names[:step])
            assert not returns, (
                f"cnpgen.{own} imports {returns}, which an earlier step of its trace has left"
            )


def test_the_simulator_does_not_import_the_rest_of_the_benchmark() -> None:
    benchmark = "addons.benchmark"
    for own, module in NAMES.items():
        if own.startswith(f"{benchmark}.simulator"):
            around = {
                target
                for target in modules_of(imports(module))
                if target.startswith(f"{benchmark}.")
            }
            assert all(
                target.startswith(f"{benchmark}.simulator") for target in around
            ), (own, around)


ADDONS = sorted(path.parent.name for path in (PACKAGE / "addons").glob("*/__init__.py"))


def addon(module: str) -> str:
    """Return the name of the add-on of a module without "cnpgen."; empty for the core."""
    parts = module.split(".")
    return parts[1] if parts[0] == "addons" and len(parts) > 1 else ""


def needs(name: str) -> set[str]:
    """Return ``NEEDS`` of the package of an add-on."""
    tree = source(Path("addons") / name / "__init__")
    values = [
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "NEEDS"
    ]
    return set(ast.literal_eval(values[0])) if values else set()


def test_an_addon_imports_the_core_and_the_addons_that_it_names() -> None:
    used: dict[str, set[str]] = {name: set() for name in ADDONS}
    for own, module in NAMES.items():
        if addon(own):
            others = {addon(target) for target in modules_of(imports(module))}
            used[addon(own)] |= others - {"", addon(own)}
    assert {name: needs(name) for name in ADDONS} == used


def test_the_core_names_no_addon() -> None:
    """Neither imports, nor stubs, nor strings of the core contain the path of a module of an add-on."""
    path = re.compile(r"cnpgen[./]addons[./]\w+")
    for file in [*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.pyi")]:
        place = file.relative_to(PACKAGE)
        if place.parts[0] in {"addons", "_recipes"}:
            continue
        tree = ast.parse(file.read_text(encoding="utf-8"))
        documented = {id(node) for node in docstrings(tree)}
        texts = [
            node.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in documented
        ]
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                texts += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                texts += [f"{node.module}.{alias.name}" for alias in node.names]
        assert [text for text in texts if path.search(text)] == [], place


def docstrings(tree: ast.Module) -> list[ast.AST]:
    """Return the constants that are docstrings."""
    holders = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    first = [
        node.body[0]
        for node in ast.walk(tree)
        if isinstance(node, holders)
        if node.body
    ]
    return [node.value for node in first if isinstance(node, ast.Expr)]


def test_every_entry_point_names_an_object_of_an_addon() -> None:
    declared = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text("utf-8"))
    groups = declared["project"]["entry-points"]
    assert len(groups) > 8
    for group, entries in groups.items():
        for name, value in entries.items():
            module, _, attribute = value.partition(":")
            own = module.removeprefix("cnpgen.")
            assert addon(own) in ADDONS, (group, name)
            assert own in NAMES, (group, name, value)
            assert not attribute or defines(NAMES[own], attribute), (group, name, value)
    installed = {
        (group, entry.name, entry.value)
        for group, entries in entry_points().items()
        for entry in entries
        if entry.distribution == "cnpgen"
    }
    assert installed == {
        (group, name, value)
        for group, entries in groups.items()
        for name, value in entries.items()
    }, "the entry points of this environment are old: pip install -e ."


def defines(module: Path, attribute: str) -> bool:
    """Return whether a module defines, assigns or imports a name."""
    return any(
        getattr(node, "name", None) == attribute
        or (
            isinstance(node, ast.Name)
            and isinstance(node.ctx, ast.Store)
            and node.id == attribute
        )
        or (
            isinstance(node, ast.Import | ast.ImportFrom)
            and attribute in {alias.asname or alias.name for alias in node.names}
        )
        for node in ast.walk(source(module))
    )


def test_entry_points_are_those_that_the_standard_library_finds() -> None:
    entry_points.cache_clear()  # another test may have installed a package
    found = importlib.metadata.distribution("cnpgen").entry_points
    expected = {
        (entry.group, entry.name, entry.value)
        for entry in found
        if entry.group.startswith("cnpgen.")
    }
    assert len(expected) > 50
    assert expected == {
        (entry.group, entry.name, entry.value)
        for entries in entry_points().values()
        for entry in entries
    }


def test_problems_import_kernels_and_world_on_use_only() -> None:
    for own, module in NAMES.items():
        if package(own) == "problems":
            loaded = modules_of(imports(module, everywhere=False))
            assert not {
                target for target in loaded if package(target) in {"kernels", "world"}
            }, own


def test_every_module_is_imported_or_registered() -> None:
    """Registered kinds and commands are loaded by name; facades are for users."""
    from cnpgen.cli.commands import _CORE
    from cnpgen.schema import registry

    used = {target for module in MODULES for target in modules_of(imports(module))}
    registered = [
        spec for kinds in registry.BUILT_IN.values() for spec in kinds.values()
    ]
    registered += [entry.value for group in entry_points().values() for entry in group]
    by_name = {spec.partition(":")[0].removeprefix("cnpgen.") for spec in registered}
    by_name |= {f"cli.{module}" for module in _CORE.values()}
    unused = {
        own
        for own, module in NAMES.items()
        if own not in used | by_name | modules_of(public_modules())
        and module.name != "__init__"
    }
    assert unused <= {
        "__main__",
        "benchmark",
        "interop.jax",
        "interop.lerobot",
        "interop.torch",
        "plugins",
        "recipes",
        "results",
        "scenes",
        "trajectories",
        "training.select_via_points",
    }


def public_modules() -> set[str]:
    """Return the modules of the public names in the stubs."""
    stubs = [
        ast.parse(path.read_text(encoding="utf-8")) for path in PACKAGE.rglob("*.pyi")
    ]
    return {
        str(node.module)
        for stub in stubs
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
    }


def test_no_module_imports_a_heavy_library_at_module_level() -> None:
    for own, module in NAMES.items():
        heavy = {
            imported.split(".")[0] for imported in imports(module, everywhere=False)
        } & set(HEAVY)
        assert not heavy, f"cnpgen.{own} imports {heavy}"


def test_only_the_bridge_of_a_framework_imports_it() -> None:
    for module in MODULES:
        frameworks = {imported.split(".")[0] for imported in imports(module)} & set(
            FRAMEWORKS
        )
        parts = name(module).split(".")
        own = set(parts[2:3]) if parts[:2] == ["addons", "frameworks"] else set()
        assert frameworks <= own, f"{name(module)} imports {frameworks}"


def python(code: str) -> str:
    root = str(PACKAGE.parent)
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=root,
    )
    return done.stdout.splitlines()[-1]


MAKING = ("make-dataset", "validate", "inspect", "list", "show", "doctor")
PLANNING = ("complete", "evaluate", "simulate", "benchmark", "export")


def test_imports_and_help_texts_load_no_heavy_library() -> None:
    """One process runs all steps and reports the first step that loads a heavy library."""
    code = f"""
import sys
import tomllib
from contextlib import suppress
loaded = {{}}
def check(step):
    for heavy in set({(*HEAVY, *FRAMEWORKS, "numpy.testing")!r}) & set(sys.modules):
        loaded.setdefault(heavy, step)
import cnpgen
check("import cnpgen")
import cnpgen.make.recipe
check("import cnpgen.make.recipe")
from cnpgen.cli.main import main
main(["list"])
check("list")
for command in {("", *MAKING, *PLANNING)!r}:
    with suppress(SystemExit):
        main([*command.split(), "--help"])
    check(command + " --help")
print("LOADED", loaded)
"""
    assert python(code) == "LOADED {}"


def test_the_verifier_loads_no_solver_module() -> None:
    """Verify rows in a process and check that it has loaded no kernel and no stage."""
    code = """
import sys
import tomllib
import numpy as np
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.load_robot import load_robot
from cnpgen.judges.rows.verify import verify_rows
problem = load_problem("heavy-object")
robot = load_robot(problem)
zero = np.zeros((1, robot.n))
fields = {"start_q": zero, "start_dq": zero, "start_ddq": zero, "goal_q": zero, "goal_dq": zero}
verify_rows(problem, robot, {**fields, "start_xyz": np.ones((1, 3)), "goal_xyz": np.ones((1, 3))})
solvers = ("cnpgen.kernels", "cnpgen.pipelines", "cnpgen.refine", "casadi")
print("LOADED", *sorted(m for m in sys.modules if m.startswith(solvers)))
"""
    assert python(code) == "LOADED"
