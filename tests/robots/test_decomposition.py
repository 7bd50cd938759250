"""Convex parts of meshes: they cover the mesh, are smaller than its hull, and are computed once."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import scipy

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.shape import decomposition, link_pairs
from cnpgen.robots.shape.decomposition import (
    TriangleMesh,
    convex_parts,
    cut_mesh,
    cut_parts,
)
from cnpgen.robots.shape.hull import hull_corners
from tests.examples.shaped_robot import box, channel, stl, write_problem
from tests.refusals import is_refused


def covered(points: np.ndarray, parts: list[np.ndarray]) -> np.ndarray:
    """Return a mask of the points in one of the hulls, within a nanometre, by SciPy's Delaunay triangulation."""
    grown = [
        part.mean(axis=0) + (part - part.mean(axis=0)) * (1 + 1e-6) for part in parts
    ]
    return np.any(
        [scipy.spatial.Delaunay(part).find_simplex(points) >= 0 for part in grown],
        axis=0,
    )


def volume(parts: list[np.ndarray]) -> float:
    return sum(scipy.spatial.ConvexHull(part).volume for part in parts)


def on_triangles(triangles: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points on triangles."""
    shares = rng.dirichlet([1, 1, 1], (len(triangles), 200))
    return (shares @ triangles).reshape(-1, 3)


def as_mesh(triangles: np.ndarray) -> TriangleMesh:
    """A mesh of triangles that share no points."""
    return TriangleMesh(
        triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    )


def slanted(angle: float) -> np.ndarray:
    """The triangles of the channel, turned about x and z."""
    return (
        channel()
        @ scipy.spatial.transform.Rotation.from_euler("xz", [angle, angle])
        .as_matrix()
        .T
    )


@pytest.mark.parametrize("angle", [0.0, 0.5], ids=["along the axes", "slanted"])
def test_every_point_of_a_mesh_is_in_a_part(angle):
    triangles = slanted(angle)
    parts = [
        hull_corners(part.used_points) for part in cut_parts(as_mesh(triangles), 8)
    ]
    assert 3 <= len(parts) <= 8
    assert covered(on_triangles(triangles, np.random.default_rng(1)), parts).all()
    assert (
        volume(parts) < 0.75 * scipy.spatial.ConvexHull(triangles.reshape(-1, 3)).volume
    )


def test_a_cut_keeps_every_triangle_on_its_side():
    rng = np.random.default_rng(2)
    triangles = np.concatenate(
        [rng.normal(size=(500, 3, 3)), np.round(rng.normal(size=(500, 3, 3)))]
    )
    below, above = (
        half.points[half.triangles] for half in cut_mesh(as_mesh(triangles), 1, 0.0)
    )
    assert below[..., 1].max() <= 1e-12
    assert above[..., 1].min() >= -1e-12
    areas = [
        np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum()
        for t in (below, above)
    ]
    whole = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]),
        axis=1,
    ).sum()
    assert sum(areas) == pytest.approx(whole, rel=1e-12)


def channel_problem(folder: Path, more: str = "") -> Problem:
    """The small arm with a channel in its hand."""
    file = write_problem(folder)
    (folder / "crane" / "channel.stl").write_bytes(
        stl(
            channel().reshape(-1, 3),
            [(k, k + 1, k + 2) for k in range(0, 3 * len(channel()), 3)],
        )
    )
    urdf = folder / "crane" / "crane.urdf"
    urdf.write_text(urdf.read_text().replace("meshes/claw.obj", "channel.stl"))
    file.write_text(file.read_text().replace('tip = "hand"', f'tip = "hand"\n{more}'))
    return load_problem(file)


def test_a_robot_is_judged_by_the_parts_of_its_meshes(tmp_path, monkeypatch):
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(link_pairs, "SAMPLED_STATES", 100)
    problem = channel_problem(tmp_path, "convex_parts = 3")
    counts = Counter(part.link for part in load_robot(problem).shape.convex_parts)
    assert (counts["claw"], counts["fore"]) == (3, 1)  # no cut reduces a wedge
    others = channel_problem(
        tmp_path / "others", 'convex_parts = 3\ndecomposed = ["fore"]'
    )
    assert (
        Counter(part.link for part in load_robot(others).shape.convex_parts)["claw"]
        == 1
    )
    monkeypatch.setattr(
        decomposition, "cut_parts", lambda *_: pytest.fail("the parts are in the cache")
    )
    again = channel_problem(tmp_path / "again", "convex_parts = 3")
    assert again.urdf_text == problem.urdf_text
    assert open_problem(record_problem(again))[0].urdf_text == problem.urdf_text


def test_a_convex_mesh_stays_a_hull():
    corners = box(np.zeros(3), np.ones(3))
    parts = convex_parts(corners.reshape(-1, 3), np.arange(36).reshape(-1, 3), 8, None)
    assert [len(part) for part in parts] == [8]


def test_links_that_do_not_exist_cannot_be_decomposed(tmp_path):
    with is_refused(RecipeError):
        load_robot(
            channel_problem(tmp_path, 'convex_parts = 3\ndecomposed = ["claws"]')
        )
    with is_refused(RecipeError):
        channel_problem(tmp_path / "one", 'decomposed = ["claw"]')


def test_a_line_has_no_meshes_to_decompose(tmp_path):
    with is_refused(RecipeError):
        channel_problem(tmp_path, 'convex_parts = 3\ngeometry = "paper-capsules"')
