"""Scenes of datasets as obstacles."""

from cnpgen.problems.scenes.scene_problem import make_obstacle
from cnpgen.robots.obstacle import Obstacle
from cnpgen.store.scene_table import OBSTACLE_KINDS, SceneTable

_NUMBERS_OF_SIZE = {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2}


def obstacles_of(table: SceneTable, scene: int) -> tuple[Obstacle, ...]:
    """Return the obstacles of one scene.

    Args:
        table: The scenes.
        scene: Index of the scene in the table.
    """
    obstacles, place = list[Obstacle](), f"scene {int(table.scene_ids[scene])}"
    for index in range(int(table.obstacle_count[scene])):
        kind = OBSTACLE_KINDS[int(table.obstacle_kind[scene, index])]
        sizes = table.obstacle_size[scene, index, : _NUMBERS_OF_SIZE[kind]]
        pose = table.obstacle_position[scene, index], table.obstacle_quaternion[scene, index]
        obstacles.append(make_obstacle(f"{kind} {index + 1}", kind, sizes, *pose, place=place))
    return tuple(obstacles)
