"""Arms that are chains of any number of joints, which only their limits bound."""

from pathlib import Path

from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem

LINK = """<link name="l{k}"><inertial><mass value="1"/><origin xyz="0.05 0.01 0"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="j{k}" type="revolute"><parent link="l{before}"/><child link="l{k}"/><origin xyz="0.1 0 0"/>
<axis xyz="{x} {y} {z}"/><limit lower="-3" upper="3" velocity="2" effort="80"/></joint>"""
USES = ("joint-position", "joint-velocity", "joint-acceleration", "joint-torque")


def chain(folder: Path, joints: int, *, jerk: bool) -> Problem:
    """Write a chain's files to a folder; with limits of jerks if wanted."""
    parts = [LINK.format(k=0)]
    for k in range(1, joints + 1):
        x, y, z = (int(k % 3 == axis) for axis in range(3))
        parts += [LINK.format(k=k), JOINT.format(k=k, before=k - 1, x=x, y=y, z=z)]
    (folder / "chain.urdf").write_text(
        f'<robot name="chain">{"".join(parts)}</robot>', encoding="utf-8"
    )
    names, base = (
        [text.format(k=k) for k in range(1, joints + 1)] for text in ('"j{k}"', "0.1")
    )
    head = f"""name = "chain"
[robot]
urdf = "chain.urdf"
joints = [{", ".join(names)}]
tip = "l{joints}"
base = "[{", ".join(base)}] rad"
[limits]
acceleration_cap = "10 rad/s^2"
{'jerk = "300 rad/s^3"' if jerk else ""}
"""
    uses = (*USES, "joint-jerk") if jerk else USES
    tolerances = ("1e-3 rad" if each == "joint-position" else "0.5 %" for each in uses)
    pairs = zip(uses, tolerances, strict=True)
    bounded = "".join(
        f'[[constraint]]\nuse = "{use}"\ntolerance = "{tolerance}"\n'
        for use, tolerance in pairs
    )
    path = folder / "problem.toml"
    path.write_text(head + bounded, encoding="utf-8")
    return load_problem(str(path))
