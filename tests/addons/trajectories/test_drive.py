"""Sampled trajectories of arms with drives: the friction of the URDF decides, and reversals between samples count."""

from pathlib import Path

import numpy as np
import pytest

import cnpgen
from cnpgen.addons.trajectories.evaluate_trajectories import evaluate_trajectories
from cnpgen.problems.problem import Problem
from cnpgen.trajectories import Trajectory
from tests.problems.test_drive import arm

START = np.array([0.0, 0.2, -0.6, -1.0])
DURATION_S = 1.9


def quintic(rate: float, distance: float = 2.0, *, back: bool = False) -> Trajectory:
    """Move joint 4 from rest to rest, and back, sampled at a rate [Hz]."""
    t = np.linspace(0, DURATION_S, int(DURATION_S * rate) + 1)
    s = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    x = t / DURATION_S
    if back:  # a reversal at the midpoint
        s = np.polynomial.Polynomial([0, 0, 0, 64, -192, 192, -64])
    q = np.tile(START, (len(t), 1))
    dq, ddq = np.zeros_like(q), np.zeros_like(q)
    q[:, 3] += distance * s(x)
    dq[:, 3] = distance * s.deriv()(x) / DURATION_S
    ddq[:, 3] = distance * s.deriv(2)(x) / DURATION_S**2
    return Trajectory(t, q, dq, ddq)


def used(folder: Path, drive: str = "") -> Problem:
    return arm(folder, f'[drive]\nurdf_dynamics = "use"\n{drive}')


@pytest.mark.parametrize(("share", "violation"), [(0, 18.25), (1, 17.5)])
def test_friction_of_the_urdf_makes_a_motion_invalid(
    tmp_path: Path, share: int, violation: float
) -> None:
    """The case: 38.25 N m where friction never helps, 37.5 by the exact law, of 20 N m."""
    ignored = arm(tmp_path, '[drive]\nurdf_dynamics = "ignore"')
    found = evaluate_trajectories(ignored, [quintic(500)])
    assert found.valid.all()
    assert found.summary()["torque"] == "rigid body"
    found = evaluate_trajectories(
        used(tmp_path, f"friction_help = {share}"), [quintic(500)]
    )
    (verdict,) = found.verdicts
    assert str(verdict.reason) == "joint torque limit"
    worst = verdict.conditions["highest motor torque"].margin
    assert worst is not None
    assert worst.part == "j4"
    assert worst.violation == pytest.approx(violation, abs=0.05)
    assert found.summary()["torque"].startswith("rigid body and drives")


def test_soft_limits_make_a_motion_invalid(tmp_path: Path) -> None:
    motion = quintic(500, 1.6)
    moved = Trajectory(
        motion.t, *(x[:, [3, 1, 2, 0]] for x in (motion.q, motion.dq, motion.ddq))
    )
    moved.q[:, 0] += 1.0
    problem = arm(tmp_path, urdf="soft-limits")
    (verdict,) = evaluate_trajectories(problem, [moved]).verdicts
    assert str(verdict.reason) == "joint position limit"
    hard = arm(tmp_path, urdf="soft-limits", limits='soft = "ignore"')
    assert evaluate_trajectories(hard, [moved]).valid.all()


def test_a_reversal_between_samples_is_part_of_the_uncertainty(tmp_path: Path) -> None:
    """Noise of the velocity near the reversal may turn all of the friction."""
    drive = "friction_help = 1\nviscous = 0\ncoulomb = [0.1, 0.1, 0.1, 19]"
    problem = arm(tmp_path, f'[drive]\nurdf_dynamics = "ignore"\n{drive}')
    motion = quintic(200, 0.4, back=True)
    known, noisy = (
        evaluate_trajectories(problem, [motion], interpolation="quintic", noise=noise)
        for noise in (0.0, [0.0, 0.02, 0.0])
    )
    low = [
        found.verdicts[0].conditions["lowest motor torque"].margin
        for found in (known, noisy)
    ]
    assert low[0] is not None
    assert low[1] is not None
    assert known.valid.all()
    assert low[1].violation > low[0].violation


def test_torques_of_motors_alone_are_judged(tmp_path: Path) -> None:
    problem = used(tmp_path, 'limits = "motor"')
    (verdict,) = evaluate_trajectories(problem, [quintic(500)]).verdicts
    assert str(verdict.reason) == "joint torque limit"
    assert "joint torque" not in verdict.conditions


def test_the_summary_of_plans_states_the_torque(tmp_path: Path) -> None:
    plans = cnpgen.draw_boundary_problems("heavy-object", 1)
    assert cnpgen.evaluate_plans(plans).summary()["torque"] == "rigid body"
