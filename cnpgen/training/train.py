"""Training a model on a dataset: a file in the end, a checkpoint and a log on the way."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cnpgen.errors import DatasetError, UsageError
from cnpgen.planner.kit import surroundings
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import load_model, save_model
from cnpgen.planner.requests import problem_of
from cnpgen.threads import one_thread
from cnpgen.training.checkpoint import Checkpoints, differences
from cnpgen.training.journal import Journal
from cnpgen.training.prepare import begin_run, identity, prepare_run
from cnpgen.training.run import Run, Watcher
from cnpgen.training.settings import Length, TrainingSettings
from cnpgen.training.source import open_source
from cnpgen.training.state import State
from cnpgen.training.validation import validate

SECONDS = 120.0  # of CPU time, if nobody says how long
MOST_JUDGED = 2000  # validation rows that the last model is judged on


@dataclass(frozen=True)
class Trained:
    """What came of a run.

    Attributes:
        model: The best model.
        path: Its file.
        score: What ``validate`` says of it on the validation split, or its first 2,000 rows.
        made: Whether it was made now; False if it was there already.
    """

    model: Model
    path: Path
    score: Mapping[str, Any]
    made: bool = True


def train_model(
    folder: str | Path,
    out: str | Path,
    *,
    steps: int | None = None,
    epochs: float | None = None,
    cpu_seconds: float | None = None,
    settings: TrainingSettings | None = None,
    check_rows: int = 200,
    command: str = "",
    force: bool = False,
    workers: int | None = None,
    begin: Callable[[State, Run], None] | None = None,
    watch: Watcher | None = None,
) -> Trained:
    """Train a model, or go on with one that was interrupted; one that is there already is returned as it is.

    Beside the model there are a log, ``.jsonl``, and as long as it is not finished a checkpoint, ``.checkpoint``. Cut
    off and resumed, a run gives the bits that it would have given uncut.

    Args:
        folder: The dataset.
        out: The model's file, ``.h5``.
        steps: How long, in steps.
        epochs: How long, in passes over all rows.
        cpu_seconds: How long, in CPU time of the steps [s]: how long a step takes is measured before, and their number
            is then fixed. If nothing says how long, 120 s.
        settings: How to train.
        check_rows: Validation rows that models are compared by on the way; the last one sees up to 2,000.
        command: What the model says that it was made by.
        force: Replace the model that is there; throw away what another run has left in its checkpoint.
        workers: Processes of the last validation; training itself is one process.
        begin: Called once before the first step.
        watch: Called with every line of the log.

    Raises:
        UsageError: An argument cannot be meant, or there is another model.
        DatasetError: The dataset or the checkpoint is damaged, or the checkpoint is of another run.
        MachineError: The disk is full, or the loss is not finite any more.
    """
    if steps is None and epochs is None and cpu_seconds is None:
        cpu_seconds = SECONDS
    length = Length(steps=steps, epochs=epochs, cpu_seconds=cpu_seconds)
    out, settings = _checked(Path(out)), settings or TrainingSettings()
    source = open_source(folder)
    lasts = {name: value for name, value in vars(length).items() if value is not None}
    asked = {"length": lasts, "check_rows": check_rows}
    checkpoints = Checkpoints(out.with_suffix(".checkpoint"), {**identity(source, settings), **asked})
    if out.exists() and not checkpoints.path.exists() and not force:
        return _finished(out, checkpoints.identity)
    with one_thread(), surroundings(problem_of(source.dataset.plan)) as given:
        run, kit = prepare_run(source, given, settings, check_rows=check_rows, command=command)
        state = checkpoints.load(discard=force) or begin_run(run, length)
        if begin is not None:
            begin(state, run)
        journal = Journal(out.with_suffix(".jsonl"), state.adam.step)
        run.go_on(state, checkpoints, journal, watch)
        checkpoints.save(state)
        held_out = source.boundary(source.validation, MOST_JUDGED)
        score = validate(run.model(state.best.parameters), kit, held_out, workers=workers)
    journal.write({"step": state.adam.step, "best": state.best.step, "final": score})
    outcome = {**asked, **_outcome(state, score)}
    model = run.model(state.best.parameters, log=journal.text, training=outcome)
    save_model(out, model)
    checkpoints.remove()
    return Trained(model, out, score)


def _checked(path: Path) -> Path:
    if path.suffix != ".h5" or path.is_dir() or not path.parent.is_dir():
        raise UsageError(f"{path} must be a file that ends in .h5, in a folder that exists")
    return path


def _finished(path: Path, identity: Mapping[str, Any]) -> Trained:
    """Return the model that is there if it is the one that was asked for."""
    hint = "train another file, or replace it with --force"
    try:
        model = load_model(path)
    except DatasetError as error:
        raise UsageError(f"{path} exists and is no model ({error}): {hint}") from error
    found = {name: model.training.get(name) for name in identity}
    changed = list(differences(found, identity))
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
