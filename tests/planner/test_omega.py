"""Control points for anybody's network: what they meet, gradients, plans, and what is refused."""

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cnpgen
from cnpgen.errors import UsageError
from cnpgen.planner.omega import Omega
from cnpgen.plans.format import BOUNDARY
from cnpgen.trajectory.boundary import Boundary
from tests.conftest import needs_compiler, some
from tests.examples.plans_of_networks import asked_of, at_ends, boundary, outputs

PROBLEMS = ("airhockey", "heavy-object")
GIVEN = "airhockey, accelerations given"


@pytest.fixture(scope="module")
def omegas(cache_folder: Path, fastest: Any) -> dict[str, Omega]:
    backends = {"airhockey": fastest, "heavy-object": "numpy"}  # compiling the others takes longer than their tests do
    found = {name: Omega(name, backend=backends[name], cache_folder=cache_folder) for name in PROBLEMS}
    given = Omega("airhockey", goal_acceleration="given", backend="numpy", cache_folder=cache_folder)
    return found | {GIVEN: given}


@pytest.mark.parametrize("problem", [*some(PROBLEMS, 1, "slow"), GIVEN])
def test_boundary_conditions_hold_whatever_a_network_says(omegas: dict[str, Omega], problem: str) -> None:
    omega = omegas[problem]
    given = asked_of(omega, 4)
    points = omega(omega.tasks(given), *outputs(omega, 4))
    assert points.path.shape == (4, 15, len(omega.problem.robot.joints))
    assert points.rate.shape == (4, 20)
    for found, expected, exact in zip(
        at_ends(points.path, points.rate), given.given().values(), (1e-12, 1e-10, 1e-8) * 2, strict=False
    ):
        np.testing.assert_allclose(found, expected, rtol=0, atol=exact)


@pytest.mark.parametrize(
    ("problem", "landing"),
    [("airhockey", 0), ("airhockey", 1), (GIVEN, 1), *some([("heavy-object", 0), ("heavy-object", 1)], 0, "slow")],
)
def test_gradients_of_outputs_are_those_of_central_differences(problem: str, landing: int, omegas: Any) -> None:
    omega = omegas[problem] if landing else Omega(problem, bending_steps=0, landing_steps=0)
    tasks, given, random = omega.tasks(asked_of(omega, 3)), outputs(omega, 3), np.random.default_rng(2)
    points = omega(tasks, *given)
    by_path, by_rate = random.normal(size=points.path.shape), random.normal(size=points.rate.shape)

    def scalar(phi: Any, log_rate: Any) -> Any:
        found = omega(tasks, phi, log_rate)
        return (found.path * by_path).sum((1, 2)) + (found.rate * by_rate).sum(1)

    gradients = omega.pull_back(tasks, *given, path_gradient=by_path, rate_gradient=by_rate)
    for _ in range(3):
        steps = [1e-6 * random.normal(size=part.shape) for part in given]
        ends = [scalar(*(part + sign * step for part, step in zip(given, steps, strict=True))) for sign in (1, -1)]
        found = sum((gradient * step).sum(1) for gradient, step in zip(gradients, steps, strict=True))
        np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2, rtol=1e-5, atol=1e-9)


@needs_compiler
@pytest.mark.extended
def test_transports_are_the_same_compiled_and_interpreted(omegas: dict[str, Omega], cache_folder: Path) -> None:
    interpreted, given = omegas["heavy-object"], boundary("heavy-object", 3)
    compiled = Omega("heavy-object", backend="compiled", cache_folder=cache_folder)
    said, gradients = outputs(compiled, 3), {"path_gradient": np.ones((3, 15, 7)), "rate_gradient": np.ones((3, 20))}
    tasks = [of.tasks(given) for of in (compiled, interpreted)]
    np.testing.assert_allclose(compiled(tasks[0], *said).path, interpreted(tasks[1], *said).path, rtol=0, atol=1e-8)
    found, expected = (
        compiled.pull_back(tasks[0], *said, **gradients),
        interpreted.pull_back(tasks[1], *said, **gradients),
    )
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7)  # rounding, after an inverse


@pytest.mark.parametrize("backend", some([pytest.param("compiled", marks=needs_compiler), "numpy"], 1, "slow"))
def test_a_row_that_overflows_touches_no_other(backend: Any, cache_folder: Path) -> None:
    omega = Omega("airhockey", backend=backend, cache_folder=cache_folder)
    tasks, (phi, log_rate) = omega.tasks(boundary("airhockey", 4)), outputs(omega, 4)
    ones = {"path_gradient": np.ones((4, 15, 6)), "rate_gradient": np.ones((4, 20))}
    expected, points = omega.pull_back(tasks, phi, log_rate, **ones), omega(tasks, phi, log_rate)
    for value in (1000.0, -1000.0, np.nan):
        log_rate[2, 0] = value
        np.testing.assert_array_equal(np.delete(omega(tasks, phi, log_rate).path - points.path, 2, 0), 0)
        found = omega.pull_back(tasks, phi, log_rate, **ones)
        for each, other in zip(found, expected, strict=True):
            assert (each[2] == 0).all()
            np.testing.assert_array_equal(np.delete(each, 2, 0), np.delete(other, 2, 0))


def test_a_gradient_that_is_nan_itself_is_not_hidden(omegas: dict[str, Omega]) -> None:
    omega = omegas["airhockey"]
    by_path = np.ones((2, 15, 6))
    by_path[1] = np.nan
    by_phi, _ = omega.pull_back(
        omega.tasks(boundary("airhockey", 2)), *outputs(omega, 2), path_gradient=by_path, rate_gradient=np.ones((2, 20))
    )
    assert np.isfinite(by_phi[0]).all()
    assert np.isnan(by_phi[1]).any()


@pytest.mark.parametrize("problem", [GIVEN, *some(PROBLEMS, 1, "slow")])
def test_of_no_task_there_are_no_control_points_and_no_gradients(omegas: dict[str, Omega], problem: str) -> None:
    omega = omegas[problem]
    tasks, given = omega.tasks(asked_of(omega, 1)[:0]), [values[:0] for values in outputs(omega, 1)]
    points = omega(tasks, *given)
    found = omega.pull_back(tasks, *given, path_gradient=points.path, rate_gradient=points.rate)
    assert [values.shape for values in found] == [values.shape for values in given]


def test_plans_are_of_the_same_control_points_and_tasks(cache_folder: Path) -> None:
    omega = Omega("heavy-object", bending_steps=0, landing_steps=0, backend="numpy", cache_folder=cache_folder)
    given = boundary("heavy-object", 3)
    tasks, said = omega.tasks(given), outputs(omega, 3)
    plans = omega.plans(tasks, *said)
    np.testing.assert_array_equal(plans.path_control_points, omega(tasks, *said).path)
    np.testing.assert_array_equal(plans.boundary.goal_dq, given.goal_dq)
    np.testing.assert_allclose(plans.columns["goal_xyz"], plans.problem.tip_positions(given.goal_q), atol=1e-9)
    assert omega.tops(tasks).shape == (3, 2)


def test_without_steps_and_outputs_the_path_is_the_papers_line() -> None:
    omega = Omega("airhockey", bending_steps=0, landing_steps=0)
    points = omega(omega.tasks(boundary("airhockey", 2)), np.zeros((2, 60)), np.zeros((2, 20)))
    np.testing.assert_allclose(np.diff(points.path[:, 3:13], 2, axis=1), 0, atol=1e-12)


def test_it_can_be_sent_to_other_processes_after_use(omegas: dict[str, Omega]) -> None:
    omega = omegas["airhockey"]
    tasks, said = omega.tasks(boundary("airhockey", 2)), outputs(omega, 2)
    expected = omega(tasks, *said)
    again = pickle.loads(pickle.dumps(omega))
    np.testing.assert_array_equal(again(again.tasks(tasks.boundary), *said).path, expected.path)


def test_what_cannot_be_meant_is_refused(omegas: dict[str, Omega]) -> None:
    omega, given = omegas["airhockey"], boundary("airhockey", 2)
    tasks, (phi, log_rate) = omega.tasks(given), outputs(omega, 2)
    with pytest.raises(UsageError, match=r"phi must have shape \(2, 60\), got \(2, 59\)"):
        omega(tasks, phi[:, 1:], log_rate)
    with pytest.raises(UsageError, match=r"log_rate must have shape \(2, 20\), got \(1, 20\)"):
        omega(tasks, phi, log_rate[1:])
    with pytest.raises(UsageError, match=r"goal_q must have shape \(N, 6\), N = 2, got \(2, 7\)"):
        omega.tasks(replace(given, goal_q=np.zeros((2, 7))))
    with pytest.raises(UsageError, match="goal_ddq must be None"):
        omega.tasks(replace(given, goal_ddq=np.zeros((2, 6))))
    with pytest.raises(UsageError, match='goal_ddq is missing: goal_acceleration is "given"'):
        omegas[GIVEN].tasks(given)
    with pytest.raises(UsageError, match="goal_acceleration must be one of free, given, got 'none'"):
        Omega("airhockey", goal_acceleration="none")
    with pytest.raises(UsageError, match=r"landing_steps must be an integer from 0 on, got 1\.5"):
        Omega("airhockey", landing_steps=1.5)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="path_scale must be a finite number, got None"):
        Omega("airhockey", path_scale=None)  # type: ignore[arg-type]


def test_plans_of_a_shuffled_batch_meet_and_name_the_rows_of_the_dataset(tiny: Any, omegas: Any) -> None:
    dataset = cnpgen.load_dataset(tiny("airhockey-replan"))
    rows = dataset.arrays("train", fields=[*BOUNDARY, "sample_id"])
    omega = omegas["airhockey"]
    batch = next(iter(dataset.batches(8, fields=[*BOUNDARY, "hit_speed", "sample_id"], dtype="float64")))
    boundary = Boundary.from_batch(batch)
    tasks = omega.tasks(boundary)
    phi, log_rate = np.zeros((8, omega.path_outputs)), np.zeros((8, omega.rate_outputs))
    plans = omega.plans(tasks, phi, log_rate, sample_id=batch["sample_id"])
    assert plans.sample_id.tolist() == batch["sample_id"].tolist() != list(range(8))
    for plan in plans:
        row = int(np.flatnonzero(rows["sample_id"] == plan.sample_id[0])[0])
        for name in BOUNDARY:
            np.testing.assert_allclose(getattr(plan.boundary, name)[0], rows[name][row], atol=1e-12)


def test_boundary_conditions_are_taken_out_of_rows_in_their_units(tiny: Any) -> None:
    dataset = cnpgen.load_dataset(tiny("airhockey-replan"))
    rows = dataset.arrays("train")
    with pytest.raises(UsageError, match=r"normalization= must be said of a dict: dataset\.normalization, or None"):
        Boundary.from_batch(rows)
    plain = next(iter(dataset.batches(8, shuffle=False, normalize=False, dtype="float64")))
    np.testing.assert_array_equal(Boundary.from_batch(plain).start_q, rows["start_q"][:8])
    boundary = Boundary.from_batch(rows, None)
    assert boundary.goal_ddq is None
    np.testing.assert_array_equal(boundary.start_ddq, rows["start_ddq"])
    assert Boundary.from_batch({**rows, "goal_ddq": rows["start_ddq"]}, None).fixed_at_goal == 3
    with pytest.raises(
        UsageError, match="the batch lacks start_ddq, goal_dq: it has the fields start_q, start_dq, goal_q"
    ):
        Boundary.from_batch({name: rows[name] for name in ("start_q", "start_dq", "goal_q")}, None)


def test_joint_positions_in_degrees_are_said_to_be_suspicious(omegas: Any) -> None:
    given = boundary("airhockey", 4)
    with pytest.warns(UserWarning, match="goal_q of plan 0: joint_. = .* rad is far outside of its limits"):
        omegas["airhockey"].tasks(replace(given, goal_q=np.degrees(given.goal_q)))
