"""The example agent in the evaluator of the Air Hockey Challenge, in a Python environment of its own.

``CNPGEN_CHALLENGE`` is a clone of the Challenge, ``CNPGEN_CHALLENGE_PYTHON`` the interpreter with its libraries.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RUN = ROOT / "docs" / "examples" / "challenge_run.py"
CONSTRAINTS = {"joint_pos_constr", "joint_vel_constr", "ee_constr", "link_constr"}

MIN_X_M = 1.51 - (1.948 / 2 - 0.04815)  # of the mallet in the frame of the robot
needs_challenge = pytest.mark.skipif(
    not {"CNPGEN_CHALLENGE", "CNPGEN_CHALLENGE_PYTHON"} <= os.environ.keys(),
    reason="CNPGEN_CHALLENGE and CNPGEN_CHALLENGE_PYTHON are not set",
)


def run(python: str, *options: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [python, str(RUN), *options]
    return subprocess.run(
        command,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.mark.slow
@needs_challenge
def test_the_agent_scores_without_violating_a_constraint():
    python, clone = (
        os.environ["CNPGEN_CHALLENGE_PYTHON"],
        os.environ["CNPGEN_CHALLENGE"],
    )
    done = run(
        python,
        "--environment",
        clone,
        "--episodes",
        "4",
        "--chunk",
        "4",
        "--seed",
        "31",
    )
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["episodes"] == 4
    assert result["successes"] >= 3
    assert not CONSTRAINTS & result["violations"].keys()


EDGE = """
import sys; sys.path[:0] = sys.argv[1:3]
import json, cnpgen, numpy as np
from air_hockey_challenge.framework.air_hockey_challenge_wrapper import AirHockeyChallengeWrapper
from challenge_agent import GOAL, HitAgent
agent = HitAgent(AirHockeyChallengeWrapper("7dof-hit", interpolation_order=None).env_info)
still, edges = np.zeros(6), []
plan = cnpgen.plan_hits(agent.planner, (agent.home, still, still), [0.743, -0.354], GOAL, speed_share=0.95).plans
for motion in (plan, agent.checked(plan)):
    q = motion.motion.at_times(np.linspace(0, 1, 500)[None] * motion.duration[:, None]).q[0]
    edges.append(float(motion.problem.tip_positions(q)[:, 0].min()))
print(json.dumps(edges))
"""


@needs_challenge
def test_the_agent_refines_hits_that_leave_the_table():
    python, clone = (
        os.environ["CNPGEN_CHALLENGE_PYTHON"],
        os.environ["CNPGEN_CHALLENGE"],
    )
    command = [python, "-W", "ignore", "-c", EDGE, clone, str(RUN.parent)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    planned, checked = json.loads(done.stdout.splitlines()[-1])
    assert planned < MIN_X_M < checked


def test_a_folder_without_the_environment_gives_a_message(tmp_path):
    done = run(sys.executable, "--environment", str(tmp_path))
    assert done.returncode == 3
    assert done.stderr.startswith("the environment cannot be imported: ")
    assert "Traceback" not in done.stderr
