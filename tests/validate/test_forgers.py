"""Forged datasets with valid digests and statistics: the checks of dataset-format.md that detect them."""

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from cnpgen.judges.rows.hits import highest_speed
from cnpgen.make.make_dataset import make_dataset
from cnpgen.make.recipe import load_dataset_recipe
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.store.dataset_spec import load_dataset_spec, shards
from cnpgen.store.shard import read_shard
from cnpgen.store.shard_record import commit_shard, load_record
from cnpgen.validate.validate_dataset import validate_dataset
from tests.conftest import some
from tests.examples.finalized import finalize

ROBOT = load_robot(load_problem("airhockey"))
FRAME = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "dataset-format.md"
Columns = dict[str, np.ndarray]


def jacobian(q: np.ndarray) -> np.ndarray:
    return np.array(
        pin.computeFrameJacobian(
            ROBOT.model, ROBOT.model.createData(), q, ROBOT.tip_frame, FRAME
        )[:3]
    )


def tip(q: np.ndarray) -> np.ndarray:
    pin.framesForwardKinematics(ROBOT.model, data := ROBOT.model.createData(), q)
    return np.array(data.oMf[ROBOT.tip_frame].translation)


def put_at(q: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    for _ in range(8):
        q = q + np.linalg.pinv(jacobian(q)) @ (xyz - tip(q))
    return q


def slow_all_down(columns: Columns) -> None:
    for name in ("goal_dq", "hit_speed"):
        columns[name] *= 0.5


def slow_each_down_randomly(columns: Columns) -> None:
    factor = np.random.default_rng(0).uniform(0.5, 1.0, len(columns["hit_speed"]))
    columns["hit_speed"] *= factor
    columns["goal_dq"] *= factor[:, None]


def swing_other_joints(columns: Columns) -> None:
    for row, q in enumerate(columns["goal_q"]):
        J = jacobian(q)
        columns["goal_dq"][row] = np.linalg.pinv(J) @ (J @ columns["goal_dq"][row])


def turn_the_arm(columns: Columns) -> None:
    """Goals are taken with another elbow; speeds and their highest values are those of that elbow."""
    for row in range(len(columns["goal_q"])):
        q = columns["goal_q"][row]
        q = put_at(
            q + 1e-3 * np.linalg.svd(jacobian(q))[2][-1], columns["goal_xyz"][row]
        )
        J, angle = jacobian(q), columns["hit_angle"][row]
        highest = highest_speed(
            J[None], columns["hit_angle"][[row]], ROBOT.velocity_limit
        )[0]
        direction = np.array([np.cos(angle), np.sin(angle), 0.0])
        velocity = np.linalg.pinv(J) @ direction
        speed = 0.5 * (ROBOT.velocity_limit / np.abs(velocity)).min()
        columns["goal_q"][row], columns["goal_dq"][row] = q, speed * velocity
        columns["hit_speed"][row], columns["hit_speed_max"][row] = speed, highest


def hit_too_fast(columns: Columns) -> None:
    for name in ("goal_dq", "hit_speed", "hit_speed_max"):
        columns[name] *= 1.2


def repeat_a_row(columns: Columns) -> None:
    for name, values in columns.items():
        if name not in {"sample_id", "attempts"}:
            values[1] = values[0]


def sink_into_the_table(columns: Columns) -> None:
    columns["start_q"][0] = put_at(
        columns["start_q"][0], columns["start_xyz"][0] - [0, 0, 0.02]
    )
    columns["start_xyz"][0] -= [0, 0, 0.02]


def start_elsewhere(columns: Columns) -> None:
    """Starts are drawn by the forger, at the same places and with joints that are none of the pipeline's."""
    for row, q in enumerate(columns["start_q"]):
        columns["start_q"][row] = put_at(
            q + 0.05 * np.linalg.svd(jacobian(q))[2][-1], columns["start_xyz"][row]
        )


def give_starts_other_goals(columns: Columns) -> None:
    for name in ("start_q", "start_dq", "start_ddq", "start_xyz"):
        columns[name][:] = np.roll(columns[name], 1, axis=0)


def choose_the_easy_ones(columns: Columns) -> None:
    """Sort the rows, as if a selection came first."""
    order = np.argsort(columns["hit_speed"])
    for name in columns.keys() - {"sample_id"}:
        columns[name][:] = columns[name][order]


@dataclass(frozen=True)
class Forgery:
    """A forgery, and whether --deep detects it."""

    forge: Callable[[Columns], None]
    deep: bool


FORGERIES = (
    Forgery(slow_all_down, True),
    Forgery(swing_other_joints, True),
    Forgery(turn_the_arm, True),
    Forgery(hit_too_fast, True),
    Forgery(repeat_a_row, True),
    Forgery(sink_into_the_table, True),
    Forgery(slow_each_down_randomly, False),
    Forgery(start_elsewhere, False),
    Forgery(give_starts_other_goals, False),
    Forgery(choose_the_easy_ones, False),
)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipe = replace(load_dataset_recipe("airhockey-hit"), splits={"train": 100})
    return make_dataset(
        recipe, tmp_path_factory.mktemp("honest") / "set", workers=1
    ).folder


def forged(honest: Path, folder: Path, forge: Callable[[Columns], None]) -> Path:
    """Forge every shard of a copy and recompute digests, statistics, records and documents."""
    shutil.copytree(honest, folder)
    spec = load_dataset_spec(folder)
    for task in shards(spec):
        columns, record = read_shard(folder / task.file), load_record(folder, task)
        columns = {name: values.copy() for name, values in columns.items()}
        forge(columns)
        (folder / task.sidecar).unlink()
        about = {
            "started": record.started,
            "seconds": record.seconds,
            "versions": record.versions,
        }
        commit_shard(
            folder, spec, task, columns=columns, sampling=record.sampling, **about
        )
    finalize(folder, spec)
    return folder


def test_the_original_dataset_is_valid(honest: Path) -> None:
    assert validate_dataset(honest, deep=True, regenerate=1, workers=1).ok


@pytest.mark.parametrize(
    "forgery", some(FORGERIES, 2, "slow"), ids=lambda forgery: forgery.forge.__name__
)
def test_forgeries_are_detected_by_the_expected_checks(
    honest: Path, tmp_path: Path, forgery: Forgery
) -> None:
    folder = forged(honest, tmp_path / "set", forgery.forge)
    assert validate_dataset(folder).ok
    assert validate_dataset(folder, deep=True, workers=1).ok is not forgery.deep
    assert not validate_dataset(folder, regenerate=1).ok


def test_the_documentation_has_these_counts() -> None:
    text = re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
    detected = sum(forgery.deep for forgery in FORGERIES)
    assert (
        f"`validate` detects 0 of {len(FORGERIES)} forged datasets, `--deep` {detected} and `--regenerate` all"
        in text
    )
