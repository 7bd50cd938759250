"""Rooms import rooms of lower floors only, judges stand apart, nothing heavy is imported before it is needed."""

import ast
import subprocess
import sys
from collections.abc import Collection
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from xml.etree import ElementTree

import pytest

PACKAGE = Path(__file__).parents[1] / "cnpgen"

# Floors of rooms, the ground first, as docs/architecture.md has them: a room imports rooms of the floors below only.
FLOORS = (
    ("errors",),
    ("schema", "store"),
    ("machine", "robots", "trajectory", "loader"),
    ("kernels", "world"),
    ("problems",),
    ("pipelines", "judges", "losses"),
    ("plans", "plugins"),
    ("refine", "planner"),
    ("make", "training", "interop"),
    ("validate", "benchmark"),
    ("cli", "__init__"),
    ("__main__",),
)
MOST_ROOMS = 25  # more than anybody keeps in mind need a reason
# What a room must not import although it stands on a floor below: judges share no code with what they judge.
SOLVERS = ("kernels", "pipelines", "losses", "refine", "planner")
APART = {"judges": SOLVERS, "world": SOLVERS, "benchmark.simulator": SOLVERS}
HEAVY = ("casadi", "pinocchio", "coal", "h5py", "joblib", "scipy", "matplotlib", "daqp", "mujoco", "imageio", "ompl")
FRAMEWORKS = ("torch", "jax", "tensorflow")
BRIDGES = ("interop.tensorflow",)  # those of one file; users import them
MODULES = sorted(
    path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py") if "_recipes" not in path.parts
)


def name(module: Path) -> str:
    """Dotted name of a module, without the package's: "store.files.atomic", "store" for its __init__."""
    parts = module.parts[:-1] if module.name == "__init__" and len(module.parts) > 1 else module.parts
    return ".".join(parts)


def room(module: str) -> str:
    return module.partition(".")[0]


def floor(module: str) -> int:
    found = [index for index, rooms in enumerate(FLOORS) if room(module) in rooms]
    assert len(found) == 1, f"the room {room(module)!r} is on {len(found)} floors of docs/architecture.md, expected one"
    return found[0]


@cache
def source(module: Path) -> ast.Module:
    return ast.parse((PACKAGE / module).with_suffix(".py").read_text(encoding="utf-8"))


@cache
def imports(module: Path, *, everywhere: bool = True) -> frozenset[str]:
    """Names that a module imports: at its top, which is not for type checkers only, or everywhere."""
    nodes = ast.walk(source(module)) if everywhere else iter(source(module).body)
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            if node.module.partition(".")[0] == "cnpgen":
                found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(found)


NAMES = {name(module): module for module in MODULES}


def modules_of(imported: Collection[str]) -> set[str]:
    """The package's own modules among imported names."""
    return {target for target in (item.removeprefix("cnpgen.") for item in imported) if target in NAMES}


def test_a_module_imports_its_own_room_and_those_of_lower_floors() -> None:
    for own, module in NAMES.items():
        for target in modules_of(imports(module)):
            assert room(target) == room(own) or floor(target) < floor(own), (
                f"cnpgen.{own} imports cnpgen.{target}, which is not on a lower floor"
            )


def test_every_room_is_named_in_the_docs_on_its_floor() -> None:
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    block = page.split("## Who may import whom")[1].split("```")[1]
    floors = tuple(tuple(line.split("  ")[0].split(", ")) for line in block.splitlines() if line.strip())
    assert floors == FLOORS
    assert sum(map(len, floors)) <= MOST_ROOMS
    assert {each for row in FLOORS for each in row} == {room(module) for module in NAMES}


def test_the_picture_shows_every_room_above_those_that_it_may_import() -> None:
    picture = ElementTree.parse(PACKAGE.parent / "docs" / "images" / "house.svg")
    texts = [text for text in picture.iter("{http://www.w3.org/2000/svg}text") if text.get("class") == "n"]
    heights = {str(text.text): float(text.get("y", "nan")) for text in texts}
    assert heights.pop("cnpgen") < min(heights.values())  # the roof
    drawn = [{each for each, y in heights.items() if y == height} for height in sorted(set(heights.values()))]
    assert drawn == [set(row) for row in reversed(FLOORS)]


def test_no_module_imports_itself_in_a_circle_not_even_for_types() -> None:
    graph = {own: modules_of(imports(module)) - {own} for own, module in NAMES.items()}
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError
    assert set(order) == set(graph)


@pytest.mark.parametrize("part", APART)
def test_a_judge_shares_no_code_with_what_it_judges(part: str) -> None:
    for own, module in NAMES.items():
        if own == part or own.startswith(f"{part}."):
            shared = {target for target in modules_of(imports(module)) if room(target) in APART[part]}
            assert not shared, f"cnpgen.{own} imports {shared}"


def test_the_simulator_imports_nothing_of_the_benchmark_around_it() -> None:
    for own, module in NAMES.items():
        if own.startswith("benchmark.simulator"):
            around = {target for target in modules_of(imports(module)) if room(target) == "benchmark"}
            assert all(target.startswith("benchmark.simulator") for target in around - {"benchmark"}), (own, around)


def test_the_symbolic_form_of_a_constraint_is_built_only_where_it_is_asked_for() -> None:
    for own, module in NAMES.items():
        if room(own) == "problems":
            loaded = modules_of(imports(module, everywhere=False))
            assert not {target for target in loaded if room(target) in {"kernels", "world"}}, own


def test_every_file_has_a_reader() -> None:
    """What nothing imports is left over; kinds are found by their names, and faces and bridges are for users."""
    used = {target for module in MODULES for target in modules_of(imports(module))} | modules_of(public_modules())
    by_name = {value.partition(":")[0].removeprefix("cnpgen.") for value in kinds_by_name()}
    left = {own for own, module in NAMES.items() if own not in used | by_name and module.name != "__init__"}
    assert left <= {"__main__", "plugins", *BRIDGES}


def public_modules() -> set[str]:
    """The modules of the names that users type, as the package's stub lists them."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    return {str(node.module) for node in stub.body if isinstance(node, ast.ImportFrom)}


def kinds_by_name() -> set[str]:
    from cnpgen.schema import registry

    return {spec for group in registry.BUILT_IN.values() for spec in group.values()}


def test_no_module_imports_a_heavy_library_at_its_top() -> None:
    for own, module in NAMES.items():
        found = {imported.split(".")[0] for imported in imports(module, everywhere=False)}
        assert not found & set(HEAVY), f"cnpgen.{own} imports {found & set(HEAVY)}"


def test_only_the_bridge_of_a_framework_imports_it() -> None:
    for module in MODULES:
        found = {imported.split(".")[0] for imported in imports(module)} & set(FRAMEWORKS)
        own = set(name(module).split(".")[1:2]) if room(name(module)) == "interop" else set()
        assert found <= own, f"{name(module)} imports {found}"


def python(code: str) -> str:
    root = str(PACKAGE.parent)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    return done.stdout.splitlines()[-1]


MAKING = ("make-dataset", "validate", "inspect", "list", "show", "doctor")
PLANNING = ("complete", "evaluate", "simulate", "benchmark", "export")


def test_importing_recipes_or_listing_them_or_asking_for_help_loads_nothing_heavy() -> None:
    """One process does one after the other, and names the first that loads it."""
    code = f"""
import sys
from contextlib import suppress
loaded = {{}}
def look(what):
    for heavy in set({(*HEAVY, *FRAMEWORKS, "numpy.testing")!r}) & set(sys.modules):
        loaded.setdefault(heavy, what)
import cnpgen
look("import cnpgen")
import cnpgen.make.load
look("import cnpgen.make.load")
from cnpgen.cli.main import main
main(["list"])
look("list")
for command in {("", *MAKING, *PLANNING)!r}:
    with suppress(SystemExit):
        main([*command.split(), "--help"])
    look(command + " --help")
print("LOADED", loaded)
"""
    assert python(code) == "LOADED {}"


def test_the_verifier_runs_without_a_module_of_what_it_verifies() -> None:
    """Not only by what the source says: rows are verified and then there is no kernel or stage in the process."""
    code = """
import sys
import numpy as np
from cnpgen.problems.load import load_problem
from cnpgen.problems.robot import load_robot
from cnpgen.judges.rows.verify import verify_rows
problem = load_problem("heavy-object")
robot = load_robot(problem)
zero = np.zeros((1, robot.n))
fields = {"start_q": zero, "start_dq": zero, "start_ddq": zero, "goal_q": zero, "goal_dq": zero}
verify_rows(problem, robot, {**fields, "start_xyz": np.ones((1, 3)), "goal_xyz": np.ones((1, 3))})
apart = ("cnpgen.kernels", "cnpgen.pipelines", "cnpgen.refine", "casadi")
print("LOADED", *sorted(m for m in sys.modules if m.startswith(apart)))
"""
    assert python(code) == "LOADED"
