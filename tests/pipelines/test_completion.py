"""Completion of tasks: rows of datasets are reproduced from their sampled values; unsolved tasks have a reason."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from cnpgen.errors import UsageError
from cnpgen.pipelines.completion import Completion
from cnpgen.pipelines.prepared import PreparedPipeline
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.store.field import Field
from tests.conftest import SHIPPED, Arm, Prepare
from tests.refusals import is_refused

TASK = {  # columns of the tasks; the completed values are compared with their row
    "airhockey-hit": ("start_q", "goal_xyz", "hit_angle", "hit_speed"),
    "airhockey-replan": (
        "start_q",
        "start_dq",
        "start_ddq",
        "goal_xyz",
        "hit_angle",
        "hit_speed",
    ),
    "heavy-object": ("start_q", "goal_xyz"),
}


@pytest.fixture(scope="module", params=SHIPPED)
def prepared(request: pytest.FixtureRequest, prepare: Prepare) -> PreparedPipeline:
    return prepare(request.param)


@pytest.fixture(scope="module")
def rows(prepared: PreparedPipeline) -> dict[str, np.ndarray]:
    return prepared.block(3, "train", 0, stop=200).columns


def completed(prepared: PreparedPipeline, columns: dict[str, np.ndarray]):
    lanes = {name: np.ascontiguousarray(values) for name, values in columns.items()}
    return Completion(prepared.pipeline, prepared.context, list(lanes))(lanes)


def task_of(
    prepared: PreparedPipeline, rows: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    return {name: rows[name] for name in TASK[prepared.pipeline.name]}


def test_rows_of_a_dataset_are_reproduced_from_their_sampled_values(prepared, rows):
    tasks = completed(prepared, task_of(prepared, rows))
    np.testing.assert_array_equal(tasks.alive, np.arange(200))
    assert tasks.why() == ("",) * 200
    for name in (
        "start_q",
        "start_dq",
        "start_ddq",
        "goal_q",
        "goal_dq",
        "start_xyz",
        "goal_xyz",
    ):
        np.testing.assert_allclose(
            tasks[name], rows[name], rtol=1e-12, atol=1e-9, err_msg=name
        )


def test_the_result_of_a_task_does_not_depend_on_other_tasks(prepared, rows):
    every, task = completed(prepared, task_of(prepared, rows)), task_of(prepared, rows)
    for i in (0, 7, 199):
        alone = completed(
            prepared, {name: values[:, i : i + 1] for name, values in task.items()}
        )
        for name in ("goal_q", "goal_dq", "start_xyz"):
            np.testing.assert_array_equal(
                alone[name][:, 0], every[name][:, i], err_msg=name
            )


def test_a_start_given_by_its_position_is_at_this_position(prepared, rows):
    tasks = completed(
        prepared, {name: rows[name] for name in ("start_xyz", "goal_xyz")}
    )
    assert len(tasks.alive) > 150
    arm = Arm(prepared.context.robot)
    for row, q in zip(tasks.alive[:20], tasks["start_q"].T, strict=False):
        np.testing.assert_allclose(
            arm.pose(q).translation, rows["start_xyz"][:, row], atol=1e-8
        )
    np.testing.assert_array_equal(tasks["start_dq"], 0)


def test_a_missing_start_is_the_base_at_rest(prepare):
    prepared = prepare("airhockey-replan")
    tasks = completed(
        prepared, {"goal_xyz": np.array([[1.0], [0.1]]), "hit_angle": np.array([[0.2]])}
    )
    np.testing.assert_array_equal(tasks["start_q"][:, 0], prepared.context.robot.home)
    assert not tasks["start_dq"].any()
    assert np.abs(tasks["start_ddq"]).max() < 1e-12
    np.testing.assert_array_equal(
        tasks["goal_xyz"][:, 0], [1.0, 0.1, 0.16]
    )  # the table has one height


@pytest.mark.parametrize(
    ("given", "share"),
    [({}, 1.0), ({"hit_speed_share": 0.4}, 0.4), ({"hit_speed": 0.5}, None)],
)
def test_a_hit_has_the_given_speed_or_the_maximum_speed(prepare, given, share):
    prepared = prepare("airhockey-hit")
    task = {
        "goal_xyz": np.array([[1.0], [0.1], [0.16]]),
        "hit_angle": np.array([[0.3]]),
    }
    tasks = completed(
        prepared,
        {**task, **{name: np.array([[value]]) for name, value in given.items()}},
    )
    speed, most = tasks["hit_speed"][0, 0], tasks["hit_speed_max"][0, 0]
    assert speed == pytest.approx(0.5 if share is None else share * most, rel=1e-12)
    moved = Arm(prepared.context.robot).velocity(
        tasks["goal_q"][:, 0].copy(), tasks["goal_dq"][:, 0].copy()
    )
    np.testing.assert_allclose(
        moved, speed * np.array([np.cos(0.3), np.sin(0.3), 0]), atol=1e-9
    )


def test_a_hit_without_a_direction_aims_at_the_target_of_the_pipeline(prepare):
    tasks = completed(
        prepare("airhockey-hit"), {"goal_xyz": np.array([[1.0], [0.1], [0.16]])}
    )
    assert tasks["hit_angle"][0, 0] == pytest.approx(np.arctan2(-0.1, 1.49))


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("goal_xyz", [3.0, 0, 0.16], "no hitting configuration"),
        ("goal_xyz", [1.0, 0.44, 0.16], "the hit is off the table, or leaves it"),
        ("hit_speed", [9.0], "hit speed not between 0 and the highest possible one"),
        ("start_dq", [0.1, 0, 0, 0, 0, 0], "not at rest at the start"),
    ],
)
def test_an_unsolved_task_has_a_reason_and_does_not_change_other_tasks(
    prepare, column, value, reason
):
    prepared = prepare("airhockey-hit")
    task = {
        "start_dq": np.zeros((6, 2)),
        "goal_xyz": np.array([[1.0, 0.0, 0.16]] * 2).T,
        "hit_angle": np.ones((1, 2)),
    }
    task |= {"hit_speed": np.full((1, 2), 0.8)}
    task[column] = np.stack([task[column][:, 0], value], axis=1)
    tasks = completed(prepared, task)
    assert tasks.why() == ("", reason)
    np.testing.assert_array_equal(tasks.alive, [0])


def test_a_measured_start_has_the_tolerance_of_motions(prepare):
    prepared = prepare("airhockey-replan")
    base = prepared.context.robot.home
    start = np.repeat(base[:, None], 3, axis=1)
    start[5, 1] += 3e-3
    start[3, 2] += 0.1
    task = {
        "start_q": start,
        "goal_xyz": np.tile([[1.0], [0.0], [0.16]], 3),
        "hit_angle": np.zeros((1, 3)),
    }
    assert completed(prepared, task).why() == ("", "", "off the table")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            ["goal_xyz", "hit_angel"],
            "has no column to give 'hit_angel' (did you mean 'hit_angle'?)",
        ),
        (["hit_angle"], "must give goal_xyz"),
        (["goal_xyz", "start_q", "start_xyz"], "start_q and start_xyz are both given"),
    ],
)
def test_unknown_columns_raise_an_error(prepare, given, message):
    prepared = prepare("airhockey-replan")
    with pytest.raises(UsageError) as error:
        Completion(prepared.pipeline, prepared.context, given)
    assert message in str(error.value)


def test_two_speeds_of_one_hit_raise_an_error(prepare):
    prepared = prepare("airhockey-hit")
    with is_refused(UsageError):
        Completion(
            prepared.pipeline,
            prepared.context,
            ["goal_xyz", "hit_speed", "hit_speed_share"],
        )


@dataclass(frozen=True, kw_only=True)
class _Weights(Stage):
    """Stage of a plug-in that draws two values and stores a third as a diagnostic."""

    def describe(self) -> str:
        return "draw weights"

    def outputs(self, context):
        names = (("mass", "context"), ("drag", "context"), ("ratio", "diagnostic"))
        return tuple(Field(name, "1", name, role=role) for name, role in names)

    def prepare(self, context):
        def work(candidates, random):
            candidates["mass"], candidates["drag"] = (
                2 * candidates.draw(random, 1),
                4 * candidates.draw(random, 1),
            )
            candidates["ratio"] = candidates["mass"] / candidates["drag"]

        return work


def test_plug_in_stages_keep_given_outputs_and_replace_random_values_by_their_mean(
    prepare,
):
    hits = prepare("airhockey-hit")
    prepared = replace_pipeline(hits, _Weights())
    task = {"goal_xyz": np.array([[1.0], [0.1], [0.16]])}
    drawn = completed(prepared, task)
    assert (drawn["mass"].item(), drawn["drag"].item(), drawn["ratio"].item()) == (
        1.0,
        2.0,
        0.5,
    )
    given = completed(
        prepared, {**task, "mass": np.array([[7.0]]), "drag": np.array([[1.0]])}
    )
    assert given["mass"].item() == 7.0
    with is_refused(UsageError):
        completed(prepared, {**task, "mass": np.array([[7.0]])})


def replace_pipeline(prepared: PreparedPipeline, stage: Stage) -> PreparedPipeline:
    """Prepare the pipeline with one more stage."""
    pipeline = replace(prepared.pipeline, stage=(*prepared.pipeline.stage, stage))
    kernels = prepared.context.kernels
    return PreparedPipeline(
        pipeline, backend=kernels.backend, cache_folder=kernels.cache_folder
    )
