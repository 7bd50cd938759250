"""Where an arm works: a comfortable configuration in front of it, and two boxes of positions that it reaches."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.kernels.library import choose_backend
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.draw import DrawPositions
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.problem import Problem
from cnpgen.problems.robot import load_robot
from cnpgen.robots.robot import Robot
from cnpgen.schema.keys import Range
from cnpgen.world.state import World

Array = NDArray[np.float64]

STATES = 4000  # random ones of which the base configuration is one
INSIDE = 0.1  # share of a joint's range at either end that they leave out
LOAD = 0.7  # of its torque limits that standing still there may take
APART = 5e-3  # m: between links there
SIZES = (0.3, 0.22, 0.16, 0.11, 0.08, 0.05)  # edge of the boxes / reach, the largest first
ENOUGH = 0.5  # share of draws that must be accepted of a box, unless none has so many
HARDLY = 0.02  # share below which boxes are of no use
ROWS = 512  # that are drawn to find the share out
FLAT = 1e-6  # m: a tip that moves less along an axis does not move along it


def comfortable_base(problem: Problem, robot: Robot) -> tuple[float, ...]:
    """Find a configuration with the tip in front of the robot, far from its limits and with much room to move.

    Of random states those count whose tip is ahead along x and not below the ground; if there are none, all. The best
    has the largest product of the singular values of the tip's Jacobian with the distance from the nearest limit.

    Returns:
        Joint positions [rad], rounded.

    Raises:
        RecipeError: In all states links touch each other, or it takes too much torque to stand still.
    """
    world, states = World(robot), _states(robot)
    tips, values, load = _looked_at(world, states)
    if not any(isinstance(each, JointTorque) for each in problem.constraint):
        load[:] = 0.0
    middle, half = (robot.position_upper + robot.position_lower) / 2, (robot.position_upper - robot.position_lower) / 2
    room = 1 - np.abs((states - middle) / half).max(axis=1)
    moves = values.max(axis=0) > FLAT
    score = values[:, moves].prod(axis=1) * room
    ahead = tips - robot.chain.joints[0].translation
    front = (ahead[:, 0] > 0) & (np.abs(ahead[:, 1]) <= 0.2 * ahead[:, 0]) & (tips[:, 2] >= 0)
    for group in (front, np.ones(len(states), bool)):
        for k in sorted(np.flatnonzero(group & (load <= LOAD)), key=lambda k: -score[k]):
            if _is_free(world, states[k]):
                return tuple(states[k].tolist())
    text = f"in all of {STATES:,} random states links touch each other, or it takes too much torque to stand still"
    raise RecipeError([f"{robot.urdf}: {text}"])


def _states(robot: Robot) -> Array:
    """Return random states away from the limits [rad], shape (N, n), rounded."""
    shares = np.random.default_rng(0).uniform(INSIDE, 1 - INSIDE, (STATES, robot.n))
    return np.asarray((robot.position_lower + shares * (robot.position_upper - robot.position_lower)).round(3))


def _looked_at(world: World, states: Array) -> tuple[Array, Array, Array]:
    """Return tips [m], (N, 3), singular values of their Jacobians, (N, min(3, n)), shares of torque limits, (N,)."""
    tips, values, load, still = [], [], [], np.zeros(world.robot.n)
    for q in states:
        world.set_state(q, still, still, np.zeros(0))
        tips.append(world.tip_position)
        values.append(np.linalg.svd(world.tip_jacobian, compute_uv=False))
        load.append(np.abs(world.holding_torque / world.robot.torque_limit).max())
    return np.array(tips), np.array(values), np.array(load)


def _is_free(world: World, q: Array) -> bool:
    """Whether links are apart at a state."""
    if world.robot.shape is None:
        return True
    still = np.zeros(world.robot.n)
    world.set_state(q, still, still, np.zeros(0))
    return min(world.self_distances(), default=np.inf) > APART


def find_boxes(pipeline: Pipeline) -> tuple[Pipeline, float]:
    """Find boxes of start and goal positions, side by side about the tip of the base configuration.

    Boxes are tried from the largest to the smallest: the first is taken of whose draws more than half are accepted,
    or else the one with most.

    Args:
        pipeline: Its first stage draws positions.

    Returns:
        The pipeline with the boxes, and the share of draws that is accepted.

    Raises:
        RecipeError: Hardly any draw is accepted of any box.
    """
    robot = load_robot(pipeline.problem)
    world = World(robot)
    tips = _looked_at(world, _states(robot)[:500])[0]
    world = World(robot)  # at the base configuration
    middle, reach = world.tip_position, float(np.linalg.norm(tips - robot.chain.joints[0].translation, axis=1).max())
    moves = np.ptp(tips, axis=0) > FLAT
    found: list[tuple[float, Pipeline]] = []
    for size in SIZES:
        candidate = replace(pipeline, stage=(_boxes(middle, size * reach, moves), *pipeline.stage[1:]))
        found.append((_accepted(candidate), candidate))
        if found[-1][0] >= ENOUGH:
            break
    share, best = max(found, key=lambda each: each[0])
    if share < HARDLY:
        where = ", ".join(f"{each:.2f}" for each in middle)
        text = f"the tip reaches less than {100 * HARDLY:g} % of every box of positions near ({where}) m"
        raise RecipeError([f"{robot.urdf}: {text}; choose another --tip, or copy a recipe and write its boxes by hand"])
    return best, share


def _boxes(middle: Array, edge: float, moves: NDArray[np.bool_]) -> DrawPositions:
    """Return two boxes side by side, along y if the tip moves along it; flat along axes along which it does not."""
    aside = next((axis for axis in (1, 2, 0) if moves[axis]), 1)
    shift = np.where(np.arange(3) == aside, 0.75 * edge, 0.0)

    def box(centre: Array) -> tuple[Range, Range, Range]:
        x, y, z = (
            Range(round(at - edge / 2, 3), round(at + edge / 2, 3)) if free else Range(at, at)
            for at, free in zip(centre.tolist(), moves.tolist(), strict=True)
        )
        return x, y, z

    return DrawPositions(start=box(middle - shift), goal=box(middle + shift))


def _accepted(pipeline: Pipeline) -> float:
    """Return the share of draws that is accepted."""
    backend, cache_folder = choose_backend(None)
    prepared = PreparedPipeline(pipeline, backend=backend, cache_folder=cache_folder)
    try:
        fates = prepared.block(0, "train", 0, stop=ROWS).fates
    except RecipeError:  # practically none
        return 0.0
    return fates.accepted / fates.tried
