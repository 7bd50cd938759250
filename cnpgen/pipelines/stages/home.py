"""Stage: the configuration that the goal's is chosen close to: that of the start, the base, or one somewhere else."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from cnpgen.kernels.symbolic.kinematics import tip_position
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.draw import check_reach, uniform
from cnpgen.pipelines.stages.ik import GuessedIK
from cnpgen.pipelines.stages.stage import Round, Work
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Field


@dataclass(frozen=True, kw_only=True)
class Home(GuessedIK):
    """The start in some cases, the base in others, in all that are left a configuration for a random position."""

    needs = ("start_q", "start_xyz")
    at_start: float = field("fraction of the homes that are the start configuration", low=0.0, high=1.0)
    at_base: float = field("fraction of them that are the base configuration", low=0.0, high=1.0, default=0.0)
    position: tuple[Range, Range, Range] = field("box of the tip's positions at the others: x, y, z", unit="m")

    def find_mistakes(self) -> Iterator[tuple[str, str]]:
        """Yield (key, what is wrong with it)."""
        if self.at_start + self.at_base > 1:
            yield "at_base", f"the fractions must not be more than 1 together, got {self.at_start + self.at_base:g}"

    def describe(self) -> str:
        """Say how often which."""
        elsewhere = max(1 - self.at_start - self.at_base, 0.0)
        return (
            f"choose a home: the start configuration in {100 * self.at_start:.4g} % of the cases, the base in"
            f" {100 * self.at_base:.4g} %, one for a random position{self._how()} from {self._origin()} in"
            f" {100 * elsewhere:.4g} %"
        )

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The configuration."""
        text = "joint positions that those at the goal are chosen close to"
        return (context.joint_field("home_q", "rad", text, "diagnostic"),)

    def writes(self, context: Context) -> tuple[str, ...]:
        """Also where the tip is there."""
        del context
        return "home_q", "home_xyz"

    def prepare(self, context: Context) -> Work:
        """Load the kernels."""
        check_reach(context, (("position", self.position),))
        guess_home, tip = self._solve_guessed(context, "home"), context.kernels.load(tip_position)
        base = context.robot.base[:, None]

        def work(draws: Round, random: np.random.Generator) -> None:
            draws["home_xyz"] = uniform(draws.draw(random, 3), self.position)
            draws["home_choice"] = draws.draw(random, 1)
            guess_home(draws, random)
            choice, elsewhere = draws["home_choice"][0], draws["home_q"]
            home = np.where(choice < self.at_start + self.at_base, base, elsewhere)
            draws["home_q"] = np.where(choice < self.at_start, draws["start_q"], home)
            (draws["home_xyz"],) = tip(draws["home_q"])

        return work

    def complete(self, context: Context, given: Collection[str]) -> Work:
        """Take the start: what tasks ask for is chosen close to where the arm is."""
        del context, given

        def work(draws: Round, _random: np.random.Generator) -> None:
            draws["home_q"], draws["home_xyz"] = draws["start_q"], draws["start_xyz"]

        return work
