"""Training runs: interrupted and resumed runs are exact; errors and messages."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import ANY

import numpy as np
import pytest

from cnpgen.cli.train_command import summary
from cnpgen.errors import DatasetError, UsageError
from cnpgen.losses.metric import BOUNDED
from cnpgen.make.make_dataset import make_dataset
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model
from cnpgen.store.files.leftovers import temporary_name
from cnpgen.training import checkpoint as checkpoints
from cnpgen.training.train import Trained, train_model
from cnpgen.training.training_options import TrainingOptions
from tests.conftest import some, tiny_recipe
from tests.examples.grouped import grouped
from tests.examples.models import SMALL
from tests.refusals import is_refused

STEPS, SCORED = 30, 6
Train = Callable[..., Trained]


class CutOffError(Exception):
    """Raised during a run."""


@pytest.fixture
def train(
    tiny: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Train:
    """Train a small model of the hits; with frequent checkpoints and few scored rows."""
    monkeypatch.setattr(checkpoints, "MIN_INTERVAL_S", 0.0)
    monkeypatch.setattr(checkpoints, "INTERVAL_PER_WRITING_TIME", 3.0)
    monkeypatch.setattr("cnpgen.training.train.MAX_SCORED_ROWS", SCORED)

    def run(out: str = "model.h5", **options: Any) -> Trained:
        arguments = {
            "steps": STEPS,
            "settings": SMALL,
            "check_rows": 1,
            "workers": 1,
            **options,
        }
        folders = tiny("airhockey-hit"), tmp_path / out
        return grouped(train_model, TrainingOptions, *folders, **arguments)

    return run


@pytest.fixture(scope="module")
def uncut(
    tiny: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> Trained:
    """The model of an uninterrupted run; not to be changed."""
    out = tmp_path_factory.mktemp("uncut") / "model.h5"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cnpgen.training.train.MAX_SCORED_ROWS", SCORED)
        return train_model(
            tiny("airhockey-hit"),
            out,
            steps=STEPS,
            settings=SMALL,
            check_rows=1,
            workers=1,
        )


def cut_at(step: int) -> Callable[[Any], None]:
    def watch(record: Any) -> None:
        if record["step"] >= step:
            raise CutOffError

    return watch


def lines(model: Model) -> list[dict[str, Any]]:
    """Return the log without times."""
    return [
        {k: v for k, v in json.loads(line).items() if k != "seconds"}
        for line in model.log.splitlines()
    ]


@pytest.mark.parametrize(
    "metric",
    some([SMALL.metric, replace(BOUNDED, every="batch")], 1, "slow"),
    ids=["ramped", "learned"],
)
def test_an_interrupted_and_resumed_run_gives_the_parameters_and_log_of_an_uninterrupted_one(
    train, uncut, metric
):
    settings = replace(SMALL, metric=metric)
    whole = uncut if metric == SMALL.metric else train("whole.h5", settings=settings)
    for step in (3, 17, 29):
        with pytest.raises(CutOffError):
            train("cut.h5", settings=settings, watch=cut_at(step))
    cut = train("cut.h5", settings=settings)
    np.testing.assert_array_equal(cut.model.parameters, whole.model.parameters)
    assert lines(cut.model) == lines(whole.model)
    assert cut.model.training["best_step"] == whole.model.training["best_step"]
    assert cut.score == whole.score


@pytest.mark.slow
def test_the_model_depends_on_the_seed_only(train, uncut):
    again, other = train("again.h5"), train("other.h5", settings=replace(SMALL, seed=1))
    np.testing.assert_array_equal(again.model.parameters, uncut.model.parameters)
    assert (other.model.parameters != uncut.model.parameters).any()


def test_the_saved_model_is_the_best_validated_one(uncut):
    checks = [record for record in lines(uncut.model) if "validation" in record]
    best = max(
        checks, key=lambda record: (record["validation"]["score"], record["step"])
    )
    assert len(checks) == 10
    assert uncut.model.training["best_step"] == best["step"]


def test_training_improves_plans(train):
    trained = train(steps=300, settings=replace(SMALL, hidden=32))
    steps = [record for record in lines(trained.model) if "loss" in record]
    for name in ("joint-acceleration", "joint-torque"):
        assert steps[-1]["terms"][name] < 0.05 * steps[0]["terms"][name]
    assert (
        steps[-1]["terms"]["table"] < steps[-1]["budgets"]["table"]
    )  # by the projection, from the beginning
    assert trained.score["z_error_mm_s"] < 5


def test_the_log_contains_loss_terms_budgets_weights_and_rate_and_is_in_the_model(
    uncut,
):
    on_disk = uncut.path.with_suffix(".jsonl").read_text()
    assert uncut.model.log == on_disk == load_model(uncut.path).log
    record = json.loads(on_disk.splitlines()[0])
    assert {
        "step",
        "epoch",
        "learning_rate",
        "seconds",
        "loss",
        "terms",
        "weights",
        "budgets",
        "lost",
    } <= record.keys()
    weighted = record["terms"]["time"] + sum(
        record["terms"][k] * w for k, w in record["weights"].items()
    )
    assert record["loss"] == pytest.approx(weighted)
    assert not uncut.path.with_suffix(".checkpoint").exists()


@pytest.mark.slow
def test_seconds_are_converted_to_steps_before_the_run(train):
    begun = []
    trained = train(
        steps=None, cpu_seconds=0.2, begin=lambda state, run: begun.append(state.steps)
    )
    assert begun == [trained.model.training["steps"]]
    assert 10 < begun[0] < 2000


def test_the_summary_reports_times_by_purpose(train):
    begun = time.perf_counter()
    trained = train()
    passed, times, training = (
        time.perf_counter() - begun,
        trained.times,
        trained.model.training,
    )
    assert 0.5 * passed < times.passed <= passed
    assert times.preparing > 0
    assert (
        times.computing
        >= 0.9 * (training["cpu_seconds"] + training["validation_cpu_seconds"]) - 0.2
    )
    text = " ".join(summary(trained).split())
    assert (
        f"{training['cpu_seconds']:.0f} s of CPU time and {training['validation_cpu_seconds']:.0f} s for"
        in text
    )
    assert f"this run took {times};" in text


def test_epochs_are_converted_to_steps(train):
    assert train(steps=None, epochs=2).model.training["steps"] == 2 * (600 // 32)


@pytest.mark.slow
def test_a_finished_model_is_returned_and_another_one_is_replaced_only_by_force(
    train, tmp_path
):
    first = train()
    before = (tmp_path / "model.h5").read_bytes()
    again = train(begin=lambda *_: pytest.fail("trained again"))
    assert (first.made, again.made) == (True, False)
    assert again.score == first.model.training["score"]
    np.testing.assert_array_equal(again.model.parameters, first.model.parameters)
    for options, differs in (
        ({"settings": replace(SMALL, seed=1)}, r"settings\.seed \(0, now 1\)"),
        ({"steps": 31}, r"length\.steps \(30, now 31\)"),
        ({"check_rows": 3}, r"check_rows \(1, now 3\)"),
    ):
        with pytest.raises(
            UsageError, match=rf"model\.h5 is another model.*{differs}.*force=True"
        ):
            train(**options)
    assert (tmp_path / "model.h5").read_bytes() == before
    assert train(steps=31, force=True).model.training["steps"] == 31


@pytest.mark.parametrize("out", ["missing/model.h5", "model", "model.jsonl", "."])
def test_an_invalid_output_path_raises_an_error_before_any_work(train, out):
    with is_refused(UsageError, argument="out"):
        train(out)


def test_a_file_that_is_no_model_is_not_overwritten(train, tmp_path):
    (tmp_path / "model.h5").write_bytes(b"mine")
    with is_refused(UsageError, argument="force"):
        train()
    assert (tmp_path / "model.h5").read_bytes() == b"mine"


@pytest.mark.parametrize(
    "wrong",
    [{"check_rows": 0}, {"steps": 2.5}, {"steps": None, "cpu_seconds": float("inf")}],
)
def test_invalid_arguments_of_train_model_raise_errors_with_their_name(train, wrong):
    with is_refused(UsageError, argument=ANY):
        train(**wrong)


def test_numpy_integers_give_the_same_run(train):
    train(
        steps=np.int64(STEPS),
        settings=replace(SMALL, seed=np.int64(2)),
        check_rows=np.int32(1),
    )
    assert not train(settings=replace(SMALL, seed=2)).made


@pytest.mark.parametrize("number", some([signal.SIGINT, signal.SIGTERM], 1, "slow"))
def test_a_signal_saves_the_run_after_the_current_step(train, uncut, number):
    before, steps = signal.signal(number, signal.default_int_handler), []

    def interrupt(record: Any) -> None:
        steps.append(record["step"])
        if record["step"] == 17:
            signal.raise_signal(number)

    try:
        with pytest.raises(KeyboardInterrupt):
            train("cut.h5", watch=interrupt)
    finally:
        signal.signal(number, before)
    assert steps[-1] == 17
    begun = []
    cut = train("cut.h5", begin=lambda state, run: begun.append(state.adam.step))
    assert begun == [17]
    np.testing.assert_array_equal(cut.model.parameters, uncut.model.parameters)
    assert lines(cut.model) == lines(uncut.model)


@pytest.mark.slow
def test_force_resumes_the_same_run_and_discards_the_checkpoint_of_another(train):
    begun = []
    with pytest.raises(CutOffError):
        train(force=True, watch=cut_at(15))
    train(force=True, begin=lambda state, run: begun.append(state.adam.step))
    with pytest.raises(CutOffError):
        train(force=True, watch=cut_at(15))
    train(force=True, steps=31, begin=lambda state, run: begun.append(state.adam.step))
    assert begun[0] > 0
    assert begun[1] == 0


@pytest.mark.slow
def test_the_checkpoint_of_another_run_raises_an_error(train):
    with pytest.raises(CutOffError):
        train(watch=cut_at(5))
    with is_refused(UsageError, argument="force"):
        train(settings=replace(SMALL, learning_rate=2e-3))
    train(settings=replace(SMALL, learning_rate=2e-3), force=True)


def test_a_damaged_checkpoint_raises_an_error(train, tmp_path):
    with pytest.raises(CutOffError):
        train(watch=cut_at(5))
    path = tmp_path / "model.checkpoint"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with is_refused(DatasetError):
        train()


@pytest.mark.slow
def test_failures_between_the_last_step_and_the_model_leave_one_last_line(
    train, uncut, tmp_path, monkeypatch
):
    """The last line of the log is written after the last checkpoint, and again if writing the model failed."""
    for _ in range(2):
        with monkeypatch.context() as patch:
            patch.setattr("cnpgen.training.train.save_model", dying)
            with pytest.raises(CutOffError):
                train("cut.h5")
    cut = train("cut.h5")
    assert lines(cut.model) == lines(uncut.model)
    assert (
        sum(
            "final" in line
            for line in (tmp_path / "cut.jsonl").read_text().splitlines()
        )
        == 1
    )
    np.testing.assert_array_equal(cut.model.parameters, uncut.model.parameters)


def dying(*_: Any) -> None:
    raise CutOffError


@pytest.mark.parametrize("left", some([None, b"", b'{"step": 1'], 1, "slow"))
def test_a_resumed_run_has_its_whole_log_even_if_the_file_was_changed(
    train, uncut, tmp_path, left
):
    with pytest.raises(CutOffError):
        train("cut.h5", watch=cut_at(20))
    log = tmp_path / "cut.jsonl"
    log.unlink() if left is None else log.write_bytes(left)
    cut = train("cut.h5", force=True)
    assert lines(cut.model) == lines(uncut.model)
    assert log.read_text() == cut.model.log


def test_the_log_is_replaced_atomically(train, tmp_path, monkeypatch):
    with pytest.raises(CutOffError):
        train(watch=cut_at(20))
    before = (tmp_path / "model.jsonl").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", dying)  # as if killed before the file is renamed
        with pytest.raises(CutOffError):
            train()
    assert (tmp_path / "model.jsonl").read_bytes() == before


@pytest.mark.parametrize("name", some(["model.jsonl", "model.png"], 1, "slow"))
def test_other_files_beside_the_model_are_not_replaced_without_force(
    train, tmp_path, name
):
    path = tmp_path / name
    path.write_text('{"step": 1, "my": "data"}\n')
    with is_refused(UsageError, argument="out"):
        train(begin=lambda *_: pytest.fail("trained"))
    assert path.read_text() == '{"step": 1, "my": "data"}\n'
    assert train(force=True).made


@pytest.mark.slow
def test_log_and_picture_are_replaced_by_the_next_run(train, tmp_path):
    train()
    (tmp_path / "model.h5").unlink()
    (tmp_path / "model.png").write_bytes(b"drawn of the log")
    assert train(steps=31).made


def test_only_temporary_files_of_killed_runs_are_removed(train, tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        gone.wait()

    def of(name: str, process: int) -> str:
        return temporary_name(name).replace(f"-{os.getpid()}.", f"-{process}.")

    mine = [
        of(f"model.{end}", gone.pid) for end in ("h5", "checkpoint", "jsonl", "png")
    ]
    others = [of("model.h5", os.getppid()), of("other.h5", gone.pid), ".model.h5.tmp"]
    for name in (*mine, *others):
        (tmp_path / name).write_bytes(b"half")
    train()
    left = {path.name for path in tmp_path.iterdir() if path.name.startswith(".")}
    assert left == set(others)


def test_resuming_with_a_changed_dataset_raises_an_error(train, tmp_path):
    with pytest.raises(CutOffError):
        train(watch=cut_at(5))
    other = tmp_path / "other"
    make_dataset(tiny_recipe("airhockey-hit", seed=7), other, workers=1)
    with is_refused(UsageError, argument="force"):
        train_model(
            other, tmp_path / "model.h5", steps=STEPS, settings=SMALL, check_rows=1
        )


def test_a_dataset_without_a_second_split_raises_an_error(tmp_path):
    recipe = replace(tiny_recipe("airhockey-hit"), splits={"train": 64})
    make_dataset(recipe, tmp_path / "one", workers=1)
    with is_refused(DatasetError):
        train_model(tmp_path / "one", tmp_path / "model.h5", steps=2, settings=SMALL)


@pytest.mark.slow
def test_a_killed_run_resumes_from_its_checkpoint(train, tiny, tmp_path):
    code = f"""
from pathlib import Path
from cnpgen.training import checkpoint
from cnpgen.training.settings import TrainingSettings
from cnpgen.training.train import train_model
checkpoint.MIN_INTERVAL_S, checkpoint.INTERVAL_PER_WRITING_TIME = 0.0, 3.0
train_model({str(tiny("airhockey-hit"))!r}, {str(tmp_path / "cut.h5")!r}, steps=300, check_rows=1, workers=1,
    settings=TrainingSettings(hidden=16, layers=2, batch_size=32, nodes=16))
"""
    path, environment = (
        tmp_path / "cut.checkpoint",
        {**os.environ, "OMP_NUM_THREADS": "1"},
    )
    with subprocess.Popen([sys.executable, "-c", code], env=environment) as process:
        while not path.exists() and process.poll() is None:
            time.sleep(0.02)
        time.sleep(0.1)
        os.kill(process.pid, signal.SIGKILL)
    assert path.exists()
    begun = []
    cut = train(
        "cut.h5", steps=300, begin=lambda state, run: begun.append(state.adam.step)
    )
    assert 0 < begun[0] < 300
    np.testing.assert_array_equal(
        cut.model.parameters, train("whole.h5", steps=300).model.parameters
    )


@pytest.mark.skipif(sys.platform == "win32", reason="there are no locks")
@pytest.mark.parametrize("force", [False, True])
def test_a_second_training_of_the_same_file_is_refused(train, tiny, tmp_path, force):
    """The log of the first run stays as it is; the command line ends with exit code 2."""
    results = []

    def train_again(record: Any) -> None:
        if not results:
            before = (tmp_path / "model.jsonl").read_bytes()
            command = [
                "train",
                str(tiny("airhockey-hit")),
                "-o",
                str(tmp_path / "model.h5"),
                "--steps",
                "3",
            ]
            options = ["--force"] if force else []
            done = subprocess.run(
                [sys.executable, "-m", "cnpgen", *command, *options],
                capture_output=True,
                text=True,
                check=False,
            )
            assert (tmp_path / "model.jsonl").read_bytes() == before
            results.append((done.returncode, done.stderr))

    train(watch=train_again)
    ((code, text),) = results
    assert code == 2, text
    assert (
        f"another process is writing {tmp_path / 'model.h5'}: wait for it, or choose another"
        in text
    )
    assert not (tmp_path / "model.lock").exists()
