"""Initial paths among obstacles from compiled trees, for problems whose states at rest are free of equalities.

Several trees with different margins grow in milliseconds; deeper ones follow where few of them connect. Their paths are
sorted by an estimated duration.
"""

from dataclasses import replace
from itertools import count, islice

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.collision.tree_search import TreeSettings, estimated_duration, find_tree_path
from cnpgen.refine.rrt_connect import MAX_TURN, RestSpace
from cnpgen.refine.solver.hulls import Hulls
from cnpgen.refine.task import RefinementTask

Array = NDArray[np.float64]

TREE_MARGINS_M = (6e-3, 3e-3, 1e-3, 0.0)  # of the trees in turn, added to the required distances
TREE_ROUNDS = ((12, 4_000), (8, 16_000), (4, 64_000))  # trees and their extensions, until there are enough paths
MIN_TREE_PATHS, MAX_TREE_PATHS = 3, 8
TREE_SHORTCUTS = 400  # attempted on a path


def find_obstacle_paths(task: RefinementTask, space: RestSpace, hulls: Hulls) -> list[Array]:
    """Search for paths between the ends of a task.

    Args:
        task: The task.
        space: Valid states at rest; conditions other than distances are checked on the paths, not in the trees.
        hulls: Clearances of the hulls with compiled checks.

    Returns:
        At most ``MAX_TREE_PATHS`` paths, corners of shape (K, n) each. Those that meet all conditions at rest come
        first, sorted by their estimated duration.
    """
    robot, paths = space.robot, list[Array]()
    start, goal = task.boundary.start_q[0], task.boundary.goal_q[0]
    box = (
        np.maximum(robot.position_lower, np.minimum(start, goal) - MAX_TURN),
        np.minimum(robot.position_upper, np.maximum(start, goal) + MAX_TURN),
    )
    checker = hulls.placed_checker(task.scene.poses[0])
    settings = TreeSettings(hulls.obstacle_distance, hulls.self_distance, shortcuts=TREE_SHORTCUTS)
    seeds = count()
    for trees, extensions in TREE_ROUNDS:
        for seed in islice(seeds, trees):
            margin = TREE_MARGINS_M[seed % len(TREE_MARGINS_M)]
            tree = replace(settings, margin=margin, max_extensions=extensions)
            path = find_tree_path(checker, (start, goal), box, robot.velocity_limit, tree, seed=seed)
            if path is not None:
                paths.append(path)
            if path is not None and len(path) == 2:  # the straight line is free
                return [path]
        if len(paths) >= MIN_TREE_PATHS:
            break
    durations = [
        (not space.meets_other_conditions(path), estimated_duration(path, robot.velocity_limit)) for path in paths
    ]
    return [paths[index] for index in sorted(range(len(paths)), key=durations.__getitem__)[:MAX_TREE_PATHS]]
