"""Small models for the tests: trained for a few steps on small datasets, once per session."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.control_points import Projection, make_projection
from cnpgen.planner.inference_pipeline import LoadedProblem, make_inference_pipeline
from cnpgen.planner.model import Model, ModelConfig
from cnpgen.planner.network.architecture import Architecture, initial_parameters
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_record import record_problem
from cnpgen.training.settings import TrainingSettings
from cnpgen.training.step import Learner
from cnpgen.training.training_rows import Rows, prepare_rows, zero_conditions
from cnpgen.trajectory.boundary import Boundary

SMALL = TrainingSettings(hidden=16, layers=2, batch_size=32, nodes=16)


@cache
def loaded_problem_of(name: str) -> LoadedProblem:
    """Return a shipped problem with its robot and the kernels of this machine."""
    from tests.examples.plans import PROBLEMS

    problem = PROBLEMS[name]
    robot, (backend, folder) = load_robot(problem), choose_backend()
    kernels = problem_kernels(problem, robot, backend, folder)
    return LoadedProblem(record_problem(problem), problem, robot, kernels)


def config_of(line_projection_steps: int, projection_steps: int) -> ModelConfig:
    """Return a configuration with these numbers of projection steps."""
    return ModelConfig(
        path_scale=0.5,
        line_projection_steps=line_projection_steps,
        projection_steps=projection_steps,
    )


def interpreted(loaded: LoadedProblem) -> LoadedProblem:
    """Return the same problem with interpreted kernels: for a few plans they are faster than compiling."""
    return replace(loaded, kernels=replace(loaded.kernels, backend="numpy"))


def quickest(name: str, fixed_at_goal: int = 2) -> LoadedProblem:
    """Return a problem with compiled kernels only if trainings of hits compile them anyway."""
    loaded = loaded_problem_of(name)
    return loaded if (name, fixed_at_goal) == ("airhockey", 2) else interpreted(loaded)


@cache
def projection_of(name: str, fixed_at_goal: int = 2) -> Projection:
    """Return the projection of a shipped problem."""
    loaded = quickest(name, fixed_at_goal)
    return make_projection(
        loaded.problem, loaded.kernels, steps=1, fixed_at_goal=fixed_at_goal
    )


def boundary_of_columns(columns: dict[str, np.ndarray], rows: int) -> Boundary:
    names = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
    return Boundary(*(np.asarray(columns[name][:rows], float) for name in names))


def accelerated(boundary: Boundary, scale: float = 1.0, seed: int = 9) -> Boundary:
    """Return the same boundary conditions with accelerations at the goal [rad/s^2]."""
    return replace(
        boundary,
        goal_ddq=scale * np.random.default_rng(seed).normal(size=boundary.goal_q.shape),
    )


def architecture_of(
    loaded: LoadedProblem, rows: Rows, settings: TrainingSettings
) -> Architecture:
    return Architecture(
        inputs=rows.features.shape[1],
        hidden=settings.hidden,
        layers=settings.layers,
        path_outputs=(12 - rows.tasks.boundary.fixed_at_goal) * loaded.robot.n,
        rate_outputs=20,
    )


def untrained_model(
    name: str, boundary: Boundary, *, seed: int = 0, **changes: Any
) -> Model:
    """Return a model with random parameters: its plans meet their boundary conditions, but violate limits."""
    loaded, fixed = loaded_problem_of(name), boundary.fixed_at_goal
    inference = make_inference_pipeline(
        loaded, config_of(0, 0), scale_time=False, fixed_at_goal=fixed
    )
    rows, features = prepare_rows(boundary, inference.prepare)
    architecture = architecture_of(loaded, rows, SMALL)
    options = {
        "problem": loaded.record,
        "architecture": architecture,
        "parameters": initial_parameters(
            architecture, seed=seed, head_scale=0.1, rate_bias=-0.5
        ),
        "features": features,
        "config": ModelConfig(
            path_scale=0.3, line_projection_steps=1, projection_steps=1
        ),
        "zero_conditions": zero_conditions(boundary),
    }
    return Model(**{**options, **changes})


def learner_of(
    name: str, boundary: Boundary, *, dtype: str, settings: TrainingSettings
) -> tuple[Learner, Rows]:
    """Return a learner and rows, in float32 or float64."""
    loaded, fixed = quickest(name, boundary.fixed_at_goal), boundary.fixed_at_goal
    inference = make_inference_pipeline(
        loaded, settings.config, scale_time=False, fixed_at_goal=fixed
    )
    rows, _ = prepare_rows(boundary, inference.prepare, dtype=dtype)
    loss = PlanLoss(loaded.problem, nodes=settings.nodes, dtype=dtype)
    architecture = architecture_of(loaded, rows, settings)
    return Learner(
        architecture,
        loaded.problem.trajectory,
        loss,
        settings,
        projection_of(name, fixed),
    ), rows


def model_path(folder: Path) -> Path:
    return folder / "model.h5"
