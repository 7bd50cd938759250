"""The workspace of an arm: a base configuration in front of it, and two boxes of reachable positions."""

import math
from dataclasses import replace

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.documents import Names
from cnpgen.errors import RecipeError
from cnpgen.kernels.library import choose_backend
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.draw import DrawPositions
from cnpgen.problems.constraints.joint import JointTorque
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.link_pairs import LinkContact, body_of_part, joint_poses
from cnpgen.schema.keys import Range
from cnpgen.world.world import World

BASE_CANDIDATES = 4000  # random states; the base configuration is one of them
LIMIT_SHARE = 0.1  # share of a joint's range at either end that is left out
MAX_LOAD = 0.7  # share of the torque limits that the base configuration may use at rest
# Between links at the base configuration, if a state has it.
MIN_LINK_CLEARANCE_M = 5e-3
MAX_CLEARANCE_CHECKS = 500  # free states whose clearance is measured
# Edge of the boxes / reach, the largest first.
BOX_SIZES = 0.3, 0.22, 0.16, 0.11, 0.08, 0.05
MIN_BOX_DISTANCE = 0.15  # distance of the boxes / reach, so that no task is trivial
GOOD_YIELD = 0.5  # share of accepted candidates at which the search for a box ends
MIN_YIELD = 0.02  # share below which no box is usable
YIELD_ROWS = 512  # samples that measure the share
ROUNDING_M = 1e-3  # of the corners of boxes
MIN_TIP_TRAVEL_M = 1e-6  # a tip that moves less along an axis does not move along it


def comfortable_base(problem: Problem, robot: Robot) -> tuple[tuple[float, ...], Names]:
    """Find a configuration with the tip in front of the robot, far from its limits and with high manipulability.

    Random states with the tip ahead along x and above the ground are preferred. The
    best one has the largest product of the singular values of the tip's Jacobian and
    the distance from the nearest limit. If no state is free of collisions and within
    the torque limits, the best of the others is returned.

    Returns:
        Joint positions [rad], rounded, and notes about conditions that it does not
        meet.
    """
    world = World(robot)
    states = _states(robot)
    tips, values, load = _measure_states(world, states)
    if not any(isinstance(each, JointTorque) for each in problem.constraint):
        load[:] = 0.0
    order = np.argsort(-_scores(robot, states, values), kind="stable")
    free = _free_states(robot, states)
    light = load <= MAX_LOAD
    # Groups of states from the best to the least demanding one.
    groups = [
        _are_in_front(robot, tips) & light,
        light,
        load <= 1,
        np.ones(len(states), bool),
    ]
    # Distances between links take long, so only the best states of a group are
    # measured.
    for group in groups[:3]:
        for k in order[(group & free)[order]][:MAX_CLEARANCE_CHECKS]:
            if _clearance(world, states[k]) > MIN_LINK_CLEARANCE_M:
                return tuple(states[k].tolist()), ()
    notes: Names = ()
    if not (groups[2] & free).any():
        text = f"in all of {BASE_CANDIDATES:,} random states links collide or gravity needs too much torque"
        notes = (f"{text}: choose the base configuration by hand",)
    best = next(
        group
        for group in [*(group & free for group in groups[:3]), *groups]
        if group.any()
    )
    return tuple(states[order[best[order]][0]].tolist()), notes


def _scores(robot: Robot, states: Array, values: Array) -> Array:
    """Return manipulability times the distance from the limits, by singular values of shape (N, k); shape (N,)."""
    lower = robot.position_lower
    upper = robot.position_upper
    # 1 in the middle of all joints, 0 at a limit of one of them.
    offsets = (states - (upper + lower) / 2) / ((upper - lower) / 2)
    # Directions in which the tip of an arm of fewer joints never moves do not count.
    moves = values.max(axis=0) > MIN_TIP_TRAVEL_M
    return np.asarray(values[:, moves].prod(axis=1) * (1 - np.abs(offsets).max(axis=1)))


def _are_in_front(robot: Robot, tips: Array) -> Mask:
    """Return a mask of the tips ahead of the first joint along x and above the ground, shape (N,)."""
    x, y, _ = (tips - robot.chain.joints[0].translation).T
    return np.asarray((x > 0) & (np.abs(y) <= 0.2 * x) & (tips[:, 2] >= 0))


def _states(robot: Robot) -> Array:
    """Return random states away from the limits [rad], shape (N, n), rounded."""
    shares = np.random.default_rng(0).uniform(
        LIMIT_SHARE, 1 - LIMIT_SHARE, (BASE_CANDIDATES, robot.n)
    )
    return (
        robot.position_lower + shares * (robot.position_upper - robot.position_lower)
    ).round(3)


def _measure_states(world: World, states: Array) -> tuple[Array, Array, Array]:
    """Return tips [m], (N, 3), singular values of their Jacobians, (N, min(3, n)), shares of torque limits, (N,)."""
    tips = []
    values = []
    load = []
    still = np.zeros(world.robot.n)
    for q in states:
        world.set_state(q, still, still, np.zeros(0))
        tips.append(world.tip_position)
        values.append(np.linalg.svd(world.tip_jacobian, compute_uv=False))
        load.append(np.abs(world.holding_torque / world.robot.holding_limit).max())
    return np.array(tips), np.array(values), np.array(load)


def _free_states(robot: Robot, states: Array) -> Mask:
    """Return a mask of the states without collisions of links, shape (N,)."""
    free = np.ones(len(states), bool)
    shape = robot.shape
    if shape is not None:
        poses = joint_poses(robot.model, states)
        contact = LinkContact(
            poses, map(body_of_part, shape.convex_parts), shape.joints
        )
        for pair in shape.pairs:
            if not pair.left_out:
                free &= ~contact.of(pair.first, pair.second, among=free)
    return free


def _clearance(world: World, q: Array) -> float:
    """Return the minimum distance of the links at a state [m]."""
    if world.robot.shape is None:
        return np.inf
    still = np.zeros(world.robot.n)
    world.set_state(q, still, still, np.zeros(0))
    return min(world.self_distances(), default=np.inf)


def find_boxes(pipeline: Pipeline) -> tuple[Pipeline, float]:
    """Return a pipeline with boxes of positions in its first stage, and the share of accepted candidates.

    The boxes of start and goal are side by side about the tip of the base
    configuration. They are tried from the largest to the smallest. The first with more
    than half of the candidates accepted is returned, or else the one with the largest
    share.

    Raises:
        RecipeError: No box has enough accepted candidates.
    """
    robot = load_robot(pipeline.problem)
    world = World(robot)
    tips = _measure_states(world, _states(robot)[:500])[0]
    # At the base configuration.
    world = World(robot)
    centre = world.tip_position
    reach = float(
        np.linalg.norm(tips - robot.chain.joints[0].translation, axis=1).max()
    )
    moves = np.ptp(tips, axis=0) > MIN_TIP_TRAVEL_M
    found: list[tuple[float, Pipeline]] = []
    for size in BOX_SIZES:
        boxes = _boxes(centre, size * reach, moves, MIN_BOX_DISTANCE * reach)
        candidate = replace(pipeline, stage=(boxes, *pipeline.stage[1:]))
        found.append((_accepted(candidate), candidate))
        if found[-1][0] >= GOOD_YIELD:
            break
    share, best = max(found, key=lambda each: each[0])
    if share < MIN_YIELD:
        where = ", ".join(f"{each:.2f}" for each in centre)
        text = f"the tip reaches less than {100 * MIN_YIELD:g} % of every box of positions near ({where}) m"
        raise RecipeError(
            [
                f"{robot.urdf}: {text}; choose another --tip, or copy a recipe and write its boxes by hand"
            ]
        )
    return best, share


def _boxes(centre: Array, edge: float, moves: Mask, distance: float) -> DrawPositions:
    """Return two boxes side by side, along y if the tip moves along it.

    Flat along axes along which it does not.
    """
    aside = next((axis for axis in (1, 2, 0) if moves[axis]), 1)
    # Half of edge and distance on either side of the center.
    shift = np.where(np.arange(3) == aside, (edge + distance) / 2 + ROUNDING_M, 0.0)

    def box(position: Array) -> tuple[Range, Range, Range]:
        x, y, z = (
            Range(round(at - edge / 2, 3), round(at + edge / 2, 3))
            if free
            else Range(at, at)
            for at, free in zip(position.tolist(), moves.tolist(), strict=True)
        )
        return x, y, z

    # In the horizontal plane.
    min_distance = math.floor(1e3 * distance) / 1e3 if aside < 2 else 0.0
    return DrawPositions(
        start=box(centre - shift), goal=box(centre + shift), min_distance=min_distance
    )


def _accepted(pipeline: Pipeline) -> float:
    """Return the share of accepted candidates."""
    backend, cache_folder = choose_backend(None)
    prepared = PreparedPipeline(pipeline, backend=backend, cache_folder=cache_folder)
    try:
        sampling = prepared.block(0, "train", 0, stop=YIELD_ROWS).sampling
    except RecipeError:
        # Too few candidates are accepted.
        return 0.0
    return sampling.accepted / sampling.tried
