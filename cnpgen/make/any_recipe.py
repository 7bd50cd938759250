"""A recipe of any kind: a dataset, a pipeline or a problem."""

from cnpgen.make.recipe import DatasetRecipe, load_dataset_recipe
from cnpgen.pipelines.pipeline import Pipeline, load_pipeline
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.schema.catalogue import find_recipe
from cnpgen.schema.toml import Kind, kind_of_file

Recipe = Problem | Pipeline | DatasetRecipe
# A dataset includes the other two.
KINDS: tuple[Kind, ...] = ("dataset", "pipeline", "problem")


def load_any(name_or_path: str, kind: Kind | None = None) -> Recipe:
    """Load a recipe of any kind.

    Of several with the same name the one that includes the others.
    """
    kind = kind or kind_of_file(find_recipe(KINDS, name_or_path))
    if kind == "dataset":
        return load_dataset_recipe(name_or_path)
    return (
        load_pipeline(name_or_path)
        if kind == "pipeline"
        else load_problem(name_or_path)
    )
