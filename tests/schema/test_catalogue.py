"""Finding, listing and loading recipe files."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from cnpgen.errors import RecipeError
from cnpgen.make.recipe import load_dataset_recipe, recipe_digest
from cnpgen.pipelines.pipeline import load_pipeline
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.problem import resolved
from cnpgen.problems.problem_file import load_problem
from cnpgen.schema import catalogue, registry
from cnpgen.schema.catalogue import list_recipes, recipes_root
from cnpgen.schema.keys import Range, field
from cnpgen.schema.registry import CONSTRAINTS, STAGES
from tests.examples.stages import Roll
from tests.refusals import is_refused


@dataclass(frozen=True, kw_only=True)
class Level(Constraint):
    tolerance: float = field("tilt", unit="rad", low=0.0)

    def symbolic(self, state):
        return ()

    def measured(self, world):
        return ()


@dataclass(frozen=True, kw_only=True)
class Still(Level):
    pass


PROBLEM = """
name = "arm"
title = "An arm"
[robot]
urdf = "arm.urdf"
joints = ["a", "b"]
tip = "hand"
base = "[0, 90] deg"
[limits]
velocity_scale = 0.8
[object]
size = "[10, 10, 20] cm"
[[obstacle]]
name = "pedestal"
x = "[0, 1] m"
y = "[0, 1] m"
below = "start"
[[constraint]]
use = "level"
tolerance = "1 mrad"
[[constraint]]
use = "still"
tolerance = 0.1
"""

URDF = """
<robot name="arm">
  <link name="hand"/>
  <joint name="a" type="revolute"/>
  <joint name="b" type="revolute"/>
  <joint name="grip" type="fixed"/>
</robot>
"""

PIPELINE = """
name = "roll"
title = "Roll a die"
problem = "../problems/arm/problem.toml"
[[stage]]
use = "roll"
size = "[1, 2] cm"
[[stage]]
use = "roll"
size = "3 cm"
"""

DATASET = """
name = "roll-1k"
version = "1.2.3"
pipeline = "../pipelines/roll.toml"
seed = 7
[splits]
train = 900
validation = 100
"""


@pytest.fixture(autouse=True)
def _kinds(monkeypatch):
    kinds = {
        STAGES: {"roll": "tests.examples.stages:Roll"},
        CONSTRAINTS: {"level": f"{__name__}:Level", "still": f"{__name__}:Still"},
    }
    monkeypatch.setattr(registry, "BUILT_IN", kinds)


@pytest.fixture
def files(tmp_path) -> dict[str, Path]:
    """Write a correct problem, pipeline and dataset, laid out as cnpgen ships them."""
    contents = {
        "urdf": ("problems/arm/arm.urdf", URDF),
        "problem": ("problems/arm/problem.toml", PROBLEM),
        "pipeline": ("pipelines/roll.toml", PIPELINE),
        "dataset": ("datasets/roll-1k.toml", DATASET),
    }
    for path, text in contents.values():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    return {name: tmp_path / path for name, (path, _) in contents.items()}


@pytest.fixture
def shipped(files, tmp_path, monkeypatch):
    """Make them the recipes that cnpgen ships."""
    monkeypatch.setattr(catalogue, "recipes_root", lambda: tmp_path)
    return files


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def errors_of(load, path: Path) -> list[str]:
    with pytest.raises(RecipeError) as caught:
        load(path)
    return [error.replace(f"{path}: ", "") for error in caught.value.errors]


def test_three_correct_files_load(files):
    recipe = load_dataset_recipe(files["dataset"])
    assert (recipe.name, recipe.version, recipe.seed) == ("roll-1k", "1.2.3", 7)
    assert recipe.splits == {"train": 900, "validation": 100}
    assert recipe.pipeline.stage == (
        Roll(size=Range(0.01, 0.02)),
        Roll(size=Range(0.03, 0.03)),
    )
    problem = recipe.pipeline.problem
    assert problem.constraint == (Level(tolerance=0.001), Still(tolerance=0.1))
    assert problem.object is not None
    assert problem.object.size == (0.1, 0.1, 0.2)
    assert problem.urdf_path.read_text() == URDF
    assert [part.path.is_absolute() for part in (recipe, recipe.pipeline, problem)] == [
        True
    ] * 3


def test_the_kind_of_a_table_is_part_of_the_resolved_recipe(files):
    plain = resolved(load_pipeline(files["pipeline"]))
    assert [stage["use"] for stage in plain["stage"]] == ["roll", "roll"]
    assert [constraint["use"] for constraint in plain["problem"]["constraint"]] == [
        "level",
        "still",
    ]


def test_mistakes_of_all_three_files_are_raised_at_once(files):
    edit(files["dataset"], "seed = 7", "sed = 7")
    edit(files["dataset"], "train = 900", "train = 0")
    edit(files["pipeline"], "size = ", "siz = ")
    edit(files["problem"], "velocity_scale = 0.8", "velocity_scale = 1.5")
    edit(files["problem"], 'tip = "hand"', "tip = 3")
    with pytest.raises(RecipeError) as caught:
        load_dataset_recipe(files["dataset"])
    folder = files["dataset"].parent
    pipeline = folder / "../pipelines/roll.toml"
    problem = pipeline.parent / "../problems/arm/problem.toml"
    assert caught.value.errors == (
        f"{files['dataset']}: sed: unknown key (did you mean 'seed'?)",
        f"{problem}: robot.tip: expected a string, got 3",
        f"{problem}: limits.velocity_scale: 1.5 is too large, expected at most 1",
        f"{pipeline}: stage 1.siz: unknown key (did you mean 'size'?)",
        f"{pipeline}: stage 1.size: missing key, expected a range, each end a length [m]: size of the die",
        f"{files['dataset']}: splits.train: 0 is too small, expected at least 1",
    )


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ('name = "arm"', 'name = "Arm"', "name: 'Arm' does not match"),
        ('name = "arm"', 'name = "-arm"', "name: '-arm' does not match"),
        ('urdf = "arm.urdf"', 'urdf = "ram.urdf"', "robot.urdf: no such file: "),
        (
            'base = "[0, 90] deg"',
            "base = [0]",
            "robot.base: expected 2 numbers, one per planned joint, got 1",
        ),
        (
            'joints = ["a", "b"]',
            'joints = ["a", "a"]',
            "robot.joints: each joint can be planned once, got a",
        ),
        (
            'use = "still"',
            'use = "level"',
            "constraint 2.use: there is a constraint 'level' already",
        ),
        (
            'use = "still"',
            'use = "stil"',
            "constraint 2.use: unknown constraint 'stil' (did you mean 'still'?)",
        ),
        (
            'use = "still"\n',
            "",
            "constraint 2.use: missing key, expected one of level, still",
        ),
        (
            'below = "start"',
            'below = "start"\ntop = 1.0',
            "obstacle 1.top: obstacle 'pedestal' has both",
        ),
        ('below = "start"', "", "obstacle 1.top: obstacle 'pedestal' has no height"),
        (
            'below = "start"',
            'below = "stat"',
            "obstacle 1.below: expected one of '', 'start', 'goal', got 'stat'",
        ),
        (
            '[object]\nsize = "[10, 10, 20] cm"',
            "",
            "obstacle 1.below: nothing stands on the obstacle",
        ),
        (
            'below = "start"',
            'below = "goal"\n'
            + PROBLEM[PROBLEM.index("[[obst") : PROBLEM.index("[[const")],
            "obstacle 2.name",
        ),
        ('x = "[0, 1] m"', 'x = "[1, 0] m"', "obstacle 1.x: empty range"),
        (
            'x = "[0, 1] m"',
            'x = "[0 1] m"',
            "obstacle 1.x: numbers are separated by commas, got '[0 1] m' (did you mean '[0, 1] m'?)",
        ),
        (
            '"a", "b"]',
            '"a", "bee"]',
            "robot.joints: arm.urdf has no joint 'bee' that moves",
        ),
        (
            '"a", "b"]',
            '"a", "grip"]',
            "robot.joints: arm.urdf has no joint 'grip' that moves",
        ),
        (
            'tip = "hand"',
            'tip = "hnd"',
            "robot.tip: arm.urdf has no frame 'hnd' (did you mean 'hand'?); its frames: ",
        ),
        ('urdf = "arm.urdf"', 'urdf = "arm"', "robot.urdf: no such file: "),
    ],
)
def test_a_mistake_in_a_problem_is_reported_with_its_key(files, old, new, error):
    edit(files["problem"], old, new)
    errors = errors_of(load_problem, files["problem"])
    assert len(errors) == 1
    assert errors[0].startswith(error)


def test_a_mistake_does_not_hide_another_one_that_has_nothing_to_do_with_it(files):
    edit(files["problem"], "velocity_scale = 0.8", "velocity_scale = 8")
    edit(files["problem"], '["a", "b"]', '["a", "a", "bee"]')
    edit(files["problem"], 'tip = "hand"', 'tip = "hnd"')
    edit(files["problem"], 'x = "[0, 1] m"', 'x = "[1, 0] m"')
    edit(files["problem"], 'y = "[0, 1] m"', 'y = "[1, 1] m"')
    edit(files["problem"], 'below = "start"', "")
    edit(
        files["problem"],
        "[limits]",
        "[trajectory]\npath_control_points = 6\nrate_control_points = 4.5\n[limits]",
    )
    keys = [error.split(":")[0] for error in errors_of(load_problem, files["problem"])]
    assert keys == [
        "robot.joints",
        "robot.base",
        "limits.velocity_scale",
        "obstacle 1.x",
        "obstacle 1.top",
        "trajectory.rate_control_points",
        "trajectory.path_control_points",
        "robot.joints",
        "robot.tip",
    ]


def test_a_urdf_that_is_no_xml_is_left_to_whoever_loads_the_robot(files):
    files["urdf"].write_text("<robot")
    assert load_problem(files["problem"]).robot.tip == "hand"


def test_semantic_mistakes_are_reported_along_with_wrong_types(files):
    edit(files["problem"], "velocity_scale = 0.8", "velocity_scale = true")
    edit(files["problem"], 'urdf = "arm.urdf"', 'urdf = "ar.urdf"')
    edit(files["problem"], 'use = "still"', 'use = "level"')
    errors = errors_of(load_problem, files["problem"])
    keys = [error.split(":")[0] for error in errors]
    assert keys == ["limits.velocity_scale", "robot.urdf", "constraint 2.use"]
    assert errors[1].endswith("(did you mean 'arm.urdf'?)")


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ('version = "1.2.3"', 'version = "1.2"', "version: '1.2' does not match"),
        ('version = "1.2.3"', 'version = "01.2.3"', "version: '01.2.3' does not match"),
        (
            'version = "1.2.3"',
            'version = "1.2.3-rc1"',
            "version: '1.2.3-rc1' does not match",
        ),
        ('name = "roll-1k"', 'name = "roll_1k"', "name: 'roll_1k' does not match"),
        ("seed = 7", "seed = -1", "seed: -1 is too small"),
        (
            "seed = 7",
            "seed = 9223372036854775808",
            "seed: 9223372036854775808 is too large",
        ),
        ("train = 900", "Train = 900", "splits.Train: the name 'Train' does not match"),
        ("train = 900", "train = 0", "splits.train: 0 is too small"),
        ("train = 900", "train = 1.5", "splits.train: expected an integer"),
        ("train = 900\nvalidation = 100", "", "splits: is empty"),
        ("[splits]\ntrain = 900\nvalidation = 100", "", "splits: missing key"),
        (
            'pipeline = "../pipelines/roll.toml"',
            "pipeline = 3",
            "pipeline: expected a name or a path, got 3",
        ),
        (
            'pipeline = "../pipelines/roll.toml"',
            'pipeline = "roll.toml"',
            "pipeline: no such file: ",
        ),
        (
            'pipeline = "../pipelines/roll.toml"',
            'pipeline = "../pipelines/"',
            "pipeline: ",
        ),
    ],
)
def test_a_mistake_in_a_dataset_is_reported_with_its_key(files, old, new, error):
    edit(files["dataset"], old, new)
    errors = errors_of(load_dataset_recipe, files["dataset"])
    assert len(errors) == 1
    assert errors[0].startswith(error)


@pytest.mark.parametrize("stages", ["stage = []", "stage = 3", 'stage = ["roll"]', ""])
def test_a_pipeline_without_stages_is_a_mistake(files, stages):
    head = PIPELINE[: PIPELINE.index("[[stage]]")]
    files["pipeline"].write_text(head + stages)
    for load in (load_pipeline, load_dataset_recipe):
        assert errors_of(load, files["pipeline"])[0].startswith("stage")


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (b'name = "arm"\n\ntitle = \n', "line 3: not valid TOML: Invalid value"),
        (
            b'name = "arm"\nname = "leg"\n',
            "line 2: not valid TOML: Cannot overwrite a value",
        ),
        (b'name = "arm"\n[robot\n', "line 2: not valid TOML: "),
        (b'name = "arm"\njoints = [1,', "line 2: not valid TOML: Invalid value"),
        (
            b'name = "arm"\nx = [0 1]',
            "line 2: not valid TOML: Unclosed array (entries are separated by commas)",
        ),
        (b'name = "arm"\ntitle = "\xff"\n', "line 2: not UTF-8: byte 0xff"),
        (b"seed = " + b"9" * 5000, "line 1: not valid TOML: "),
    ],
)
def test_a_file_that_is_not_toml_is_a_recipe_error_with_its_line(files, content, error):
    files["problem"].write_bytes(content)
    errors = errors_of(load_problem, files["problem"])
    assert len(errors) == 1
    assert errors[0].startswith(error)


def test_an_empty_file_misses_every_required_key(files):
    files["dataset"].write_text("")
    keys = [
        error.split(":")[0]
        for error in errors_of(load_dataset_recipe, files["dataset"])
    ]
    assert keys == ["name", "pipeline", "splits"]


def test_a_byte_order_mark_is_ignored(files):
    files["problem"].write_bytes(b"\xef\xbb\xbf" + PROBLEM.encode())
    assert load_problem(files["problem"]).name == "arm"


def test_a_recipe_of_another_kind_is_a_mistake(files):
    assert errors_of(load_dataset_recipe, files["problem"]) == [
        "is a problem, expected a dataset or a pipeline"
    ]
    assert errors_of(load_pipeline, files["dataset"]) == [
        "is a dataset, expected a pipeline"
    ]
    assert errors_of(load_problem, files["pipeline"]) == [
        "is a pipeline, expected a problem"
    ]


def test_a_pipeline_is_wrapped_where_a_dataset_is_expected(shipped):
    for given in ("roll", shipped["pipeline"]):
        recipe = load_dataset_recipe(given)
        assert (recipe.name, recipe.version, recipe.title) == (
            "roll",
            "1.0.0",
            "Roll a die",
        )
        assert recipe.splits == {"train": 90, "validation": 10}
        assert recipe.pipeline.stage == load_pipeline(given).stage


def test_shipped_recipes_are_listed_and_loaded_by_name(shipped):
    assert list_recipes("problem") == {"arm": shipped["problem"]}
    assert list_recipes("pipeline") == {"roll": shipped["pipeline"]}
    assert list_recipes("dataset") == {"roll-1k": shipped["dataset"]}
    assert load_problem("arm").name == "arm"
    assert load_pipeline("roll").name == "roll"
    assert load_dataset_recipe("roll-1k").name == "roll-1k"


def test_a_dataset_comes_before_a_pipeline_of_the_same_name(shipped):
    shipped["dataset"].rename(shipped["dataset"].with_name("roll.toml"))
    assert load_dataset_recipe("roll").splits == {"train": 900, "validation": 100}


def test_a_reference_can_be_the_name_of_a_shipped_recipe(shipped):
    edit(shipped["dataset"], "../pipelines/roll.toml", "roll")
    edit(shipped["pipeline"], "../problems/arm/problem.toml", "arm")
    assert load_dataset_recipe("roll-1k").pipeline.problem.name == "arm"


def test_an_unknown_reference_is_reported_where_it_is_made(shipped):
    edit(shipped["pipeline"], "../problems/arm/problem.toml", "amr")
    assert errors_of(load_pipeline, shipped["pipeline"]) == [
        "problem: unknown problem 'amr' (did you mean 'arm'?); known: arm"
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rol", r"unknown pipeline 'rol' \(did you mean 'roll'\?\); known: roll"),
        ("", "unknown pipeline ''; known: roll"),
        ("arm", "unknown pipeline 'arm': it is the name of a problem; known: roll"),
        (
            "roll-1k",
            "unknown pipeline 'roll-1k': it is the name of a dataset; known: roll",
        ),
        ("rolll.toml", r"no such file: rolll.toml \(did you mean 'roll'\?\)"),
        ("some/roll", "no such file: some/roll"),
        ("/", "/ is a folder, expected a .toml file"),
    ],
)
def test_a_recipe_that_is_not_there_is_an_error(
    shipped, text, message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecipeError, match=message):
        load_pipeline(text)


@pytest.mark.parametrize(
    ("load", "name", "message"),
    [
        (
            load_problem,
            "airhockey-hit",
            "unknown problem 'airhockey-hit': it is the name of a pipeline and a dataset; ",
        ),
        (
            load_pipeline,
            "airhockey",
            "unknown pipeline 'airhockey': it is the name of a problem; known: ",
        ),
        (
            load_dataset_recipe,
            "airhockey",
            "unknown dataset or pipeline 'airhockey': it is the name of a problem",
        ),
    ],
)
def test_a_name_of_another_kind_is_said_to_be_one(load, name, message):
    with pytest.raises(RecipeError) as caught:
        load(name)
    (error,) = caught.value.errors
    assert error.startswith(message)


def test_a_file_without_suffix_is_a_path(shipped, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pipelines" / "roll.toml").rename(tmp_path / "pipelines" / "mine")
    monkeypatch.chdir(tmp_path / "pipelines")
    assert load_pipeline("mine").path == tmp_path / "pipelines" / "mine"


def test_a_path_is_relative_to_the_folder_that_is_given(files, tmp_path):
    assert load_pipeline("pipelines/roll.toml", relative_to=tmp_path).name == "roll"


def test_a_missing_file_is_not_found_in_the_library_by_its_stem(shipped):
    with is_refused(RecipeError, argument="name_or_path"):
        load_pipeline("nowhere/roll.toml")


def test_recipes_are_beside_the_package_in_a_checkout_and_inside_it_in_a_wheel(
    tmp_path, monkeypatch
):
    package = tmp_path / "cnpgen"
    package.mkdir()
    monkeypatch.setattr(catalogue, "__file__", str(package / "schema" / "catalogue.py"))
    assert recipes_root() == tmp_path
    assert list_recipes("problem") == {}
    (package / "_recipes").mkdir()
    assert recipes_root() == package / "_recipes"


def test_reformatting_a_recipe_does_not_change_its_identity(files):
    before = load_dataset_recipe(files["dataset"])
    edit(files["problem"], 'title = "An arm"', "# a comment\n")
    edit(files["problem"], 'tolerance = "1 mrad"', "tolerance = 1e-3\nbudget = 0")
    edit(files["pipeline"], '"[1, 2] cm"', "[0.01, '20 mm']")
    after = load_dataset_recipe(files["dataset"])
    assert recipe_digest(after) == recipe_digest(before)
    assert after.pipeline.problem.identity == before.pipeline.problem.identity


def test_a_changed_urdf_changes_the_identity_of_recipe_and_problem(files):
    before = load_dataset_recipe(files["dataset"])
    identities = recipe_digest(before), before.pipeline.problem.identity
    files["urdf"].write_text(URDF.replace('"arm"', '"leg"'))
    after = load_dataset_recipe(files["dataset"])
    assert recipe_digest(after) != identities[0]
    assert after.pipeline.problem.identity != identities[1]


@pytest.mark.parametrize("kind", ["problem", "pipeline", "dataset"])
def test_every_shipped_recipe_is_toml_under_its_own_name(kind):
    for name, path in list_recipes(kind).items():
        assert tomllib.loads(path.read_text())["name"] == name
