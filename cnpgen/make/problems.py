"""Problems to solve: rows of a dataset, or fresh draws of a recipe, as plans that are still to be made.

Rows of a certified dataset have their plans already.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError, lacks
from cnpgen.kernels.library import choose_backend
from cnpgen.make.load import as_dataset_recipe
from cnpgen.make.recipe import DatasetRecipe
from cnpgen.plans.plans import Plans, make_plans
from cnpgen.problems.record import ProblemRecord, record_problem
from cnpgen.schema.arguments import integer
from cnpgen.trajectory.boundary import Boundary

if TYPE_CHECKING:
    from collections.abc import Mapping

    from cnpgen.store.blueprint import Blueprint

Array = NDArray[np.float64]
SPLIT = "(fresh draws)"  # no split can be called so: no row of any dataset is among them


def problems_of_rows(problem: ProblemRecord, columns: "Mapping[str, Array]", *, source: str = "") -> Plans:
    """Return rows of a dataset as plans: with those of a certified dataset, else with control points of nan.

    Args:
        problem: Their problem.
        columns: Field -> values, shape (N,) or (N, w), as shards hold them.
        source: Where they are from.
    """
    spec = problem.trajectory
    rows, n = columns["start_q"].shape
    names = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "goal_ddq")
    boundary = Boundary(*(np.asarray(columns[name], float) for name in names if name in columns))
    kept = ("start_xyz", "goal_xyz", "hit_angle", "hit_speed")
    path, rate = (columns.get(f"{part}_control_points", np.array(np.nan)) for part in ("path", "rate"))
    return make_plans(
        problem,
        boundary,
        path_control_points=np.broadcast_to(path, (rows, spec.path_control_points * n)).reshape(rows, -1, n),
        rate_control_points=np.broadcast_to(rate, (rows, spec.rate_control_points)),
        columns={name: columns[name] for name in kept if name in columns},
        sample_id=columns.get("sample_id"),
        source=source,
    )


def load_problems(folder: str | Path, *, split: str = "train", start: int = 0, n: int | None = None) -> Plans:
    """Read rows of a dataset as plans that are still to be made; those of a certified dataset have the stored plans.

    Args:
        folder: The dataset.
        split: Which split.
        start: The first row.
        n: How many; by default all that follow.

    Raises:
        DatasetError: The folder holds no readable dataset.
        UsageError: There is no such folder or split, or it has no such rows.
    """
    from cnpgen.store.reader import open_dataset

    start = integer("start", start, least=0)
    n = None if n is None else integer("n", n, least=1)
    dataset = open_dataset(Path(folder))
    if split not in dataset.blueprint.splits:
        raise UsageError(f"{folder} {lacks('split', split, dataset.blueprint.splits)}")
    rows = dataset.blueprint.splits[split]
    stop = rows if n is None else start + n
    if not 0 <= start < stop <= rows:
        wanted = f"{stop - start} from row {start} on"
        raise UsageError(f"split {split!r} of {folder} has {rows} rows, got {wanted}")
    source = f"dataset {dataset.blueprint.name}, seed {dataset.blueprint.seed}, split {split}"
    return problems_of_rows(record_of(dataset.blueprint), dataset.read(split, start=start, stop=stop), source=source)


def draw_problems(recipe: str | Path | DatasetRecipe, n: int, *, seed: int | None = None) -> Plans:
    """Draw fresh problems of a recipe's pipeline as plans that are still to be made.

    Args:
        recipe: Name of a shipped dataset or pipeline, path of a recipe file, or a loaded recipe.
        n: How many.
        seed: Root seed; by default the recipe's. Equal seeds give equal problems.

    Raises:
        RecipeError: The recipe has mistakes.
        UsageError: ``n`` is no positive integer, ``seed`` no integer from 0 to 2^63 - 1, or ``recipe`` no recipe.
        MachineError: No backend works.
    """
    from cnpgen.pipelines.prepared import PreparedPipeline

    n = integer("n", n, least=1)
    root = None if seed is None else integer("seed", seed, least=0, most=2**63 - 1)
    loaded = as_dataset_recipe(recipe)
    backend, cache_folder = choose_backend(None)
    prepared = PreparedPipeline(loaded.pipeline, backend=backend, cache_folder=cache_folder, dtype="float64")
    rows = prepared.block_rows
    root = loaded.seed if root is None else root
    parts = [
        prepared.block(root, SPLIT, index, first=0, stop=min(n - index * rows, rows)).columns
        for index in range(-(-n // rows))
    ]
    columns = {}
    for field in prepared.fields:
        values = np.concatenate([part[field.name] for part in parts], axis=1).T
        columns[field.name] = np.ascontiguousarray(values if field.width else values[:, 0])
    source = f"fresh draws of {loaded.name}, seed {root}"
    return problems_of_rows(record_problem(loaded.pipeline.problem), columns, source=source)


def record_of(blueprint: "Blueprint") -> ProblemRecord:
    """Return the problem that a dataset was made for."""
    return ProblemRecord(
        json.dumps(blueprint.recipe["pipeline"]["problem"], ensure_ascii=False), blueprint.robot["urdf"]
    )
