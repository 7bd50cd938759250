"""The registry of stages and constraints."""

import re
from dataclasses import dataclass

import pytest

from cnpgen.cli import commands
from cnpgen.cli.main import main
from cnpgen.errors import RecipeError
from cnpgen.machine.engine import ClusterEngine
from cnpgen.pipelines.scene_family import SceneFamily
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.plans.exporter import Exporter
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.objectives import ObjectiveTerm
from cnpgen.problems.published_rules import PublishedRules
from cnpgen.problems.scenes.scene_reader import SceneReader
from cnpgen.robots.obstacle_shapes.obstacle_shape import ObstacleShape
from cnpgen.schema import addons, registry
from cnpgen.schema.entry_points import EntryPoint
from cnpgen.schema.keys import field
from cnpgen.schema.registry import CONSTRAINTS, STAGES, load, name_of, names
from cnpgen.store.dataset_document import DatasetDocument
from tests.examples.stages import Idle
from tests.refusals import assert_said, is_refused


@dataclass(frozen=True, kw_only=True)
class Roll(Idle):
    sides: int = field("sides of the die", default=6)


class NotADataclass(Roll):
    pass


@dataclass(frozen=True, kw_only=True)
class Abstract(Stage):
    def describe(self):
        return "abstract"


@dataclass(frozen=True, kw_only=True)
class Undeclared(Roll):
    loaded: bool


@dataclass(frozen=True, kw_only=True)
class Toss(Roll):
    pass


THE_STRING = "not a class"


@pytest.fixture
def register(monkeypatch):
    """Return a function that installs entry points (group, name, value)."""
    entries: dict[str, tuple[EntryPoint, ...]] = {}

    def add(group, name, value, package=""):
        entry = EntryPoint(group, name, value, package)
        entries[group] = (*entries.get(group, ()), entry)

    monkeypatch.setattr(addons, "entry_points", lambda: entries)
    monkeypatch.setattr(commands, "entry_points", lambda: entries)
    monkeypatch.setattr(registry, "entry_points", lambda: entries)
    monkeypatch.setattr(
        registry,
        "BUILT_IN",
        {STAGES: {"roll": f"{__name__}:Roll"}, CONSTRAINTS: {}},
    )
    return add


def test_a_built_in_kind_is_imported_by_name(register):
    assert load(STAGES, "roll") is Roll
    assert names(STAGES) == ("roll",)


def test_an_entry_point_adds_a_kind(register):
    register(STAGES, "toss", f"{__name__}:Toss")
    assert load(STAGES, "toss") is Toss
    assert names(STAGES) == ("roll", "toss")
    assert names(CONSTRAINTS) == ()


def test_an_unknown_kind_names_the_nearest_and_all_known_ones(register):
    register(STAGES, "toss", f"{__name__}:Toss")
    with is_refused(RecipeError):
        load(STAGES, "rol")


def test_a_kind_of_the_other_group_is_unknown(register):
    with is_refused(RecipeError):
        load(CONSTRAINTS, "roll")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("no_such_module_of_anyone:Stage", "ModuleNotFoundError"),
        (f"{__name__}:Missing", "AttributeError"),
        (
            f"{__name__}:THE_STRING",
            "is not a subclass of cnpgen.pipelines.stages.stage.Stage, got 'not a class'",
        ),
        ("builtins:dict", "is not a subclass of cnpgen.pipelines.stages.stage.Stage"),
        (f"{__name__}:Abstract", "Abstract is abstract, it does not define prepare"),
        (f"{__name__}:NotADataclass", "NotADataclass is not a dataclass"),
        (
            f"{__name__}:Undeclared",
            "the field 'loaded' is not declared with cnpgen.plugins.field",
        ),
    ],
)
def test_a_broken_plug_in_is_a_recipe_error(register, value, message):
    register(STAGES, "broken", value)
    with is_refused(RecipeError) as caught:
        load(STAGES, "broken")
    assert message in str(caught.value)
    assert load(STAGES, "roll") is Roll


def test_a_module_that_raises_while_it_is_imported_is_a_recipe_error(
    register, tmp_path, monkeypatch
):
    (tmp_path / "plugin_that_divides.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(tmp_path)
    register(STAGES, "divide", "plugin_that_divides:Stage")
    with is_refused(RecipeError):
        load(STAGES, "divide")


def test_a_plug_in_with_the_name_of_a_built_in_kind_is_an_error(register):
    register(STAGES, "roll", f"{__name__}:Toss")
    with is_refused(RecipeError):
        load(STAGES, "roll")
    assert names(STAGES) == ("roll",)


def test_two_plug_ins_with_one_name_are_an_error(register):
    register(STAGES, "toss", f"{__name__}:Toss")
    register(STAGES, "toss", f"{__name__}:Roll")
    with is_refused(RecipeError):
        load(STAGES, "toss")


def test_who_lacks_a_plug_in_is_told_which_package_to_install(register):
    assert registry.why_missing(STAGES, "roll", "") == ""
    text = registry.why_missing(STAGES, "toss", "dice-stages")
    assert (
        "stage 'toss' comes from the package 'dice-stages', which is not installed"
        in text
    )
    assert "pip install dice-stages" in text
    assert "entry point group 'cnpgen.constraints'" in registry.why_missing(
        CONSTRAINTS, "toss", ""
    )
    register(STAGES, "toss", f"{__name__}:Toss")
    assert registry.why_missing(STAGES, "toss", "dice-stages") == ""


def test_name_of_is_the_inverse_of_load(register):
    register(STAGES, "broken", f"{__name__}:Missing")
    register(STAGES, "toss", f"{__name__}:Toss")
    assert [name_of(STAGES, load(STAGES, name)) for name in ("roll", "toss")] == [
        "roll",
        "toss",
    ]


def test_name_of_an_unregistered_class_says_where_it_is(register):
    register(STAGES, "broken", f"{__name__}:Missing")
    assert name_of(STAGES, Toss) == f"{__name__}:Toss"


def test_every_group_has_a_base():
    assert {group: registry.contract(group) for group in registry.CONTRACTS} == {
        STAGES: Stage,
        CONSTRAINTS: Constraint,
        registry.OBJECTIVES: ObjectiveTerm,
        registry.EXPORTERS: Exporter,
        registry.FAMILIES: SceneFamily,
        registry.READERS: SceneReader,
        registry.ENGINES: ClusterEngine,
        registry.DOCUMENTS: DatasetDocument,
        registry.RULES: PublishedRules,
        registry.SHAPES: ObstacleShape,
    }
    assert registry.CONTRACTS.keys() >= registry.BUILT_IN.keys()


@pytest.mark.parametrize("group", registry.CONTRACTS)
def test_every_built_in_kind_can_be_loaded(group):
    assert names(group)
    for name in names(group):
        assert name_of(group, load(group, name)) == name


def test_a_package_adds_a_command(register, capsys, monkeypatch, tmp_path):
    (tmp_path / "greeting_command.py").write_text(
        '"""Greet.\n\nMore."""\n\n\n'
        "def add_options(parser):\n    parser.add_argument('name')\n\n\n"
        "def run(arguments):\n    print('hello', arguments.name)\n    return 1\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    register(registry.COMMANDS, "greet", "greeting_command")
    assert main(["greet", "you"]) == 1
    assert capsys.readouterr().out == "hello you\n"
    assert main(["--help"]) == 0
    assert re.search(r"\n    greet +greet\n", capsys.readouterr().out)
    assert main(["gret"]) == 2
    assert_said(capsys.readouterr().err)


def test_a_command_that_cannot_be_imported_does_not_hide_the_others(register, capsys):
    register(registry.COMMANDS, "broken", "no_such_module_of_a_package")
    assert main(["--help"]) == 0
    assert re.search(r"    broken +cannot be used: ", capsys.readouterr().out)
    assert main(["broken"]) == 3
    assert_said(capsys.readouterr().err)


def test_a_command_without_options_does_not_hide_the_others(register, capsys):
    register(registry.COMMANDS, "blank", "cnpgen.cli", "a-package")
    assert main(["--help"]) == 0
    captured = capsys.readouterr()
    assert re.search(r"    blank +cannot be used: ", captured.out)
    assert "\n    doctor " in captured.out
    assert main(["blank"]) == 3
    assert_said(capsys.readouterr().err)


@pytest.mark.filterwarnings("default")
def test_commands_of_one_name_are_refused_or_named(register, capsys):
    for name, package in (("docs", "one"), ("twice", "one"), ("twice", "other")):
        register(registry.COMMANDS, name, "cnpgen.cli.docs_command", package)
    assert main(["--help"]) == 0
    assert_said(capsys.readouterr().err)
    assert main(["twice"]) == 3
    assert_said(capsys.readouterr().err)
