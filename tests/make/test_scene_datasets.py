"""Datasets whose samples have scenes: storage, reproduction, checks, loading, and plans."""

import json
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import cnpgen
from cnpgen.addons.hub.publish import write_repository
from cnpgen.cli.main import main
from cnpgen.errors import DatasetError, UsageError
from cnpgen.loader.batch_options import BatchOptions
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.make.generation_options import GenerationOptions
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.obstacles import with_capacity
from cnpgen.problems.problem_record import as_record, open_problem
from cnpgen.robots.solid import place_obstacles, solids_of
from cnpgen.scenes import BasisPoints, observe
from cnpgen.store.reader import open_dataset
from cnpgen.training.data import open_training_data
from cnpgen.training.settings import TrainingSettings
from cnpgen.world.world import World
from tests.conftest import needs_compiled_code
from tests.examples.forged_shards import edit
from tests.examples.scene_arm import PIPELINE, obstacles_of, write_scene_pipeline
from tests.refusals import is_refused

pytestmark = needs_compiled_code  # NumPy takes minutes
ROWS = 240
ENDS_MARGIN_M = 0.005 - 1e-9


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene_pipeline(tmp_path_factory.mktemp("scene_arm"))


@pytest.fixture(scope="module")
def dataset(pipeline: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "scenes"
    cnpgen.make_dataset(pipeline, folder, n=ROWS, shard_size=100, workers=1)
    return folder


def shard_bytes(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*.h5"))
    }


def test_h5py_reads_the_scene_of_every_sample(dataset: Path) -> None:
    with h5py.File(dataset / "train" / "shard-00001.h5") as file:
        ids, scenes, counts = (
            file["scene_id"][:],
            file["scene_ids"][:],
            file["obstacle_count"][:],
        )
        kinds, sizes, quaternions = (
            file[f"obstacle_{name}"][:] for name in ("kind", "size", "quaternion")
        )
        assert file["obstacle_position"].shape == (len(scenes), 14, 3)
        assert file["obstacle_quaternion"].attrs["convention"] == "w, x, y, z"
        assert json.loads(file["scene_family"].attrs["names"]) == ["free", "tabletop"]
        assert set(file["scene_family"][:].tolist()) <= {0, 1}
    assert np.array_equal(np.unique(ids), scenes)
    assert np.array_equal(scenes[np.searchsorted(scenes, ids)], ids)
    assert len(scenes) < 100 / 2.5
    real = np.arange(14) < counts[:, None]
    assert np.array_equal(kinds >= 0, real)
    assert (sizes[real][:, 0] > 0).all()
    assert np.linalg.norm(quaternions, axis=-1) == pytest.approx(1)


def test_scene_ids_are_those_of_the_first_samples(dataset: Path) -> None:
    columns = open_dataset(dataset).read("train", fields=["scene_id", "sample_id"])
    first = np.unique(columns["scene_id"])
    assert np.array_equal(columns["scene_id"][first], first)
    assert (np.diff(columns["scene_id"]) >= 0).all()


def test_the_card_of_a_repository_says_where_the_scenes_are(
    dataset: Path, tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    write_repository(
        dataset,
        cnpgen.load_dataset(dataset).spec,
        tmp_path,
        repository="lab/scenes",
        force=False,
    )
    table, ids = (
        parquet.read_table(tmp_path / "parquet/train/00001.parquet"),
        open_dataset(dataset),
    )
    assert np.array_equal(
        table["scene_id"].to_numpy(),
        ids.read("train", fields=["scene_id"])["scene_id"][100:200],
    )
    card, own = ((folder / "README.md").read_text() for folder in (tmp_path, dataset))
    assert (
        "The tables in `parquet/` have no scenes, only `scene_id`: the shards in `hdf5/` have them."
        in card
    )
    assert 'path: "parquet/train/*.parquet"' in card
    assert "parquet" not in own
    assert "configs:" not in own


@pytest.mark.slow
def test_two_workers_another_shard_size_and_an_extension_give_equal_scenes(
    pipeline: Path, dataset: Path, tmp_path: Path
) -> None:
    two, small = tmp_path / "two", tmp_path / "small"
    cnpgen.make_dataset(pipeline, two, n=ROWS, shard_size=100, workers=2)
    assert shard_bytes(two) == shard_bytes(dataset)
    cnpgen.make_dataset(pipeline, small, n=100, shard_size=37, workers=1)
    cnpgen.extend_dataset(small, ROWS, workers=1)
    one, other = cnpgen.load_dataset(dataset), cnpgen.load_dataset(small)
    names = ["start_q", "goal_q", "scene_id", "obstacle_poses", "scene_family"]
    for split in one:
        for name in names:
            assert np.array_equal(
                one.arrays(split, fields=[name])[name],
                other.arrays(split, fields=[name])[name],
            )


@pytest.mark.slow
def test_an_interrupted_dataset_is_finished_and_parts_are_merged(
    pipeline: Path, dataset: Path, tmp_path: Path
) -> None:
    broken, merged = tmp_path / "broken", tmp_path / "merged"
    shutil.copytree(dataset, broken)
    (broken / "train" / "shard-00001.h5").write_bytes(b"damaged")
    with pytest.warns(RuntimeWarning, match="damaged"):
        cnpgen.make_dataset(pipeline, broken, n=ROWS, shard_size=100, workers=1)
    assert shard_bytes(broken) == shard_bytes(dataset)
    parts = [tmp_path / "part0", tmp_path / "part1"]
    for index, part in enumerate(parts):
        cnpgen.make_dataset(
            pipeline,
            part,
            n=ROWS,
            shard_size=100,
            workers=1,
            options=GenerationOptions(part=(index, 2)),
        )
    cnpgen.merge_datasets(parts, merged)
    assert shard_bytes(merged) == shard_bytes(dataset)


@pytest.mark.slow
def test_a_deep_check_accepts_the_dataset_and_finds_a_moved_obstacle(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            ["validate", str(dataset), "--deep", "--regenerate", "2", "--workers", "1"]
        )
        == 0
    )
    forged = tmp_path / "forged"
    shutil.copytree(dataset, forged)

    def move(file: h5py.File) -> None:
        file["obstacle_position"][0, 0] = file["start_xyz"][0]

    edit(forged, "train/shard-00000.h5", move)
    assert main(["validate", str(forged)]) == 0
    assert main(["validate", str(forged), "--deep", "--workers", "1"]) == 1
    assert "robot clearance" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("obstacle_kind", -1),
            "obstacle_kind of 1 scenes are invalid, first those of scene 0",
        ),
        (("obstacle_quaternion", 0.0), "obstacle_quaternion of 1 scenes"),
        (("scene_ids", 3), "scene_ids are not the scene_id of the samples"),
    ],
)
def test_invalid_scenes_are_refused(
    dataset: Path, tmp_path: Path, change: tuple[str, float], message: str
) -> None:
    damaged, (name, value) = tmp_path / "damaged", change
    shutil.copytree(dataset, damaged)

    def overwrite(file: h5py.File) -> None:
        file[name][(0,) * min(file[name].ndim, 2)] = value

    edit(damaged, "train/shard-00000.h5", overwrite)
    with pytest.raises(DatasetError, match=message):
        cnpgen.load_dataset(damaged).rows("train", [0], fields=["obstacle_poses"])
    assert main(["validate", str(damaged)]) == 1


def test_ends_are_clear_of_their_scene_by_coal(dataset: Path) -> None:
    stored = open_dataset(dataset)
    problem, _ = open_problem(as_record(stored.spec.problem))
    columns, table = stored.read("train"), stored.read_scenes("train")
    robot, index = load_robot(problem), table.rows_of(columns["scene_id"])
    for row in range(0, len(index), 7):
        obstacles = obstacles_of(table, int(index[row]))
        world = World(robot, obstacles, None)
        numbers = place_obstacles(obstacles)
        for end in ("start", "goal"):
            q = columns[f"{end}_q"][row].astype(float)
            world.set_state(q, 0 * q, 0 * q, numbers)
            assert min(world.shape_distances(0.1)) > ENDS_MARGIN_M
            assert world.tip_position == pytest.approx(
                columns[f"{end}_xyz"][row], abs=1e-9
            )


def test_the_loader_places_the_obstacles_of_the_problem(dataset: Path) -> None:
    loaded, stored = cnpgen.load_dataset(dataset), open_dataset(dataset)
    table, ids = (
        stored.read_scenes("train"),
        stored.read("train", fields=["scene_id"])["scene_id"],
    )
    for row in (0, 101, -1):
        scene = loaded.scenes("train", [row])
        bodies = [body for body in scene.bodies() if body.position[2] > -50]
        wanted = obstacles_of(table, int(table.rows_of(ids)[row]))
        assert len(bodies) == len(wanted)
        by_place = {tuple(np.round(body.position, 9)): body for body in bodies}
        for body in solids_of(wanted, place_obstacles(wanted)):
            same = by_place[tuple(np.round(body.position, 9))]
            assert same.low == pytest.approx(
                body.low, abs=2e-3
            )  # prisms may be turned about their axes
            assert same.high == pytest.approx(body.high, abs=2e-3)
    with is_refused(DatasetError, argument="fields"):
        loaded.rows("train", [0], fields=["obstacle_posse"])


def test_batches_contain_the_scene_without_normalization(dataset: Path) -> None:
    loaded = cnpgen.load_dataset(dataset)
    fields = [
        "start_q",
        "obstacle_poses",
        "obstacle_count",
        "obstacle_position",
        "sample_id",
    ]
    batch = next(iter(loaded.batches(32, fields=fields, seed=3)))
    rows = loaded.rows("train", batch["sample_id"], fields=fields)
    assert np.array_equal(
        batch["obstacle_poses"], rows["obstacle_poses"].astype(np.float32)
    )
    assert np.array_equal(batch["obstacle_count"], rows["obstacle_count"])
    assert batch["obstacle_position"].shape == (32, 3 * 14)
    assert not np.array_equal(
        batch["start_q"], rows["start_q"].astype(np.float32)
    )  # normalized
    assert "obstacle_poses" not in next(iter(loaded.batches(32)))


def test_training_rows_have_the_obstacles_of_their_scenes(dataset: Path) -> None:
    data, loaded = open_training_data(dataset), cnpgen.load_dataset(dataset)
    train, checked = data.training(), data.checked(5)
    assert (
        train.obstacle_poses.shape[0] == len(train.boundary) == loaded.splits["train"]
    )
    rows = np.array([0, 7, 101])
    np.testing.assert_array_equal(
        train.obstacle_poses[rows], loaded.scenes("train", rows).poses
    )
    np.testing.assert_array_equal(
        checked.obstacle_poses, loaded.scenes("validation", np.arange(5)).poses
    )


def test_batches_observe_the_scenes_of_their_rows(dataset: Path) -> None:
    loaded = cnpgen.load_dataset(dataset)
    options = {
        "split": "validation",
        "fields": ["start_q"],
        "options": BatchOptions(shuffle=False),
    }
    batch = next(iter(loaded.batches(4, observe="basis", **options)))
    expected = observe(loaded.scenes("validation", np.arange(4)), "basis")["basis"]
    np.testing.assert_allclose(
        batch["basis"], expected, atol=1e-5
    )  # batches have float32 poses
    again = next(iter(loaded.batches(4, observe=BasisPoints(points=9), **options)))
    assert again["basis"].shape == (4, 9)


def test_a_dataset_without_scenes_has_nothing_to_observe(tiny: Any) -> None:
    with is_refused(DatasetError):
        cnpgen.load_dataset(tiny("airhockey-hit")).batches(4, observe="cloud")


@pytest.mark.slow
def test_float32_datasets_are_valid_as_stored(pipeline: Path, tmp_path: Path) -> None:
    folder = tmp_path / "single"
    cnpgen.make_dataset(
        pipeline, folder, n=60, workers=1, options=GenerationOptions(dtype="float32")
    )
    with h5py.File(folder / "train" / "shard-00000.h5") as file:
        assert file["obstacle_size"].dtype == np.float32
    assert main(["validate", str(folder), "--deep", "--workers", "1"]) == 0


def test_fresh_boundary_problems_have_scenes(pipeline: Path) -> None:
    plans = draw_boundary_problems(pipeline, 12, seed=5)
    assert plans.columns["obstacle_poses"].shape == (12, len(plans.scene.poses[0]))
    assert (plans.scene.poses != plans.scene.poses[0]).any()


def changed(pipeline: Path, folder: Path, old: str, new: str) -> Path:
    shutil.copytree(pipeline.parent, folder, dirs_exist_ok=True)
    path = folder / "scenes.toml"
    assert old in PIPELINE
    path.write_text(PIPELINE.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('use = "tabletop"', 'use = "tabletops"', "tabletop"),
        ("tables = [1, 1]", 'tables = [1, 1]\nheights = "3 cm"', "height"),
        ("sphere = 4", "cone = 4", "does not match"),
        ("straight = 0.5", "straight = 0.5\nneutral = 0.9", "add up to 1"),
    ],
)
def test_mistakes_name_file_and_key(
    pipeline: Path, tmp_path: Path, capsys: Any, old: str, new: str, message: str
) -> None:
    path = changed(pipeline, tmp_path / "changed", old, new)
    assert (
        main(["make-dataset", str(path), "--n", "10", "--out", str(tmp_path / "out")])
        == 2
    )
    error = capsys.readouterr().err
    assert message in error
    assert "scenes.toml" in error


@pytest.fixture(scope="module")
def model(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "scenes.h5"
    settings = TrainingSettings(
        hidden=8, layers=1, batch_size=16, nodes=8, validations=1
    )
    cnpgen.train_model(dataset, path, steps=2, settings=settings, check_rows=4)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("from_planner", [False, True])
def test_certified_samples_have_valid_plans_in_their_scenes(
    pipeline: Path, model: Path, tmp_path: Path, *, from_planner: bool
) -> None:
    folder = tmp_path / "certified"
    cnpgen.make_dataset(
        pipeline,
        folder,
        n=12,
        certify=True,
        workers=1,
        options=GenerationOptions(model=model if from_planner else None),
    )
    assert main(["validate", str(folder), "--deep", "--workers", "1"]) == 0
    plans = cnpgen.load_boundary_problems(folder)
    assert cnpgen.evaluate_plans(plans).valid.all()


@pytest.mark.slow
def test_plans_have_the_obstacles_of_their_samples(
    dataset: Path,
    pipeline: Path,
    model: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    expected = cnpgen.load_dataset(dataset).scenes("validation", np.arange(6)).poses
    out = tmp_path / "plans.h5"
    assert (
        main(["plan", str(dataset), "--model", str(model), "--n", "6", "-o", str(out)])
        == 0
    )
    plans = cnpgen.load_plans(out)
    np.testing.assert_array_equal(plans.columns["obstacle_poses"], expected)
    again = tmp_path / "again.h5"
    assert main(["plan", str(out), "--model", str(model), "-o", str(again)]) == 0
    np.testing.assert_array_equal(
        cnpgen.load_plans(again).columns["obstacle_poses"], expected
    )
    assert (
        main(
            [
                "plan",
                str(pipeline),
                "--n",
                "3",
                "--model",
                str(model),
                "-o",
                str(tmp_path / "drawn.h5"),
            ]
        )
        == 0
    )
    assert "obstacle_poses" in cnpgen.load_plans(tmp_path / "drawn.h5").columns
    shard = sorted((dataset / "validation").glob("*.h5"))[0]
    for command in (["plan", str(shard), "--model", str(model)], ["solve", str(shard)]):
        assert main([*command, "-o", str(tmp_path / "no.h5")]) != 0
        assert (
            "lacks the obstacles of its samples: give the folder of its dataset"
            in capsys.readouterr().err
        )


@pytest.mark.slow
def test_replanning_keeps_the_obstacles_and_planning_without_them_is_refused(
    dataset: Path, model: Path
) -> None:
    loaded, planner = cnpgen.load_dataset(dataset), cnpgen.Planner(model)
    scene = loaded.scenes("validation", np.arange(2))
    plans = planner.plan_batch(
        draw_boundary(loaded, rows=np.arange(2)),
        columns={"obstacle_poses": scene.poses.astype(float)},
    )
    new = planner.replan(plans, 0.0, goal_q=plans.boundary.goal_q + 0.01)
    np.testing.assert_array_equal(new.columns["obstacle_poses"], scene.poses)
    with is_refused(UsageError, argument="obstacle_poses"):
        planner.plan(plans.boundary.start_q, plans.boundary.goal_q)


def draw_boundary(loaded: Any, *, rows: Any) -> Any:
    columns = loaded.rows(
        "validation",
        rows,
        fields=["start_q", "goal_q"],
        normalize=False,
        dtype="float64",
    )
    zero = np.zeros_like(columns["start_q"])
    return cnpgen.Boundary(columns["start_q"], zero, zero, columns["goal_q"], zero)


@pytest.mark.slow
def test_the_boundary_layer_takes_the_obstacles_of_samples(dataset: Path) -> None:
    loaded = cnpgen.load_dataset(dataset)
    layer, scene = (
        cnpgen.BoundaryLayer(loaded.problem),
        loaded.scenes("validation", np.arange(2)),
    )
    boundary = draw_boundary(loaded, rows=np.arange(2))
    tasks = layer.tasks(boundary, obstacle_poses=scene.poses)
    np.testing.assert_array_equal(tasks.obstacle_poses, scene.poses)
    with is_refused(UsageError, argument="obstacle_poses"):
        layer.tasks(boundary)


def test_tasks_and_values_of_samples_are_refused_where_scenes_are_drawn(
    pipeline: Path,
) -> None:
    with is_refused(UsageError, argument="recipe"):
        cnpgen.complete(pipeline, start_q=np.zeros(4), goal_q=np.ones(4))
    with is_refused(UsageError, argument="problem"):
        with_capacity(cnpgen.load_problem("heavy-object-loads"), {"box": 1})
