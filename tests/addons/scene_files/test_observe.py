"""Observations of scenes: compiled code against NumPy, Coal and geometry."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cnpgen.errors import MachineError, UsageError
from cnpgen.kernels import c_library
from cnpgen.kernels.observation.compiled_observations import observation_backend
from cnpgen.loader.batch import Batch
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.loader.load import load_dataset
from cnpgen.problems.obstacles import scene_of
from cnpgen.problems.problem_record import as_problem
from cnpgen.problems.scenes.scene_problem import make_mesh
from cnpgen.recipes import Obstacle
from cnpgen.robots.observation.observations import (
    OBSERVATIONS,
    Observation,
    ObservationBackend,
)
from cnpgen.robots.observation.primitives import KINDS
from cnpgen.robots.observation.surface_points import scene_seeds
from cnpgen.robots.scene import PARKED_POSITION_M, Scene
from cnpgen.robots.shape.convex_part import turned
from cnpgen.robots.shape.hull import CUBE, coal_hull
from cnpgen.robots.solid import place_obstacles
from cnpgen.scenes import (
    BasisPoints,
    BatchObserver,
    Camera,
    CameraCloud,
    DistanceGrid,
    ObjectTokens,
    SceneProblem,
    SurfaceCloud,
    observe,
    scene_bodies,
)
from tests.conftest import needs_compiled_code
from tests.examples.numpy_observations import (
    NumpyObservations,
    bodies_of,
    depth_image,
    signed_distances,
)
from tests.refusals import is_refused

CAMERA = Camera(position=(2.0, 1.0, 1.5), width=64, height=48)
SMALL = (
    SurfaceCloud(points=700),
    CameraCloud(points=500, camera=CAMERA),
    DistanceGrid(shape=(7, 8, 9)),
    BasisPoints(points=600),
    ObjectTokens(capacity=20),
)


def obstacle(index: int, random: np.random.Generator) -> Obstacle:
    """Return a random obstacle; its kind follows from the index."""
    kind, place = (
        (*KINDS, "mesh")[index % 5],
        tuple(random.uniform([-0.6, -0.6, 0], [0.6, 0.6, 0.8])),
    )
    turn, radius, length = (
        tuple(random.uniform(-3, 3, 3)),
        random.uniform(0.03, 0.15),
        random.uniform(0.05, 0.4),
    )
    if kind == "box":
        size = tuple(random.uniform(0.05, 0.5, 3))
        return Obstacle(
            name=f"{index}", kind=kind, position=place, size=size, rotation=turn
        )
    if kind == "sphere":
        return Obstacle(name=f"{index}", kind=kind, position=place, radius=radius)
    if kind == "mesh":
        return make_mesh(
            f"{index}",
            radius * random.normal(size=(12, 3)) + 0.1,
            np.array(place),
            turned(*turn),
            place="",
        )
    return Obstacle(
        name=f"{index}",
        kind=kind,
        position=place,
        radius=radius,
        length=length,
        rotation=turn,
    )


def scenes() -> list[tuple[Obstacle, ...]]:
    random = np.random.default_rng(1)
    return [
        tuple(obstacle(index, random) for index in range(count))
        for count in (5, 11, 0, 1)
    ]


@needs_compiled_code
@pytest.mark.parametrize("kind", SMALL, ids=lambda kind: kind.name)
def test_compiled_observations_equal_the_numpy_reference(kind: Observation) -> None:
    compiled, bodies = observe(scenes(), kind, seed=5), scene_bodies(scenes())
    reference = kind.observe(bodies, scene_seeds(5, len(bodies)), NumpyObservations())
    for name, values in compiled.items():
        assert values.dtype == reference[name].dtype
        np.testing.assert_allclose(values, reference[name], rtol=0, atol=2e-5)


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_observations_have_default_parameters_by_name(kind: str) -> None:
    values = observe(scenes()[:1], kind)
    assert all(len(array) == 1 and array.size for array in values.values())


def test_cloud_points_lie_on_surfaces_in_proportion_to_their_areas() -> None:
    """The reference of the areas are boxes and balls of known size; that of the surfaces are signed distances."""
    cloud = observe(scenes(), SurfaceCloud(points=2000))["cloud"]
    for index in (0, 1, 3):
        distances = signed_distances(
            bodies_of(scene_bodies(scenes()), index), cloud[index].astype(float)
        )
        assert np.abs(distances).min(axis=0).max() < 1e-6
    assert np.isnan(cloud[2]).all()  # a scene without obstacles
    cube = Obstacle(name="cube", kind="box", position=(0, 0, 0), size=(1, 1, 1))
    ball = Obstacle(name="ball", kind="sphere", position=(5, 0, 0), radius=1.0)
    points = observe([(cube, ball)], SurfaceCloud(points=10_000))["cloud"][0]
    on_ball = points[:, 0] > 2
    assert on_ball.mean() == pytest.approx(4 * np.pi / (6 + 4 * np.pi), abs=2e-4)
    assert np.abs(points[on_ball].mean(axis=0) - [5, 0, 0]).max() < 0.01
    assert (points[~on_ball, 2] > 0.4999).mean() == pytest.approx(1 / 6, abs=1e-3)


def test_distances_agree_with_coal() -> None:
    import coal

    items, kind = (
        scenes()[1],
        BasisPoints(points=200, low=(-0.7, -0.7, -0.1), high=(0.7, 0.7, 0.9)),
    )
    points, distances = kind.positions, observe([items], kind)["basis"][0]
    bodies = bodies_of(scene_bodies([items]), 0)
    shapes = {
        "box": lambda size: coal.Box(*(2 * size)),
        "sphere": lambda size: coal.Sphere(size[0]),
        "cylinder": lambda size: coal.Cylinder(size[0], 2 * size[1]),
        "capsule": lambda size: coal.Capsule(size[0], 2 * size[1]),
    }
    solids = [
        coal_hull(mesh.corners)
        if (mesh := bodies.mesh(k))
        else shapes[KINDS[bodies.kinds[k]]](bodies.sizes[k])
        for k in range(len(bodies))
    ]
    for point, distance in zip(points, distances, strict=True):
        smallest = np.inf
        for index, shape in enumerate(solids):
            place = coal.Transform3s(bodies.rotations[index], bodies.centers[index])
            result = coal.DistanceResult()
            coal.distance(
                shape,
                place,
                coal.Sphere(1e-6),
                coal.Transform3s(np.eye(3), point),
                coal.DistanceRequest(),
                result,
            )
            smallest = min(smallest, result.min_distance + 1e-6)
        assert distance == pytest.approx(smallest, abs=5e-6)


def test_without_compiled_code_the_error_names_the_compiler(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fresh_compiler: None
) -> None:
    monkeypatch.setattr(c_library, "BUILT_FOLDER", tmp_path / "none")
    monkeypatch.setenv("CC", "no-such-compiler")
    with is_refused(MachineError):
        observe(scenes(), "cloud")


def test_a_camera_sees_the_nearest_surface_only() -> None:
    bodies = bodies_of(scene_bodies(scenes()), 1)
    depth = depth_image(bodies, CAMERA)
    seen = np.isfinite(depth)
    assert 0.02 < seen.mean() < 0.9
    forward, right, down = CAMERA.axes
    row, column = np.nonzero(seen)
    x, y = (2 * column + 1) / CAMERA.width - 1, (2 * row + 1) / CAMERA.height - 1
    rays = forward + x[:, None] * right + y[:, None] * down
    hits = CAMERA.position + depth[seen][:, None] * rays
    assert (
        np.abs(signed_distances(bodies, hits).min(axis=0)).max() < 1e-9
    )  # on a surface, and inside of no body
    for share in np.linspace(0, 0.99, 40):  # nothing is in between
        before = CAMERA.position + share * depth[seen][:, None] * rays
        assert signed_distances(bodies, before).min() > 0
    cloud = observe([scenes()[1]], CameraCloud(points=300, camera=CAMERA))[
        "camera_cloud"
    ][0]
    assert (
        np.abs(signed_distances(bodies, cloud.astype(float)).min(axis=0)).max() < 1e-5
    )


@needs_compiled_code
@pytest.mark.parametrize(
    "make_backend", [observation_backend, NumpyObservations], ids=["compiled", "numpy"]
)
@pytest.mark.parametrize("shift", [(0.0, 0.3, 0.0), (0.0, 0.0, 0.2), (0.1, 0.1, -0.1)])
def test_a_mesh_is_seen_as_the_box_of_its_corners_also_along_its_faces(
    make_backend: Callable[[], ObservationBackend], shift: tuple[float, ...]
) -> None:
    """The rows and columns of a camera along an axis contain rays that are parallel to faces."""
    along = Camera(
        position=(1.5, 0.0, 0.0),
        target=(0.0, 0.0, 0.0),
        width=33,
        height=33,
        field_of_view=1.0,
    )
    for turn in (
        (0.0, 0.0, 0.0),
        (0.4, 0.0, 0.0),
        (np.pi / 4, 0.0, 0.0),
        (2.0, 0.0, 0.0),
        (0.3, 0.2, 0.1),
    ):
        box = Obstacle(
            name="box",
            kind="box",
            position=tuple(shift),
            size=(0.6, 0.5, 0.4),
            rotation=turn,
        )
        mesh = make_mesh(
            "mesh",
            CUBE * box.size @ turned(*turn).T,
            np.array(shift),
            np.eye(3),
            place="",
        )
        images = [
            make_backend().depth_images(scene_bodies([(each,)]), along)
            for each in (box, mesh)
        ]
        seen = np.isfinite(images[0]) & np.isfinite(images[1])
        assert seen.sum() > 40
        np.testing.assert_allclose(images[1][seen], images[0][seen], atol=1e-5)
        inner = np.isfinite(images[0][0, 1:-1, 1:-1])
        around = sum(
            np.isfinite(images[0][0, 1 + i : 32 + i, 1 + j : 32 + j])
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        )
        assert np.isfinite(images[1][0, 1:-1, 1:-1])[
            inner & (around == 9)
        ].all()  # no holes
        assert not np.isfinite(images[1][0, 1:-1, 1:-1])[~inner & (around == 0)].any()


def test_a_wall_hides_what_is_behind_it() -> None:
    wall = Obstacle(name="wall", kind="box", position=(1, 0, 0), size=(0.1, 4, 4))
    ball = Obstacle(name="ball", kind="sphere", position=(0, 0, 0), radius=0.3)
    kind = CameraCloud(points=100, camera=Camera(position=(3, 0, 0), target=(0, 0, 0)))
    assert (observe([(ball, wall)], kind)["camera_cloud"][..., 0] > 0.9).all()
    assert (observe([(ball,)], kind)["camera_cloud"][..., 0] < 0.31).all()
    away = CameraCloud(points=100, camera=Camera(position=(3, 0, 0), target=(4, 0, 0)))
    assert np.isnan(observe([(ball, wall)], away)["camera_cloud"]).all()


def test_tokens_describe_every_body_and_mask_the_rest() -> None:
    values = observe(scenes(), ObjectTokens(capacity=12))
    assert values["tokens"].shape == (4, 12, 16)
    assert values["mask"].sum(axis=1).tolist() == [5, 11, 0, 1]
    np.testing.assert_array_equal(
        values["tokens"][0, :5, :4], [*np.eye(4), [1, 0, 0, 0]]
    )  # a mesh is a box
    assert not values["tokens"][~values["mask"]].any()
    with is_refused(UsageError, argument="capacity"):
        observe(scenes(), ObjectTokens(capacity=10))


def test_scenes_of_plans_problems_and_obstacles_are_the_same_scenes() -> None:
    items = scenes()[1]
    parked = Obstacle(
        name="parked", kind="sphere", position=PARKED_POSITION_M, radius=0.1
    )
    numbers = np.tile(place_obstacles([*items, parked]), (2, 1))
    problem = SceneProblem(
        name="one", obstacles=items, start_q=np.zeros(7), goal_q=np.zeros((1, 7))
    )
    clouds = [
        observe(each, SurfaceCloud(points=50))["cloud"][0]
        for each in (
            Scene((*items, parked), numbers),
            problem,
            [problem],
            [items],
            scene_bodies([items]),
        )
    ]
    for cloud in clouds[1:]:
        np.testing.assert_array_equal(cloud, clouds[0])


def test_clouds_depend_on_the_seed_and_the_scene_only() -> None:
    one, other = scenes()[:2]
    kind = SurfaceCloud(points=50)
    first = observe([one, other], kind, seed=1)["cloud"]
    np.testing.assert_array_equal(first[0], observe([one], kind, seed=1)["cloud"][0])
    assert not np.array_equal(first[0], observe([one], kind, seed=2)["cloud"][0])


def test_wrong_observations_are_refused() -> None:
    mesh = Obstacle(name="rock", kind="mesh", position=(0, 0, 0), mesh="rock.stl")
    for arguments, message in (
        ((scenes(), "clouds"), "did you mean 'cloud'"),
        (([], "cloud"), "no scenes"),
        (([(mesh,)], "cloud"), "'rock' is a mesh file"),
    ):
        with pytest.raises(UsageError, match=message):
            observe(*arguments)
    for make, message in (
        (lambda: SurfaceCloud(points=0), "points"),
        (lambda: Camera(target=(1.3, 0.9, 1.1)), "target"),
        (lambda: Camera(field_of_view=4.0), "below pi"),
        (
            lambda: DistanceGrid(low=(0, 0, 0), high=(1, 1, -1)),
            "above the lower corner",
        ),
        (lambda: BasisPoints(points=10**9), "from 1 to"),
        (lambda: DistanceGrid(shape=(1000, 1000, 1000)), "at most"),
    ):
        with pytest.raises(UsageError, match=message):
            make()


def test_batches_of_a_dataset_have_the_observations_of_their_scenes(tiny) -> None:
    dataset = load_dataset(tiny("heavy-object"))
    problem = as_problem(dataset.problem)

    def scenes_of(batch: Batch) -> Scene:
        ends = [np.asarray(batch[name], float) for name in ("start_xyz", "goal_xyz")]
        return scene_of(problem, *ends)

    fields = ["start_q", "start_xyz", "goal_xyz"]
    observer = BatchObserver(BasisPoints(points=40), scenes_of, seed=3)
    options = {
        "fields": fields,
        "normalize": False,
        "options": BatchOptions(drop_last=False, shuffle=False),
    }
    batches = list(dataset.batches(16, observe=observer, **options))
    for batch, plain in zip(batches, dataset.batches(16, **options), strict=True):
        assert list(batch) == [*fields, "basis"]
        assert batch["basis"].shape == (batch.rows, 40)
        np.testing.assert_array_equal(
            batch["basis"], observe(scenes_of(plain), BasisPoints(points=40))["basis"]
        )
    cloud = BatchObserver(SurfaceCloud(points=9), scenes_of)
    first, again = (
        next(iter(dataset.batches(16, observe=cloud, **options)))["cloud"]
        for _ in range(2)
    )
    np.testing.assert_array_equal(first, again)


def test_every_seed_of_batches_observes(tiny) -> None:
    dataset = load_dataset(tiny("heavy-object"))
    ball = Obstacle(name="ball", kind="sphere", position=(0.4, 0.0, 0.3), radius=0.1)
    observer = BatchObserver(
        BasisPoints(points=4), lambda batch: [(ball,)] * batch.rows, seed=2**62
    )
    assert next(iter(dataset.batches(4, observe=observer)))["basis"].shape == (4, 4)
