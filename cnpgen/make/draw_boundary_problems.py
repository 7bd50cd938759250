"""Fresh boundary problems of a recipe, disjoint from all datasets, as plans without motions."""

from pathlib import Path

from cnpgen.kernels.library import choose_backend
from cnpgen.make.recipe import MAX_SEED, DatasetRecipe, as_dataset_recipe
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import record_problem
from cnpgen.robots.scene import scene_poses
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import check_memory, integer
from cnpgen.store.scene_table import OBSTACLE_POSES, SCENE_ID, concatenate_scenes

SPLIT = "(fresh draws)"  # an invalid name of a split: no dataset contains these rows


@checked_arguments
def draw_boundary_problems(
    recipe: str | Path | DatasetRecipe, n: int, *, seed: int | None = None
) -> Plans:
    """Draw fresh boundary problems of a recipe, as plans without motions for ``solve_plans``.

    Args:
        recipe: Name of a shipped dataset or pipeline, path of a recipe file, or a
            loaded recipe.
        n: Number of boundary problems.
        seed: Root seed; by default the recipe's. Equal seeds give equal problems.

    Raises:
        RecipeError: The recipe has errors.
        UsageError: ``n`` is not a positive integer, ``seed`` is not an integer from 0
            to 2^63 - 1, or ``recipe`` is not a recipe.
        MachineError: No backend works.
    """
    from cnpgen.make.make_shards import stored_columns
    from cnpgen.pipelines.prepared import PreparedPipeline

    n = integer("n", n, least=1)
    root = None if seed is None else integer("seed", seed, least=0, most=MAX_SEED)
    loaded = as_dataset_recipe(recipe)
    backend, cache_folder = choose_backend(None)
    prepared = PreparedPipeline(
        loaded.pipeline, backend=backend, cache_folder=cache_folder, dtype="float64"
    )
    rows = prepared.block_rows
    check_memory("n", n, n * sum(max(field.width, 1) for field in prepared.fields))
    root = loaded.seed if root is None else root
    blocks = [
        # The random numbers of a block depend on seed, split and index: n does not
        # change the first rows.
        prepared.block(root, SPLIT, index, first=0, stop=min(n - index * rows, rows))
        for index in range(-(-n // rows))
    ]
    columns = stored_columns(blocks, prepared.fields, "float64")
    if tables := [block.scenes for block in blocks if block.scenes is not None]:
        scenes = concatenate_scenes(tables)
        table = scenes[scenes.rows_of(columns[SCENE_ID])]
        columns[OBSTACLE_POSES] = scene_poses(loaded.pipeline.problem.obstacle, table)
    source = f"fresh draws of {loaded.name}, seed {root}"
    return plans_of_rows(
        record_problem(loaded.pipeline.problem), columns, source=source
    )
