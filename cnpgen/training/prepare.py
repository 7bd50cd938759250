"""Setting a run up: rows, kernels, loss and network; how many steps it has."""

import time
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from cnpgen.errors import UsageError
from cnpgen.losses.margins import suggested_margins
from cnpgen.losses.metric import Metric
from cnpgen.losses.metric_settings import suggested_weights
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.machine.versions import __version__
from cnpgen.planner.kit import Kit, Surroundings, make_kit
from cnpgen.planner.landing import make_landing
from cnpgen.planner.model import Meaning, Model, begins_and_ends_at_rest
from cnpgen.planner.network.architecture import Architecture, initial_parameters
from cnpgen.planner.network.features import Features, count_features, usual_blocks
from cnpgen.store.files.documents import plain
from cnpgen.training.data import TrainingData
from cnpgen.training.rows import Rows, prepare_rows, resting
from cnpgen.training.run import Run
from cnpgen.training.score import validate
from cnpgen.training.settings import Length, TrainingSettings
from cnpgen.training.state import State, start_state
from cnpgen.training.step import Learner
from cnpgen.trajectory.boundary import Boundary

WARMING, TIMED = 10, 50  # steps taken to find out how long one takes


def prepare_run(
    source: TrainingData,
    given: Surroundings,
    settings: TrainingSettings,
    *,
    first: Model | None = None,
    check_rows: int = 200,
    command: str = "",
) -> tuple[Run, Kit]:
    """Load rows, kernels and loss; set up the network.

    Args:
        source: The dataset.
        given: Its problem.
        settings: How to train.
        first: The model to start from; None for random parameters and features standardised by the rows.
        check_rows: Validation rows that models are compared by.
        command: What the model says that it was made by.

    Returns:
        The run, and the kit that plans are made with.

    Raises:
        UsageError: Plans are to be imitated, and the dataset has none; or the first model is for something else.
    """
    boundary = source.training()
    rest, spec = resting(boundary), given.problem.trajectory
    fixed = boundary.fixed_at_goal
    meaning = settings.meaning if first is None else replace(settings.meaning, middles=first.meaning.middles)
    kit = make_kit(given, meaning, slow_down=begins_and_ends_at_rest(rest, fixed), fixed_at_goal=fixed)
    architecture = _architecture(given, settings, boundary, first)
    if first is not None:
        _check_first(first, architecture, settings, given, rest)
    rows, features = _rows(boundary, kit, first)
    if settings.imitation:
        rows = _with_demonstrations(rows, source, given)
    loss = _loss(given, settings)
    held_out = source.checked(check_rows)
    landing = make_landing(
        given.problem,
        given.kernels,
        steps=settings.landing_steps,
        fixed_at_goal=fixed,
        within_limits=settings.within_limits,
    )
    run = Run(
        learner=Learner(architecture, spec, loss, settings, landing),
        names=loss.terms,
        budgets=dict(zip(loss.terms[1:], loss.budgets.tolist(), strict=True)),
        rows=rows,
        features=features,
        metric=_metric(loss, settings),
        problem=given.record,
        meaning=meaning,
        validate=lambda model: validate(model, kit, held_out),
        rest=rest,
        first=None if first is None else first.parameters,
        training={"command": command, **identity(source, settings), "stages": source.dataset.blueprint.stages},
    )
    return run, kit


def _rows(boundary: Boundary, kit: Kit, first: Model | None) -> tuple[Rows, Features]:
    """Prepare the rows, along the lines that plans of the first model take."""
    if first is None:
        return prepare_rows(boundary, kit.prepare)
    lines = None if kit.detours is None else lambda some: kit.planned(first, some)[0]
    return prepare_rows(boundary, kit.prepare, features=first.features, lines=lines)


def identity(source: TrainingData, settings: TrainingSettings) -> dict[str, Any]:
    """Say what, beside its length, distinguishes one run from another; JSON-able."""
    return {"cnpgen": __version__, "dataset": source.describe(), "settings": plain(asdict(settings))}


def _with_demonstrations(rows: Rows, source: TrainingData, given: Surroundings) -> Rows:
    shown = source.demonstrations(given.robot.n)
    if shown is None:
        raise UsageError(
            f"{source.dataset.folder} holds no plans that could be imitated: make it with"
            " make_dataset(..., certify=True) or 'cnpgen make-dataset --certify', or train without imitation"
        )
    return replace(rows, shown=shown)


def _check_first(
    first: Model, architecture: Architecture, settings: TrainingSettings, given: Surroundings, rest: tuple[str, ...]
) -> None:
    """Refuse a model whose parameters would mean something else in this run."""
    if first.problem.comparable_sha256 != given.record.comparable_sha256:
        differs = ", ".join(given.record.differences(first.problem)[:4])
        raise UsageError(f"the model to start from is for another problem, they differ in {differs}")
    theirs = _said(first.architecture, first.meaning, first.rest)
    ours = _said(architecture, settings.meaning, rest)
    changed = [
        f"{name} is {theirs[name]!r} there and {ours[name]!r} here" for name in ours if theirs[name] != ours[name]
    ]
    if changed:
        raise UsageError(f"the model to start from does not fit: {', '.join(changed)}")


def _said(architecture: Architecture, meaning: Meaning, rest: tuple[str, ...]) -> dict[str, Any]:
    """Return what must be the same for parameters to mean the same."""
    about = {"path_scale": meaning.path_scale, "zero conditions": rest, "expected_time": meaning.expected_time}
    return {**asdict(architecture), **about}


def _architecture(
    given: Surroundings, settings: TrainingSettings, boundary: Boundary, first: Model | None
) -> Architecture:
    spec, blocks = given.problem.trajectory, usual_blocks(boundary) if first is None else first.features.blocks
    return Architecture(
        inputs=count_features(blocks, given.robot.n),
        hidden=settings.hidden,
        layers=settings.layers,
        path_outputs=given.robot.n * (spec.path_control_points - 3 - boundary.fixed_at_goal),
        rate_outputs=spec.rate_control_points,
    )


def _loss(given: Surroundings, settings: TrainingSettings) -> PlanLoss:
    backend = given.kernels.backend
    names = PlanLoss(given.problem, nodes=settings.nodes, backend=backend).terms  # its kernels are built when needed
    usual = suggested_margins(names)
    margins = replace(usual, factors={**usual.factors, **settings.margins})
    loss = PlanLoss(given.problem, nodes=settings.nodes, form=settings.form, backend=backend, margins=margins)
    loss.load_kernels()  # so that no step is slow because of it
    return loss


def _metric(loss: PlanLoss, settings: TrainingSettings) -> Metric:
    learned = settings.metric.kind == "learned"
    weights = loss.weights0 if learned else suggested_weights(loss.terms, loss.weights0)
    return Metric(weights, loss.budgets, settings.metric)


def begin_run(run: Run, length: Length) -> State:
    """Start a run; find out how many steps it has."""
    if length.steps is not None:
        steps = int(length.steps)
    elif length.epochs is not None:
        steps = max(round(length.epochs * run.order.batches), 1)
    else:
        assert length.cpu_seconds is not None
        steps = max(int(length.cpu_seconds / _step_seconds(run)), 1)
    return _fresh(run, steps)


def _fresh(run: Run, steps: int) -> State:
    settings = run.learner.settings
    if run.first is not None:
        parameters = run.first.copy()
    else:
        parameters = initial_parameters(
            run.learner.architecture,
            seed=settings.seed,
            head_scale=settings.head_scale,
            rate_bias=settings.rate_bias,
        )
    return start_state(parameters, terms=len(run.names), steps=steps, imitation=settings.imitation)


def _step_seconds(run: Run) -> float:
    """Measure how long a step takes [s of CPU time], on a state that is thrown away."""
    state, metric = _fresh(run, 10_000), run.metric.state()
    state.imitating = 0
    gradient, times = np.empty_like(state.adam.parameters), []
    for _ in range(WARMING + TIMED):
        begun = time.process_time()
        run.step(state, gradient)
        times.append(time.process_time() - begun)
    run.metric.load_state(metric)
    return float(np.median(times[WARMING:]))
