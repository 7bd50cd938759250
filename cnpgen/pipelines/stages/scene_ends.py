"""Stage: collision-free joint positions of start and goal among the obstacles of a scene."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array, Mask
from cnpgen.documents import NamedErrors
from cnpgen.errors import RecipeError
from cnpgen.kernels.kernel import Kernel
from cnpgen.kernels.symbolic.kinematics import forward_kinematics, tip_position
from cnpgen.kernels.symbolic.linalg import add, dot, scale, subtract, symbols
from cnpgen.kernels.tape import Loop
from cnpgen.pipelines.stages.batch_scenes import BatchScenes
from cnpgen.pipelines.stages.draw import position_field
from cnpgen.pipelines.stages.ik import clip_to_limits, clipped_step
from cnpgen.pipelines.stages.scene_clearance import SceneClearance
from cnpgen.pipelines.stages.stage import (
    CandidateBatch,
    Context,
    Stage,
    StageFunction,
    fraction,
    leave,
)
from cnpgen.pipelines.stages.torque import torque_ratio
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import field
from cnpgen.store.field import Fields

Indices = NDArray[np.int64]

MAX_PAIRS_PER_CANDIDATE = 8  # of a start and a goal that are tried for one candidate
NEUTRAL_STATES = 12  # of a scene
RANDOM_STATES = 16  # of a scene, most of which collide
FIRST_PHASES = (0.5, 0.25, 0.75)  # of a straight line, checked first
OTHER_PHASES = tuple(k / 16 for k in range(1, 16, 2))
NO_ENDS = "no collision-free start and goal in the scene"
# Random numbers: kind of start, and two for each of two states, less one.
NUMBERS_PER_PAIR = 5
# Inverse kinematics of poses
METERS_PER_RADIAN = 0.3  # weight of an angle against a distance
POSE_TOLERANCE = 1e-9  # m and weighted rad, before the last step
MAX_POSE_IK_STEPS = 30
MAX_POSE_IK_STEP_RAD = 0.5  # of any joint
POSE_DAMPING = 1e-3  # relative to the squared error (Sugihara 2011)
MIN_DAMPING = 1e-12


@dataclass(frozen=True, kw_only=True)
class SceneEnds(Stage):
    """Stage: goals at grasps of the scene, and starts at other grasps, near the base configuration or random."""

    inputs = ("scene",)
    neutral: float = fraction(
        "share of starts near the base configuration", default=0.4
    )
    grasp: float = fraction("share of starts at another grasp", default=0.4)
    random: float = fraction("share of random starts", default=0.2)
    spread: float = field(
        "standard deviation of starts around the base configuration",
        unit="rad",
        default=0.1,
        low=0.0,
        plausible=np.pi,
    )
    margin: float = field(
        "distance of both ends from obstacles, in addition to that of the problem",
        unit="m",
        default=0.005,
        low=0.0,
        plausible=1.0,
    )
    straight: float = fraction(
        "share of the samples whose straight line may be free of collisions",
        default=0.1,
    )
    grasps: int = field("grasps of a scene that are tried", default=8, low=1, high=100)
    poses: int = field("random poses at each grasp", default=12, low=1, high=100)

    def validate(self) -> NamedErrors:
        total = self.neutral + self.grasp + self.random
        if abs(total - 1) > 1e-9:
            yield "random", f"the shares of starts must add up to 1, got {total:g}"

    def describe(self) -> str:
        kinds = f"near the base configuration {100 * self.neutral:.3g} %, at other grasps {100 * self.grasp:.3g} %"
        return (
            f"choose collision-free goals at grasps and starts ({kinds}, random {100 * self.random:.3g} %) that a"
            f" straight line connects in at most {100 * self.straight:.3g} % of the cases"
        )

    def outputs(self, context: Context) -> Fields:
        center = context.robot.chain.joints[0].translation
        reach = context.robot.chain.reach
        low = (np.asarray(center) - reach).tolist()
        high = (np.asarray(center) + reach).tolist()
        return (
            context.joint_field("start_q", "rad", "joint positions at the start"),
            context.joint_field(
                "goal_q", "rad", "joint positions at the goal", "target"
            ),
            position_field("start", low, high),
            position_field("goal", low, high),
        )

    def task_inputs(self, context: Context) -> Fields:
        return self.outputs(context)[:2]

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        return leave

    def prepare(self, context: Context) -> StageFunction:
        states = _EndStates(context, self)
        tip = context.kernels.load(tip_position)

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            scenes = candidates.scenes
            if scenes is None:
                # A plug-in may write the column "scene" without scenes.
                raise RecipeError(
                    [
                        "stage 'scene-ends' needs scenes: expected a stage 'draw-scenes' before it"
                    ]
                )
            pools = states.pools(scenes, random)
            numbers = candidates.draw(
                random, 1 + NUMBERS_PER_PAIR * MAX_PAIRS_PER_CANDIDATE
            )
            start, goal = states.pairs(scenes, pools, candidates.scene, numbers)
            candidates["start_q"] = start
            candidates["goal_q"] = goal
            candidates.reject(np.isfinite(start).all(axis=0), NO_ENDS)
            for end in ("start", "goal"):
                (candidates[f"{end}_xyz"],) = tip(candidates[f"{end}_q"])

        return work


class _Pool(NamedTuple):
    """Valid joint positions q [rad], shape (n, M), by scene and group, such as those of one grasp.

    The first state of each group has shape (groups + 1,), the first group of each scene
    (S + 1,).
    """

    q: Array
    first_state: Indices
    first_group: Indices

    def choose(
        self, scene: Indices, u: Array, v: Array, other_than: Indices | None = None
    ) -> tuple[Indices, Indices]:
        """Choose a group of each scene and one of its states by random numbers u and v, -1 where there is none.

        All arguments have shape (P,); groups in ``other_than`` are not chosen, -1
        excludes none.
        """
        first = self.first_group[scene]
        count = self.first_group[scene + 1] - first
        excluded = np.full(len(scene), -1) if other_than is None else other_than
        # Skip the excluded group: draw from one less, and shift those at or above it.
        without = count - (excluded >= 0)
        group = first + np.minimum(
            (u * without).astype(np.int64), np.maximum(without - 1, 0)
        )
        group += (excluded >= 0) & (group >= excluded)
        # Where no group is left, any valid index will do; -1 is returned for it.
        group = np.where(without > 0, group, 0)
        begin = self.first_state[group]
        size = (
            self.first_state[np.minimum(group + 1, len(self.first_state) - 1)] - begin
        )
        state = begin + np.minimum((v * size).astype(np.int64), np.maximum(size - 1, 0))
        exists = (without > 0) & (size > 0)
        return np.where(exists, group, -1), np.where(exists, state, -1)


def _make_pool(q: Array, key: Indices, scenes: int, groups: int) -> _Pool:
    """Return a pool of states, sorted by ``key``, which is the scene times ``groups`` plus the group."""
    present, first_state = np.unique(key, return_index=True)
    # Keys ascend by scene, so the groups of one scene are consecutive.
    first_group = np.searchsorted(present // groups, np.arange(scenes + 1))
    return _Pool(q, np.append(first_state, len(key)), first_group)


class _EndStates:
    """Valid states of the scenes of a batch, and pairs of them."""

    def __init__(self, context: Context, stage: SceneEnds) -> None:
        self._robot: Robot = context.robot
        self._stage = stage
        self._clearance = SceneClearance(context)
        loop = Loop(POSE_TOLERANCE, MAX_POSE_IK_STEPS)
        self._ik: Kernel = context.kernels.load(pose_ik_step, loop)
        self._torque: Kernel = context.kernels.load(torque_ratio)

    def pools(
        self, scenes: BatchScenes, random: np.random.Generator
    ) -> dict[str, _Pool]:
        """Draw states of all scenes and keep the valid ones."""
        robot = self._robot
        count = len(scenes)
        low = robot.position_lower[:, None]
        high = robot.position_upper[:, None]
        # All random numbers of a batch are drawn before any check, in a fixed order.
        neutral = robot.home[:, None] + self._stage.spread * random.standard_normal(
            (robot.n, count * NEUTRAL_STATES)
        )
        anywhere = low + (high - low) * random.random((robot.n, count * RANDOM_STATES))
        q, key = self._grasp_states(scenes, random)
        owners = [
            np.repeat(np.arange(count), each)
            for each in (NEUTRAL_STATES, RANDOM_STATES)
        ]
        states = np.concatenate([q, neutral, anywhere], axis=1)
        valid = self._are_valid(
            scenes, states, np.concatenate([key // self._stage.grasps, *owners])
        )
        masks = np.split(valid, np.cumsum([q.shape[1], neutral.shape[1]]))
        parts = zip(
            ("grasp", "neutral", "random"),
            (q, neutral, anywhere),
            (key, *owners),
            masks,
            strict=True,
        )
        groups = {"grasp": self._stage.grasps, "neutral": 1, "random": 1}
        return {
            name: _make_pool(each[:, mask], own[mask], count, groups[name])
            for name, each, own, mask in parts
        }

    def _are_valid(self, scenes: BatchScenes, q: Array, scene: Indices) -> Mask:
        """Return which states are within limits, can be held, and are clear in their scene, shape (K,)."""
        robot = self._robot
        valid = (
            (q >= robot.position_lower[:, None]) & (q <= robot.position_upper[:, None])
        ).all(axis=0)
        # Cheap tests first: collisions are checked for states that can be held.
        (ratio,) = self._torque(np.ascontiguousarray(q))
        chosen = np.flatnonzero(valid & (ratio[0] <= 1.0))
        # Sorted by scene, as ``are_clear`` requires.
        chosen = chosen[np.argsort(scene[chosen], kind="stable")]
        clear = self._clearance.are_clear(
            q[:, chosen], scene[chosen], scenes, self._stage.margin
        )
        valid = np.zeros(q.shape[1], bool)
        valid[chosen[clear]] = True
        return valid

    def _grasp_states(
        self, scenes: BatchScenes, random: np.random.Generator
    ) -> tuple[Array, Indices]:
        """Solve for poses at random grasps of each scene.

        Return joint positions and keys of the solved ones.
        """
        stage = self._stage
        robot = self._robot
        count = len(scenes)
        # Random order of the grasps of each scene; padding sorts last.
        order = random.random((count, scenes.grasp_tilt.shape[1]))
        order[np.arange(order.shape[1]) >= scenes.grasp_count[:, None]] = np.inf
        chosen = np.argsort(order, axis=1, kind="stable")[:, : stage.grasps]
        numbers = random.random((3 + robot.n, count, chosen.shape[1], stage.poses))
        exists = np.take_along_axis(order, chosen, axis=1) < 1.0
        scene, grasp = np.nonzero(exists)
        place = chosen[scene, grasp]
        # Pose by pose of every grasp.
        u = numbers[:, scene, grasp].reshape(len(numbers), -1)
        approach, tilt, position = (
            np.repeat(values[scene, place], stage.poses, axis=0)
            for values in (
                scenes.grasp_approach,
                scenes.grasp_tilt,
                scenes.grasp_position,
            )
        )
        # Poses within the tilt of the approach, uniform on the spherical cap.
        rotation = _rotations(approach, tilt, u[:3])
        low = robot.position_lower[:, None]
        high = robot.position_upper[:, None]
        lanes = [
            np.ascontiguousarray(each)
            for each in (low + (high - low) * u[3:], position.T, rotation)
        ]
        if not len(scene):
            return lanes[0], np.empty(0, np.int64)
        q, error = self._ik(*lanes)
        met = error[0] < POSE_TOLERANCE
        return q[:, met], np.repeat(scene * stage.grasps + grasp, stage.poses)[met]

    def pairs(
        self,
        scenes: BatchScenes,
        pools: dict[str, _Pool],
        scene: Indices,
        numbers: Array,
    ) -> tuple[Array, Array]:
        """Return starts and goals of the candidates [rad], nan without one, shape (n, N) each."""
        stage = self._stage
        size = (self._robot.n, len(scene))
        start = np.full(size, np.nan)
        goal = np.full(size, np.nan)
        # A share of the samples may have a free straight line; the others must need a
        # detour.
        may_be_straight = numbers[0] < stage.straight
        pending = np.arange(len(scene))
        used = np.empty(0, np.int64)
        for attempt in range(MAX_PAIRS_PER_CANDIDATE):
            first = 1 + NUMBERS_PER_PAIR * attempt
            q, aim, key = self._pair(
                pools,
                scene[pending],
                numbers[first : first + NUMBERS_PER_PAIR, pending],
            )
            # Every pair of states is used once in a batch.
            is_new = _is_first(np.append(used, key))[len(used) :]
            exists = is_new & np.isfinite(q).all(axis=0)
            accepted = exists & may_be_straight[pending]
            lines = np.flatnonzero(exists & ~accepted)
            accepted[lines] = self._lines_collide(
                scenes, q[:, lines], aim[:, lines], scene[pending[lines]]
            )
            used = np.append(used, key[accepted])
            start[:, pending[accepted]] = q[:, accepted]
            goal[:, pending[accepted]] = aim[:, accepted]
            pending = pending[~accepted]
            if not len(pending):
                break
        return start, goal

    def _pair(
        self, pools: dict[str, _Pool], scene: Indices, u: Array
    ) -> tuple[Array, Array, Indices]:
        """Choose a start and a goal of each scene, nan without one, shape (n, P) each, and a key of each pair."""
        group, target = pools["grasp"].choose(scene, u[0], u[1])
        chosen = {
            "grasp": pools["grasp"].choose(scene, u[3], u[4], other_than=group)[1],
            "neutral": pools["neutral"].choose(scene, u[3], u[4])[1],
            "random": pools["random"].choose(scene, u[3], u[4])[1],
        }
        ends = np.cumsum([getattr(self._stage, name) for name in chosen])
        kind = np.minimum(np.searchsorted(ends, u[2], side="right"), len(ends) - 1)
        start = np.choose(
            kind, [_taken(pools[name].q, state) for name, state in chosen.items()]
        )
        state = np.choose(kind, list(chosen.values()))
        goal = _taken(pools["grasp"].q, target)
        # One number for goal, kind and start, to find repeated pairs.
        key = (target * len(ends) + kind) * 2**31 + state
        return np.where(np.isfinite(goal), start, np.nan), goal, key

    def _lines_collide(
        self, scenes: BatchScenes, start: Array, goal: Array, scene: Indices
    ) -> Mask:
        """Return which straight lines have a state that is not clear, shape (P,).

        A few states are checked.
        """
        collides = np.zeros(len(scene), bool)
        # Most lines collide in the middle; only the others are checked more densely.
        for phases in (FIRST_PHASES, OTHER_PHASES):
            rest = np.flatnonzero(~collides)
            line = start[:, rest, None] + (goal - start)[:, rest, None] * np.array(
                phases
            )
            states = np.ascontiguousarray(line.reshape(len(start), -1))
            clear = self._clearance.are_clear(
                states, np.repeat(scene[rest], len(phases)), scenes
            )
            collides[rest] = ~clear.reshape(-1, len(phases)).all(axis=1)
        return collides


def _taken(q: Array, state: Indices) -> Array:
    """Return states by index, nan for -1, shape (n, P)."""
    if not q.shape[1]:
        return np.full((len(q), len(state)), np.nan)
    return np.where(state >= 0, q[:, np.maximum(state, 0)], np.nan)


def _is_first(key: Indices) -> Mask:
    """Return which entries do not occur before, shape (P,)."""
    first = np.zeros(len(key), bool)
    first[np.unique(key, return_index=True)[1]] = True
    return first


def _rotations(approach: Array, tilt: Array, u: Array) -> Array:
    """Return rotations, by rows, whose z axis is within a tilt of the approach.

    U are random numbers, shape (3, K).
    """
    # Uniform on a cap: the cosine is uniform between cos(tilt) and 1 (Archimedes).
    cosine = 1 - u[0] * (1 - np.cos(tilt))
    sine = np.sqrt(1 - cosine**2)
    angle = 2 * np.pi * u[1]
    roll = 2 * np.pi * u[2]
    first, second = _across(approach)
    z = (
        (sine * np.cos(angle))[:, None] * first
        + (sine * np.sin(angle))[:, None] * second
        + cosine[:, None] * approach
    )
    # A random roll about the approach completes the frame.
    first, second = _across(z)
    x = np.cos(roll)[:, None] * first + np.sin(roll)[:, None] * second
    y = np.cross(z, x)
    return np.stack([x, y, z], axis=2).reshape(-1, 9).T


def _across(axis: Array) -> tuple[Array, Array]:
    """Return two unit vectors that form a right-handed frame with unit vectors, shape (K, 3) each."""
    # An axis that is not nearly parallel, so that the cross product is well defined.
    helper = np.where(np.abs(axis[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(helper, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(axis, first)


def pose_ik_step(robot: Robot) -> Any:
    """Build ``(q, position, rotation by rows) -> (next q, |error|)``; steps end at the joint limits.

    The error is the distance from the position, and the rotation vector to the rotation
    times ``METERS_PER_RADIAN``, stretched to twice the tangent of half the angle, so
    that rotations by 180 degrees are no fixed point.
    """
    import casadi as ca

    (q_sx, q), (p_sx, p), (r_sx, r) = (
        symbols(name, width) for name, width in (("q", robot.n), ("p", 3), ("r", 9))
    )
    kin = forward_kinematics(robot.chain, q)
    target = [r[0:3], r[3:6], r[6:9]]
    # target times the transposed rotation
    relative = [[dot(a, b) for b in kin.rotation] for a in target]
    trace = relative[0][0] + relative[1][1] + relative[2][2]
    # The vector of the skew part is 2 sin(angle) axis and the trace 1 + 2 cos(angle),
    # so 2 turn / (1 + trace) = 2 tan(angle / 2) axis.
    stretch = METERS_PER_RADIAN * 2.0 / ca.fmax(1.0 + trace, 1e-2)
    turn = [
        relative[2][1] - relative[1][2],
        relative[0][2] - relative[2][0],
        relative[1][0] - relative[0][1],
    ]
    # Six rows: position [m], and rotation vector times ``METERS_PER_RADIAN``.
    error = [*subtract(p, kin.tip), *scale(turn, stretch)]
    axes = [
        axis if turns else [0.0] * 3
        for axis, turns in zip(kin.axes, kin.revolute, strict=True)
    ]
    rows = [[column[row] for column in kin.jacobian] for row in range(3)]
    rows += [[METERS_PER_RADIAN * axis[row] for axis in axes] for row in range(3)]
    # Levenberg-Marquardt damping by the squared error: small near a solution, so the
    # convergence there is superlinear.
    square = dot(error, error)
    step, _ = clipped_step(
        rows, error, MAX_POSE_IK_STEP_RAD, POSE_DAMPING * square + MIN_DAMPING
    )
    following = clip_to_limits(add(q, step), robot)
    return ca.Function(
        "pose_ik", [q_sx, p_sx, r_sx], [ca.vertcat(*following), ca.sqrt(square)]
    )
