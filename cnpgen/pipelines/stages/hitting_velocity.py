"""Stage: the fastest joint velocity along the hit, a linear program solved exactly.

Maximize ``a . v`` subject to ``B^T v = 0`` and ``|v_i| <= L_i``, where ``a_i`` is the
tip's velocity along the hit and ``b_i`` its two components across it per unit of joint
i. The dual, ``min over y in R^2 of sum_i L_i |a_i - b_i . y|``, has its minimum where
two residuals vanish: n (n - 1) / 2 candidates, evaluated without branches. Joints with
non-zero residual go to the limit of its sign.

In half of the poses of an arm with intersecting axes, three or more residuals vanish
together and the optimum is a face. The remaining joints then get the velocity ``v_i = t
L_i sign(b_i . z)`` with the smallest t that satisfies the equations. This is again a
linear program, and its dual has its optimum at a ``z`` orthogonal to one of the b_i.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.kernels.symbolic.kinematics import forward_kinematics
from cnpgen.kernels.symbolic.linalg import Scalar, Vec, cross, dot, symbols
from cnpgen.pipelines.stages.candidate_table import (
    hit_direction,
    table_normal,
    velocity_factor,
)
from cnpgen.pipelines.stages.hitting_newton import along, direction_symbols
from cnpgen.pipelines.stages.stage import (
    CandidateBatch,
    Context,
    Stage,
    StageFunction,
    fraction,
)
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field
from cnpgen.store.field import Field, Fields

ZERO_RESIDUAL_M = 1e-11  # residuals below this are treated as zero
# Task column: hit speed as a fraction of the maximum speed.
SPEED_SHARE_COLUMN = "hit_speed_share"
PARALLEL_TOLERANCE = 1e-9  # relative determinants below this are treated as zero


@dataclass(frozen=True, kw_only=True)
class HittingVelocity(Stage):
    """Stage: joint velocities of the goal, exactly along the hit, at the maximum speed or scaled down."""

    inputs = ("goal_q", "hit_angle")
    full_speed: float = fraction(
        "fraction of the hits at the maximum speed; the others are scaled"
    )
    min_speed: float = field(
        "minimum of the maximum speed of a hit", unit="m/s", default=1e-3, low=1e-9
    )

    def describe(self) -> str:
        slower = (
            f"; scale it uniformly in [0, 1) in {1 - self.full_speed:.4g} of the cases"
            if self.full_speed < 1
            else ""
        )
        return f"solve the linear program for the fastest joint velocity along the hit{slower}"

    def outputs(self, context: Context) -> Fields:
        return (
            context.joint_field(
                "goal_dq", "rad/s", "joint velocities at the goal", "target"
            ),
            Field(
                "hit_speed",
                "m/s",
                "speed of the tip along the hit at the goal",
                role="context",
                frame="world",
            ),
            Field(
                "hit_speed_max",
                "m/s",
                "highest possible speed along the hit at the goal configuration",
                role="diagnostic",
                frame="world",
            ),
        )

    def prepare(self, context: Context) -> StageFunction:
        def draw_share(
            candidates: CandidateBatch, random: np.random.Generator, _speed: Array
        ) -> Array:
            factor = candidates.draw(random, 1)
            choice = candidates.draw(random, 1)
            # Both numbers are drawn for every candidate, so that the fraction does not
            # change later ones.
            return np.where(choice < self.full_speed, 1.0, factor)

        return self._solve(context, draw_share)

    def task_inputs(self, context: Context) -> Fields:
        """List the speed, and its share of the maximum speed.

        The share is 1 if neither is given.
        """
        share = Field(
            SPEED_SHARE_COLUMN,
            "1",
            "speed of the hit, as a fraction of the highest possible one",
            role="context",
        )
        return self.outputs(context)[1], share

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        if {"hit_speed", SPEED_SHARE_COLUMN} <= set(given):
            raise UsageError(
                f"hit_speed and {SPEED_SHARE_COLUMN} both define the speed of the hit: give one of them"
            )

        def given_share(
            candidates: CandidateBatch, _random: np.random.Generator, speed: Array
        ) -> Array:
            if SPEED_SHARE_COLUMN in given:
                return candidates[SPEED_SHARE_COLUMN]
            return (
                candidates["hit_speed"] / speed
                if "hit_speed" in given
                else np.ones_like(speed)
            )

        solve = self._solve(context, given_share)

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            solve(candidates, random)
            possible = (candidates["hit_speed"] > 0) & (
                candidates["hit_speed"] <= candidates["hit_speed_max"]
            )
            candidates.reject(
                possible[0], "hit speed not between 0 and the highest possible one"
            )

        return work

    def _solve(
        self,
        context: Context,
        share: Callable[[CandidateBatch, np.random.Generator, Array], Array],
    ) -> StageFunction:
        kernel = context.kernels.load(hitting_velocity, min_speed=self.min_speed)

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            directions = [
                hit_direction(context, candidates),
                *table_normal(context, candidates),
            ]
            velocity, speed, found = kernel(candidates["goal_q"], *directions)
            limit = velocity_factor(context, candidates)
            if limit is not None:
                # The optimum of the linear program scales with its bounds.
                velocity = velocity * limit
                speed = speed * limit
            factor = share(candidates, random, speed)
            candidates["goal_dq"] = velocity * factor
            candidates["hit_speed"] = speed * factor
            candidates["hit_speed_max"] = speed
            candidates.reject(found[0] > 0, "no hitting velocity")

        return work


def hitting_velocity(robot: Robot, *, min_speed: float) -> Any:
    """Build the linear program as an SX function ``(q, d) -> (dq, speed, found)``, or of (q, d, normal).

    The joint velocity dq [rad/s] maximizes the tip's speed [m/s] along d, which has
    width 2. If samples tilt the table, directions have width 3, and the normal of the
    table is the third argument. ``found`` is 0 for hits that are slower than
    ``min_speed`` [m/s], and if the Jacobian is singular and dq is not finite.
    """
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    d_sx, d = direction_symbols(robot)
    normal_sx, normal = symbols("normal", 3)
    jacobian = forward_kinematics(robot.chain, q).jacobian
    # Speed along the hit: sum over joints of (d . J_i) dq_i.
    forward = [along(d, column) for column in jacobian]
    # Unit vectors across the hit: in the table's plane, and its normal.
    if robot.parameters.tilts_table:
        side = cross(normal, d)
        across = [[dot(side, column), dot(normal, column)] for column in jacobian]
    else:
        across = [
            [d[0] * column[1] - d[1] * column[0], column[2]] for column in jacobian
        ]
    velocity, speed = maximise(
        forward, across, [float(x) for x in robot.velocity_limit]
    )
    # A singular Jacobian gives nan, for which every comparison is false.
    found = ca.logic_and(min_speed <= speed, speed < np.inf)
    for rate in velocity:
        found = ca.logic_and(found, ca.fabs(rate) < np.inf)
    arguments = (
        [q_sx, d_sx, normal_sx] if robot.parameters.tilts_table else [q_sx, d_sx]
    )
    return ca.Function(
        "hitting_velocity", arguments, [ca.vertcat(*velocity), speed, found]
    )


def maximise(a: Vec, b: list[Vec], limit: list[float]) -> tuple[Vec, Scalar]:
    """Solve ``max a . v, sum_i b_i v_i = 0, |v_i| <= limit_i`` without branches; n >= 2, b_i in R^2.

    Return ``(v, value)``.
    """
    import casadi as ca

    n = len(a)
    best: Scalar = ca.SX(np.inf)
    y: Vec = [ca.SX(0), ca.SX(0)]
    # Vertices of the dual: y solves a_k = b_k . y for two joints (Cramer's rule).
    for i, j in combinations(range(n), 2):
        det = b[i][0] * b[j][1] - b[i][1] * b[j][0]
        size = ca.fabs(b[i][0] * b[j][1]) + ca.fabs(b[i][1] * b[j][0])
        usable = ca.fabs(det) > PARALLEL_TOLERANCE * size
        inverse = 1.0 / ca.if_else(usable, det, 1.0)
        candidate = [
            (a[i] * b[j][1] - b[i][1] * a[j]) * inverse,
            (b[i][0] * a[j] - a[i] * b[j][0]) * inverse,
        ]
        others = (k for k in range(n) if k not in (i, j))
        value = sum(
            (limit[k] * ca.fabs(a[k] - dot(b[k], candidate)) for k in others), 0.0
        )
        # The first of equal vertices stays.
        better = ca.logic_and(usable, value < best)
        best = ca.if_else(better, value, best)
        pairs = zip(candidate, y, strict=True)
        y = [ca.if_else(better, new, old) for new, old in pairs]
    # Complementary slackness: a joint with residual r_k != 0 is at the limit of its
    # sign.
    residual = [a[k] - dot(b[k], y) for k in range(n)]
    left = [ca.fabs(r) < ZERO_RESIDUAL_M for r in residual]
    fixed = [
        ca.if_else(free, 0.0, bound * ca.sign(r))
        for free, bound, r in zip(left, limit, residual, strict=True)
    ]
    # The joints with residual 0 must satisfy the equations that the others leave.
    missing = [-dot([b[k][c] for k in range(n)], fixed) for c in range(2)]
    left_rows = [[x * free for x in b_k] for b_k, free in zip(b, left, strict=True)]
    rest = _smallest_ratio(left_rows, limit, missing)
    return [x + r for x, r in zip(fixed, rest, strict=True)], best


def _smallest_ratio(b: list[Vec], limit: list[float], target: Vec) -> Vec:
    """Solve ``min t, sum_i b_i v_i = target, |v_i| <= t limit_i``.

    Joints with b_i = 0 stay at rest.
    """
    import casadi as ca

    n = len(b)
    ratio: Scalar = ca.SX(-1)
    z: Vec = [ca.SX(0), ca.SX(0)]
    pivot: Vec = [ca.SX(0), ca.SX(0)]
    # Dual: maximize target . z / sum_k limit_k |b_k . z|; at the optimum z is
    # orthogonal to some b_j.
    for j in range(n):
        # z orthogonal to b_j
        normal = [-b[j][1], b[j][0]]
        weight = sum(
            (limit[k] * ca.fabs(dot(b[k], normal)) for k in range(n) if k != j), 0.0
        )
        size = dot(normal, normal)
        usable = weight > PARALLEL_TOLERANCE * ca.sqrt(size) * 1e-3
        value = dot(target, normal) / ca.if_else(usable, weight, 1.0)
        better = ca.logic_and(usable, ca.fabs(value) > ratio)
        ratio = ca.if_else(better, ca.fabs(value), ratio)
        sign = ca.if_else(value < 0, -1.0, 1.0)
        z = [
            ca.if_else(better, sign * new, old)
            for new, old in zip(normal, z, strict=True)
        ]
        pivot = [
            ca.if_else(better, new, old) for new, old in zip(b[j], pivot, strict=True)
        ]
    # Without a target or without free joints nothing moves.
    ratio = ca.fmax(ratio, 0.0)
    return _velocities_of_ratio(b, limit, target, ratio=ratio, z=z, pivot=pivot)


def _velocities_of_ratio(
    b: list[Vec],
    limit: list[float],
    target: Vec,
    *,
    ratio: Scalar,
    z: Vec,
    pivot: Vec,
) -> Vec:
    """Return the velocities ``v_i = t L_i sign(b_i . z)`` with the smallest t, and the remainder along the pivot."""
    import casadi as ca

    length = ca.sqrt(dot(pivot, pivot))
    # Joints whose b is parallel to the pivot have b . z = 0: the dual leaves their
    # velocity open, and they share what the others leave.
    parallel = [
        ca.fabs(dot(x, z)) <= PARALLEL_TOLERANCE * length * ca.sqrt(dot(x, x))
        for x in b
    ]
    joints = list(zip(parallel, limit, b, strict=True))
    v = [
        ca.if_else(same, 0.0, ratio * bound * ca.sign(dot(x, z)))
        for same, bound, x in joints
    ]
    # The remainder is along the pivot; each parallel joint contributes in proportion to
    # its limit, so all have the same ratio.
    left = [target[c] - dot([x[c] for x in b], v) for c in range(2)]
    shares = [ca.if_else(same, bound * dot(x, pivot), 0.0) for same, bound, x in joints]
    total = sum(map(ca.fabs, shares), 0.0)
    amount = dot(left, pivot) / ca.if_else(total > 0, total, 1.0)
    along = [
        ca.if_else(same, amount * bound * ca.sign(dot(x, pivot)), 0.0)
        for same, bound, x in joints
    ]
    return [x + w for x, w in zip(v, along, strict=True)]
