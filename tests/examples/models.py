"""Small models for the tests: trained for a moment on the small datasets, once per session."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.planner.kit import Surroundings, make_kit
from cnpgen.planner.landing import Landing, make_landing
from cnpgen.planner.model import Meaning, Model
from cnpgen.planner.network.architecture import Architecture, initial_parameters
from cnpgen.problems.record import record_problem
from cnpgen.problems.robot import load_robot
from cnpgen.training.rows import Rows, prepare_rows, resting
from cnpgen.training.settings import TrainingSettings
from cnpgen.training.step import Learner
from cnpgen.trajectory.boundary import Boundary

SMALL = TrainingSettings(hidden=16, layers=2, batch_size=32, nodes=16)


@cache
def surroundings_of(name: str) -> Surroundings:
    """A shipped problem with its robot and the kernels of this machine."""
    from tests.examples.plans import PROBLEMS

    problem = PROBLEMS[name]
    robot, (backend, folder) = load_robot(problem), choose_backend()
    kernels = problem_kernels(problem, robot, backend, folder)
    return Surroundings(record_problem(problem), problem, robot, kernels)


def meaning_of(bending_steps: int, landing_steps: int) -> Meaning:
    """What outputs mean that are bent in so many steps."""
    return Meaning(path_scale=0.5, bending_steps=bending_steps, landing_steps=landing_steps)


def interpreted(given: Surroundings) -> Surroundings:
    """The same with kernels that are interpreted: for a few plans that is quicker than compiling them."""
    return replace(given, kernels=replace(given.kernels, backend="numpy"))


def quickest(name: str, fixed_at_goal: int = 2) -> Surroundings:
    """The same with kernels that are compiled only where trainings of hits need them: others would take longer."""
    given = surroundings_of(name)
    return given if (name, fixed_at_goal) == ("airhockey", 2) else interpreted(given)


@cache
def landing_of(name: str, fixed_at_goal: int = 2) -> Landing:
    """The landing of a shipped problem."""
    given = quickest(name, fixed_at_goal)
    return make_landing(given.problem, given.kernels, steps=1, fixed_at_goal=fixed_at_goal)


def boundary_of_columns(columns: dict[str, np.ndarray], rows: int) -> Boundary:
    names = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
    return Boundary(*(np.asarray(columns[name][:rows], float) for name in names))


def accelerated(boundary: Boundary, scale: float = 1.0, seed: int = 9) -> Boundary:
    """The same, with an acceleration at the goal [rad/s^2]."""
    return replace(boundary, goal_ddq=scale * np.random.default_rng(seed).normal(size=boundary.goal_q.shape))


def architecture_of(given: Surroundings, rows: Rows, settings: TrainingSettings) -> Architecture:
    return Architecture(
        inputs=rows.features.shape[1],
        hidden=settings.hidden,
        layers=settings.layers,
        path_outputs=(12 - rows.tasks.boundary.fixed_at_goal) * given.robot.n,
        rate_outputs=20,
    )


def untrained_model(name: str, boundary: Boundary, *, seed: int = 0, **changes: Any) -> Model:
    """A model of a problem with random parameters: plans are bad, but plans."""
    given, fixed = surroundings_of(name), boundary.fixed_at_goal
    kit = make_kit(given, meaning_of(0, 0), slow_down=False, fixed_at_goal=fixed)  # preparing takes nothing else of it
    rows, features = prepare_rows(boundary, kit.prepare)
    architecture = architecture_of(given, rows, SMALL)
    options = {
        "problem": given.record,
        "architecture": architecture,
        "parameters": initial_parameters(architecture, seed=seed, head_scale=0.1, rate_bias=-0.5),
        "features": features,
        "meaning": Meaning(path_scale=0.3, bending_steps=1, landing_steps=1),
        "rest": resting(boundary),
    }
    return Model(**{**options, **changes})


def learner_of(name: str, boundary: Boundary, *, dtype: str, settings: TrainingSettings) -> tuple[Learner, Rows]:
    """What one step of training needs, in float32 or float64."""
    given, fixed = quickest(name, boundary.fixed_at_goal), boundary.fixed_at_goal
    kit = make_kit(given, settings.meaning, slow_down=False, fixed_at_goal=fixed)
    rows, _ = prepare_rows(boundary, kit.prepare, dtype=dtype)
    loss = PlanLoss(given.problem, nodes=settings.nodes, dtype=dtype)
    architecture = architecture_of(given, rows, settings)
    return Learner(architecture, given.problem.trajectory, loss, settings, landing_of(name, fixed)), rows


def model_path(folder: Path) -> Path:
    return folder / "model.h5"
