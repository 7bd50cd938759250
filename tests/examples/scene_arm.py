"""A pipeline whose samples have scenes, for an arm of seven joints whose links are spheres."""

from pathlib import Path

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
    file.write_text(file.read_text().replace("[limits]", 'geometry = "urdf"\n[limits]') + CLEARANCE)
    return file


def write_scene_pipeline(folder: Path, text: str = PIPELINE) -> Path:
    """Write a pipeline with scenes and its problem to a folder; return the pipeline file."""
    write_arm(folder)
    path = folder / "scenes.toml"
    path.write_text(text)
    return path
