"""Shapes from URDFs: files are found or said to be missing, pieces are what they say, capsules cover them."""

import base64
import json
import shutil
from pathlib import Path

import coal
import numpy as np
import pytest
import scipy

from cnpgen.errors import RecipeError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.robots.obstacle_shapes.cylinder_shape import PRISM_SIDES
from cnpgen.robots.robot import Attached, reduced_model
from cnpgen.robots.shape import link_pairs as pairs
from cnpgen.robots.shape import shape as module
from cnpgen.robots.shape.capsule import covering_capsule
from cnpgen.robots.shape.convex_part import ConvexPart, link_convex_parts
from cnpgen.robots.shape.hull import coal_hull, enclosing_hull, hull_corners
from cnpgen.robots.shape.inline import corners_of, inline_mesh, with_inline_meshes
from cnpgen.robots.shape.mesh_files import find_named_file
from cnpgen.robots.shape.shape import Shape, load_shape
from cnpgen.robots.urdf_changes import (
    disabled_pairs,
    with_disabled_pairs,
    with_ignored_pairs,
)
from cnpgen.store.files.cache_entry import read_entry, write_entry
from tests.examples.shaped_robot import (
    CLAW,
    LINKS,
    PLANNED,
    WEDGE,
    stl,
    urdf,
    write_crane,
    write_problem,
)
from tests.refusals import is_refused

DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.0254" name="inch"/></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 1 0 0 0 2 0 0 0 3</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def load(file: Path, keep: Path) -> Shape:
    text = with_inline_meshes(file.read_text(), file)
    return load_shape(text, reduced_model(file, text, PLANNED, Attached("hand")), keep)


@pytest.fixture(scope="module")
def shape(tmp_path_factory: pytest.TempPathFactory, cache_folder: Path) -> Shape:
    return load(write_crane(tmp_path_factory.mktemp("crane")), cache_folder)


def places_of(error: RecipeError) -> list[str]:
    return [line.strip() for line in str(error).splitlines()[1:-1]]


def test_a_missing_mesh_is_an_error_with_the_searched_paths(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'ros'}:{tmp_path / 'more'}")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ament"))
    file = tmp_path / "arm" / "urdf" / "arm.urdf"
    with pytest.raises(RecipeError, match="missing; searched paths:") as caught:
        find_named_file(
            "package://arm/a%20b.stl",
            file,
            [tmp_path / "named", tmp_path / "x" / "arm"],
        )
    folders = [
        "named/arm",
        "x/arm/arm",
        "x/arm",
        "ros/arm",
        "more/arm",
        "ament/share/arm",
        "arm/urdf/arm",
        "arm/arm",
    ]
    found = places_of(caught.value)
    assert found[: len(folders)] == [
        str(tmp_path / folder / "a b.stl") for folder in folders
    ]
    assert {str(tmp_path / "arm" / "a b.stl"), "/arm/a b.stl"} <= set(found)


@pytest.mark.parametrize("place", ["named", "ros", "ament/share", "arm", "."])
def test_a_mesh_is_found_in_any_of_the_places(tmp_path, monkeypatch, place):
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ros"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "ament"))
    mesh = tmp_path / place / "meshes" / "hand" / "palm.stl"
    mesh.parent.mkdir(parents=True)
    mesh.touch()
    file = tmp_path / "arm" / "urdf" / "arm.urdf"
    assert (
        find_named_file("package://meshes/hand/palm.stl", file, [tmp_path / "named"])
        == mesh
    )


def test_a_package_whose_folder_has_another_name_is_found_around_the_urdf(tmp_path):
    mesh = tmp_path / "renamed" / "meshes" / "palm.stl"
    mesh.parent.mkdir(parents=True)
    mesh.touch()
    name = "package://arm_description/meshes/palm.stl"
    for place in ("arm.urdf", "urdf/arm.urdf", "urdf/left/arm.urdf"):
        assert find_named_file(name, tmp_path / "renamed" / place) == mesh
    with pytest.raises(RecipeError, match="missing; searched paths:"):
        find_named_file(name, tmp_path / "renamed" / "a" / "b" / "c" / "arm.urdf")


def test_addresses_of_files_and_relative_paths_are_read_and_others_refused(tmp_path):
    (tmp_path / "a.stl").touch()
    for name in ("a.stl", f"file://{tmp_path}/a.stl", str(tmp_path / "a.stl")):
        assert find_named_file(name, tmp_path / "arm.urdf") == tmp_path / "a.stl"
    with is_refused(RecipeError):
        find_named_file("https://example.org/a.stl", tmp_path / "arm.urdf")


def test_pieces_are_what_the_elements_say(tmp_path):
    file = write_crane(tmp_path)
    pieces = {
        piece.link: piece
        for piece in link_convex_parts(with_inline_meshes(file.read_text(), file))
    }
    base, turret, arm = pieces["base"], pieces["turret"], pieces["arm"]
    np.testing.assert_allclose(
        [base.vertices.min(axis=0), base.vertices.max(axis=0)],
        [[-0.15, -0.15, 0], [0.15, 0.15, 0.1]],
    )
    across = np.linalg.norm(turret.vertices[:, :2], axis=1)
    np.testing.assert_allclose(across, 0.07 / np.cos(np.pi / PRISM_SIDES))
    np.testing.assert_allclose(np.unique(np.round(turret.vertices[:, 2], 12)), [0, 0.2])
    np.testing.assert_allclose(arm.vertices, [[0.05, 0, 0], [0.35, 0, 0]], atol=1e-12)
    assert arm.radius == 0.05
    cosine, sine = np.cos(0.3), np.sin(0.3)
    turned = WEDGE / 1000 @ np.array(
        [[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]]
    ).T + [0.02, 0, 0]
    order = np.lexsort(turned.T), np.lexsort(pieces["fore"].vertices.T)
    np.testing.assert_allclose(
        pieces["fore"].vertices[order[1]], turned[order[0]], atol=1e-8
    )
    np.testing.assert_allclose(
        np.sort(pieces["claw"].vertices, axis=0), np.sort(CLAW, axis=0), atol=1e-8
    )


def test_a_text_with_its_meshes_needs_no_file(tmp_path):
    file = write_crane(tmp_path)
    text = with_inline_meshes(file.read_text(), file)
    shutil.rmtree(tmp_path / "crane")
    assert with_inline_meshes(text, file) is text
    assert [piece.link for piece in link_convex_parts(text)] == [
        "base",
        "turret",
        "arm",
        "fore",
        "hand",
        "hand",
        "claw",
    ]


def test_capsules_are_no_reason_for_the_parser_to_complain(tmp_path, capfd):
    file = write_crane(tmp_path)
    file.write_text(file.read_text().replace(' version="1.2"', ""))
    text = with_inline_meshes(file.read_text(), file)
    assert with_inline_meshes(text, file) is text
    reduced_model(file, text, PLANNED, Attached("hand"))
    assert capfd.readouterr().err == ""


def test_what_is_no_mesh_is_said_to_be_none(tmp_path):
    file = write_crane(tmp_path)
    (tmp_path / "crane" / "meshes" / "wedge.stl").write_text("nothing")
    (tmp_path / "crane" / "meshes" / "claw.obj").unlink()
    with pytest.raises(RecipeError) as caught:
        with_inline_meshes(file.read_text(), file)
    assert "not a mesh that can be read" in caught.value.errors[0]
    assert "claw.obj' is missing" in caught.value.errors[1]


def test_only_meshes_of_a_bounded_size_are_given_to_their_reader(tmp_path, monkeypatch):
    file = write_crane(tmp_path)
    monkeypatch.setattr("cnpgen.robots.shape.inline.MAX_MESH_BYTES", 400)
    with pytest.raises(
        RecipeError,
        match=r"wedge.stl: has 484 bytes, expected a mesh of at most 400 .a mesh of link 'fore'",
    ):
        with_inline_meshes(file.read_text(), file)
    (tmp_path / "crane" / "secret.txt").write_text("secret")
    for name in ("secret.txt", f"file://{tmp_path}/crane/secret.txt"):
        text = file.read_text().replace("package://crane/meshes/wedge.stl", name)
        with pytest.raises(
            RecipeError,
            match=r"secret.txt: not a mesh that can be read: expected one of .stl, .dae, .obj",
        ):
            with_inline_meshes(text, file)
    text = file.read_text().replace("package://crane/meshes/wedge.stl", "a" * 5000)
    with pytest.raises(RecipeError, match=r"the file 'a{56}\.\.\. is missing"):
        with_inline_meshes(text, file)


def test_a_mesh_too_fine_is_replaced_by_a_body_that_contains_it(tmp_path):
    fine = np.random.default_rng(1).normal(size=(12_000, 3))
    fine *= [[0.05, 0.03, 0.1]] / np.linalg.norm(fine, axis=1, keepdims=True)
    assert len(scipy.spatial.ConvexHull(fine).vertices) > 10_000
    (tmp_path / "fine.stl").write_bytes(
        stl(
            fine,
            [tuple(side) for side in scipy.spatial.ConvexHull(fine).simplices.tolist()],
        )
    )
    with pytest.warns(
        RuntimeWarning,
        match=r"fine.stl: a hull of the mesh has 12,000 corners.* at most 0.\d+ mm",
    ):
        corners = corners_of(inline_mesh(tmp_path / "fine.stl", np.ones(3)))
    equations = scipy.spatial.ConvexHull(corners).equations
    assert (
        fine @ equations[:, :3].T + equations[:, 3]
    ).max() < 1e-8  # STL has numbers of 32 bits
    assert len(corners) <= 4_000
    body, bound = enclosing_hull(fine)
    distance = np.linalg.norm(
        body - fine[scipy.spatial.KDTree(fine).query(body)[1]], axis=1
    ).max()
    assert np.linalg.norm(body / [0.05, 0.03, 0.1], axis=1).max() - 1 < 3e-3
    assert 0 < bound < min(distance, 3e-4)


def test_flat_meshes_and_units_of_dae_files_are_reported(tmp_path):
    square = np.array([[0, 0, 0], [1, 0, 0.3], [0, 1, 0.1], [1, 1, 0.4]])
    (tmp_path / "flat.stl").write_bytes(stl(square, [(0, 1, 2), (1, 3, 2)]))
    with pytest.warns(
        RuntimeWarning,
        match=r"flat.stl: the mesh is flat, and a body of 0.002 mm replaces it",
    ):
        inline_mesh(tmp_path / "flat.stl", np.ones(3))
    (tmp_path / "inches.dae").write_text(DAE)
    with pytest.warns(
        RuntimeWarning,
        match=r'unit of 0.0254 m, which is ignored.* write scale="0.0254 0.0254 0.0254"',
    ):
        corners = corners_of(inline_mesh(tmp_path / "inches.dae", np.ones(3)))
    assert corners.max() == 3.0
    inline_mesh(tmp_path / "inches.dae", np.full(3, 0.0254))  # no warning


@pytest.mark.parametrize(
    ("corners", "text"),
    [
        (
            [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]],
            "its 4 corners are not those of a body",
        ),
        ([[1, 1, 1]] * 8, "its 8 corners are not those of a body"),
        ([], "a mesh has no corners"),
        (
            np.random.default_rng(0).normal(size=(20_000, 3)),
            "it has 20,000 corners, expected at most 10,000",
        ),
        (
            [[0, 0, 0], [1e308, 0, 0], [0, 1e308, 0], [0, 0, -1e308]],
            "it reaches further than 10,000 m",
        ),
        ([[0, 0, 0], [np.nan, 0, 0], [0, 1, 0], [0, 0, 1]], "some that are not finite"),
    ],
)
def test_corners_that_a_stranger_wrote_into_a_text_are_those_of_a_body(corners, text):
    content = base64.b64encode(np.array(corners, "<f8").tobytes()).decode()
    mesh = f'<geometry><mesh filename="data:application/octet-stream;base64,{content}"/></geometry>'
    with is_refused(RecipeError) as caught:
        link_convex_parts(urdf({**LINKS, "hand": [mesh], "fore": [], "claw": []}))
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("element", "text"),
    [
        (
            '<geometry><box size="0.1 0.1"/></geometry>',
            "needs 3 numbers as 'size', got '0.1 0.1'",
        ),
        (
            '<geometry><box size="0.1 0.1 -1"/></geometry>',
            "lengths must be positive and finite, got -1 m",
        ),
        (
            '<geometry><sphere radius="big"/></geometry>',
            "could not convert string to float",
        ),
        (
            '<geometry><cone radius="1"/></geometry>',
            "<cone> is not a box, sphere, cylinder, capsule or mesh",
        ),
        (
            '<geometry><sphere radius="1"/></geometry><origin xyz="0 nan 0"/>',
            "numbers that are not finite",
        ),
        ("<geometry/>", "it has no <geometry>"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_link(element, text):
    with is_refused(RecipeError) as caught:
        link_convex_parts(urdf({**LINKS, "hand": [element], "fore": [], "claw": []}))
    assert text in str(caught.value)


@pytest.mark.parametrize("flat", [[1, 1, 0], [1, 0, 0], [0, 0, 0]])
def test_a_mesh_without_volume_has_a_hull_none_the_less(tmp_path, flat):
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) * flat
    corners = hull_corners(points)
    assert np.ptp(corners, axis=0).min() > 1e-7
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    ball = coal.Transform3s(np.eye(3), np.array([0, 0, 3.0]))
    found = coal.distance(
        coal_hull(corners), coal.Transform3s(), coal.Sphere(1.0), ball, request, result
    )
    assert found == pytest.approx(2.0, abs=1e-5)


def inside(points: np.ndarray, capsule: module.Capsule) -> np.ndarray:
    """Return the depth of points inside a capsule [m]."""
    along = capsule.second - capsule.first
    share = np.clip((points - capsule.first) @ along / max(along @ along, 1e-18), 0, 1)
    return capsule.radius - np.linalg.norm(
        points - capsule.first - np.outer(share, along), axis=1
    )


def test_capsules_hold_every_point_of_their_links(shape):
    random = np.random.default_rng(1)
    by_link = {capsule.link: capsule for capsule in shape.capsules}
    for piece in shape.convex_parts:
        shares = random.dirichlet(np.full(len(piece.vertices), 0.2), 500)
        within = np.concatenate([shares @ piece.vertices, piece.vertices])
        assert (inside(within, by_link[piece.link]) >= piece.radius - 1e-12).all(), (
            piece.link
        )


def test_the_overhang_is_how_far_a_capsule_sticks_out_of_the_hull(shape):
    """Measured by Coal at many points of the capsule's surface."""
    random = np.random.default_rng(2)
    normals = random.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    point, place, request = coal.Sphere(0.0), coal.Transform3s(), coal.DistanceRequest()
    for capsule in (
        each
        for each in shape.capsules
        if each.link in ("base", "turret", "fore", "claw")
    ):
        (piece,) = (each for each in shape.convex_parts if each.link == capsule.link)
        hull, out = coal_hull(piece.vertices), []
        for end in (capsule.first, capsule.second):
            for surface in end + capsule.radius * normals:
                place.setTranslation(surface)
                out.append(
                    coal.distance(
                        hull,
                        coal.Transform3s(),
                        point,
                        place,
                        request,
                        coal.DistanceResult(),
                    )
                )
        assert capsule.overhang - 2e-3 < max(out) < capsule.overhang + 1e-6


def test_a_link_that_is_a_capsule_is_covered_by_itself(shape):
    (arm,) = (capsule for capsule in shape.capsules if capsule.link == "arm")
    assert arm.radius == pytest.approx(0.05, abs=3e-5)
    assert arm.overhang < 2e-3  # a ball counts with 200 of its points


def test_the_search_finds_less_overhang_than_the_best_start(monkeypatch):
    long_box = ConvexPart(
        "box",
        np.array([[x, y, z] for x in (0, 0.4) for y in (0, 0.1) for z in (0, 0.14)]),
    )
    found = covering_capsule([long_box]).overhang
    monkeypatch.setattr("cnpgen.robots.shape.capsule.SEARCH_DIRECTIONS", 0)
    assert found < 0.95 * covering_capsule([long_box]).overhang


@pytest.mark.slow
def test_capsules_and_pairs_are_kept_and_what_was_damaged_is_found_again(
    tmp_path, monkeypatch, shape
):
    monkeypatch.setattr(pairs, "SAMPLED_STATES", 300)
    file = write_crane(tmp_path)
    again = load(file, tmp_path / "kept")
    assert [c.radius for c in again.capsules] == [c.radius for c in shape.capsules]
    (kept,) = (tmp_path / "kept").glob("shape-*.json")
    with monkeypatch.context() as forbidden:
        forbidden.setattr(
            module, "covering_capsule", lambda _: pytest.fail("it is known")
        )
        third = load(file, tmp_path / "kept")
    assert repr(third.pairs) == repr(again.pairs)
    np.testing.assert_array_equal(third.capsules[3].first, again.capsules[3].first)
    whole = kept.read_bytes()
    content = read_entry(kept)
    assert content is not None
    thinner = json.loads(content)
    thinner["capsules"][2]["radius"] *= 0.9  # it no longer covers the link
    write_entry(tmp_path / "thinner", json.dumps(thinner).encode())
    for damaged in (whole[:-40], (tmp_path / "thinner").read_bytes()):
        kept.write_bytes(damaged)
        found = load(file, tmp_path / "kept")
        assert repr(found.pairs) == repr(again.pairs)
        assert [c.radius for c in found.capsules] == [c.radius for c in again.capsules]
    assert kept.read_bytes() == whole


def test_nothing_is_kept_where_others_may_write(tmp_path, monkeypatch):
    monkeypatch.setattr(pairs, "SAMPLED_STATES", 300)
    problem = load_problem(write_problem(tmp_path))
    for mode, count in ((0o700, 1), (0o777, 0)):
        cache = tmp_path / f"cache-{mode}"
        cache.mkdir()
        cache.chmod(mode)
        monkeypatch.setenv("CNPGEN_CACHE", str(cache))
        assert load_robot(problem).shape is not None
        assert len(list(cache.glob("shape-*.json"))) == count


def test_pairs_are_those_that_can_collide(shape):
    found = {(pair.first, pair.second): pair for pair in shape.pairs}
    assert {names for names, pair in found.items() if pair.left_out == "adjacent"} == {
        ("base", "turret"), ("turret", "arm"), ("arm", "fore"), ("fore", "hand"),
    }  # fmt: skip
    assert ("hand", "claw") not in found  # the joint between them is not planned
    assert found["base", "hand"].for_solvers
    assert found["base", "arm"].colliding > 0.1
    assert not found[
        "base", "arm"
    ].for_solvers  # their capsules overlap where they do not
    assert found["arm", "claw"].colliding == 0
    assert not found["arm", "claw"].left_out  # judges look at it none the less
    assert not found["arm", "claw"].for_solvers


def test_links_that_are_always_in_contact_are_left_out(tmp_path, cache_folder):
    stuck = '<origin xyz="0 0 0.15"/><geometry><sphere radius="0.4"/></geometry>'
    found = load(write_crane(tmp_path, {**LINKS, "base": [stuck]}), cache_folder)
    (pair,) = (
        each for each in found.pairs if {each.first, each.second} == {"base", "arm"}
    )
    assert (pair.left_out, pair.colliding) == ("always", 1.0)


def test_an_srdf_decides_which_pairs_are_left_out(tmp_path, cache_folder, shape):
    file, srdf = write_crane(tmp_path), tmp_path / "crane.srdf"
    srdf.write_text(
        '<robot name="crane"><disable_collisions link1="hand" link2="base" reason="Default"/></robot>'
    )
    text = with_disabled_pairs(with_inline_meshes(file.read_text(), file), srdf)
    assert disabled_pairs(text) == {frozenset(("base", "hand"))}
    found = load_shape(
        text, reduced_model(file, text, PLANNED, Attached("hand")), cache_folder
    )
    (pair,) = (
        each for each in found.pairs if (each.first, each.second) == ("base", "hand")
    )
    assert pair.left_out == "disabled"
    assert not pair.for_solvers
    assert pair.colliding == next(
        p.colliding for p in shape.pairs if (p.first, p.second) == ("base", "hand")
    )
    assert disabled_pairs(urdf()) is None


def test_links_of_an_srdf_that_the_urdf_lacks_are_a_warning(tmp_path, caplog):
    srdf = tmp_path / "crane.srdf"
    pairs = ("hand", "foot"), ("hand", "base"), ("toe", "foot")
    entries = "".join(
        f'<disable_collisions link1="{a}" link2="{b}"/>' for a, b in pairs
    )
    srdf.write_text(f"<robot>{entries}</robot>")
    text = with_disabled_pairs(urdf(), srdf)
    assert disabled_pairs(text) == {frozenset(("base", "hand"))}
    assert "names 2 links that the URDF lacks: foot, toe" in caplog.text
    with is_refused(RecipeError):
        with_ignored_pairs(text, [("hand", "foot")])


def test_a_pair_of_one_link_is_refused(tmp_path):
    with pytest.raises(RecipeError, match="names the link 'hand' twice"):
        with_ignored_pairs(urdf(), [("hand", "hand")])
    srdf = tmp_path / "crane.srdf"
    entry = '<disable_collisions link1="hand" link2="hand"/>'
    srdf.write_text(f"<robot>{entry}</robot>")
    with pytest.raises(RecipeError, match="names the link 'hand' twice"):
        with_disabled_pairs(urdf(), srdf)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (
            '<disable_colisions link1="hand" link2="base"/>',
            r"<disable_colisions> in <robot> \(did you mean 'disable_collisions'",
        ),
        (
            '<disable_collisions link1="hand" link="base"/>',
            "the attribute 'link' of <disable_collisions>",
        ),
        ('<disable_default_collisions link="hand"/>', "is not supported: its"),
    ],
)
def test_elements_of_an_srdf_that_are_not_honoured_are_refused(tmp_path, content, text):
    srdf = tmp_path / "crane.srdf"
    srdf.write_text(f"<robot>{content}</robot>")
    with pytest.raises(RecipeError, match=text):
        with_disabled_pairs(urdf(), srdf)


def test_elements_of_an_srdf_that_change_nothing_are_listed(tmp_path, caplog):
    caplog.set_level("INFO", "cnpgen")
    pair = 'link1="hand" link2="base"'
    plain = f"<disable_collisions {pair}/>"
    more = f'<group name="arm"/><group_state name="home"/><rotor_params/><enable_collisions {pair}/>'
    texts = []
    for content in (plain, plain.replace("/>", ' reason="User"/>') + more):
        (tmp_path / "crane.srdf").write_text(f"<robot>{content}</robot>")
        texts.append(
            disabled_pairs(with_disabled_pairs(urdf(), tmp_path / "crane.srdf"))
        )
    assert texts[0] == texts[1]
    listed = "not used: <enable_collisions>, <group>, <group_state>, <rotor_params>"
    assert listed in caplog.text


def test_a_robot_without_collision_geometry_has_no_shape(tmp_path):
    file = write_crane(tmp_path, {link: [] for link in LINKS})
    with is_refused(RecipeError):
        load(file, tmp_path)
