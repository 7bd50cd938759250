"""The identity of a problem: it changes with everything that kernels and plans depend on, and with nothing else."""

from collections.abc import Iterator
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cnpgen.planner.inference_pipeline import loaded_problem
from cnpgen.planner.model import Model, ModelConfig
from cnpgen.planner.planner import Planner
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.robot_spec import HeldObject, Payload
from cnpgen.schema import registry
from cnpgen.schema.keys import Range, keys
from cnpgen.trajectory.boundary import Boundary
from tests.examples.constraints import TipSpeed
from tests.examples.models import untrained_model
from tests.examples.shipped import PROBLEMS

# Names, locations of files, how they are read, what was measured and who states limits:
# only their content counts.
LABELS = {
    "title",
    "version",
    "robot.urdf",
    "robot.srdf",
    "robot.convex_parts",
    "robot.hull_gap",
    "limits.sources",
}


PLUGGED = "with a plug-in"
NAMES = (*PROBLEMS, PLUGGED)


def example(name: str) -> Problem:
    """Return a shipped problem, or one with a constraint of another package."""
    if name != PLUGGED:
        return PROBLEMS[name]
    shipped = PROBLEMS["airhockey"]
    return replace(shipped, constraint=(*shipped.constraint, TipSpeed()))


def other_values(value: Any) -> Iterator[Any]:
    """Other values of a key, each different in one place: of nested tables in every key of theirs."""
    if isinstance(value, Range):
        yield from (
            Range(value.low - 1e-9, value.high),
            Range(value.low, value.high + 1e-9),
        )
    elif is_dataclass(value):
        yield from (changed for _, changed in changes(value))
    elif isinstance(value, tuple):
        yield from [value[:-1]] if value else []
        yield from (
            (*value[:i], each, *value[i + 1 :])
            for i, entry in enumerate(value)
            for each in other_values(entry)
        )
    elif isinstance(value, str):
        yield value + "x"
    else:
        yield 1.5 if value is None else value + (1 if isinstance(value, int) else 1e-9)


def changes(obj: Any) -> Iterator[tuple[str, Any]]:
    """Yield every key of a table, dotted, with an object that differs from ``obj`` there alone."""
    for key in keys(type(obj)):
        value = getattr(obj, key.name)
        if is_dataclass(value) and not isinstance(value, Range):
            yield from (
                (f"{key.name}.{inner}", replace(obj, **{key.name: new}))
                for inner, new in changes(value)
            )
        elif key.hint is HeldObject:
            yield key.name, replace(obj, **{key.name: HeldObject(size=(0.1, 0.1, 0.1))})
        elif key.hint is Payload:
            yield key.name, replace(obj, **{key.name: Payload(mass=1.5)})
        else:
            yield from (
                (key.name, replace(obj, **{key.name: new}))
                for new in other_values(value)
            )


@pytest.mark.parametrize("name", NAMES)
def test_every_key_of_a_recipe_but_its_labels_changes_the_identity(name: str) -> None:
    problem = example(name)
    found = [(key, other) for key, other in changes(problem) if key not in LABELS]
    keys_seen = {key for key, _ in found}
    assert {
        "name",
        "robot.joints",
        "robot.tip",
        "robot.base",
        "limits.torque_scale",
        "constraint",
    } < keys_seen
    assert {
        "trajectory.degree",
        "trajectory.rate_control_points",
        "objective.centrifugal",
    } < keys_seen
    assert len(found) > 40
    identities = {other.identity for _, other in found}
    same = [key for key, other in found if other.identity == problem.identity]
    assert not same
    assert len(identities) == len(found)


@pytest.mark.parametrize("name", NAMES)
def test_what_a_problem_is_called_and_where_it_lies_does_not_change_it(
    name: str, tmp_path: Path
) -> None:
    problem = example(name)
    (tmp_path / "other.urdf").write_bytes(problem.urdf_path.read_bytes())
    moved = replace(
        problem,
        title="Another",
        path=tmp_path / "p.toml",
        robot=replace(problem.robot, urdf="other.urdf"),
    )
    assert moved.identity == problem.identity


def test_the_content_of_the_urdf_changes_it_and_robot_and_identity_are_of_one_text(
    tmp_path: Path,
) -> None:
    problem = replace(PROBLEMS["airhockey"], path=tmp_path / "problem.toml")
    text = PROBLEMS["airhockey"].urdf_path.read_text(encoding="utf-8")
    problem.urdf_path.write_text(text, encoding="utf-8")
    before = problem.identity
    assert before == PROBLEMS["airhockey"].identity
    problem.urdf_path.write_text(
        text.replace('effort="320"', 'effort="100"'), encoding="utf-8"
    )
    edited = replace(problem)
    assert edited.identity != before
    assert load_robot(edited).torque_limit[0] != load_robot(problem).torque_limit[0]
    np.testing.assert_array_equal(
        load_robot(problem).torque_limit, load_robot(PROBLEMS["airhockey"]).torque_limit
    )
    problem.urdf_path.unlink()
    assert problem.identity == before
    assert load_robot(problem).model.nq == 6


def test_code_and_undeclared_fields_of_a_plug_in_change_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = example(PLUGGED)
    faster = replace(
        problem, constraint=(*problem.constraint[:-1], TipSpeed(highest=2.0))
    )
    assert faster.identity != problem.identity
    monkeypatch.setattr(registry, "package_digest", lambda _: "edited")
    assert replace(problem).identity != problem.identity


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_problem_that_is_read_from_its_record_is_the_same_one(name: str) -> None:
    problem = PROBLEMS[name]
    record = record_problem(problem)
    assert open_problem(record)[0].identity == problem.identity
    with loaded_problem(record, "numpy") as given:
        assert given.kernels.identity == problem.identity


def boundary(n: int, speed: float) -> Boundary:
    """Two motions that start at a speed [rad/s]."""
    start = np.zeros((2, n)) + np.linspace(0.1, 0.4, 2)[:, None]
    return Boundary(
        start,
        np.full((2, n), speed),
        np.full((2, n), 0.1),
        start + 0.5,
        np.full((2, n), 0.2),
    )


@pytest.fixture(scope="module")
def model() -> Model:
    """An untrained model of the shipped problem, without Gauss-Newton steps: their kernels take seconds to build."""
    return untrained_model(
        "airhockey",
        boundary(6, 0.3),
        config=ModelConfig(path_scale=0.3, line_projection_steps=0, projection_steps=0),
    )


def model_of(problem: Problem, given: Model, outputs: int) -> Model:
    """The model for another problem, whose paths have ``outputs`` free control points."""
    architecture = replace(given.architecture, path_outputs=outputs * 6)
    parameters = (
        np.random.default_rng(0)
        .normal(0, 0.01, architecture.n_parameters)
        .astype(np.float32)
    )
    return replace(
        given,
        problem=record_problem(problem),
        architecture=architecture,
        parameters=parameters,
    )


@pytest.mark.parametrize(
    ("change", "outputs"), [({"degree": 5}, 10), ({"path_control_points": 13}, 8)]
)
def test_kernels_of_a_problem_are_not_those_of_one_with_another_trajectory(
    change: dict[str, int],
    outputs: int,
    model: Model,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CNPGEN_CACHE", str(tmp_path))
    shipped, wanted = PROBLEMS["airhockey"], boundary(6, 0.3)
    Planner(model, backend="numpy").plan_batch(wanted)
    problem = replace(shipped, trajectory=replace(shipped.trajectory, **change))
    plans = Planner(model_of(problem, model, outputs), backend="numpy").plan_batch(
        wanted
    )
    assert plans.path_control_points.shape == (
        2,
        problem.trajectory.path_control_points,
        6,
    )
    q, dq, ddq = plans.states_at(0.0)
    np.testing.assert_allclose(q, wanted.start_q, atol=1e-12)
    np.testing.assert_allclose(dq, 0.3, atol=1e-12)
    np.testing.assert_allclose(ddq, 0.1, atol=1e-9)
