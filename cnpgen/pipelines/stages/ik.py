"""Inverse kinematics: stages for positions of start, home and goal, free or vertical, and their step."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from cnpgen.documents import NamedErrors
from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.kinematics import (
    Kinematics,
    forward_kinematics,
    tip_position,
)
from cnpgen.kernels.symbolic.linalg import (
    Scalar,
    Vec,
    add,
    dot,
    gram,
    scale,
    solve,
    subtract,
    symbols,
)
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.stages.candidate_table import upright_axes
from cnpgen.pipelines.stages.draw import check_reach, uniform
from cnpgen.pipelines.stages.stage import (
    CandidateBatch,
    Context,
    Stage,
    StageFunction,
    fraction,
)
from cnpgen.robots.plausible_values import find_implausible_value
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import Range, field
from cnpgen.store.field import Fields

# M and rad, before the last step (quadratic convergence, except with joints on their
# limits).
IK_TOLERANCE = 1e-9
MAX_IK_STEPS = 24
IK_DAMPING = 1e-9
# Additional damping min(MAX_LIMIT_DAMPING, LIMIT_DAMPING_RATE |e|^2) of the step within
# joint limits. If the limits leave hardly enough free joints, an undamped step
# amplifies rounding errors until solutions differ between machines. The damping
# vanishes with the error e, so convergence stays quadratic.
MAX_LIMIT_DAMPING = 1e-2
LIMIT_DAMPING_RATE = 1e-1


@dataclass(frozen=True, kw_only=True)
class GuessedIK(Stage):
    """Base class: Gauss-Newton inverse kinematics from a random guess or from the base configuration.

    Its steps are clipped and saturate at the joint limits.
    """

    orientation: str = field(
        "required orientation of the tip", choices=("free", "vertical"), default="free"
    )
    max_step: float = field(
        "maximum change of a joint per iteration",
        unit="rad",
        default=0.4,
        low=1e-3,
        plausible=np.pi,
    )
    guess: tuple[Range, ...] = field(
        "box of random guesses; default: the base configuration", unit="rad", default=()
    )
    at_limit: float = fraction(
        "fraction of the guesses with one random joint held on one of its limits",
        default=0.0,
        since_version=2,
    )

    def _how(self) -> str:
        return (
            " with the tip's z axis vertical" if self.orientation == "vertical" else ""
        )

    def _origin(self) -> str:
        """Describe the initial guess."""
        box = " x ".join(f"[{g.low:.4g}, {g.high:.4g}]" for g in self.guess)
        held = (
            f", with one joint held on a limit in {100 * self.at_limit:.4g} % of the cases"
            if self.at_limit
            else ""
        )
        return (
            f"a random guess in {box} rad" if self.guess else "the base configuration"
        ) + held

    def _solve(
        self, context: Context, end: str, initial: str = "guess_q"
    ) -> StageFunction:
        """Return the stage function that solves for the position of an end, from a column of initial positions."""
        hold = initial == "guess_q" and self.at_limit > 0
        options = {
            "vertical": self.orientation == "vertical",
            "max_step": self.max_step,
            "hold": hold,
        }
        kernel = context.kernels.load(
            ik_step, Loop(IK_TOLERANCE, MAX_IK_STEPS), **options
        )
        low = context.robot.position_lower[:, None]
        high = context.robot.position_upper[:, None]

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            more = [candidates["held"]] if hold else []
            more += (
                upright_axes(context, candidates)
                if self.orientation == "vertical"
                else []
            )
            # The error is that of the state before the last step; the step makes it
            # smaller still.
            q, error = kernel(candidates[initial], candidates[f"{end}_xyz"], *more)
            candidates[f"{end}_q"] = q
            candidates.reject(
                error[0] < IK_TOLERANCE, f"no inverse kinematics of the {end}"
            )
            q = candidates[f"{end}_q"]
            candidates.reject(
                ((low <= q) & (q <= high)).all(0), f"joint position limit at the {end}"
            )

        return work

    def _solve_guessed(self, context: Context, end: str) -> StageFunction:
        guess = self._guesses(context)
        solve = self._solve(context, end)

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            guess(candidates, random)
            solve(candidates, random)

        return work

    def _guesses(self, context: Context) -> StageFunction:
        """Return the stage function that draws initial guesses."""
        robot = context.robot
        n = context.robot.n
        if self.guess and len(self.guess) != n:
            raise RecipeError(
                [
                    f"guess: needs {n} ranges, one per planned joint, got {len(self.guess)}"
                ]
            )
        # A stored problem was checked when it was made.
        for index, each in enumerate(() if context.problem.is_stored else self.guess):
            # Both ends of one joint's range, all other joints at home.
            ends = np.full((2, n), robot.home)
            ends[:, index] = each.low, each.high
            if wrong := find_implausible_value(
                robot, "guess_q", ends, robot.units("rad")
            ):
                raise RecipeError([f"guess: {robot.joint_names[index]}: {wrong}"])
        guess = self.guess or tuple(Range(float(x), float(x)) for x in robot.home)

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            # Numbers for all joints and the choice are drawn whether they are used or
            # not.
            candidates["guess_q"] = uniform(candidates.draw(random, n), guess)
            if self.at_limit:
                choice, joint, side = candidates.draw(random, 3)
                # One joint is chosen uniformly; rounding must not give the index n.
                held = (
                    np.arange(n)[:, None] == np.minimum((joint * n).astype(int), n - 1)
                ) & (choice < self.at_limit)
                limit = np.where(
                    side < 0.5,
                    robot.position_lower[:, None],
                    robot.position_upper[:, None],
                )
                candidates["guess_q"] = np.where(held, limit, candidates["guess_q"])
                candidates["held"] = held.astype(float)

        return work


@dataclass(frozen=True, kw_only=True)
class StartIK(GuessedIK):
    """Stage: joint positions of the start, from the base configuration or from a random guess."""

    inputs = ("start_xyz",)

    def describe(self) -> str:
        return f"solve the start configuration{self._how()} from {self._origin()}"

    def outputs(self, context: Context) -> Fields:
        return (context.joint_field("start_q", "rad", "joint positions at the start"),)

    def prepare(self, context: Context) -> StageFunction:
        return self._solve_guessed(context, "start")


@dataclass(frozen=True, kw_only=True)
class GoalIK(GuessedIK):
    """Stage: joint positions of the goal, from the start configuration or from an independent guess."""

    inputs = ("goal_xyz", "start_q")
    guess: tuple[Range, ...] = field(
        "box of random guesses; default: the start configuration",
        unit="rad",
        default=(),
        since_version=2,
    )
    from_start: float = fraction(
        "fraction of the goals that start from the start configuration in spite of guesses",
        default=0.0,
        since_version=2,
    )
    max_change: float | None = field(
        "maximum difference of a joint between start and goal",
        unit="rad",
        low=1e-3,
        default=None,
        since_version=2,
    )

    def validate(self) -> NamedErrors:
        for name in ("from_start", "at_limit"):
            if getattr(self, name) and not self.guess:
                yield name, "needs random guesses: give guess, too"

    def describe(self) -> str:
        origin = self._origin() if self.guess else "the start configuration"
        if self.from_start:
            origin += f", but in {100 * self.from_start:.4g} % of the cases from the start configuration"
        if self.max_change is not None:
            origin += f"; no joint may be farther than {self.max_change:.4g} rad from the start"
        return f"solve the goal configuration{self._how()} from {origin}"

    def outputs(self, context: Context) -> Fields:
        return (
            context.joint_field(
                "goal_q", "rad", "joint positions at the goal", "target"
            ),
        )

    def prepare(self, context: Context) -> StageFunction:
        search = self._search(context)
        max_change = self.max_change
        if max_change is None:
            return search

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            search(candidates, random)
            change = np.abs(candidates["goal_q"] - candidates["start_q"]).max(0)
            candidates.reject(
                change <= max_change, "goal configuration too far from the start's"
            )

        return work

    def _search(self, context: Context) -> StageFunction:
        if not self.guess:
            return self._solve(context, "goal", "start_q")
        guess = self._guesses(context)
        solve = self._solve(context, "goal")

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            guess(candidates, random)
            there = candidates.draw(random, 1)[0] < self.from_start
            candidates["guess_q"] = np.where(
                there, candidates["start_q"], candidates["guess_q"]
            )
            # A search from the start configuration holds no joint.
            if self.at_limit:
                candidates["held"] = np.where(there, 0.0, candidates["held"])
            solve(candidates, random)

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Search from the start configuration: goals of tasks are near it."""
        if self.guess:
            return GoalIK(
                orientation=self.orientation, max_step=self.max_step
            ).complete(context, given)
        return super().complete(context, given)


def ik_step(
    robot: Robot, *, vertical: bool, max_step: float, hold: bool = False
) -> Any:
    """Build one step of inverse kinematics as an SX function ``(q, p) -> (next q, |error|)``.

    A joint that would leave its limits is set to the limit. The rest of the step is
    redistributed once over the other joints; no joint changes more than ``max_step``
    [rad]. With ``hold``, a third argument is 1 for joints that stay constant, otherwise
    0. With ``vertical``, the tip's z axis must be vertical, too. If parameters of the
    problem turn the upright direction, the last argument then has three axes, of which
    the last is the direction, shape (9,).
    """
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    p_sx, p = symbols("p", 3)
    held_sx, held = symbols("held", robot.n)
    kin = forward_kinematics(robot.chain, q)
    # Rows of the task: three of position, two of tilt.
    rows = [[column[row] for column in kin.jacobian] for row in range(3)]
    error = subtract(p, kin.tip)
    turned = vertical and robot.parameters.turns_upright
    axes_sx, axes = symbols("axes", 9)
    if vertical:
        tilt, tilt_rows = _tilt(
            kin, [axes[:3], axes[3:6], axes[6:]] if turned else None
        )
        error = [*error, *tilt]
        rows = [*rows, *tilt_rows]
    if hold:
        # Columns of held joints are zero, so they do not move.
        rows = [
            [x * (1 - stays) for x, stays in zip(row, held, strict=True)]
            for row in rows
        ]
    square = dot(error, error)
    following = _saturated(robot, q, rows, error, square=square, max_step=max_step)
    given = [q_sx, p_sx, *([held_sx] if hold else []), *([axes_sx] if turned else [])]
    return ca.Function("ik", given, [ca.vertcat(*following), ca.sqrt(square)])


def _saturated(
    robot: Robot,
    q: Vec,
    rows: list[Vec],
    error: Vec,
    *,
    square: Scalar,
    max_step: float,
) -> Vec:
    """Return the joint positions after a step that corrects the error, of given square, within the joint limits."""
    import casadi as ca

    # Least-norm step: s = J^T (J J^T + damping I)^-1 e, shortened as a whole.
    step, factor = clipped_step(rows, error, max_step, IK_DAMPING)
    target = add(q, step)
    free = [
        ca.logic_and(float(low) <= x, x <= float(high))
        for x, low, high in zip(
            target, robot.position_lower, robot.position_upper, strict=True
        )
    ]
    # Saturated joints go to their limits; the others make up for what is missing, once.
    moved = [
        ca.if_else(ok, 0.0, x - at)
        for ok, x, at in zip(free, clip_to_limits(target, robot), q, strict=True)
    ]
    # The remaining error, shortened as the first step was.
    rest = [factor * e - dot(row, moved) for e, row in zip(error, rows, strict=True)]
    left = [[x * ok for x, ok in zip(row, free, strict=True)] for row in rows]
    more_damping = ca.fmin(MAX_LIMIT_DAMPING, LIMIT_DAMPING_RATE * square)
    again, _ = clipped_step(left, rest, max_step, IK_DAMPING + more_damping)
    return clip_to_limits(add(add(q, moved), again), robot)


def _tilt(kin: Kinematics, frame: list[Vec] | None) -> tuple[Vec, list[Vec]]:
    """Return the angular error of the tip's z axis about x and y of a frame, and its Jacobian rows.

    The frame is the world if it is None. The error is ``z x e_z`` scaled by ``2 / (1 +
    z_z) = 2 tan(angle / 2) / sin(angle)``, so that the inverted orientation is not a
    fixed point.
    """
    import casadi as ca

    # Angular velocity about the axes of the frame: components of the joint axes.
    up = [row[2] for row in kin.rotation]
    turns_about = kin.axes
    if frame is not None:
        up = [dot(axis, up) for axis in frame]
        turns_about = [[dot(axis, turning) for axis in frame] for turning in kin.axes]
    # At 180 degrees up[2] = -1; the bound keeps the factor finite.
    stretch = 2.0 / ca.fmax(1.0 + up[2], 1e-3)
    # A prismatic joint does not turn the tip.
    rows = [
        [
            axis[row] if turns else 0.0
            for axis, turns in zip(turns_about, kin.revolute, strict=True)
        ]
        for row in range(2)
    ]
    return [up[1] * stretch, -up[0] * stretch], rows


def clipped_step(
    rows: list[Vec], error: Vec, max_step: float, damping: Scalar
) -> tuple[Vec, Scalar]:
    """Return the least-norm step that corrects the error, shortened to ``max_step``, and the factor of shortening."""
    import casadi as ca

    weights = solve(gram(rows, damping), error)
    step = [dot(column, weights) for column in zip(*rows, strict=True)]
    largest = reduce(ca.fmax, map(ca.fabs, step))
    # The step keeps its direction: clipping single joints would leave the path to the
    # target.
    factor = ca.fmin(1.0, max_step / ca.fmax(largest, 1e-9))
    return scale(step, factor), factor


def clip_to_limits(q: Vec, robot: Robot) -> Vec:
    """Move joint positions outside their limits to the limits."""
    import casadi as ca

    bounds = zip(
        q, robot.position_lower.tolist(), robot.position_upper.tolist(), strict=True
    )
    return [ca.fmin(ca.fmax(x, low), high) for x, low, high in bounds]


@dataclass(frozen=True, kw_only=True)
class Home(GuessedIK):
    """Stage: home is the start, the base, or a configuration for a random position, with given fractions."""

    inputs = ("start_q", "start_xyz")
    at_start: float = fraction("fraction of homes at the start configuration")
    at_base: float = fraction(
        "fraction of homes at the base configuration", default=0.0
    )
    position: tuple[Range, Range, Range] = field(
        "box of tip positions of the other homes: x, y, z", unit="m"
    )

    def validate(self) -> NamedErrors:
        if self.at_start + self.at_base > 1:
            yield (
                "at_base",
                f"the fractions must not be more than 1 together, got {self.at_start + self.at_base:g}",
            )

    def describe(self) -> str:
        elsewhere = max(1 - self.at_start - self.at_base, 0.0)
        return (
            f"choose a home: the start configuration in {100 * self.at_start:.4g} % of the cases, the base in"
            f" {100 * self.at_base:.4g} %, one for a random position{self._how()} from {self._origin()} in"
            f" {100 * elsewhere:.4g} %"
        )

    def outputs(self, context: Context) -> Fields:
        return (
            context.joint_field(
                "home_q",
                "rad",
                "joint positions that those at the goal are chosen close to",
                "diagnostic",
            ),
        )

    def writes(self, context: Context) -> tuple[str, ...]:
        return "home_q", "home_xyz"

    def prepare(self, context: Context) -> StageFunction:
        check_reach(context, (("position", self.position),))
        guess_home = self._solve_guessed(context, "home")
        tip = context.kernels.load(tip_position)
        base = context.robot.home[:, None]

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            candidates["home_xyz"] = uniform(candidates.draw(random, 3), self.position)
            # The choice is drawn in every case, so that the numbers of later stages do
            # not change.
            candidates["home_choice"] = candidates.draw(random, 1)
            guess_home(candidates, random)
            choice = candidates["home_choice"][0]
            elsewhere = candidates["home_q"]
            # Nested choice: start, else base, else the solution for a random position.
            home = np.where(choice < self.at_start + self.at_base, base, elsewhere)
            candidates["home_q"] = np.where(
                choice < self.at_start, candidates["start_q"], home
            )
            (candidates["home_xyz"],) = tip(candidates["home_q"])

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Use the start: goals of tasks are chosen near the start configuration."""

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            candidates["home_q"] = candidates["start_q"]
            candidates["home_xyz"] = candidates["start_xyz"]

        return work
