"""Convex parts of meshes: they cover the mesh, are smaller than its hull, and are found once."""

import os
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from cnpgen.errors import MachineError, RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.shape.decomposition import MAX_TRIANGLE_OVERHANG_M, assign_triangles, convex_parts
from tests.examples.shaped_robot import stl, write_problem

# A channel along x: a floor and two walls [m], lowest and highest corners.
BOXES = np.array(
    [
        [[0, -0.05, 0], [0.3, 0.05, 0.01]],
        [[0, -0.05, 0.01], [0.3, -0.04, 0.08]],
        [[0, 0.04, 0.01], [0.3, 0.05, 0.08]],
    ]
)
# In the place of CoACD: it finds the boxes, a tenth of a millimetre too small.
STAND_IN = f"""
import numpy as np
class Mesh:
    def __init__(self, points, triangles):
        assert len(points) == len(np.unique(points, axis=0)) and triangles.max() < len(points)
def set_log_level(level):
    pass
def run_coacd(mesh, max_convex_hull, seed):
    if max_convex_hull == 13:
        raise RuntimeError("no such random numbers")
    with open(__file__ + ".runs", "a") as runs:
        runs.write("again ")
    boxes = np.array({BOXES.tolist()!r})
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    return [(low + 1e-4 + corners * (high - low - 2e-4), None) for low, high in boxes]
"""


def box(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The triangles of a box, shape (12, 3, 3), facing outwards."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    hull = ConvexHull(corners)
    inwards = np.linalg.det(corners[hull.simplices] - (low + high) / 2) < 0
    sides = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    return corners[sides]


CHANNEL = np.concatenate([box(*each) for each in BOXES])


def covered(points: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
    """Return a mask of the points in one of the hulls, within a nanometre, by SciPy's Delaunay triangulation."""
    grown = [part.mean(axis=0) + (part - part.mean(axis=0)) * (1 + 1e-6) for part in parts]
    return np.any([Delaunay(part).find_simplex(points) >= 0 for part in grown], axis=0)


def volume(parts: list[np.ndarray]) -> float:
    return sum(ConvexHull(part).volume for part in parts)


def on_triangles(triangles: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points on triangles."""
    shares = rng.dirichlet([1, 1, 1], (len(triangles), 200))
    return (shares @ triangles).reshape(-1, 3)


@pytest.mark.parametrize("across", [False, True])
def test_every_point_of_a_mesh_is_in_a_part(across):
    parts = [box(low + 1e-4, high - 1e-4).reshape(-1, 3) for low, high in BOXES]
    if across:  # parts cut across triangles that are as long as the channel
        parts = [part * [0.5, 1, 1] + [shift, 0, 0] for part in parts for shift in (0, 0.15)]
    found = assign_triangles(CHANNEL, parts)
    assert len(found) == len(parts)
    assert covered(on_triangles(CHANNEL, np.random.default_rng(1)), found).all()
    assert volume(found) < volume(parts) * (1.25 if across else 1.1)
    for part, given in zip(found, parts, strict=True):
        equations = ConvexHull(given).equations
        assert (part @ equations[:, :3].T + equations[:, 3]).max() <= MAX_TRIANGLE_OVERHANG_M


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A folder with a package that is called coacd."""
    folder = tmp_path / "packages"
    (folder / "coacd-1.0.dist-info").mkdir(parents=True)
    (folder / "coacd-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: coacd\nVersion: 1.0\n")
    (folder / "coacd.py").write_text(STAND_IN)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]))
    monkeypatch.syspath_prepend(folder)
    return folder


def channel_problem(folder: Path, more: str = "") -> Problem:
    """The small arm with a channel in its hand."""
    file = write_problem(folder)
    (folder / "crane" / "channel.stl").write_bytes(
        stl(CHANNEL.reshape(-1, 3), [(k, k + 1, k + 2) for k in range(0, 3 * len(CHANNEL), 3)])
    )
    urdf = folder / "crane" / "crane.urdf"
    urdf.write_text(urdf.read_text().replace("meshes/claw.obj", "channel.stl"))
    file.write_text(file.read_text().replace('tip = "hand"', f'tip = "hand"\n{more}'))
    return load_problem(file)


@pytest.mark.slow
def test_a_robot_is_judged_by_the_parts_of_its_meshes(tmp_path, stand_in, monkeypatch):
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))
    problem = channel_problem(tmp_path, "convex_parts = 3")
    shape = load_robot(problem).shape
    assert [piece.link for piece in shape.convex_parts].count("claw") == 3
    assert [piece.link for piece in shape.convex_parts].count("fore") == 1  # a wedge is convex
    hull = load_robot(channel_problem(tmp_path / "hull")).shape
    assert [piece.link for piece in hull.convex_parts].count("claw") == 1
    again = channel_problem(tmp_path / "again", "convex_parts = 3")
    assert again.urdf_text == problem.urdf_text
    assert (stand_in / "coacd.py.runs").read_text() == "again "  # once: then its answer is kept
    assert open_problem(record_problem(again))[0].urdf_text == problem.urdf_text  # whoever reads a plan needs no CoACD


def test_where_parts_are_no_smaller_the_hull_stays(tmp_path, stand_in):
    low, high = np.zeros(3), np.ones(3)
    corners = box(low, high)
    parts = convex_parts(corners.reshape(-1, 3), np.arange(36).reshape(-1, 3), 8, None)
    assert [len(part) for part in parts] == [8]
    assert not (stand_in / "coacd.py.runs").exists()


def test_without_coacd_it_is_said_what_to_install(monkeypatch):
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    with pytest.raises(MachineError, match=r"pip install 'cnpgen\[decompose\]'"):
        convex_parts(CHANNEL.reshape(-1, 3), np.arange(108).reshape(-1, 3), 8, None)


def test_what_coacd_cannot_do_is_said_with_the_mesh(tmp_path, stand_in, monkeypatch):
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))
    with pytest.raises(
        RecipeError, match=r"channel\.stl: CoACD cannot decompose a mesh: RuntimeError: no such random numbers"
    ):
        load_robot(channel_problem(tmp_path, "convex_parts = 13"))


def test_a_line_has_no_meshes_to_decompose(tmp_path):
    with pytest.raises(RecipeError, match=r"robot\.convex_parts.*meshes matter with geometry"):
        channel_problem(tmp_path, 'convex_parts = 3\ngeometry = "paper-capsules"')


@pytest.mark.extended
@pytest.mark.skipif(find_spec("coacd") is None, reason="CoACD is not installed")
def test_coacd_decomposes_a_channel():
    parts = convex_parts(CHANNEL.reshape(-1, 3), np.arange(108).reshape(-1, 3), 8, None)
    assert covered(on_triangles(CHANNEL, np.random.default_rng(2)), parts).all()
    assert volume(parts) < 0.5 * ConvexHull(CHANNEL.reshape(-1, 3)).volume
