"""The pages of a puck and a load: 1,000 drags in a browser give the plans of Python, without an error."""

import importlib.util
import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio
import pytest

from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.problems.obstacles import table_frame_of
from cnpgen.problems.problem_record import open_problem
from tests.conftest import HANGING

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(find_spec("ziglang") is None, reason="needs cnpgen[compiler]"),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
]
DOCS = Path(__file__).parents[2] / "docs"
DRAGS = 1_000
JOINTS = {"puck": 6, "transport": 7}
_DRAGS = """<pre id="found"></pre><script>
const found = [];
window.addEventListener("error", (event) => found.push({error: event.message}));
for (let k = 0; k < DRAGS; k++) {
  if (k % 10 === 0) for (const [i, {name, low, high, factor}] of SLIDERS.entries())
    scene[name] = factor * (low + (high - low) * (0.5 + 0.5 * Math.cos(0.11 * k + i)));
  const name = names[k % 2], {left, right, low, high} = HANDLES[name];
  const [u, v] = [0.5 + 0.5 * Math.cos(0.37 * k), 0.5 + 0.5 * Math.sin(0.48 * k)];
  move(name, left + (right - left) * u, low + (high - low) * v);
  const kept = k % 50 < 2;
  found.push({code: last.code, duration: last.duration, request: kept ? last.request : null, path: kept ? last.path : null,
              state: kept ? last.states[80] : null});
}
const shape = {overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
               text: parseFloat(getComputedStyle(document.body).fontSize)};
canvas.focus();
scene.selected = names[1];
scene[names[0]] = [(HANDLES[names[0]].left + HANDLES[names[0]].right) / 2, 0];
canvas.dispatchEvent(new KeyboardEvent("keydown", {key: " "}));
shape.selected = scene.selected;
const before = scene[names[0]][0];
canvas.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight"}));
shape.key = scene[names[0]][0] - before;
const slider = document.querySelector("input");
slider.value = slider.max;
slider.dispatchEvent(new Event("input"));
shape.slider = last.request[last.request.length - Object.keys(D.ranges).length];
const box = canvas.getBoundingClientRect(), scale = box.width / (VIEW.right - VIEW.left);
canvas.setPointerCapture = () => {}; // synthetic pointers cannot be captured
const at = (x) => ({pointerId: 1, pointerType: "touch", clientX: box.left + (x - VIEW.left) * scale,
                    clientY: box.top + 0.5 * box.height});
for (const [type, x] of [["pointerdown", before], ["pointermove", before + 0.05], ["pointerup", before + 0.05]])
  canvas.dispatchEvent(new PointerEvent(type, at(x)));
shape.touched = scene[names[0]][0] - before;
document.getElementById("found").textContent = JSON.stringify({found, shape});
</script>"""


@cache
def planner_pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "planner_pages", DOCS / "planner_pages.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Dragged:
    """Results of the drags of a page."""

    name: str
    text: str
    log: str
    found: list[dict[str, Any]]
    shape: dict[str, Any]

    @property
    def planner(self) -> Planner:
        """The planner of the page."""
        return Planner(planner_pages().PAGES[self.name].model)

    @property
    def kept(self) -> list[dict[str, Any]]:
        """Those with a request, in the order of the conditions of a boundary, and a motion."""
        return [each for each in self.found if each["request"] and not each["code"]]


@pytest.fixture(scope="module", params=JOINTS)
def dragged(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Dragged:
    """Results of the drags, in a window of 400 pixels, from a file."""
    pages, name = planner_pages(), request.param
    folder = tmp_path_factory.mktemp("page")
    text = pages.page_text(name, pages.planner_module(pages.PAGES[name].model, folder))
    page = folder / f"{name}.html"
    script = _DRAGS.replace("DRAGS", str(DRAGS))
    page.write_text(text.replace("</body>", script + "</body>"), encoding="utf-8")
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu"]
    command += ["--enable-logging=stderr", "--window-size=400,1200"]
    command += [f"--user-data-dir={folder / 'profile'}", "--dump-dom", page.as_uri()]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=HANGING
    )
    assert 'data-ready="yes"' in done.stdout
    found = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.S)
    assert found is not None
    return Dragged(
        name, text, done.stderr, **json.loads(found[1].replace("&quot;", '"'))
    )


def test_a_page_is_small_and_names_no_address(dragged: Dragged) -> None:
    assert len(dragged.text.encode()) <= 1_000_000
    assert not re.findall(r"https?:|src=|href=", dragged.text)


def test_all_drags_are_planned_and_most_are_valid(dragged: Dragged) -> None:
    assert len(dragged.found) == DRAGS
    assert not [each["error"] for each in dragged.found if "error" in each]
    assert "CONSOLE" not in dragged.log
    codes = np.array([each["code"] for each in dragged.found])
    assert np.mean(codes == 0) > 0.7
    assert all((each["duration"] > 0) == (each["code"] == 0) for each in dragged.found)


def test_plans_in_the_browser_equal_those_of_python(dragged: Dragged) -> None:
    planner, n = dragged.planner, JOINTS[dragged.name]
    assert len(dragged.kept) > 10
    for each in dragged.kept:
        states = np.reshape(each["request"][: 5 * n], (5, n))
        plan = planner.plan(
            states[0], states[3], goal_dq=states[4], parameters=each["request"][5 * n :]
        )
        path = plan.path_control_points.ravel()
        np.testing.assert_allclose(each["path"], path, rtol=0, atol=1e-6)
        assert each["duration"] == pytest.approx(float(plan.duration[0]), rel=1e-5)


def test_torques_of_the_page_are_those_of_pinocchio(dragged: Dragged) -> None:
    """The parameters hold the mass of the load."""
    from cnpgen.world.path import PathWorld

    n = JOINTS[dragged.name]
    robot = dragged.planner.robot
    for each in dragged.kept:
        q, dq, ddq, torque = np.reshape(each["state"], (4, n))
        parameters = np.array(each["request"][5 * n :], float)
        world = PathWorld(robot)
        world.set_path(q[:, None], dq[:, None], ddq[:, None], parameters)
        np.testing.assert_allclose(torque, world.torque[:, 0], rtol=1e-9, atol=1e-8)


def test_ends_of_the_page_are_those_of_pinocchio(dragged: Dragged) -> None:
    """Hits are on the table, within the velocity limits, and along the table; loads are upright at their places."""
    n = JOINTS[dragged.name]
    problem, robot = open_problem(dragged.planner.model.problem)
    for each in dragged.kept:
        start, _, _, goal, dq = np.reshape(each["request"][: 5 * n], (5, n))
        parameters = np.array([each["request"][5 * n :]])
        tips = robot.tip_positions(np.stack([start, goal, goal + 1e-6 * dq]))
        if dragged.name == "puck":
            frame = table_frame_of(problem, parameters)
            assert frame is not None
            heights = np.concatenate([frame.to_table(tip[None]) for tip in tips])[:, 2]
            assert heights[:2] == pytest.approx(0.16, abs=1e-8)
            assert heights[2] - heights[1] == pytest.approx(0, abs=1e-11)
            limit = robot.velocity_limit * parameters[0, -1]
            assert np.all(np.abs(dq) <= limit * (1 + 1e-9))
        else:
            assert np.all(
                (robot.position_lower <= [start, goal])
                & ([start, goal] <= robot.position_upper)
            )
            assert tips[0, 1] < 0 < tips[1, 1]
            for q in (start, goal):
                data = robot.model.createData()
                pinocchio.framesForwardKinematics(robot.model, data, q)
                tip = data.oMf[robot.model.getFrameId(robot.tip)]
                assert tip.rotation[2, 2] == pytest.approx(1, abs=1e-7)


def test_a_page_is_usable_at_400_pixels_by_keyboard_and_touch(dragged: Dragged) -> None:
    shape = dragged.shape
    assert shape["overflow"] <= 0
    assert shape["text"] >= 16
    assert shape["key"] == pytest.approx(0.02)
    assert shape["touched"] == pytest.approx(0.05, abs=0.02)
    first = next(iter(planner_pages().PAGES))
    assert shape["selected"] == ("puck" if dragged.name == first else "start")
    assert shape["slider"] == pytest.approx(0.1 if dragged.name == first else 14)


def test_examples_of_a_transport_are_of_the_data_set() -> None:
    boundary = draw_boundary_problems("heavy-object-loads", 3, seed=1).boundary
    pages = planner_pages()
    examples = np.array(pages.page_data(pages.PAGES["transport"], b"")["examples"])
    np.testing.assert_allclose(examples[:3, 6:13], boundary.start_q, atol=1e-4)
