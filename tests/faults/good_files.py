"""A valid file of every kind, the starting point of changed files."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from cnpgen.addons.benchmark.results_file import answer_to_dict, open_results
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import DatasetRecipe, load_dataset_recipe
from cnpgen.planner.model_file import save_model
from cnpgen.plans.plan_file import save_plans
from cnpgen.refine.refinement_journal import open_journal
from cnpgen.refine.task import Attempt, Outcome
from cnpgen.schema.catalogue import list_recipes, recipes_root
from cnpgen.store.shard import read_shard
from cnpgen.training.checkpoint import Checkpoints, start_state
from tests.examples.models import boundary_of_columns, untrained_model
from tests.examples.plan_files import plans_of, remove_checksum
from tests.examples.plans import load as stored_plan
from tests.faults.mesh_subjects import make_mesh_files
from tests.faults.scene_subjects import make_scene_files

IDENTITY = {"steps": 10}  # of the run of the checkpoint, the journal and the results


def tiny_recipe_of(name: str) -> DatasetRecipe:
    """Return a shipped recipe with 24 rows for training and 8 for validation."""
    return replace(load_dataset_recipe(name), splits={"train": 24, "validation": 8})


def make_good_files(folder: Path) -> None:
    """Make a valid file of every kind."""
    make_dataset(
        tiny_recipe_of("airhockey-hit"), folder / "set", workers=1, shard_size=24
    )
    shutil.copytree(recipes_root() / "problems" / "airhockey", folder / "recipes")
    for kind in ("pipelines", "datasets"):
        shutil.copy(
            recipes_root() / kind / "airhockey-hit.toml",
            folder / "recipes" / f"{kind}.toml",
        )
    for name, old, new in (
        (
            "datasets.toml",
            'pipeline = "airhockey-hit"',
            'pipeline = "./pipelines.toml"',
        ),
        ("pipelines.toml", 'problem = "airhockey"', 'problem = "./problem.toml"'),
    ):
        path = folder / "recipes" / name
        path.write_text(
            path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8"
        )
    _make_task_files(folder)
    plan = stored_plan("hit")
    save_plans(folder / "plans.h5", plans_of(plan, plan))
    shutil.copy(folder / "plans.h5", folder / "without_checksum.h5")
    remove_checksum(folder / "without_checksum.h5")
    columns = read_shard(folder / "set" / "train" / "shard-00000.h5")
    model = untrained_model("airhockey", boundary_of_columns(columns, 20))
    save_model(
        folder / "model.h5",
        replace(model, training={"dataset": {"name": "x"}, "stages": [{"use": "y"}]}),
    )
    state = start_state(np.zeros(10, np.float32), terms=3, steps=10)
    Checkpoints(folder / "checkpoint", IDENTITY).save(state)
    journal = open_journal(folder / "journal", IDENTITY)
    attempt = Attempt(
        path=np.zeros((15, 6)),
        rate=np.ones(20),
        cost=1.0,
        outcome=Outcome.SOLVED,
        iterations=3,
        reason="ok",
    )
    journal.append([0], [attempt])
    journal.file.close()
    make_scene_files(folder)
    (folder / "crane").mkdir()
    make_mesh_files(folder / "crane")


def _make_task_files(folder: Path) -> None:
    """Make files of tasks and of a benchmark: a suite, boundary conditions, tables of tasks and results."""
    suite = list_recipes("suite")["hits-81"].read_text(encoding="utf-8")
    (folder / "recipes" / "suite.toml").write_text(
        suite.replace('problem = "airhockey"', 'problem = "./problem.toml"').replace(
            "= 9", "= 2"
        ),
        encoding="utf-8",
    )
    plan = stored_plan("hit")
    plans = plans_of(plan, plan)
    with h5py.File(folder / "boundary.h5", "w") as file:
        file.attrs["problem"] = "airhockey"
        for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq"):
            file[name] = getattr(plans.boundary, name)
        file["sample_id"] = np.arange(2)
        file["hit_angle"] = np.zeros(2)
    with h5py.File(folder / "tasks.h5", "w") as file:
        file["goal_xyz"], file["hit_angle"] = (
            np.array([[1.0, 0.1], [1.1, -0.1]]),
            np.zeros(2),
        )
    (folder / "tasks.csv").write_text(
        "goal_xyz.x,goal_xyz.y,hit_angle\n1.0,0.1,0.0\n1.1,-0.1,0.1\n", encoding="utf-8"
    )
    results = open_results(folder / "results.jsonl", IDENTITY)
    for index, answer in enumerate(
        (plans[:1], Trajectory(t=np.arange(3.0), q=np.zeros((3, 6))), None)
    ):
        results.append(
            {
                "problem": index,
                "ending": "answered",
                "planning_s": 0.1,
                "planning_cpu_s": 0.1,
                "error": "",
            }
            | {"answer": None if answer is None else answer_to_dict(answer)}
            | {
                "verdict": {
                    "valid": True,
                    "metrics": {"duration": 1.0},
                    "value_over_bound": {"joint torque": 0.5},
                    "paper": {"valid": True, "finished": True},
                }
            }
            | {"executed": {"nominal": {"scored": True}}}
        )
    results.file.close()
