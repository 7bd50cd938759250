"""Training a model on a dataset: a file in the end, a checkpoint and a log on the way."""

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen import __version__
from cnpgen.errors import UsageError
from cnpgen.losses.metric import Metric
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.losses.schedule import suggested_weights
from cnpgen.network.architecture import Architecture, initial_parameters
from cnpgen.planner.kit import Kit, Surroundings, make_kit, surroundings
from cnpgen.planner.model import Model
from cnpgen.planner.model_file import save_model
from cnpgen.planner.requests import problem_of
from cnpgen.store.documents import plain
from cnpgen.threads import one_thread
from cnpgen.training.checkpoint import Checkpoints
from cnpgen.training.journal import Journal
from cnpgen.training.margins import suggested_margins
from cnpgen.training.rows import prepare_rows, resting
from cnpgen.training.run import Run, Watcher
from cnpgen.training.settings import Length, TrainingSettings
from cnpgen.training.source import Source, open_source, stages_of
from cnpgen.training.state import State, start_state
from cnpgen.training.step import Learner
from cnpgen.training.validation import validate

SECONDS = 120.0  # of CPU time, if nobody says how long
MOST_JUDGED = 2000  # validation rows that the last model is judged on
WARMING, TIMED = 10, 50  # steps taken to find out how long one takes


@dataclass(frozen=True)
class Trained:
    """What came of a run.

    Attributes:
        model: The best model.
        path: Its file.
        score: What ``validate`` says of it on the validation split, or its first 2,000 rows.
    """

    model: Model
    path: Path
    score: Mapping[str, Any]


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
    """Train a model, or go on with one that was interrupted.

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
        force: Begin again, and replace what is there.
        workers: Processes of the last validation; training itself is one process.
        begin: Called once before the first step.
        watch: Called with every line of the log.

    Raises:
        UsageError: An argument cannot be meant, or the model exists already.
        DatasetError: The dataset or the checkpoint is damaged, or the checkpoint is of another run.
        MachineError: The disk is full, or the loss is not finite any more.
    """
    if steps is None and epochs is None and cpu_seconds is None:
        cpu_seconds = SECONDS
    length = Length(steps=steps, epochs=epochs, cpu_seconds=cpu_seconds)
    out, settings = Path(out), settings or TrainingSettings()
    source = open_source(folder)
    checkpoints = Checkpoints(out.with_suffix(".checkpoint"), _identity(source, settings, length, check_rows))
    if force:
        checkpoints.remove()
    elif out.exists() and not checkpoints.path.exists():
        raise UsageError(f"{out} exists already: train another one, or pass --force to replace it")
    with one_thread(), surroundings(problem_of(source.dataset.plan)) as given:
        run, kit = prepare_run(source, given, settings, check_rows=check_rows, command=command)
        state = checkpoints.load() or begin_run(run, length)
        if begin is not None:
            begin(state, run)
        journal = Journal(out.with_suffix(".jsonl"), state.adam.step)
        run.go_on(state, checkpoints, journal, watch)
        checkpoints.save(state)
        held_out = source.boundary(source.validation, MOST_JUDGED)
        score = validate(run.model(state.best.parameters), kit, held_out, workers=workers)
    journal.write({"step": state.adam.step, "best": state.best.step, "final": score})
    model = run.model(state.best.parameters, log=journal.text, training=_outcome(state, score))
    save_model(out, model)
    checkpoints.remove()
    return Trained(model, out, score)


def prepare_run(
    source: Source, given: Surroundings, settings: TrainingSettings, *, check_rows: int = 200, command: str = ""
) -> tuple[Run, Kit]:
    """Load rows, kernels and loss; set up the network.

    Args:
        source: The dataset.
        given: Its problem.
        settings: How to train.
        check_rows: Validation rows that models are compared by.
        command: What the model says that it was made by.

    Returns:
        The run, and the kit that plans are made with.
    """
    boundary = source.boundary(source.train)
    rest = resting(boundary)
    kit = make_kit(given, bending_steps=settings.bending_steps, slow_down=len(rest) == 3)  # all of them
    rows, features = prepare_rows(boundary, kit.prepare)
    spec, joints = given.problem.trajectory, given.robot.n
    loss = _loss(given, settings)
    architecture = Architecture(
        inputs=rows.features.shape[1],
        hidden=settings.hidden,
        layers=settings.layers,
        path_outputs=joints * (spec.path_control_points - 3 - boundary.fixed_at_goal),
        rate_outputs=spec.rate_control_points,
    )
    weights = loss.weights0 if settings.metric.kind == "learned" else suggested_weights(loss.terms, loss.weights0)
    held_out = source.boundary(source.validation, check_rows)
    run = Run(
        learner=Learner(architecture, spec, loss, settings),
        names=loss.terms,
        budgets=dict(zip(loss.terms[1:], loss.budgets.tolist(), strict=True)),
        rows=rows,
        features=features,
        metric=Metric(weights, loss.budgets, settings.metric),
        problem=given.record,
        validate=lambda model: validate(model, kit, held_out),
        rest=rest,
        training={
            "command": command,
            "cnpgen": __version__,
            "dataset": source.describe(),
            "stages": stages_of(source.dataset.plan),
            "settings": plain(asdict(settings)),
        },
    )
    return run, kit


def _loss(given: Surroundings, settings: TrainingSettings) -> PlanLoss:
    backend = given.kernels.backend
    names = PlanLoss(given.problem, nodes=settings.nodes, backend=backend).terms  # its kernels are built when needed
    return PlanLoss(given.problem, nodes=settings.nodes, backend=backend, margins=suggested_margins(names))


def _identity(source: Source, settings: TrainingSettings, length: Length, check_rows: int) -> dict[str, Any]:
    """Say what distinguishes one run from another."""
    lasts = {name: value for name, value in vars(length).items() if value is not None}
    return {
        "cnpgen": __version__,
        "dataset": source.describe(),
        "settings": plain(asdict(settings)),
        "length": lasts,
        "check_rows": check_rows,
    }


def begin_run(run: Run, length: Length) -> State:
    """Start a run; find out how many steps it has."""
    if length.steps is not None:
        steps = length.steps
    elif length.epochs is not None:
        steps = max(round(length.epochs * run.order.batches), 1)
    else:
        assert length.cpu_seconds is not None
        steps = max(int(length.cpu_seconds / _step_seconds(run)), 1)
    return _fresh(run, steps)


def _fresh(run: Run, steps: int) -> State:
    settings = run.learner.settings
    parameters = initial_parameters(
        run.learner.architecture,
        seed=settings.seed,
        head_scale=settings.head_scale,
        rate_bias=settings.rate_bias,
    )
    return start_state(parameters, terms=len(run.names), steps=steps)


def _step_seconds(run: Run) -> float:
    """Measure how long a step takes [s of CPU time], on a state that is thrown away."""
    state, metric = _fresh(run, 10_000), run.metric.state()
    gradient, times = np.empty_like(state.adam.parameters), []
    for _ in range(WARMING + TIMED):
        begun = time.process_time()
        run.step(state, gradient)
        times.append(time.process_time() - begun)
    run.metric.load_state(metric)
    return float(np.mean(times[WARMING:]))


def _outcome(state: State, score: Mapping[str, Any]) -> dict[str, Any]:
    """Say how training went, for the model's file."""
    return {
        "steps": state.adam.step,
        "best_step": state.best.step,
        "cpu_seconds": round(state.seconds, 1),
        "validation_cpu_seconds": round(state.checking, 1),
        "score": {key: value for key, value in score.items() if key != "score"},
    }
