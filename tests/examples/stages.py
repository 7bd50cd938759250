"""A stage that does nothing, for tests of recipes."""

from dataclasses import dataclass

from cnpgen.pipelines.stages.stage import Stage
from cnpgen.schema.keys import Range, field


@dataclass(frozen=True, kw_only=True)
class Idle(Stage):
    def describe(self):
        return "roll"

    def outputs(self, context):
        return ()

    def prepare(self, context):
        return lambda candidates, random: None


@dataclass(frozen=True, kw_only=True)
class Roll(Idle):
    size: Range = field("size of the die", unit="m")
