"""Stage: draw the parameters of the problem."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from cnpgen.errors import RecipeError
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.draw import uniform
from cnpgen.pipelines.stages.stage import CandidateBatch, Stage, StageFunction
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class DrawParameters(Stage):
    """Stage: parameters of the problem, uniform in the ranges of its ``[parameters]``."""

    def describe(self) -> str:
        return "draw the parameters of the problem uniformly in their ranges"

    def outputs(self, context: Context) -> tuple[Field, ...]:
        ranges = context.problem.parameters
        if not ranges:
            raise RecipeError([f"needs [parameters], which the problem {context.problem.path} does not have"])
        low, high = (tuple(getattr(span, end) for span in ranges.ranges) for end in ("low", "high"))
        text = "parameters of the problem"
        return (Field("parameters", ranges.units, text, len(ranges), ranges.names, valid_min=low, valid_max=high),)

    def prepare(self, context: Context) -> StageFunction:
        ranges = context.problem.parameters.ranges

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["parameters"] = uniform(candidates.draw(random, len(ranges)), ranges)

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Keep the parameters of the tasks; they are nominal if none are given."""
        if "parameters" in given:
            return super().complete(context, given)
        nominal = context.robot.nominal_parameters[:, None]

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            candidates["parameters"] = np.repeat(nominal, len(candidates.alive), axis=1)

        return work
