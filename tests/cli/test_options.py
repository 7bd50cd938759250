"""Options: each has an effect, or is refused by name where it has none; none is given twice."""

from pathlib import Path

import pytest

from cnpgen.cli.main import build_parser, main

COMMON = {"help", "verbose", "quiet", "json", "out", "force"}
ENGINE = "workers engine address"
REFINING = "objective weight max_iterations tolerance deadline stay_within explain"
TABLES = "joints velocities time unit rate separator separate_by unwrap drop_repeats"
SAMPLES = f"{TABLES} parameters scenes topic allow_unused payload"
# Options that have an effect on every input of their command, and those that are refused
# for some, in ``WITHOUT_EFFECT`` and in the tests of the formats. A new option is one of
# them: where would it be ignored?
ALWAYS = {
    "make-dataset": f"n seed {ENGINE} shard_size dtype backend part certify dry_run",
    "merge": "",
    "extend": f"n {ENGINE}",
    "copy": "kind",
    "inspect": "plot",
    "validate": "deep regenerate",
    "plan": "model n no_time_scaling refine",
    "complete": "extrapolate",
    "solve": f"n robot time_limit {REFINING} {ENGINE}",
    "refine": f"problem extrapolate {REFINING} {ENGINE}",
    "evaluate": "problem extrapolate step workers list plot",
    "export": "to rate plan sample join",
    "doctor": "",
    "docs": "search",
    "benchmark": f"planners n list simulate time_limit {ENGINE} seed repeat plane_tolerance set replan",
    "import": "problem noise at_rest stay_within",
    "init": "urdf planner",
    "list": "",
    "make-scenes": "list",
    "publish": "to private dry_run",
    "show": "stage constraint keys",
    "simulate": "problem plant environment workers list image video",
    "view": "serve",
}
REFUSED = {
    "make-dataset": "model",
    "validate": ENGINE,
    "plan": f"split first seed other_rows allow_large_angles allow_unused {REFINING} {ENGINE}",
    "solve": "split first seed problem extrapolate allow_unused payload start initial_plans smooth_stop packages"
    " allow_large_angles",
    "evaluate": f"tracking_error plan {SAMPLES} interpolation max_jerk noise time_jitter ignore_velocities",
    "export": "at rows scenes allow_unused",
    "docs": "url",
    "benchmark": "plant environment video reference",
    "import": SAMPLES,
    "init": "tip packages srdf joint_limits collision_from_visual skip_mesh allow_unused",
    "make-scenes": "robot n seed per_scene set",
    "show": "kind",
    "simulate": "plan",
    "view": f"row rows split problem {SAMPLES}",
}
OF_OTHERS = {"train", "check-episodes"}  # with tests of their own
WITHOUT_EFFECT = [
    ("solve {rows} --stay-within 2deg", "--stay-within needs the path"),
    ("solve {rows} --allow-large-angles", "--allow-large-angles is for boundary"),
    ("solve {rows} --problem airhockey", "--problem is for boundary"),
    ("solve {rows} --smooth-stop", "--smooth-stop is for scenes"),
    ("solve {rows} --seed 3", "--seed is for fresh draws"),
    ("solve airhockey-hit --n 2 --stay-within 2deg", "--stay-within needs the path"),
    ("solve airhockey-hit --n 2 --allow-large-angles", "--allow-large-angles is for"),
    ("solve airhockey-hit --n 2 --first 3", "--first needs the folder"),
    ("solve x.yaml --robot panda --allow-large-angles", "--allow-large-angles is not"),
    ("solve x.yaml --robot panda --stay-within 2deg", "--stay-within needs the path"),
    ("solve x.yaml --robot panda --split train", "--split is not for scenes"),
    ("plan {rows} --model airhockey-hit --allow-unused x", "--allow-unused is for"),
    ("plan {rows} --model airhockey-hit --allow-large-angles", "--allow-large-angles"),
    ("plan {rows} --model airhockey-hit --deadline 9ms", "--deadline needs --refine"),
    ("plan airhockey-hit --n 2 --split train", "--split needs the folder"),
    ("plan airhockey-hit --n 2 --allow-unused x", "--allow-unused is for scenes"),
    ("plan airhockey-hit --n 2 --allow-large-angles", "--allow-large-angles is for"),
    ("validate {rows} --workers 2", "--workers needs --deep"),
    ("evaluate {rows} --plan 3", "--plan needs --plot"),
    ("evaluate {rows} --list --json", "--list has no effect with --json"),
    ("complete panda {rows} -o a.h5 --extrapolate", "--extrapolate has no effect on"),
    ("make-scenes --list --n 3", "--n has no effect with --list"),
    ("make-scenes tabletop --list", "FAMILY has no effect with --list"),
    ("benchmark --list --n 3", "--n has no effect with --list"),
    ("benchmark hits-81 --plant heavier", "--plant needs --simulate"),
    ("init arm --planner --tip x", "--tip has no effect with --planner"),
    ("init arm --planner --allow-unused x", "--allow-unused has no effect with"),
    ("simulate {rows} --plan 3", "--plan needs --image or --video"),
    ("docs --search puck --url", "--url has no effect with --search"),
    ("export {rows} --to npz --allow-unused x", "--allow-unused needs --scenes"),
    ("solve {rows} --objective effort=2 --weight 3", "the objective 'effort=2' has"),
    ("solve {rows} --max-iterations 0 --deadline 9ms", "--deadline has no effect with"),
    ("solve {rows} --n 3 --n 4", "--n: given twice, 3 and 4: expected once"),
    ("solve {rows} -o a.h5 --out b.h5", "-o/--out: given twice, a.h5 and b.h5"),
    ("train {rows} -o a.h5 --seed 0 --seed 5", "--seed: given twice, 0 and 5"),
    ("benchmark --planners a --planners b", "--planners: given twice, ['a'] and ['b']"),
    ("evaluate a.csv --separator , --separator ;", "--separator: given twice"),
]


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("options") / "hits"
    words = ["make-dataset", "airhockey-hit", "--n", "20", "--workers", "1", "-q"]
    assert main([*words, "-o", str(folder)]) == 0
    return folder


def test_every_option_is_known_to_have_an_effect_or_to_be_refused() -> None:
    pytest.importorskip("cnpgen.addons")
    parser = build_parser()
    (commands,) = (each for each in parser._actions if isinstance(each.choices, dict))
    for name, command in commands.choices.items():
        found = {each.dest for each in command._actions if each.option_strings}
        known = {*ALWAYS.get(name, "").split(), *REFUSED.get(name, "").split()}
        if name not in OF_OTHERS:
            assert found - COMMON == known - COMMON, name


@pytest.mark.parametrize(("line", "text"), WITHOUT_EFFECT)
def test_an_option_without_effect_is_refused_by_name(
    line: str,
    text: str,
    rows: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.yaml").touch()
    words = line.format(rows=rows).split()
    if words[0] == "plan" and "-o" not in words:
        words += ["-o", "plans.h5"]
    assert main(words) == 2
    assert text in capsys.readouterr().err
    assert not list(tmp_path.glob("*.h5"))


def test_an_equal_value_may_be_repeated(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "problems", "--json", "--json"]) == 0
    assert main(["docs", "--search", "of a puck", "--search", "of a puck"]) in {0, 1}
