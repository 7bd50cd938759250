"""Forward kinematics of many states: agreement with Pinocchio."""

from pathlib import Path

import numpy as np
import pinocchio as pin

from cnpgen.errors import MachineError
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.world.forward_kinematics import ForwardKinematics
from tests.examples.shaped_robot import write_problem
from tests.refusals import is_refused

BRANCHING = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<joint name="turn" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.1 0.2 0.3" rpy="0.1 0.2 0.3"/>
<axis xyz="1 2 3"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="slide" type="prismatic"><parent link="b"/><child link="c"/><origin xyz="0 0.2 0" rpy="1 0 0"/>
<axis xyz="3 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="other" type="revolute"><parent link="b"/><child link="d"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""


def models(folder: Path) -> dict[str, pin.Model]:
    """Return models with revolute and prismatic joints and with branches."""
    problems = [
        load_problem("airhockey"),
        load_problem("heavy-object"),
        load_problem(write_problem(folder)),
    ]
    found = {problem.name: load_robot(problem).model for problem in problems}
    return {**found, "branching": pin.buildModelFromXML(BRANCHING)}


def test_poses_agree_with_those_of_single_states(tmp_path: Path) -> None:
    for name, model in models(tmp_path).items():
        data, q = (
            model.createData(),
            np.random.default_rng(0).uniform(-2, 2, (model.nq, 40)),
        )
        rotations, positions = ForwardKinematics(model).poses(q)
        for k, state in enumerate(q.T):
            pin.forwardKinematics(model, data, state.copy())
            for joint, pose in enumerate(data.oMi):
                np.testing.assert_allclose(
                    rotations[joint, ..., k], pose.rotation, atol=1e-14, err_msg=name
                )
                np.testing.assert_allclose(
                    positions[joint, :, k], pose.translation, atol=1e-14, err_msg=name
                )


def test_poses_that_differ_from_pinocchios_raise_an_error() -> None:
    model = load_robot(load_problem("airhockey")).model
    kinematics = ForwardKinematics(model)
    model.jointPlacements[
        3
    ].translation += 1e-6  # the model changes after its coefficients were read
    with is_refused(MachineError):
        kinematics.poses(np.ones((model.nq, 3)))


def test_no_point_moves_by_more_than_the_motion_bounds(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    for model in models(tmp_path).values():
        data, extents = model.createData(), np.full(model.njoints, 0.2)
        bounds = ForwardKinematics(model).motion_bounds(extents, np.full(model.nq, 2.0))
        points = random.normal(size=(50, 3))
        points *= 0.2 / np.linalg.norm(points, axis=1)[:, None]
        for _ in range(50):
            q, dq = random.uniform(-2, 2, model.nq), random.normal(size=model.nq)
            places = []
            for state in (q, q + 1e-6 * dq):
                pin.forwardKinematics(model, data, state)
                places.append(
                    [pose.act(point) for pose in list(data.oMi)[1:] for point in points]
                )
            moved = np.linalg.norm(np.diff(places, axis=0)[0], axis=1).max()
            assert moved <= 1e-6 * (bounds @ np.abs(dq)) * (1 + 1e-5)
