"""Everything that public functions take and return is public, so that users can name it in their own annotations."""

import ast
import functools
import importlib
import inspect
import pydoc
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest

import cnpgen
import cnpgen.plugins
from cnpgen.schema.entry_points import entry_points
from cnpgen.schema.public_names import NAMES

SPECIAL = {"__init__", "__call__", "__getitem__", "__iter__"}
INNER = {  # classes in public signatures that users neither construct nor annotate
    "JudgedLimits": "limits that an evaluation applied, with who states them",
    "SceneColumns": "places in the values of a scene, returned by Problem.scene_columns",
    "Columns": "layout of a Batch, used through the names of its fields",
    "BatchPartition": "constructed by Dataset.batches",
    "RowFormat": "constructed by Dataset.batches",
    "Position": "constructed by Dataset.batches",
    "Scaling": "protocol that Normalization satisfies",
    "Shard": "constructed by load_dataset",
    "ShardReader": "constructed by load_dataset",
    "SplitShards": "constructed by load_dataset",
    "Missing": "stands for an omitted argument",
    "ObservationBackend": "argument of observations, constructed by observe",
    "Primitives": "bodies of scenes, returned by scene_bodies and passed to observe",
    "Observation": "base class of the observations in cnpgen.scenes",
    "Robot": "argument of kernels and worlds of plug-ins; RobotModel is the public robot",
    "Kinematics": "attribute of SymbolicState, used through its fields",
    "KernelLibrary": "attribute of Context, used through its method load",
    "PathWorld": "argument of Constraint.met, with the fields of World for many states",
}


@functools.cache
def names_in(module: str) -> dict[str, Any]:
    """Names of a module, those that it imports for type checkers only as well."""
    found = dict(vars(importlib.import_module(module)))
    for node in ast.walk(ast.parse(inspect.getsource(sys.modules[module]))):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            for line in node.body:
                if isinstance(line, ast.ImportFrom) and line.module:
                    home = importlib.import_module(line.module)
                    found |= {
                        alias.asname or alias.name: getattr(home, alias.name)
                        for alias in line.names
                    }
                elif isinstance(line, ast.Import):
                    found |= {
                        alias.asname or alias.name: importlib.import_module(alias.name)
                        for alias in line.names
                    }
    return found


def classes_in(hint: Any) -> Iterator[type]:
    """Classes of cnpgen in an annotation."""
    for part in hint if isinstance(hint, list | tuple) else typing.get_args(hint):
        yield from classes_in(part)
    for each in (hint, typing.get_origin(hint)):
        if isinstance(each, type) and each.__module__.startswith("cnpgen."):
            yield each


def functions_of(kind: type) -> Iterator[FunctionType]:
    """Methods and properties that users call."""
    for name, member in vars(kind).items():
        if name in SPECIAL or not name.startswith("_"):
            inner = (
                member.fget
                if isinstance(member, property)
                else getattr(member, "func", member)
            )
            function = inspect.unwrap(getattr(inner, "__func__", inner))
            if inspect.isfunction(function) and function.__module__.startswith(
                "cnpgen."
            ):
                yield function


def annotated(public: Any) -> Iterator[tuple[str, Any]]:
    """Annotations in the signature of a function, or in the fields, methods and properties of a class."""
    if inspect.isfunction(public):
        yield from typing.get_type_hints(public, names_in(public.__module__)).items()
    elif inspect.isclass(public):
        for base in (
            each for each in public.__mro__ if each.__module__.startswith("cnpgen.")
        ):
            for name, hint in typing.get_type_hints(
                base, names_in(base.__module__)
            ).items():
                if not name.startswith("_"):
                    yield name, hint
            for function in functions_of(base):
                for name, hint in annotated(function):
                    yield f"{function.__name__}: {name}", hint


MODULES = (
    "benchmark",
    "errors",
    "losses",
    "plugins",
    "recipes",
    "results",
    "scenes",
    "trajectories",
)
MAX_NAMES, MAX_HELP_LINES = 43, 400
MAX_ANNOTATION_CHARACTERS = (
    80  # of one argument in a signature; NumPy's ArrayLike in full has 300
)


def public_names() -> dict[str, Any]:
    """Return all public names: those of the package and of its public modules."""
    names = {
        name: getattr(cnpgen, name) for name in cnpgen.__all__ if name != "__version__"
    }
    for module in map(importlib.import_module, (f"cnpgen.{name}" for name in MODULES)):
        listed = getattr(
            module, "__all__", [name for name in vars(module) if name.endswith("Error")]
        )
        names |= {f"{module.__name__}.{name}": getattr(module, name) for name in listed}
    return names


def test_every_class_in_a_public_signature_is_public() -> None:
    known = list(public_names().values())
    inner = {
        (kind, f"{owner.__name__}({where})")
        for owner in known
        for where, hint in annotated(owner)
        for kind in classes_in(hint)
        if kind not in known
    }
    assert [
        f"{kind.__name__} in {where}"
        for kind, where in inner
        if kind.__name__ not in INNER
    ] == []
    assert {kind.__name__ for kind, _ in inner} == set(INNER), (
        "listed here, but in no public signature"
    )


def test_the_walk_sees_functions_fields_methods_and_properties() -> None:
    classes = {
        kind
        for owner in (cnpgen.load_plans, cnpgen.Plans, cnpgen.Motion, cnpgen.RobotModel)
        for _, hint in annotated(owner)
        for kind in classes_in(hint)
    }
    assert {
        cnpgen.Problem,
        cnpgen.Boundary,
        cnpgen.Scene,
        cnpgen.recipes.TrajectorySpec,
    } <= classes


STUBS = ["cnpgen", *(f"cnpgen.{name}" for name in MODULES if name != "errors")]


@pytest.mark.parametrize("package", STUBS)
def test_a_stub_lists_every_name_once_and_nothing_else(package: str) -> None:
    module = importlib.import_module(package)
    stub = Path(str(module.__file__)).with_suffix(".pyi").read_text(encoding="utf-8")
    imported = [
        node
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom) and node.module != "typing"
    ]
    own = [alias.asname for node in imported for alias in node.names]
    added = [
        entry.name.removeprefix(f"{package}.")
        for entry in entry_points()[NAMES]
        if entry.name.rpartition(".")[0] == package
    ]
    assert ("def __getattr__(" in stub) == bool(added)
    names = sorted([*own, *added])
    assert names == sorted(set(names)) == sorted(module.__all__) == dir(module)


def test_the_package_has_few_names_and_help_is_short() -> None:
    assert len(cnpgen.__all__) <= MAX_NAMES
    lines = pydoc.plain(pydoc.render_doc(cnpgen)).splitlines()
    assert len(lines) <= MAX_HELP_LINES
    assert any("cnpgen.make_dataset(" in line for line in lines[:15])
    text = "\n".join(lines)
    assert all(
        f"``{name}``" in text for name in cnpgen.__all__ if name != "__version__"
    )


def test_signatures_name_aliases_of_types_and_do_not_expand_them() -> None:
    public = public_names().values()
    classes = [kind for kind in public if inspect.isclass(kind)]
    bases = {
        base
        for kind in classes
        for base in kind.__mro__
        if base.__module__.startswith("cnpgen.")
    }
    functions = [each for each in public if inspect.isfunction(each)]
    functions += [function for base in bases for function in functions_of(base)]
    assert len(classes) > 80
    assert len(functions) > 300
    long = {}
    for function in (*classes, *functions):
        signature = inspect.signature(function)
        hints = [
            signature.return_annotation,
            *(each.annotation for each in signature.parameters.values()),
        ]
        texts = [
            text
            for text in map(inspect.formatannotation, hints)
            if len(text) > MAX_ANNOTATION_CHARACTERS
        ]
        long |= {function.__qualname__: texts} if texts else {}
    assert long == {}, "let the module begin with 'from __future__ import annotations'"


def test_public_modules_begin_with_one_sentence() -> None:
    for name in MODULES:
        summary = str(importlib.import_module(f"cnpgen.{name}").__doc__).splitlines()[0]
        assert summary.endswith("."), name


def test_importing_the_package_loads_none_of_its_packages() -> None:
    code = "import sys, cnpgen; print(*sorted(name for name in sys.modules if name.startswith(('cnpgen', 'numpy'))))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [
        "cnpgen",
        "cnpgen.schema",
        "cnpgen.schema.public_names",
    ]
