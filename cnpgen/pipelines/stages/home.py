"""Stage: the home, the configuration near which the goal configuration is chosen."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.pipelines.stages.draw import check_reach, uniform
from cnpgen.pipelines.stages.ik import GuessedIK
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, StageFunction
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class Home(GuessedIK):
    """Stage: home is the start, the base, or a configuration for a random position, with given fractions."""

    inputs = ("start_q", "start_xyz")
    at_start: float = field("fraction of homes at the start configuration", low=0.0, high=1.0)
    at_base: float = field("fraction of homes at the base configuration", low=0.0, high=1.0, default=0.0)
    position: tuple[Range, Range, Range] = field("box of tip positions of the other homes: x, y, z", unit="m")

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        if self.at_start + self.at_base > 1:
            yield "at_base", f"the fractions must not be more than 1 together, got {self.at_start + self.at_base:g}"

    def describe(self) -> str:
        elsewhere = max(1 - self.at_start - self.at_base, 0.0)
        return (
            f"choose a home: the start configuration in {100 * self.at_start:.4g} % of the cases, the base in"
            f" {100 * self.at_base:.4g} %, one for a random position{self._how()} from {self._origin()} in"
            f" {100 * elsewhere:.4g} %"
        )

    def outputs(self, context: Context) -> tuple[Field, ...]:
        text = "joint positions that those at the goal are chosen close to"
        return (context.joint_field("home_q", "rad", text, "diagnostic"),)

    def writes(self, context: Context) -> tuple[str, ...]:
        """List the home configuration and its tip position."""
        return "home_q", "home_xyz"

    def prepare(self, context: Context) -> StageFunction:
        check_reach(context, (("position", self.position),))
        guess_home, tip = self._solve_guessed(context, "home"), context.kernels.load(tip_position)
        base = context.robot.base[:, None]

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["home_xyz"] = uniform(candidates.draw(random, 3), self.position)
            candidates["home_choice"] = candidates.draw(random, 1)
            guess_home(candidates, random)
            choice, elsewhere = candidates["home_choice"][0], candidates["home_q"]
            home = np.where(choice < self.at_start + self.at_base, base, elsewhere)
            candidates["home_q"] = np.where(choice < self.at_start, candidates["start_q"], home)
            (candidates["home_xyz"],) = tip(candidates["home_q"])

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Use the start: goals of tasks are chosen near the start configuration."""

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            candidates["home_q"], candidates["home_xyz"] = candidates["start_q"], candidates["start_xyz"]

        return work
