"""Set up a run: rows, kernels, loss, network and validation.

Determine its number of steps.
"""

import math
import time
from dataclasses import asdict, replace
from functools import partial

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError
from cnpgen.losses.margins import Margins, suggested_margins
from cnpgen.losses.metric import Metric, suggested_weights
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.machine.versions import __version__
from cnpgen.planner.control_points import make_projection
from cnpgen.planner.inference_pipeline import (
    InferencePipeline,
    LoadedProblem,
    make_inference_pipeline,
)
from cnpgen.planner.model import Model, ModelConfig, is_rest_to_rest
from cnpgen.planner.network.architecture import Architecture, initial_parameters
from cnpgen.planner.network.features import (
    SCENE,
    Features,
    count_features,
    feature_blocks,
    published_features,
)
from cnpgen.planner.tasks import Tasks
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.schema.arguments import check_memory
from cnpgen.store.files.documents import plain
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.training.checkpoint import State, start_state
from cnpgen.training.data import TrainingData
from cnpgen.training.settings import Length, TrainingSettings
from cnpgen.training.step import Learner
from cnpgen.training.training_rows import (
    Rows,
    TrainingProblems,
    prepare_rows,
    zero_conditions,
)
from cnpgen.training.training_run import Run
from cnpgen.trajectory.boundary import Boundary

WARM_UP_STEPS, TIMED_STEPS = 10, 50  # to measure the time of a step
MEANS = ("duration_s", "z_error_mm_s", "vertical_error_rad_s")


def prepare_run(
    source: TrainingData,
    loaded: LoadedProblem,
    settings: TrainingSettings,
    *,
    initial_model: Model | None = None,
    check_rows: int = 200,
    command: str = "",
) -> tuple[Run, InferencePipeline]:
    """Load rows, kernels and loss; set up the network; return the run, and the inference pipeline of its plans.

    Without an initial model, parameters are random and features are standardized by the
    rows. Models are compared on ``check_rows`` validation rows. The command is recorded
    in the model.

    Raises:
        UsageError: The dataset has no plans to imitate, or the initial model does not
            fit.
    """
    problems = source.training()
    boundary = problems.boundary
    zero = zero_conditions(boundary)
    config, blocks, features = _inputs(loaded, settings, boundary, initial_model)
    inference = _inference(loaded, config, boundary, zero, blocks)
    architecture = _architecture(loaded, settings, blocks, boundary)
    _check_initial_model(initial_model, architecture, settings, loaded, zero)
    rows, features = _rows(problems, inference, blocks, features, initial_model)
    rows = _with_demonstrations(rows, source, loaded) if settings.imitation else rows
    make_model = partial(
        Model,
        problem=loaded.record,
        architecture=architecture,
        features=features,
        config=config,
        zero_conditions=zero,
        training=_record(source, settings, command, rows, initial_model),
    )
    loss = _loss(loaded, settings)
    spec = loaded.problem.trajectory
    learner = Learner(architecture, spec, loss, settings, features=features)
    run = Run(
        _with_projection(learner, loaded, inference, boundary.fixed_at_goal),
        loss=loss,
        rows=rows,
        metric=_metric(loss, settings),
        model=lambda values: make_model(parameters=values.astype(np.float32)),
        validate=partial(validate, inference, source.checked(check_rows)),
        initial_parameters=None if initial_model is None else initial_model.parameters,
    )
    return run, inference


def _inputs(
    loaded: LoadedProblem,
    settings: TrainingSettings,
    boundary: Boundary,
    initial_model: Model | None,
) -> tuple[ModelConfig, tuple[str, ...], Features | None]:
    """Return the configuration of the models, the blocks of features, and the features if the rows do not define them."""
    if initial_model is None:
        return settings.config, *_initial_features(loaded, settings, boundary)
    # Features and via points belong to the parameters that the run starts from.
    config = replace(settings.config, via_points=initial_model.config.via_points)
    return config, initial_model.features.blocks, initial_model.features


def _inference(
    loaded: LoadedProblem,
    config: ModelConfig,
    boundary: Boundary,
    zero: tuple[str, ...],
    blocks: tuple[str, ...],
) -> InferencePipeline:
    fixed = boundary.fixed_at_goal
    return make_inference_pipeline(
        loaded,
        config,
        # Only motions from rest to rest may be slowed without a change of their ends.
        scale_time=is_rest_to_rest(zero, fixed),
        fixed_at_goal=fixed,
        observed=SCENE in blocks,
    )


def _rows(
    problems: TrainingProblems,
    inference: InferencePipeline,
    blocks: tuple[str, ...],
    features: Features | None,
    initial_model: Model | None,
) -> tuple[Rows, Features]:
    """Prepare the rows, along the lines of an initial model that has via points."""

    def planned_lines(boundary: Boundary) -> Tasks:
        assert initial_model is not None
        return inference.planned(initial_model, boundary)[0]

    has_lines = initial_model is not None and inference.via_points is not None
    return prepare_rows(
        problems.boundary,
        inference.prepare,
        features=features,
        blocks=blocks,
        lines=planned_lines if has_lines else None,
        obstacle_poses=problems.obstacle_poses,
    )


def _with_projection(
    learner: Learner,
    loaded: LoadedProblem,
    inference: InferencePipeline,
    fixed_at_goal: int,
) -> Learner:
    """Return a learner that projects paths onto the equalities, and that has tasks along the projected lines."""
    projection = make_projection(
        loaded.problem.for_planning,
        loaded.kernels,
        steps=learner.settings.projection_steps,
        fixed_at_goal=fixed_at_goal,
        within_limits=learner.settings.within_limits,
    )
    return replace(learner, projection=projection, along=inference.prepare.along)


def _initial_features(
    loaded: LoadedProblem, settings: TrainingSettings, boundary: Boundary
) -> tuple[tuple[str, ...], Features | None]:
    """Return the blocks of a new model's features, and the features if they do not depend on the rows."""
    placed = loaded.problem.has_sample_obstacles
    iterated = settings.iterations > 1
    blocks = feature_blocks(
        boundary, settings.features, placed=placed, iterated=iterated
    )
    if settings.features != "paper":
        return blocks, None
    return blocks, published_features(
        blocks, loaded.robot.velocity_limit, loaded.robot.acceleration_limit
    )


def identity(source: TrainingData, settings: TrainingSettings) -> JsonObject:
    """Return the identity of a run without its length; JSON-able."""
    return {
        "cnpgen": __version__,
        "dataset": source.describe(),
        "settings": plain(asdict(settings)),
    }


def _record(
    source: TrainingData,
    settings: TrainingSettings,
    command: str,
    rows: Rows,
    initial_model: Model | None,
) -> JsonObject:
    """Return what a model's file states of its run; JSON-able."""
    return {
        "command": command,
        **identity(source, settings),
        "stages": source.stages,
        "input_ranges": input_ranges(rows.features, initial_model),
    }


def input_ranges(
    inputs: AnyArray, initial_model: Model | None = None
) -> dict[str, list[float]]:
    """Return the smallest and largest inputs of the network in the training rows, shape (N, F), with eight digits.

    The rows of an initial model count, too, if it stores their ranges. JSON-able.
    """
    low = inputs.min(axis=0)
    high = inputs.max(axis=0)
    earlier = (
        None if initial_model is None else initial_model.training.get("input_ranges")
    )
    if earlier is not None:
        # The parameters have been trained on the inputs of both runs.
        low = np.minimum(low, earlier["low"])
        high = np.maximum(high, earlier["high"])
    return {
        name: [float(f"{value:.8g}") for value in values.tolist()]
        for name, values in (("low", low), ("high", high))
    }


def _with_demonstrations(
    rows: Rows, source: TrainingData, loaded: LoadedProblem
) -> Rows:
    target = source.demonstrations(loaded.robot.n)
    if target is None:
        raise UsageError(
            f"{source.place} has no plans to imitate: make it with"
            " make_dataset(..., certify=True) or 'cnpgen make-dataset --certify', or train without imitation"
        )
    spec = loaded.problem.trajectory
    theirs = (target.path.shape[1], target.rate.shape[1])
    ours = (spec.path_control_points, spec.rate_control_points)
    if theirs != ours:
        raise UsageError(
            f"the plans to imitate have {theirs} control points, these motions {ours}"
        )
    return replace(rows, target=target)


def _check_initial_model(
    model: Model | None,
    architecture: Architecture,
    settings: TrainingSettings,
    loaded: LoadedProblem,
    zero: tuple[str, ...],
) -> None:
    """Raise an error if the parameters of an initial model cannot be used in this run."""
    if model is None:
        return
    if model.problem.comparable_sha256 != loaded.record.comparable_sha256:
        differs = ", ".join(loaded.record.differences(model.problem)[:4])
        raise UsageError(
            f"the model to start from is for another problem, they differ in {differs}: train without it"
        )
    theirs = _parameter_definition(
        model.architecture, model.config, model.zero_conditions
    )
    ours = _parameter_definition(architecture, settings.config, zero)
    changed = [
        f"{name} is {theirs[name]!r} there and {ours[name]!r} here"
        for name in ours
        if theirs[name] != ours[name]
    ]
    if changed:
        raise UsageError(f"the model to start from does not fit: {', '.join(changed)}")


def _parameter_definition(
    architecture: Architecture, config: ModelConfig, zero: tuple[str, ...]
) -> JsonObject:
    """Return the values that must agree for parameters to be interchangeable."""
    outputs = {
        "path_scale": config.path_scale,
        "zero conditions": zero,
        "expected_time": config.expected_time,
    }
    outputs["iterations"] = config.iterations
    return {**asdict(architecture), **outputs}


def _architecture(
    loaded: LoadedProblem,
    settings: TrainingSettings,
    blocks: tuple[str, ...],
    boundary: Boundary,
) -> Architecture:
    check_memory("hidden", settings.hidden, settings.layers * settings.hidden**2)
    check_memory(
        "batch_size", settings.batch_size, settings.batch_size * settings.nodes
    )
    spec = loaded.problem.trajectory
    # Boundary conditions fix three control points at the start and fixed_at_goal at the
    # goal.
    outputs = loaded.robot.n * (spec.path_control_points - 3 - boundary.fixed_at_goal)
    return Architecture(
        inputs=count_features(
            blocks, loaded.robot.n, len(loaded.problem.parameters), line=outputs
        ),
        hidden=settings.hidden,
        layers=settings.layers,
        path_outputs=outputs,
        rate_outputs=spec.rate_control_points,
    )


def _loss(loaded: LoadedProblem, settings: TrainingSettings) -> PlanLoss:
    usual = suggested_margins(loaded.problem) if settings.usual_margins else Margins()
    margins = replace(usual, factors={**usual.factors, **settings.margins})
    loss = PlanLoss(
        loaded.problem,
        nodes=settings.nodes,
        form=settings.form,
        backend=loaded.kernels.backend,
        margins=margins,
        dtype=settings.precision,
    )
    # Outside the timed steps.
    loss.load_kernels()
    return loss


def _metric(loss: PlanLoss, settings: TrainingSettings) -> Metric:
    learned = settings.metric.kind == "learned"
    weights = (
        loss.weights0 if learned else suggested_weights(loss.problem, loss.weights0)
    )
    if settings.constraint_terms == "budgeted":
        # Constraints without a budget are left out of the loss.
        weights = np.where(loss.budgets > 0, weights, 0.0)
    return Metric(weights, loss.budgets, settings.metric)


def begin_run(run: Run, length: Length) -> State:
    """Return the initial state of a run; determine its number of steps."""
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
    if run.initial_parameters is not None:
        parameters = run.initial_parameters.copy()
    else:
        parameters = initial_parameters(
            run.learner.architecture,
            seed=settings.seed,
            head_scale=settings.head_scale,
            rate_bias=settings.rate_bias,
        )
    return start_state(
        parameters, terms=len(run.loss.terms), steps=steps, imitation=settings.imitation
    )


def _step_seconds(run: Run) -> float:
    """Measure the CPU time of a step [s], on a temporary state."""
    state = _fresh(run, 10_000)
    metric = run.metric.state()
    # The time of a step is that of the loss, not of imitation.
    state.imitating = 0
    gradient = np.empty_like(state.adam.parameters)
    times = []
    for _ in range(WARM_UP_STEPS + TIMED_STEPS):
        started = time.process_time()
        run.step(state, gradient)
        times.append(time.process_time() - started)
    # The measurement leaves no trace in the metric.
    run.metric.load_state(metric)
    # The first steps fill caches, and the median ignores interruptions.
    return float(np.median(times[WARM_UP_STEPS:]))


def validate(
    inference: InferencePipeline,
    problems: TrainingProblems,
    model: Model,
    *,
    workers: int | None = 1,
) -> JsonObject:
    """Plan for N validation rows and judge the plans in some processes.

    Returns:
        JSON-able: number of ``plans``; fractions ``valid`` and, if the paper's rules
        are installed, ``paper_valid``; means of some metrics; ``broken``, condition ->
        number of violating plans; ``score``, which compares models: 1 % of the plans
        counts as much as 1 % of the motion time.
    """
    poses = problems.obstacle_poses
    columns = None if poses is None else {OBSTACLE_POSES: poses}
    plans = inference.plan(model, problems.boundary, columns=columns)
    summary = evaluate_plans(plans, workers=workers).summary()
    metrics = summary["metrics_of_all"]
    duration = float(np.mean(plans.duration))
    return {
        "plans": summary["plans"],
        "valid": summary["valid_ratio"],
        **(
            {"paper_valid": summary["paper_valid_ratio"]}
            if "paper_valid_ratio" in summary
            else {}
        ),
        **{name: metrics[name]["mean"] for name in MEANS if name in metrics},
        "broken": {
            name: condition["violating_plans"]
            for name, condition in summary["conditions"].items()
            if condition["violating_plans"]
        },
        # A percentage point of valid plans counts as much as one percent of the
        # duration.
        "score": summary["valid_ratio"] - math.log(duration),
    }
