"""Holding torque: Pinocchio's gravity torque, payload included."""

from dataclasses import replace

import numpy as np
import pytest

from cnpgen.pipelines.stages.torque import GravityTorque, torque_ratio
from tests.conftest import Arm, Prepare, needs_compiled_code, run_stages

BACKENDS = [pytest.param("compiled", marks=needs_compiled_code), "numpy", "casadi"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["heavy-object", "airhockey-hit"])
def test_the_ratio_is_the_largest_gravity_torque_by_its_limit(
    prepare: Prepare, kernels_of, name, backend
):
    prepared = prepare(name)
    robot, arm, random = (
        prepared.context.robot,
        Arm(prepared.context.robot),
        np.random.default_rng(101),
    )
    q = random.uniform(
        robot.position_lower, robot.position_upper, (300, robot.n)
    ).T.copy()
    (ratio,) = kernels_of(prepared, backend).load(torque_ratio)(q)
    zero = np.zeros(robot.n)
    expected = [
        np.max(np.abs(arm.torque(x, zero, zero)) / robot.torque_limit) for x in q.T
    ]
    np.testing.assert_allclose(ratio[0], expected, rtol=1e-12)


def test_the_payload_is_part_of_the_torque(prepare: Prepare):
    """The payload is twelve kilograms on a stretched arm; without it, the shoulder torque is much smaller."""
    robot = prepare("heavy-object").context.robot
    arm, zero = Arm(robot), np.zeros(7)
    stretched = np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0])
    reach = np.linalg.norm(np.array(arm.pose(stretched).translation)[:2])
    assert abs(arm.torque(stretched, zero, zero)[1]) > 12 * 9.8 * reach


def test_torque_ratios_of_accepted_rows_are_stored_and_at_most_one(prepare: Prepare):
    prepared = prepare("heavy-object")
    candidates = run_stages(prepared, 1500, seed=102)
    robot, arm, zero = prepared.context.robot, Arm(prepared.context.robot), np.zeros(7)
    for end in ("start", "goal"):
        expected = [
            np.max(np.abs(arm.torque(q, zero, zero)) / robot.torque_limit)
            for q in candidates[f"{end}_q"].T
        ]
        np.testing.assert_allclose(
            candidates[f"{end}_torque_ratio"][0], expected, rtol=1e-12
        )
        assert 0.3 < max(expected) <= 1


@pytest.mark.slow
def test_configurations_above_the_torque_limit_are_rejected_and_counted(
    prepare: Prepare,
):
    pipeline = prepare("heavy-object").pipeline
    problem = replace(
        pipeline.problem, limits=replace(pipeline.problem.limits, torque_scale=0.35)
    )
    prepared = prepare(replace(pipeline, problem=problem), "numpy")
    candidates = run_stages(prepared, 1500, seed=102)
    counts = np.bincount(candidates.outcome, minlength=1 + len(candidates.reasons))[1:]
    sampling = dict(zip(candidates.reasons, counts.tolist(), strict=True))
    assert sampling["joint torque limit at the start"] > 50
    assert sampling["joint torque limit at the goal"] > 10
    robot, arm, zero = prepared.context.robot, Arm(prepared.context.robot), np.zeros(7)
    for end in ("start", "goal"):
        for q in candidates[f"{end}_q"].T:
            assert np.all(
                np.abs(arm.torque(q, zero, zero)) <= robot.torque_limit * (1 + 1e-12)
            )


@pytest.mark.parametrize("end", ["start", "goal"])
def test_the_stage_names_its_end(prepare: Prepare, end):
    stage = GravityTorque(end=end)
    assert stage.inputs == (f"{end}_q",)
    assert f"the {end} configuration, payload included" in stage.describe()
    (field,) = stage.outputs(prepare("heavy-object").context)
    assert field.name == f"{end}_torque_ratio"
