"""A pipeline whose samples have scenes, for an arm of seven joints whose links are spheres."""

from pathlib import Path

from cnpgen.problems.scenes.scene_problem import make_obstacle
from cnpgen.robots.obstacle import Obstacle
from cnpgen.store.scene_table import OBSTACLE_KINDS, SceneTable
from tests.examples.chains import chain

SPHERE = '<collision><origin xyz="0.05 0 0"/><geometry><sphere radius="0.02"/></geometry></collision></link>'
CLEARANCE = '[[constraint]]\nuse = "robot-clearance"\ntolerance = "0.1 mm"\n'
PIPELINE = """name = "scenes"
problem = "problem.toml"
[[stage]]
use = "draw-scenes"
per_scene = 5
capacity = { box = 6, cylinder = 4, sphere = 4 }
[[stage.family]]
use = "free"
count = [3, 6]
spheres = 0.3
size = "[5, 20] cm"
[[stage.family]]
use = "tabletop"
share = 0.5
tables = [1, 1]
objects = [1, 3]
[[stage]]
use = "scene-ends"
straight = 0.5
[[stage]]
use = "at-rest"
end = "start"
[[stage]]
use = "at-rest"
end = "goal"
"""


def write_arm(folder: Path) -> Path:
    """Write the arm's files to a folder; return the problem file."""
    chain(folder, 7, jerk=False)
    urdf, file = folder / "chain.urdf", folder / "problem.toml"
    urdf.write_text(urdf.read_text().replace("</link>", SPHERE))
    file.write_text(
        file.read_text().replace("[limits]", 'geometry = "urdf"\n[limits]') + CLEARANCE
    )
    return file


def write_scene_pipeline(folder: Path, text: str = PIPELINE) -> Path:
    """Write a pipeline with scenes and its problem to a folder; return the pipeline file."""
    write_arm(folder)
    path = folder / "scenes.toml"
    path.write_text(text)
    return path


def obstacles_of(table: SceneTable, scene: int) -> tuple[Obstacle, ...]:
    """The obstacles of one scene of a dataset."""
    numbers, obstacles = (
        {"box": 3, "sphere": 1, "cylinder": 2, "capsule": 2},
        list[Obstacle](),
    )
    for index in range(int(table.obstacle_count[scene])):
        kind = OBSTACLE_KINDS[int(table.obstacle_kind[scene, index])]
        sizes = table.obstacle_size[scene, index, : numbers[kind]]
        pose = (
            table.obstacle_position[scene, index],
            table.obstacle_quaternion[scene, index],
        )
        obstacles.append(
            make_obstacle(f"{kind} {index + 1}", kind, sizes, *pose, place="a dataset")
        )
    return tuple(obstacles)
