"""Dependencies point one way, nothing heavy is imported before it is needed, and the rim is where effects are."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from itertools import pairwise
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "cnpgen"

# Layers from the top of docs/architecture.md downwards; a module may import those of its own layer and above.
LAYERS = (
    ("errors", "units", "fields", "outcome", "wording", "threads", "arguments", "signals"),
    ("workers",),
    ("schema", "parsing"),
    ("constraints", "pipelines.stage"),
    ("plugins",),
    ("recipes", "recipe_files", "recipe_checks", "library", "data_card"),
    ("robots",),
    ("kernels",),
    ("pipelines",),
    ("store", "trajectory", "verify"),
    ("verdict", "plans", "losses", "refine", "loader", "export", "plan_plots"),
    ("certification",),
    ("network", "planner"),
    ("interop",),
    ("make_shard", "make_plan", "make"),
    ("consistency", "shard_checks", "deep_check", "regeneration"),
    ("validation", "inspection", "describe", "plots", "doctor"),
    ("evaluation", "refinement", "solving"),
    ("training",),
    ("cli", "__main__", "__init__"),
)
# What a part must not import although a layer above it may be older: the judges share no code with what they judge.
APART = {
    "store": ("kernels", "pipelines", "robots", "refine"),
    "loader": ("kernels", "pipelines", "robots", "refine", "verify", "recipes", "trajectory"),
    "verify": ("kernels", "pipelines", "refine", "robots.symbolic", "robots.linalg", "robots.boxes"),
    "verdict": ("kernels", "pipelines", "refine", "robots.symbolic", "robots.linalg", "robots.boxes"),
    "trajectory": ("kernels", "pipelines", "robots", "refine", "verify"),
}
HEAVY = ("casadi", "pinocchio", "coal", "h5py", "joblib", "scipy", "matplotlib", "daqp")
FRAMEWORKS = ("torch", "jax", "tensorflow")
MODULES = sorted(
    path.relative_to(PACKAGE).with_suffix("") for path in PACKAGE.rglob("*.py") if "_recipes" not in path.parts
)


def name(module: Path) -> str:
    parts = module.parts[:-1] if module.name == "__init__" and len(module.parts) > 1 else module.parts
    return ".".join(parts)


def layer(module: str) -> int:
    best = max((prefix for row in LAYERS for prefix in row if within(module, prefix)), key=len, default=None)
    assert best is not None, f"cnpgen.{module} is in no layer of docs/architecture.md"
    return next(index for index, row in enumerate(LAYERS) if best in row)


def within(module: str, prefix: str) -> bool:
    return module == prefix or module.startswith(prefix + ".")


def imports(module: Path, *, everywhere: bool = True) -> set[str]:
    """Names that a module imports at run time: at its top, or also inside functions."""
    tree = ast.parse((PACKAGE / module).with_suffix(".py").read_text(encoding="utf-8"))
    nodes = ast.walk(tree) if everywhere else iter(tree.body)
    typing_only = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for child in ast.walk(node)
    }
    found: set[str] = set()
    for node in nodes:
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            if node.module == "cnpgen":
                found.update(f"cnpgen.{alias.name}" for alias in node.names)
    return found


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_a_module_imports_only_its_own_layer_and_those_above(module: Path) -> None:
    own = layer(name(module))
    for imported in imports(module):
        target = imported.removeprefix("cnpgen.")
        if (
            imported.startswith("cnpgen.")
            and (PACKAGE / target.split(".")[0]).with_suffix(".py").exists() | (PACKAGE / target.split(".")[0]).is_dir()
        ):
            if within(name(module), "constraints") and target == "robots.boxes":
                continue  # the symbolic form of a constraint, built only where kernels are
            assert layer(target) <= own, f"cnpgen.{name(module)} imports cnpgen.{target} of a later layer"


def test_the_layers_of_the_docs_are_these() -> None:
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
    block = page.split("## Who may import whom")[1].split("```")[1]
    lines = [line.split("  ")[0].split(", ") for line in block.splitlines() if line.strip() and line[0] != " "]
    named = [module for line in lines for module in line]
    assert {*named, "__main__", "__init__"} == {module for row in LAYERS for module in row}
    for above, below in pairwise(lines):
        assert max(map(layer, above)) <= min(map(layer, below)), f"{above} stand above {below}"


@pytest.mark.parametrize("part", APART)
def test_a_judge_shares_no_code_with_what_it_judges(part: str) -> None:
    for module in MODULES:
        if within(name(module), part):
            for imported in imports(module):
                target = imported.removeprefix("cnpgen.")
                allowed = (
                    target in {"pipelines.stage", "robots.robot", "robots.obstacles", "robots.chain"}
                    and part != "store"
                )
                assert allowed or not any(within(target, apart) for apart in APART[part]), (
                    f"{name(module)} imports {target}"
                )


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_no_module_imports_a_heavy_library_at_its_top(module: Path) -> None:
    found = {imported.split(".")[0] for imported in imports(module, everywhere=False)}
    assert not found & set(HEAVY)


def test_only_the_bridge_of_a_framework_imports_it() -> None:
    for module in MODULES:
        found = {imported.split(".")[0] for imported in imports(module)} & set(FRAMEWORKS)
        own = {framework for framework in FRAMEWORKS if within(name(module), f"interop.{framework}")}
        assert found <= own, f"{name(module)} imports {found}"


@pytest.mark.parametrize(
    "statement", ["import cnpgen", "import cnpgen.make.load", "from cnpgen.cli.main import main; main(['list'])"]
)
def test_importing_recipes_or_listing_them_loads_nothing_heavy(statement: str) -> None:
    code = f"{statement}\nimport sys\nprint('LOADED', *sorted(set({(*HEAVY, *FRAMEWORKS)!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "LOADED"


def modules_of(imported: set[str]) -> set[str]:
    """The package's own modules among imported names."""
    known = {name(module) for module in MODULES}
    return {target for target in (item.removeprefix("cnpgen.") for item in imported) if target in known}


def test_no_module_imports_itself_in_a_circle_not_even_inside_functions() -> None:
    graph = {name(module): modules_of(imports(module)) - {name(module)} for module in MODULES}
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError
    assert set(order) == set(graph)


def python(code: str) -> str:
    root = str(PACKAGE.parent)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    return done.stdout.splitlines()[-1]


@pytest.mark.parametrize(
    "command", ["", "make-dataset", "validate", "inspect", "list", "show", "evaluate", "export", "doctor"]
)
def test_help_is_given_without_loading_anything_heavy(command: str) -> None:
    code = f"""
import sys
from contextlib import suppress
from cnpgen.cli.main import main
with suppress(SystemExit):
    main([*{command.split()!r}, "--help"])
print("LOADED", *sorted(set({(*HEAVY, *FRAMEWORKS, "numpy.testing")!r}) & set(sys.modules)))
"""
    assert python(code) == "LOADED"


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
apart = ("cnpgen.kernels", "cnpgen.pipelines.", "cnpgen.symbolic.state", "cnpgen.symbolic.boxes", "casadi")
print("LOADED", *sorted(m for m in sys.modules if m.startswith(apart) and m != "cnpgen.pipelines.stages.stage"))
"""
    assert python(code) == "LOADED"
