"""Recipes of problems, pipelines and datasets, and the classes of their tables."""

from cnpgen.make.recipe import DatasetRecipe
from cnpgen.make.recipe_file import load_dataset_recipe
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.pipeline_file import load_pipeline
from cnpgen.problems.problem import Objective
from cnpgen.problems.problem_record import ProblemRecord
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.parameter_ranges import ParameterRanges
from cnpgen.robots.robot_spec import HeldObject, LimitSpec, Payload, RobotSpec
from cnpgen.schema.catalogue import list_recipes
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

__all__ = [
    "DatasetRecipe",
    "HeldObject",
    "LimitSpec",
    "Objective",
    "Obstacle",
    "ParameterRanges",
    "Payload",
    "Pipeline",
    "ProblemRecord",
    "RobotSpec",
    "TrajectorySpec",
    "list_recipes",
    "load_dataset_recipe",
    "load_pipeline",
]
