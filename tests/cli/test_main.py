"""The command line: data on stdout, everything else on stderr, one line per error, and the exit codes it promises."""

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import types
import warnings
from pathlib import Path

import pytest

import cnpgen.errors
from cnpgen.cli import values
from cnpgen.cli.dry_run import size_text
from cnpgen.cli.main import main
from cnpgen.cli.make_command import _yield
from cnpgen.cli.terminal import Meter
from cnpgen.errors import DatasetError, RecipeError
from cnpgen.make.resolve_spec import MAX_ROWS
from cnpgen.store.check import Finding
from cnpgen.store.sampling_statistics import SamplingStatistics
from cnpgen.validate.validate_dataset import ValidationReport
from tests.conftest import HANGING
from tests.refusals import is_refused

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(cnpgen.errors.__file__).parents[1])}
MAKE = ("make-dataset", "airhockey-hit", "--n", "200", "--workers", "1", "--out")


@pytest.fixture(scope="session")
def hits(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cli") / "hits"
    assert main([*MAKE, str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture
def run(capsys):
    """Run the command line and return (exit code, stdout, stderr)."""

    def call(*words):
        code = main([str(word) for word in words])
        return code, *capsys.readouterr()

    return call


def spawn(*words, **options):
    command = [sys.executable, *(str(word) for word in words)]
    return subprocess.Popen(
        command,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def one_line(stderr):
    """Return the only line of stderr, an error."""
    (line,) = stderr.splitlines()
    assert line.startswith("cnpgen: error: ")
    return line


# Options and their values


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("120000", 120_000),
        ("120_000", 120_000),
        ("1e6", 10**6),
        ("1.5E3", 1500),
        ("2e+3", 2000),
        ("+7", 7),
        ("-5", -5),
    ],
)
def test_whole_numbers_are_read_as_people_write_them(text, number):
    assert values.whole(text) == number


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1e9x",
        "2.5",
        "2.0",
        "1.23e1",
        "1e-3",
        "120k",
        "120,000",
        "1__0",
        "_1",
        "0x10",
        "١٢",
        "inf",
        "1e999",
        "9" * 5000,
    ],
)
def test_anything_else_is_no_whole_number(text):
    with is_refused(ValueError):
        values.whole(text)


def test_the_bounds_are_those_of_the_library():
    assert values.MAX_ROWS_ARGUMENT == MAX_ROWS


@pytest.mark.parametrize("text", ["1e9x", "0", "-5", "2.5"])
def test_a_wrong_number_of_rows_is_one_line_that_says_what_to_write(
    run, text, tmp_path
):
    code, out, err = run(
        "make-dataset", "airhockey-hit", "--out", tmp_path / "x", "--n", text
    )
    assert (code, out) == (2, "")
    assert repr(text) in one_line(err)
    assert "such as 120000, 120_000 or 1e6" in err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--part", "3/3"),
        ("--part", "1"),
        ("--part", "-1/2"),
        ("--part", "a/b"),
        ("--seed", "-1"),
        ("--seed", str(2**63)),
        ("--workers", "0"),
        ("--shard-size", "0"),
        ("--n", "1e13"),
    ],
)
def test_a_wrong_value_is_one_line(run, option, value, tmp_path):
    code, out, err = run(*MAKE, tmp_path / "x", "--quiet", option, value)
    assert (code, out) == (2, "")
    one_line(err)


@pytest.mark.parametrize("value", ["nan", "abc", "-5ms", "-.5"])
def test_a_wrong_time_is_said_once(run, value):
    expected = (
        f"--deadline: expected a time above 0, such as 0.001 or 1ms; got {value!r}; see"
    )
    assert expected in one_line(run("refine", "x.h5", "--deadline", value)[2])


@pytest.mark.parametrize("value", ["10", "0.01", "1e-2", "5."])
def test_a_deadline_without_a_unit_is_refused(run, value):
    expected = f"--deadline: expected a time with its unit, such as 10ms; got {value!r}, is it {value}ms or {value}s?"
    for command in (
        ("refine", "x.h5"),
        ("solve", "airhockey-hit"),
        ("plan", "airhockey-hit", "--refine"),
    ):
        code, _, err = run(*command, "--deadline", value)
        assert code == 2
        assert expected in one_line(err)


def test_a_wrong_unit_is_named(run):
    assert "unknown unit 'mz'" in one_line(
        run("refine", "x.h5", "--deadline", "5mz")[2]
    )


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (("make-datset", "x"), "'make-dataset'"),
        (("make-dataset", "airhockey-hit", "--worker", "4"), "'--workers'"),
        (("make-dataset", "airhockey-hit", "--shardsize=4"), "'--shard-size'"),
        (("make-dataset", "airhockey-hit", "--backend", "numpi"), "'numpy'"),
        (("make-dataset", "airhocky-hit"), "'airhockey-hit'"),
        (("show", "airhockey-hot"), "'airhockey-hit'"),
        (("show", "--stage", "start-k"), "'start-ik'"),
        (("show", "--constraint", "tabel"), "'table'"),
        (("show", "--constraint", "joint-speed"), "'joint-velocity'"),
        (("show", "--constraint", "joint-effort"), "'joint-torque'"),
        (("load", "x"), "'inspect'"),
        (("verify", "x"), "'validate'"),
        (("generate", "x"), "'make-dataset'"),
        (("list", "stage"), "'stages'"),
        (("--hepl",), "'--help'"),
        (("list", "--jsn"), "'--json'"),
    ],
)
def test_what_is_misspelt_is_met_with_the_nearest_known_name(run, words, hint):
    code, out, err = run(*words)
    assert (code, out) == (2, "")
    assert f"did you mean {hint}" in one_line(err)


def test_options_are_not_abbreviated_and_arguments_not_ignored(run):
    assert run("make-dataset", "airhockey-hit", "--dry")[0] == 2
    assert "unexpected argument 'more'" in run("list", "stages", "more")[2]
    assert "NAME|FILE" in one_line(run("make-dataset")[2])
    assert "see 'cnpgen inspect --help'" in one_line(run("inspect")[2])


# Help, version, speed


def test_help_lists_the_commands_and_exit_codes(run):
    code, out, err = run("--help")
    assert (code, err) == (0, "")
    for word in (
        "make-dataset",
        "list",
        "show",
        "inspect",
        "validate",
        "doctor",
        "  130  interrupted",
    ):
        assert word in out
    assert "  3    the machine: no permission to read or write a path" in out
    codes = {
        error.exit_code
        for error in vars(cnpgen.errors).values()
        if hasattr(error, "exit_code")
    }
    assert all(f"\n  {code}    " in out for code in {0, *codes})


@pytest.mark.parametrize(
    "command", ["make-dataset", "list", "show", "inspect", "validate", "doctor"]
)
def test_every_command_has_help(run, command):
    code, out, _ = run(command, "--help")
    assert code == 0
    assert f"usage: cnpgen {command}" in out


def test_help_imports_nothing_heavy():
    heavy = {
        "numpy",
        "casadi",
        "pinocchio",
        "coal",
        "h5py",
        "joblib",
        "tqdm",
        "matplotlib",
        "importlib.metadata",
    }
    script = f"import sys; from cnpgen.cli.main import main; main(['--help']); print({heavy!r} & sys.modules.keys())"
    out, err = spawn("-c", script).communicate()
    assert out.splitlines()[-1] == "set()"
    assert err == ""


def test_without_a_command_the_help_is_on_stderr(run):
    code, out, err = run()
    assert (code, out) == (2, "")
    assert "usage: cnpgen" in err


def test_the_package_is_a_command_and_has_a_version():
    process = spawn("-m", "cnpgen", "--version")
    out, err = process.communicate()
    assert (process.returncode, err) == (0, "")
    assert out.startswith("cnpgen ")


# make-dataset


def test_stdout_is_the_folder_and_stderr_a_start_and_a_summary(run, tmp_path):
    code, out, err = run(*MAKE, tmp_path / "hits")
    assert (code, out) == (0, f"{tmp_path / 'hits'}\n")
    start, *summary = err.splitlines()
    assert start == f"making {tmp_path / 'hits'}: 200 rows"
    text = " ".join(summary)
    times = r"[\d.]+ s: [\d.]+ s to get ready, then [\d,]+ rows/s"
    assert re.match(
        rf"made 200 rows \(train 182, validation 18\) in {times} accepted ", text
    )
    assert "accepted " in text
    assert "rejected: " in text
    assert len(summary) <= 3


def test_a_finished_dataset_is_already_complete(run, hits):
    code, out, err = run(*MAKE, hits)
    assert (code, out) == (0, f"{hits}\n")
    assert err.splitlines()[:2] == [
        f"checking {hits}: 200 rows",
        f"making {hits}: 200 rows, 200 exist already",
    ]
    assert "already complete: 200 rows (train 182, validation 18)" in err


def test_quiet_is_quiet(run, hits):
    assert run(*MAKE, hits, "--quiet") == (0, f"{hits}\n", "")


def test_reasons_that_round_to_nothing_are_not_summed_up():
    outcome = SamplingStatistics(
        tried=10_000,
        accepted=7_996,
        rejections={"too close": 2_000, "rare": 4, "never": 0},
    )
    assert (
        _yield(outcome) == "accepted 80.0% of 10,000 draws; rejected: too close 20.0%"
    )


def test_another_dataset_is_refused_until_it_is_forced(run, hits, tmp_path):
    folder = tmp_path / "hits"
    shutil.copytree(hits, folder)
    code, out, err = run(*MAKE, folder, "--seed", "5")
    assert (code, out) == (2, "")
    assert "are exist already" not in err
    assert "--force" in err.splitlines()[-1]
    assert run(*MAKE, folder, "--seed", "5", "--force", "--quiet")[0] == 0
    assert json.loads((folder / "specification.json").read_text())["seed"] == "5"


def test_parts_make_a_whole(run, tmp_path):
    folder = tmp_path / "parts"
    first = run(*MAKE, folder, "--part", "0/2")
    assert f"making {folder}: 182 rows\n" in first[2]
    assert "made 182 rows (train 182), part 0/2 of 200 rows, in " in first[2]
    assert "; other parts are still to be made" in " ".join(first[2].split())
    again = run(*MAKE, folder, "--part", "0/2")[2]
    assert (
        "already made: 182 rows (train 182), part 0/2 of 200 rows; other parts are still to be made"
        in again
    )
    assert not (folder / "manifest.json").exists()
    last = " ".join(run(*MAKE, folder, "--part", "1/2")[2].split())
    assert "made 18 rows (validation 18), part 1/2 of 200 rows, in " in last
    assert "rows/s; all parts are made accepted" in last
    assert (folder / "manifest.json").exists()


def test_a_part_that_was_interrupted_says_what_was_missing_of_it(run, tmp_path):
    folder = tmp_path / "parts"
    words = [*MAKE, folder, "--shard-size", "50", "--part", "0/2"]
    run(*words)
    (folder / "train" / "shard-00001.json").unlink()
    assert (
        "made the missing 50 of 100 rows (train 100), part 0/2 of 200 rows, in "
        in run(*words)[2]
    )


def test_a_damaged_shard_is_a_warning_of_one_line(run, hits, tmp_path):
    folder = Path(shutil.copytree(hits, tmp_path / "hits"))
    shard = folder / "train" / "shard-00000.h5"
    shard.write_bytes(shard.read_bytes()[:-1] + b"x")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code, out, err = run(*MAKE, folder)
    assert (code, out) == (0, f"{folder}\n")
    assert (
        f"cnpgen: warning: a shard is damaged and is made again: {shard} was changed"
        in err
    )
    assert "made the missing 182 of 200 rows" in err
    assert run("validate", folder)[0] == 0


def test_a_lost_manifest_is_written_again_and_not_passed_over(run, hits, tmp_path):
    folder = Path(shutil.copytree(hits, tmp_path / "hits"))
    (folder / "manifest.json").unlink()
    code, out, err = run(*MAKE, folder)
    assert (code, out) == (0, f"{folder}\n")
    assert (
        "all samples existed, manifest.json written again: 200 rows (train 182, validation 18)"
        in err
    )
    assert (folder / "manifest.json").read_bytes() == (
        hits / "manifest.json"
    ).read_bytes()


def test_a_dry_run_prints_the_plan_and_writes_nothing(run, tmp_path):
    code, out, err = run(*MAKE, tmp_path / "hits", "--dry-run", "--dtype", "float32")
    assert code == 0
    assert err in {"", "cnpgen: compiling kernels, once per problem and machine\n"}
    for text in (
        "state    new",
        "200: train 182, validation 18",
        "float32",
        "rad/s^2",
        "start_ddq",
        "bytes per row",
    ):
        assert text in out
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_says_what_is_in_the_folder(run, hits, tmp_path):
    shutil.copytree(hits, tmp_path / "half")
    (tmp_path / "half" / "train" / "shard-00000.json").unlink()
    (tmp_path / "half" / "manifest.json").unlink()
    assert "already complete" in run(*MAKE, hits, "--dry-run")[1]
    assert (
        "another dataset: would be refused"
        in run(*MAKE, hits, "--dry-run", "--seed", "5")[1]
    )
    assert (
        "holds a dataset, which would be replaced"
        in run(*MAKE, hits, "--dry-run", "--force")[1]
    )
    assert (
        "1 of 2 shards exist: would resume"
        in run(*MAKE, tmp_path / "half", "--dry-run")[1]
    )
    assert "something else: would be refused" in run(*MAKE, tmp_path, "--dry-run")[1]


def test_a_dry_run_with_force_says_that_foreign_files_would_be_in_the_way(
    run, hits, tmp_path
):
    folder = Path(shutil.copytree(hits, tmp_path / "hits"))
    (folder / "train" / "thesis.tex").write_text("mine")
    code, out, _ = run(*MAKE, folder, "--dry-run", "--force")
    assert code == 0
    refusal = "would be refused: it holds train/thesis.tex, which is not part of the dataset: move it away first"
    assert refusal in " ".join(out.split())
    assert run(*MAKE, folder, "--force")[0] == 2


def test_a_dry_run_says_what_becomes_of_a_plan_that_is_damaged_or_of_which_nothing_was_made(
    run, hits, tmp_path
):
    folder = Path(shutil.copytree(hits, tmp_path / "hits"))
    content = (folder / "specification.json").read_bytes()
    (folder / "specification.json").write_bytes(content[:100])
    assert (
        "a damaged specification.json: would be refused without --force"
        in run(*MAKE, folder, "--dry-run")[1]
    )
    assert "would be replaced" in run(*MAKE, folder, "--dry-run", "--force")[1]
    shutil.rmtree(folder / "train")
    shutil.rmtree(folder / "validation")
    for text in (content, content[:100]):
        (folder / "specification.json").write_bytes(text)
        assert (
            "without shards: would be replaced"
            in run(*MAKE, folder, "--dry-run", "--seed", "5")[1]
        )


def test_the_estimated_size_is_about_right(run, hits):
    line = next(
        line for line in run(*MAKE, hits, "--dry-run")[1].splitlines() if "size" in line
    )
    estimate = float(line.split("about ")[1].split(" kB")[0]) * 1000
    actual = sum(path.stat().st_size for path in hits.rglob("*") if path.is_file())
    assert estimate == pytest.approx(actual, rel=0.25)


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (6_700_000, "6.7 MB"),
        (2 * 10**15, "2e+03 TB"),
    ],
)
def test_sizes_are_written_in_decimal_units(number, text):
    assert size_text(number) == text


def test_an_interruption_is_130_and_says_how_to_go_on(run, monkeypatch, tmp_path):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("cnpgen.make.make_dataset.make_dataset", interrupted)
    code, out, err = run(*MAKE, tmp_path / "x", "--quiet")
    assert (code, out) == (130, "")
    assert (
        err
        == "cnpgen: interrupted: finished shards are kept; run the same command again to resume\n"
    )


@pytest.mark.slow
def test_what_a_signal_interrupts_is_kept(tmp_path):
    folder = tmp_path / "many"
    words = (
        "make-dataset",
        "airhockey-hit",
        "--n",
        "2e6",
        "--shard-size",
        "4096",
        "--workers",
        "1",
        "--out",
        folder,
    )
    process = spawn("-m", "cnpgen", *words)
    while (
        not (folder / "train" / "shard-00001.json").exists() and process.poll() is None
    ):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=HANGING)
    assert (process.returncode, out) == (130, "")
    assert "Traceback" not in err
    assert "finished shards are kept" in err
    found, _ = spawn("-m", "cnpgen", "inspect", folder).communicate()
    assert "unfinished: " in found


# Progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_sees_a_bar_with_the_draws_tried_and_their_share_accepted(
    monkeypatch,
):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "120")
    meter = Meter()
    meter.begin("making x", 300, 100)
    meter(100, SamplingStatistics(tried=200, accepted=100, rejections={"no": 100}))
    time.sleep(0.2)  # tqdm draws ten times a second
    meter(100, SamplingStatistics(tried=100, accepted=100))
    meter.close()
    assert "100/300" in terminal.getvalue()
    assert "300/300" in terminal.getvalue()
    assert "300 tried, 66.7% accepted" in terminal.getvalue()
    assert "row/s" in terminal.getvalue()
    assert meter.rows == 200
    assert meter.sampling.tried == 300


def test_a_file_sees_a_single_line(capsys):
    meter = Meter()
    meter.begin("making x", 300, 100)
    meter(100)
    meter(100)
    meter.close()
    meter.begin("making y", 1)
    assert (
        capsys.readouterr().err
        == "making x: 300 rows, 100 exist already\nmaking y: 1 row\n"
    )
    assert meter.rows == 0


# list, show


def test_list_shows_everything_that_there_is(run):
    code, out, err = run("list")
    assert (code, err) == (0, "")
    models = "planner trained on airhockey-hit"
    for text in (
        "airhockey-replan",
        "120,000 rows",
        models,
        "7 joints, 8 constraints",
        "goal-ik",
        "robot-clearance",
    ):
        assert text in out
    assert max(len(line) for line in out.splitlines()) <= 100


def test_list_can_be_narrowed_and_read_by_programs(run):
    assert "start-ik" not in run("list", "datasets")[1]
    found = json.loads(run("list", "--json")[1])
    assert list(found) == [
        "datasets",
        "models",
        "pipelines",
        "problems",
        "stages",
        "constraints",
        "objectives",
        "exporters",
        "families",
        "shapes",
        "planners",
        "suites",
    ]
    assert found["datasets"][0]["rows"] == 19_800
    assert Path(found["problems"][0]["file"]).is_file()


def test_a_broken_plug_in_does_not_hide_the_others(run, monkeypatch):
    import cnpgen.schema.registry

    load = cnpgen.schema.registry.load

    def fail(group, name, base=None):
        if name == "goal-ik":
            raise RecipeError(["stage 'goal-ik' cannot be imported"])
        return load(group, name, base)

    monkeypatch.setattr(cnpgen.schema.registry, "load", fail)
    code, out, _ = run("list", "stages")
    assert code == 0
    assert "(broken: stage 'goal-ik' cannot be imported)" in out
    assert "start-ik" in out


def test_show_prefers_the_dataset_and_can_be_told_otherwise(run):
    assert run("show", "heavy-object")[1].startswith("dataset heavy-object 1.1.0")
    assert run("show", "heavy-object", "--kind", "pipeline")[1].startswith(
        "pipeline heavy-object"
    )
    assert run("show", "heavy-object", "--kind", "problem")[1].startswith(
        "problem heavy-object"
    )
    assert run("show", "airhockey")[1].startswith("problem airhockey")


@pytest.mark.parametrize("kind", ["dataset", "pipeline", "problem"])
def test_show_tells_the_kind_of_a_file(run, kind):
    from cnpgen.schema.catalogue import list_recipes

    path = list_recipes(kind)["heavy-object"]
    assert run("show", path)[1].startswith(f"{kind} heavy-object")
    assert json.loads(run("show", path, "--json")[1])["kind"] == kind


def test_a_part_of_a_problem_is_read_as_one(run, tmp_path):
    path = tmp_path / "part.toml"
    path.write_text("[drive]\nbacklash = 1\n")
    code, _, stderr = run("show", path)
    assert code == 2
    assert "drive.backlash: unknown key" in stderr
    assert "name of the problem" in stderr


def test_show_describes_kinds_of_stages_and_constraints(run):
    assert run("show", "--stage", "start-ik")[1].startswith("stage start-ik")
    assert run("show", "--constraint", "table")[1].startswith("constraint table")
    assert json.loads(run("show", "--stage", "at-rest", "--json")[1])["keys"][0][
        "choices"
    ] == ["start", "goal"]
    assert run("show", "--stage", "at-rest", "--kind", "problem")[0] == 2
    assert run("show", "--stage", "at-rest", "airhockey")[0] == 2


def test_a_file_that_is_not_there_or_not_toml_is_one_line(run, tmp_path):
    assert "no such file" in one_line(run("show", tmp_path / "no.toml")[2])
    (tmp_path / "bad.toml").write_text("name = \n")
    code, _, err = run("show", tmp_path / "bad.toml")
    assert code == 2
    assert "line 1" in one_line(err)


# inspect, validate, doctor


def test_inspect_shows_rows_ranges_and_yield(run, hits):
    code, out, err = run("inspect", hits)
    assert (code, err) == (0, "")
    state = "complete; checksums of the shards were not checked, 'cnpgen validate' does"
    for text in (
        state,
        "200: train 182, validation 18",
        "too close together",
        "joint_6",
        "rad/s^2",
        "100.00 %",
    ):
        assert text in out
    assert max(len(line) for line in out.splitlines()) <= 100


@pytest.mark.slow
def test_inspect_writes_json_and_a_picture(run, hits, tmp_path):
    code, out, err = run("inspect", hits, "--json", "--plot", tmp_path / "hits.png")
    assert code == 0
    assert json.loads(out)["densities"]["goal_xyz"]["candidates"]
    assert err == f"drawn: {tmp_path / 'hits.png'}\n"
    assert (tmp_path / "hits.png").stat().st_size > 10_000
    assert "ends in .png" in one_line(run("inspect", hits, "--plot", "hits.jpeg")[2])


def test_a_picture_in_a_folder_that_is_not_there_is_refused_before_any_work(
    run, hits, tmp_path
):
    (tmp_path / "file").write_text("")
    for folder in ("nothing", "file"):
        code, out, err = run("inspect", hits, "--plot", tmp_path / folder / "hits.png")
        assert (code, out) == (2, "")
        assert "--plot: expected a file in a folder that is there, got " in one_line(
            err
        )


def test_inspect_of_a_damaged_dataset_is_1(run, hits, tmp_path):
    folder = shutil.copytree(hits, tmp_path / "damaged")
    (folder / "manifest.json").write_text("{}", encoding="utf-8")
    code, out, _ = run("inspect", folder)
    assert code == 1
    assert "damaged: manifest.json: " in out
    assert run("inspect", folder, "--json")[0] == 1


def test_inspect_works_on_an_unfinished_dataset(run, hits, tmp_path):
    shutil.copytree(hits, tmp_path / "half")
    (tmp_path / "half" / "manifest.json").unlink()
    for sidecar in (tmp_path / "half").glob("*/*.json"):
        sidecar.unlink()
        code, out, _ = run("inspect", tmp_path / "half")
        assert code == 0
        assert "unfinished: " in out


def test_inspect_of_something_else_is_one_line(run, tmp_path):
    assert run("inspect", tmp_path / "nothing")[0] == 2
    code, _, err = run("inspect", tmp_path)
    assert code == 2
    assert "not a dataset" in one_line(err)


def test_validate_says_yes(run, hits):
    code, out, err = run(
        "validate", hits, "--deep", "--workers", "1", "--regenerate", "1"
    )
    assert code == 0
    assert "no findings" in out
    assert "recomputed with Pinocchio and Coal: 200 rows, 0 out" in out
    assert err == f"validating {hits}: 200 rows\n"


def test_a_quiet_validation_prints_findings_and_nothing_else(run, hits, tmp_path):
    assert run(
        "validate", hits, "--deep", "--workers", "1", "--regenerate", "1", "--quiet"
    ) == (0, "", "")
    folder = Path(shutil.copytree(hits, tmp_path / "hits"))
    (folder / "notes.txt").write_text("mine")
    assert run("validate", folder, "--quiet") == (0, "", "")
    (folder / "stats.json").unlink()
    assert run("validate", folder, "--quiet") == (1, "stats.json: is missing\n", "")


def test_validate_says_no_with_a_line_per_finding(run, hits, monkeypatch):
    notes = (Finding("mine.txt", "is not part of the dataset", note=True),)
    findings = (
        Finding("train/shard-00000.h5", "is missing"),
        Finding("specification.json", "was\nchanged"),
        *notes,
    )
    wanted = {}

    def validate(folder, **options):
        wanted.update(options)
        return ValidationReport(folder, 18, findings)

    monkeypatch.setattr("cnpgen.validate.validate_dataset.validate_dataset", validate)
    code, out, err = run("validate", hits, "--regenerate", "3")
    assert code == 1
    lines = [
        "train/shard-00000.h5: is missing",
        "specification.json: was changed",
        "note: mine.txt: is not part of the dataset",
    ]
    assert out.splitlines() == [*lines, f"{hits}: 18 rows, 2 findings"]
    assert err == ""
    assert wanted["regenerate"] == 3
    code, out, _ = run("validate", hits, "--json")
    assert code == 1
    assert json.loads(out)["ok"] is False


def test_doctor_finds_this_machine_well(run):
    code, out, _ = run("doctor")
    assert code == 0
    assert "all requirements are met" in out


def test_the_report_of_doctor_has_all_findings(run, monkeypatch):
    """``cnpgen doctor > machine.txt`` loses none of them."""
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")
    monkeypatch.setitem(sys.modules, "pinocchio", types.ModuleType("pinocchio"))
    _, out, _ = run("doctor")
    assert "another project" in " ".join(out.split())
    assert re.search(r"^warning .*container may use 1 of", out, re.MULTILINE)


def test_doctor_writes_json(run):
    assert json.loads(run("doctor", "--json")[1])["ok"] is True


def test_doctor_is_3_with_a_line_per_problem(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "pinocchio", types.ModuleType("pinocchio"))
    monkeypatch.delenv(
        "LOKY_MAX_CPU_COUNT", raising=False
    )  # of the tests; doctor would say that cores are kept back
    code, out, err = run("doctor")
    assert code == 3
    assert "1 problem, below" in out
    assert "another project" in one_line(err)


# Errors


def test_every_mistake_of_a_recipe_is_a_line(run, tmp_path):
    recipe = tmp_path / "bad.toml"
    recipe.write_text(
        'name = "Bad Name"\npipeline = "airhockey-hit"\nsed = 3\n[splits]\ntrain = 0\n'
    )
    code, out, err = run("make-dataset", recipe)
    assert (code, out) == (2, "")
    lines = err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"cnpgen: error: {recipe}: ") for line in lines)


def _fail_with(monkeypatch, error):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("cnpgen.store.inspection.inspect_dataset", fail)


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (DatasetError("a\n  b"), 1, "a b"),
        (
            ZeroDivisionError("division\nby zero"),
            3,
            "internal error: ZeroDivisionError: division by zero",
        ),
        (ImportError("No module named 'casadi'"), 3, "'cnpgen doctor'"),
        (PermissionError(13, "Permission denied", "/x"), 3, "/x: Permission denied"),
        (MemoryError(), 3, "out of memory"),
        (DatasetError("gone"), 1, "gone"),
    ],
)
def test_an_error_is_a_line_and_a_code_without_a_traceback(
    run, hits, monkeypatch, error, code, text
):
    _fail_with(monkeypatch, error)
    found, out, err = run("inspect", hits)
    assert (found, out) == (code, "")
    assert text in one_line(err)


@pytest.mark.parametrize(
    "words", [("--debug", "inspect", "{}"), ("inspect", "{}", "--debug")]
)
def test_debug_shows_the_traceback(run, hits, monkeypatch, words):
    _fail_with(monkeypatch, ZeroDivisionError("division by zero"))
    code, _, err = run(*(word.format(hits) for word in words))
    assert code == 3
    assert "Traceback (most recent call last)" in err
    assert err.splitlines()[-1].startswith("cnpgen: error: ")


def test_a_warning_is_a_line(run, hits, monkeypatch):
    def warn(*_, **__):
        warnings.warn("no compiler;\n  slower", RuntimeWarning, stacklevel=1)
        raise DatasetError("gone")

    monkeypatch.setattr("cnpgen.store.inspection.inspect_dataset", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        _, _, err = run("inspect", hits)
    assert err == "cnpgen: warning: no compiler; slower\ncnpgen: error: gone\n"


def test_an_interruption_of_another_command_is_130(run, hits, monkeypatch):
    _fail_with(monkeypatch, KeyboardInterrupt())
    assert run("inspect", hits) == (130, "", "cnpgen: interrupted\n")


def test_a_reader_that_goes_away_is_left_quietly():
    process = spawn("-m", "cnpgen", "list")
    process.stdout.close()
    err = process.stderr.read()
    process.stderr.close()
    assert process.wait(60) == 141
    assert err == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_behind_stdout_is_a_line():
    with Path("/dev/full").open("w") as full:
        process = subprocess.run(
            [sys.executable, "-m", "cnpgen", "list"],
            env=ENVIRONMENT,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert process.returncode == 3
    assert one_line(process.stderr) == "cnpgen: error: stdout: No space left on device"


def test_closed_streams_are_no_error():
    command = f"'{sys.executable}' -m cnpgen list >&- 2>&-"
    assert (
        subprocess.run(command, shell=True, env=ENVIRONMENT, check=False).returncode
        == 0
    )


def test_suggestions_do_not_depend_on_the_process():
    """Names that are equally similar are in the same order, whatever the seed of Python's hashes is."""
    script = "from cnpgen.cli.recipe_names import _shipped; print(*_shipped())"
    orders = {
        subprocess.run(
            [sys.executable, "-c", script],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            check=True,
        ).stdout
        for seed in "123"
    }
    assert len(orders) == 1


def test_the_list_has_planners_families_and_suites_of_addons(run):
    out = run("list", "planners")[1]
    assert "trajopt" in out
    assert "tabletop" in run("list", "families")[1]
    names = [
        entry["name"]
        for entry in json.loads(run("list", "suites", "--json")[1])["suites"]
    ]
    assert "hits-81" in names
