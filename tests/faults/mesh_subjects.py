"""The files beside the URDF of a robot with link geometry: meshes in three formats, and an SRDF."""

import shutil
from pathlib import Path
from random import Random

from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from tests.examples.shaped_robot import LINKS, write_crane, write_problem
from tests.faults.mutations import change_bytes, change_text, change_urdf

MESHES = ("wedge.stl", "claw.obj", "rail.dae")
RAIL = '<geometry><mesh filename="meshes/rail.dae"/></geometry>'
_SRDF = """<robot name="crane">
<group name="arm"><chain base_link="base" tip_link="hand"/></group>
<disable_collisions link1="base" link2="claw" reason="Never"/>
<disable_collisions link1="fore" link2="hand" reason="Adjacent"/>
<disable_collisions link1="hand" link2="claw" reason="Adjacent"/>
</robot>
"""
_DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1" name="meter"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="rail"><mesh>
<source id="points"><float_array id="values" count="12">
0 -0.02 -0.01
0 0.02 -0.01
0 0 0.02
0.06 0 0
</float_array><technique_common><accessor source="#values" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<vertices id="corners"><input semantic="POSITION" source="#points"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#corners" offset="0"/>
<p>0 2 1 0 1 3 1 2 3 2 0 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="node">
<instance_geometry url="#rail"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene>
</COLLADA>
"""


def make_mesh_files(folder: Path) -> None:
    """Write a robot with meshes in three formats and an SRDF, and a problem of it."""
    write_problem(folder, robot='srdf = "crane/crane.srdf"')
    # Capsules are fitted to each link with shapes, which takes most time of a reading.
    shapes = {"base": [RAIL], "fore": LINKS["fore"], "claw": LINKS["claw"]}
    write_crane(folder, {name: shapes.get(name, []) for name in LINKS})
    (folder / "crane" / "crane.srdf").write_text(_SRDF, encoding="utf-8")
    (folder / "crane" / "meshes" / "rail.dae").write_text(_DAE, encoding="utf-8")


def change_mesh(good: Path, folder: Path, draw: Random) -> None:
    """Change one mesh: its bytes, or its text if it is one."""
    shutil.copytree(good / "crane", folder / "crane")
    path = folder / "crane" / "crane" / "meshes" / draw.choice(MESHES)
    content = path.read_bytes()
    if path.suffix == ".stl" or draw.random() < 0.3:
        path.write_bytes(change_bytes(content, draw))
        return
    separator = " " if path.suffix == ".obj" else ">"
    lines = content.decode().replace(separator, f"={separator}")
    changed = change_text(lines, draw).replace(f"={separator}", separator)
    path.write_text(changed, encoding="utf-8", errors="replace")


def change_srdf(good: Path, folder: Path, draw: Random) -> None:
    """Change an SRDF as a URDF or byte by byte."""
    shutil.copytree(good / "crane", folder / "crane")
    path = folder / "crane" / "crane" / "crane.srdf"
    if draw.random() < 0.2:
        path.write_bytes(change_bytes(path.read_bytes(), draw))
        return
    text = change_urdf(path.read_text(encoding="utf-8"), draw)
    path.write_text(text, encoding="utf-8", errors="replace")


def read_shaped_robot(folder: Path, draw: Random) -> None:
    """Read a robot whose links have meshes and whose pairs are those of an SRDF."""
    robot = load_robot(load_problem(folder / "crane" / "problem.toml"))
    assert robot.shape is not None
