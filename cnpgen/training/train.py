"""Train a model on a dataset: a model file at the end, a checkpoint and a log during the run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cnpgen.documents import JsonMapping, JsonObject
from cnpgen.errors import DatasetError, UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.machine.times import NO_TIME, Stopwatch, Times
from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import find_model, load_model, save_model
from cnpgen.problems.problem_record import (
    ProblemRecord,
    as_record,
    with_control_points,
    with_objective,
)
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import concerning, integer
from cnpgen.schema.old_keywords import with_old_keywords
from cnpgen.store.files.atomic import check_writable, file_sha256
from cnpgen.store.files.documents import differences, plain
from cnpgen.store.files.file_lock import output_lock
from cnpgen.store.files.leftovers import remove_leftovers_of
from cnpgen.training.checkpoint import Checkpoints, State
from cnpgen.training.data import TrainingData, open_training_data
from cnpgen.training.log import TrainingLog, is_log
from cnpgen.training.prepare import begin_run, identity, prepare_run, validate
from cnpgen.training.settings import Length, TrainingSettings
from cnpgen.training.training_options import TrainingOptions

DEFAULT_CPU_TIME_S = 120.0
# In place of .h5.
CHECKPOINT = ".checkpoint"
LOG = ".jsonl"
PICTURE = ".png"
LOCK = ".lock"
MAX_SCORED_ROWS = 2000  # validation rows for the final score


@dataclass(frozen=True)
class Trained:
    """Result of a run.

    Attributes:
        model: The best model.
        path: Its file.
        score: Result of ``validate`` on up to 2,000 validation rows that were not used
            to select it.
        made: Whether it was made now; False if it existed.
        times: Times of this run including the final validation; of a resumed run, since
            it was resumed. The model's ``training`` has the CPU time of all steps and
            validations.
    """

    model: Model
    path: Path
    score: JsonMapping
    made: bool = True
    times: Times = NO_TIME


@checked_arguments
def train_model(
    folder: str | Path,
    out: str | Path,
    *,
    steps: int | None = None,
    cpu_seconds: float | None = None,
    settings: TrainingSettings | None = None,
    start_from: str | Path | None = None,
    check_rows: int = 200,
    force: bool = False,
    workers: int | None = None,
    options: TrainingOptions | None = None,
    **old_keywords: Any,
) -> Trained:
    """Train a model, or resume an interrupted run; an existing model of the same run is returned.

    The run writes a log, ``.jsonl``, and until it is finished a checkpoint,
    ``.checkpoint``, beside the model. An interrupted and resumed run gives the same
    parameters to the bit as an uninterrupted one.

    Args:
        folder: The dataset; with ``robot`` a scene file, or a folder of scene files.
        out: The model's file, ``.h5``.
        steps: Length in steps.
        cpu_seconds: Length in CPU time of the steps [s]: the time of a step is measured
            first, and the number of steps is then fixed. Compiling, reading rows and
            validation are not included. The default is 120 s.
        settings: Training settings.
        start_from: Model, by name or path, whose parameters and features replace random
            ones; width, depth and output definition in the settings must be the same.
        check_rows: Number of validation rows that models are compared on during the
            run, at most half of them; the best one is scored on up to 2,000 others.
        force: Replace an existing model, log and picture; discard another run's
            checkpoint.
        workers: Number of processes of the final validation; training itself uses one
            process.
        options: Length in epochs, the robot of scene files and others.
        old_keywords: Fields of the options, as keywords of version 1.0.

    Raises:
        UsageError: An argument is invalid, the initial model is missing or does not
            fit, there is another model, another run's checkpoint, or a log or picture
            of another origin, or another process writes the same model.
        DatasetError: The dataset or the checkpoint is damaged.
        MachineError: The disk is full, or the loss is not finite any more.
    """
    clock = Stopwatch()
    chosen = with_old_keywords("train_model", options, TrainingOptions(), old_keywords)
    out = Path(out)
    settings = settings or TrainingSettings()
    lengths = {"steps": steps, "epochs": chosen.epochs, "cpu_seconds": cpu_seconds}
    stated = {name: value for name, value in lengths.items() if value is not None}
    passed: JsonObject = stated or {"cpu_seconds": DEFAULT_CPU_TIME_S}
    check_rows = integer("check_rows", check_rows, least=1)
    check_out(out)
    remove_temporary_files(out)
    source = open_training_data(folder, chosen.robot)
    model, digest = _read_initial_model(start_from)
    own = {"length": plain(passed), "check_rows": check_rows, "start_from": digest}
    run_identity = identity(source, settings) | own
    checkpoints = Checkpoints(out.with_suffix(CHECKPOINT), run_identity)
    # A checkpoint is removed after its model is saved: without one the run is finished.
    if not force and out.exists() and not checkpoints.path.exists():
        return _finished(out, checkpoints.identity)
    if not force:
        check_beside(out)
    request = _TrainingRequest(
        out, source, settings, Length(**passed), model, check_rows, checkpoints
    )
    return _train(request, chosen, clock, force=force, workers=workers)


@dataclass(frozen=True)
class _TrainingRequest:
    """Checked arguments of a training that is not finished."""

    out: Path
    source: TrainingData
    settings: TrainingSettings
    length: Length
    initial_model: Model | None
    check_rows: int
    checkpoints: Checkpoints

    def record(self) -> ProblemRecord:
        """Return the problem with the control points and the objective of the settings."""
        settings = self.settings
        record = with_control_points(
            as_record(self.source.problem),
            settings.path_control_points,
            settings.rate_control_points,
        )
        return with_objective(record, settings.objective)


def _train(
    request: _TrainingRequest,
    options: TrainingOptions,
    clock: Stopwatch,
    *,
    force: bool,
    workers: int | None,
) -> Trained:
    """Train from the checkpoint or from the start, and save the best model."""
    out, checkpoints = request.out, request.checkpoints
    with (
        output_lock(out, out.with_suffix(LOCK)),
        one_thread(),
        loaded_problem(request.record()) as loaded,
    ):
        run, inference = prepare_run(
            request.source,
            loaded,
            request.settings,
            initial_model=request.initial_model,
            check_rows=request.check_rows,
            command=options.command,
        )
        # The checkpoint is read after the kernels: their compilation may raise errors,
        # too.
        state = checkpoints.load(discard=force) or begin_run(run, request.length)
        clock.prepared()
        if options.begin is not None:
            options.begin(state, run)
        log = TrainingLog(out.with_suffix(LOG), state.log)
        run.train(state, checkpoints, log, options.watch)
        checkpoints.save(state)
        best = run.model(state.best.parameters)
        # Other rows than those that selected the best model, so that the score has no
        # selection bias.
        rows = request.source.judged(MAX_SCORED_ROWS, after=request.check_rows)
        score = validate(inference, rows, best, workers=workers)
        model = _save(best, request, state, log, score)
    clock.computed_here()
    return Trained(model, out, score, times=clock.times())


def _save(
    best: Model,
    request: _TrainingRequest,
    state: State,
    log: TrainingLog,
    score: JsonMapping,
) -> Model:
    """Save the best model with its log and its score in place of the checkpoint; return it."""
    # The checkpoint lacks this line, so that it is written once.
    log.write({"step": state.adam.step, "best": state.best.step, "final": score})
    identity_of_run = request.checkpoints.identity
    training = {**best.training, **identity_of_run, **_outcome(state, score)}
    model = replace(best, log=log.text, training=training)
    save_model(request.out, model)
    request.checkpoints.remove()
    return model


def _read_initial_model(
    start_from: str | Path | None,
) -> tuple[Model | None, str | None]:
    """Read the model to start from, and its file's sha256; None if there is none."""
    if start_from is None:
        return None, None
    with concerning("start_from"):
        return load_model(start_from), file_sha256(find_model(start_from))


def _finished(path: Path, identity: JsonMapping) -> Trained:
    """Return the existing model if it is of the same run."""
    hint = "train another file, or replace it with {force}"
    try:
        model = load_model(path)
    except (DatasetError, UsageError) as error:
        raise UsageError(
            f"{path} exists and is no model ({error}): {hint}", remedies={"force": True}
        ) from error
    existing = {name: model.training.get(name) for name in identity}
    changed = list(map(str, differences(existing, identity)))
    if changed:
        raise UsageError(
            f"{path} is another model, it differs in {', '.join(changed[:4])}: {hint}",
            remedies={"force": True},
        )
    return Trained(model, path, model.training["score"], made=False)


def _outcome(state: State, score: JsonMapping) -> JsonObject:
    """Return steps, times and score of a run, for the model's file."""
    return {
        "steps": state.adam.step,
        "best_step": state.best.step,
        "cpu_seconds": round(state.seconds, 1),
        "validation_cpu_seconds": round(state.checking, 1),
        "score": {key: value for key, value in score.items() if key != "score"},
    }


def check_out(out: Path) -> None:
    """Raise an error if the path is no possible model file, or cannot be written."""
    if out.suffix != ".h5" or out.is_dir() or not out.parent.is_dir():
        raise UsageError(
            f"{out} must be a file that ends in .h5, in a folder that exists",
            concerns="out",
        )
    check_writable(out)


def check_beside(out: Path) -> None:
    """Raise UsageError if a log or a picture of another origin beside a model's file would be replaced."""
    log = out.with_suffix(LOG)
    picture = out.with_suffix(PICTURE)
    hint = "choose another {out}, or replace it with {force}"
    remedies = {"out": None, "force": True}
    if log.exists() and not is_log(log):
        raise UsageError(
            f"{log} exists and is no training log: {hint}", remedies=remedies
        )
    if picture.exists() and not log.exists():
        raise UsageError(
            f"{picture} exists and is of no training run: {hint}", remedies=remedies
        )


def remove_temporary_files(out: Path) -> None:
    """Remove the temporary files of killed runs."""
    beside = (out.with_suffix(suffix) for suffix in (CHECKPOINT, LOG, PICTURE))
    for path in (out, *beside):
        remove_leftovers_of(path)
