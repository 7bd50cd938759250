"""A payload with touch links is a box that touches neither other links nor obstacles, for kernels, trees and judges."""

import re
from dataclasses import replace

import numpy as np
import pytest

import cnpgen
from cnpgen.errors import RecipeError
from cnpgen.plans.boundary_problems import plans_of_rows
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import (
    as_problem,
    open_problem,
    record_problem,
    with_payload_of,
)
from cnpgen.robots.robot_spec import Payload
from cnpgen.robots.urdf_changes import PAYLOAD
from tests.examples.shaped_robot import write_problem
from tests.refusals import is_refused

BODY = """
[payload]
mass = 2.0
centre = [0.1, 0.0, 0.2]
size = [0.1, 0.1, 0.3]
touch_links = ["hand"]
"""


def with_payload(folder, text: str = BODY):
    file = write_problem(folder)
    content = file.read_text(encoding="utf-8").replace("[robot]", f"{text}\n[robot]")
    file.write_text(content, encoding="utf-8")
    return file


def test_the_payload_is_a_link_without_mass_at_the_tip(tmp_path):
    robot = load_robot(load_problem(with_payload(tmp_path)))
    bare = load_robot(
        load_problem(
            with_payload(tmp_path / "bare", BODY.replace('touch_links = ["hand"]', ""))
        )
    )
    (part,) = (each for each in robot.shape.convex_parts if each.link == PAYLOAD)
    placement = robot.model.frames[robot.tip_frame].placement
    corners = (part.vertices - placement.translation) @ placement.rotation
    np.testing.assert_allclose(
        np.sort(corners, axis=0)[[0, -1]],
        [[0.05, -0.05, 0.05], [0.15, 0.05, 0.35]],
        atol=1e-12,
    )
    pairs = {
        frozenset((pair.first, pair.second)): pair.left_out
        for pair in robot.shape.pairs
    }
    assert pairs[frozenset(("base", PAYLOAD))] == ""
    assert (
        frozenset(("hand", PAYLOAD)) not in pairs or pairs[frozenset(("hand", PAYLOAD))]
    )
    assert PAYLOAD not in bare.shape.joints
    for name in ("mass", "com", "inertia"):
        np.testing.assert_allclose(
            getattr(robot.chain.joints[-1], name),
            getattr(bare.chain.joints[-1], name),
            atol=1e-12,
        )


def test_a_stored_problem_has_the_payload_once(tmp_path):
    problem = load_problem(with_payload(tmp_path))
    record = record_problem(problem)
    assert record.urdf.count(f'<link name="{PAYLOAD}"') == 1
    restored, robot = open_problem(record)
    assert restored.urdf_text == record.urdf
    assert PAYLOAD in robot.shape.joints
    with record.restored() as again:
        assert again.payload.touch_links == ("hand",)


def test_a_changed_payload_of_a_stored_problem_changes_its_body(tmp_path):
    problem = load_problem(with_payload(tmp_path))
    stored = as_problem(record_problem(problem))
    assert stored.urdf_text == problem.urdf_text
    larger = replace(problem.payload, size=(0.2, 0.2, 0.6))
    for payload, size in (
        (None, None),
        (Payload(mass=3.0), None),
        (larger, [0.2, 0.2, 0.6]),
    ):
        shape = load_robot(replace(stored, payload=payload)).shape
        parts = [part for part in shape.convex_parts if part.link == PAYLOAD]
        assert [np.ptp(part.vertices, axis=0).round(9).tolist() for part in parts] == (
            [size] if size else []
        )
    (tmp_path / "crane" / "crane.urdf").write_text(problem.urdf_text)
    named = load_problem(tmp_path / "problem.toml")
    with is_refused(RecipeError):
        load_robot(named)


def test_samples_of_a_body_keep_it_and_cannot_move_it(tmp_path):
    ranges = "[parameters]\npayload_mass = [1.0, 3.0]\n"
    problem = load_problem(with_payload(tmp_path, BODY + ranges))
    sample = with_payload_of(record_problem(problem), np.array([2.5]))
    _, robot = open_problem(sample)
    assert robot.chain.joints[-1].mass == pytest.approx(4.5)  # with hand and claw
    assert PAYLOAD in robot.shape.joints
    moved = ranges.replace("payload_mass = [1.0, 3.0]", "payload_x = [0.0, 0.2]")
    with is_refused(RecipeError):
        load_problem(with_payload(tmp_path / "moved", BODY + moved))


def test_the_payload_does_not_enter_obstacles(tmp_path):
    file = with_payload(tmp_path)
    problem, bare = (
        load_problem(file),
        load_problem(with_payload(tmp_path / "bare", "")),
    )
    for each, touches in ((problem, True), (bare, False)):
        robot = load_robot(each)
        model = cnpgen.RobotModel(each)
        position, rotation = model.forward_kinematics(robot.home)
        center = np.ravel(position) + np.reshape(rotation, (3, 3)) @ [0.1, 0.0, 0.32]
        obstacle = cnpgen.recipes.Obstacle(
            name="ball", kind="sphere", position=tuple(center), radius=0.01
        )
        among = cnpgen.RobotModel(each.with_obstacles([obstacle]))
        assert bool(np.ravel(among.is_collision_free(robot.home))[0]) != touches


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (
            '["hand"]',
            '["hnad"]',
            r"payload.touch_links: the URDF has no link 'hnad' \(did you mean 'hand'\?\)",
        ),
        (
            "size = [0.1, 0.1, 0.3]\n",
            "",
            "payload.touch_links: a payload that is a body needs a 'size'",
        ),
    ],
)
def test_wrong_touch_links_are_refused(tmp_path, old, new, text):
    with pytest.raises(RecipeError, match=text):
        load_robot(load_problem(with_payload(tmp_path, BODY.replace(old, new))))


def test_a_body_needs_link_geometry(tmp_path):
    file = with_payload(tmp_path)
    text = re.sub(
        'use = "robot-clearance"\n',
        'use = "robot-clearance"\nradius = 0.1\n',
        file.read_text(),
    )
    file.write_text(
        text.replace("[robot]", '[robot]\ngeometry = "paper-capsules"'),
        encoding="utf-8",
    )
    with is_refused(RecipeError):
        load_problem(file)


def test_optimized_plans_keep_the_payload_out_of_obstacles_and_links(tmp_path):
    small = BODY.replace("[0.1, 0.1, 0.3]", "[0.06, 0.06, 0.16]").replace(
        "0.0, 0.2]", "0.0, -0.14]"
    )
    problem = load_problem(with_payload(tmp_path, small))
    bare = load_problem(
        with_payload(tmp_path / "bare", small.replace('touch_links = ["hand"]', ""))
    )
    model = cnpgen.RobotModel(problem)
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (1000, 4))
    q = q[model.is_collision_free(q)]
    tips = model.forward_kinematics(q)[0]
    ahead = (tips[:, 0] > 0.3) & (tips[:, 2] < 0.5)
    start, goal = (
        np.flatnonzero(ahead & (side * tips[:, 1] > 0.15))[:4] for side in (1, -1)
    )
    rows = {f"{end}_q": q[chosen] for end, chosen in (("start", start), ("goal", goal))}
    rows |= {
        f"{end}_xyz": tips[chosen] for end, chosen in (("start", start), ("goal", goal))
    }
    rows |= dict.fromkeys(("start_dq", "start_ddq", "goal_dq"), np.zeros((4, 4)))

    def closest(problem: Problem) -> float:
        solved = cnpgen.solve_plans(
            plans_of_rows(record_problem(problem), rows), workers=1
        )
        assert solved.valid.all()
        times = np.linspace(0, 1, 100)[:, None] * solved.plans.duration
        states = [solved.plans.states_at(time)[0] for time in times]
        return float(model.min_distance(np.concatenate(states)).min())

    assert closest(problem) > -1e-4
    assert closest(bare) < -5e-3
