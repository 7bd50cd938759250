"""Training a model on a dataset: a file in the end, a checkpoint and a log on the way."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.machine.times import NO_TIME, Stopwatch, Times
from cnpgen.planner.kit import Kit, surroundings
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import find_model, load_model, save_model
from cnpgen.problems.record import as_record
from cnpgen.schema.arguments import integer
from cnpgen.store.files.atomic import file_sha256
from cnpgen.store.files.documents import differences, plain
from cnpgen.training.checkpoint import Checkpoints
from cnpgen.training.data import TrainingData, open_training_data
from cnpgen.training.files import CHECKPOINT, LOG, check_beside, check_out, sweep_beside
from cnpgen.training.log import TrainingLog
from cnpgen.training.prepare import begin_run, identity, prepare_run
from cnpgen.training.run import Run, Watcher
from cnpgen.training.score import validate
from cnpgen.training.settings import Length, TrainingSettings
from cnpgen.training.state import State

SECONDS = 120.0  # of CPU time, if nobody says how long
MOST_JUDGED = 2000  # validation rows that the last model is judged on


@dataclass(frozen=True)
class Trained:
    """What came of a run.

    Attributes:
        model: The best model.
        path: Its file.
        score: What ``validate`` says of it on up to 2,000 validation rows that it was not chosen by.
        made: Whether it was made now; False if it was there already.
        times: Where the time of this run went, the last validation included; of one that was interrupted, since it went
            on. The model's ``training`` has the CPU time of all steps and validations.
    """

    model: Model
    path: Path
    score: Mapping[str, Any]
    made: bool = True
    times: Times = NO_TIME


def train_model(
    folder: str | Path,
    out: str | Path,
    *,
    steps: int | None = None,
    epochs: float | None = None,
    cpu_seconds: float | None = None,
    settings: TrainingSettings | None = None,
    start_from: str | Path | None = None,
    check_rows: int = 200,
    command: str = "",
    force: bool = False,
    workers: int | None = None,
    begin: Callable[[State, Run], None] | None = None,
    watch: Watcher | None = None,
) -> Trained:
    """Train a model, or go on with one that was interrupted; one that is there already is returned as it is.

    Beside the model there are a log, ``.jsonl``, and as long as it is not finished a checkpoint, ``.checkpoint``. Cut
    off and resumed, a run gives the parameters that it would have given uncut, to the bit.

    Args:
        folder: The dataset.
        out: The model's file, ``.h5``.
        steps: How long, in steps.
        epochs: How long, in passes over all rows.
        cpu_seconds: How long, in CPU time of the steps [s]: how long a step takes is measured before, and their number
            is then fixed. Compiling, reading rows and validating come on top. If nothing says how long, 120 s.
        settings: How to train.
        start_from: A model, by name or path, whose parameters and features the run begins with, instead of random
            parameters; width, depth and the meaning of outputs in the settings must be those that it has.
        check_rows: Validation rows that models are compared by on the way, half of them at most; the best one is judged
            on up to 2,000 others.
        command: What the model says that it was made by.
        force: Replace the model, log and picture that are there; throw away another run's checkpoint.
        workers: Processes of the last validation; training itself is one process.
        begin: Called once before the first step.
        watch: Called with every line of the log.

    Raises:
        UsageError: An argument cannot be meant, there is no model to start from or it is for something else, or there
            is another model, another run's checkpoint, or a log or picture of something else.
        DatasetError: The dataset or the checkpoint is damaged.
        MachineError: The disk is full, or the loss is not finite any more.
    """
    clock = Stopwatch()
    lasts = {"steps": steps, "epochs": epochs, "cpu_seconds": cpu_seconds}
    settings = settings or TrainingSettings()
    job = _job(folder, Path(out), settings, lasts, check_rows=check_rows, start_from=start_from)
    if not force:
        if job.out.exists() and not job.checkpoints.path.exists():
            return _finished(job)
        check_beside(job.out)
    with one_thread(), surroundings(as_record(job.source.dataset.problem)) as given:
        run, kit = prepare_run(
            job.source, given, job.settings, first=job.first, check_rows=job.check_rows, command=command
        )
        state = job.checkpoints.load(discard=force) or begin_run(run, job.length)
        clock.prepared()
        if begin is not None:
            begin(state, run)
        journal = TrainingLog(job.out.with_suffix(LOG), state.log)
        run.go_on(state, job.checkpoints, journal, watch)
        job.checkpoints.save(state)
        trained = _kept(job, run, state, kit=kit, journal=journal, workers=workers)
    clock.computed_here()
    return replace(trained, times=clock.times())


@dataclass(frozen=True)
class _Job:
    """What is to be trained, on what, from what, for how long, and where it goes."""

    source: TrainingData
    first: Model | None
    out: Path
    settings: TrainingSettings
    length: Length
    check_rows: int
    checkpoints: Checkpoints


def _job(
    folder: str | Path,
    out: Path,
    settings: TrainingSettings,
    lasts: Mapping[str, Any],
    *,
    check_rows: int,
    start_from: str | Path | None,
) -> _Job:
    """Check what was asked for, open the dataset, and read the model to start from."""
    given = {name: value for name, value in lasts.items() if value is not None} or {"cpu_seconds": SECONDS}
    length, check_rows = Length(**given), integer("check_rows", check_rows, least=1)
    check_out(out)
    sweep_beside(out)
    source = open_training_data(folder)
    first, digest = _first(start_from)
    asked = {**identity(source, settings), "length": plain(given), "check_rows": check_rows, "start_from": digest}
    return _Job(source, first, out, settings, length, check_rows, Checkpoints(out.with_suffix(CHECKPOINT), asked))


def _first(start_from: str | Path | None) -> tuple[Model | None, str | None]:
    """Read the model to start from, and its file's sha256; None where there is none."""
    if start_from is None:
        return None, None
    return load_model(start_from), file_sha256(find_model(start_from))


def _kept(job: _Job, run: Run, state: State, *, kit: Kit, journal: TrainingLog, workers: int | None) -> Trained:
    """Judge the best model and write it; the log's last line is not in the checkpoint, so that it comes but once."""
    best = run.model(state.best.parameters)
    score = validate(best, kit, job.source.judged(MOST_JUDGED, after=job.check_rows), workers=workers)
    journal.write({"step": state.adam.step, "best": state.best.step, "final": score})
    training = {**best.training, **job.checkpoints.identity, **_outcome(state, score)}
    model = replace(best, log=journal.text, training=training)
    save_model(job.out, model)
    job.checkpoints.remove()
    return Trained(model, job.out, score)


def _finished(job: _Job) -> Trained:
    """Return the model that is there if it is the one that was asked for."""
    path, identity, hint = job.out, job.checkpoints.identity, "train another file, or replace it with force=True"
    try:
        model = load_model(path)
    except DatasetError as error:
        raise UsageError(f"{path} exists and is no model ({error}): {hint}") from error
    found = {name: model.training.get(name) for name in identity}
    changed = list(map(str, differences(found, identity)))
    if changed:
        raise UsageError(f"{path} is another model, it differs in {', '.join(changed[:4])}: {hint}")
    return Trained(model, path, model.training["score"], made=False)


def _outcome(state: State, score: Mapping[str, Any]) -> dict[str, Any]:
    """Say how training went, for the model's file."""
    return {
        "steps": state.adam.step,
        "best_step": state.best.step,
        "cpu_seconds": round(state.seconds, 1),
        "validation_cpu_seconds": round(state.checking, 1),
        "score": {key: value for key, value in score.items() if key != "score"},
    }
