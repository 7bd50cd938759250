"""The page where the reader moves the puck: 1,000 drags in a browser give the plans of Python, without an error."""

import importlib.util
import json
import re
import shutil
import subprocess
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from cnpgen.planner.planner import Planner
from cnpgen.robots.robot import Robot

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.extended,
    pytest.mark.skipif(find_spec("ziglang") is None, reason="needs cnpgen[compiler]"),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
]
DOCS = Path(__file__).parents[2] / "docs"
DRAGS = 1_000
_DRAGS = """<pre id="found"></pre><script>
const found = [];
window.addEventListener("error", (event) => found.push({error: event.message}));
for (let k = 0; k < DRAGS; k++) {
  const angle = 0.37 * k, began = performance.now();
  if (k % 2) move("puck", 1 + 0.2 * Math.cos(angle), 0.25 * Math.sin(angle));
  else move("target", 2.4, 0.3 * Math.sin(1.3 * angle));
  found.push({time: performance.now() - began, code: last.code, duration: last.duration,
              request: k % 50 < 2 ? last.request : null, path: k % 50 < 2 ? last.path : null});
}
const shape = {overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
               text: parseFloat(getComputedStyle(document.body).fontSize)};
table.focus();
const before = scene.puck[0];
scene.selected = "puck";
table.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight"}));
shape.key = scene.puck[0] - before;
const box = table.getBoundingClientRect();
table.setPointerCapture = () => {}; // synthetic pointers cannot be captured
for (const [type, x] of [["pointerdown", 0.4], ["pointermove", 0.45], ["pointerup", 0.45]])
  table.dispatchEvent(new PointerEvent(type, {pointerId: 1, pointerType: "touch", clientX: box.left + x * box.width,
                                              clientY: box.top + 0.5 * box.height}));
shape.touched = scene.puck;
document.getElementById("found").textContent = JSON.stringify({found, shape});
</script>"""


def puck_page() -> ModuleType:
    spec = importlib.util.spec_from_file_location("puck_page", DOCS / "puck_page.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    module = puck_page()
    page: str = module.page_text(module.planner_module(tmp_path_factory.mktemp("wasm")))
    assert len(page.encode()) <= module.MAX_BYTES
    return page


@pytest.fixture(scope="module")
def dragged(text: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Results of the drags, in a window of 400 pixels, from a file."""
    folder = tmp_path_factory.mktemp("page")
    page = folder / "puck.html"
    script = _DRAGS.replace("DRAGS", str(DRAGS))
    page.write_text(text.replace("</body>", script + "</body>"), encoding="utf-8")
    command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu"]
    command += ["--window-size=400,1200", f"--user-data-dir={folder / 'profile'}"]
    done = subprocess.run(
        [*command, "--dump-dom", page.as_uri()],
        capture_output=True, text=True, check=True, timeout=300,
    )  # fmt: skip
    assert 'data-ready="yes"' in done.stdout
    found = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.S)
    assert found is not None
    result: dict[str, Any] = json.loads(found[1].replace("&quot;", '"'))
    return result


def test_all_drags_are_planned_and_most_are_valid(dragged: dict[str, Any]) -> None:
    found = dragged["found"]
    assert len(found) == DRAGS
    assert not [each["error"] for each in found if "error" in each]
    codes = np.array([each["code"] for each in found])
    assert np.mean(codes == 0) > 0.8
    assert all((each["duration"] > 0) == (each["code"] == 0) for each in found)


def test_plans_in_the_browser_equal_those_of_python(dragged: dict[str, Any]) -> None:
    planner = Planner("airhockey-hit")
    kept = [each for each in dragged["found"] if each["path"] and each["code"] == 0]
    assert len(kept) > 10
    for each in kept:
        states = np.reshape(each["request"], (5, 6))
        plan = planner.plan(states[0], states[3], goal_dq=states[4])
        path = plan.path_control_points.ravel()
        np.testing.assert_allclose(each["path"], path, rtol=0, atol=1e-6)
        assert each["duration"] == pytest.approx(float(plan.duration[0]), rel=1e-5)


def test_hits_of_the_page_are_those_of_pinocchio(dragged: dict[str, Any]) -> None:
    """Goals are on the table, within the velocity limits, and move along the table."""
    robot: Robot = Planner("airhockey-hit").robot
    goals = [
        np.reshape(each["request"], (5, 6))
        for each in dragged["found"]
        if each["request"]
    ]
    step = 1e-6
    for _, _, _, q, dq in goals:
        tip, ahead = robot.tip_positions(np.stack([q, q + step * dq]))
        assert tip[2] == pytest.approx(0.16, abs=1e-8)
        assert (ahead - tip)[2] / step == pytest.approx(0, abs=1e-5)
        assert np.all(np.abs(dq) <= robot.velocity_limit * (1 + 1e-9))


def test_the_page_is_usable_at_400_pixels_by_keyboard_and_touch(
    dragged: dict[str, Any],
) -> None:
    shape = dragged["shape"]
    assert shape["overflow"] <= 0
    assert shape["text"] >= 16
    assert shape["key"] == pytest.approx(0.02)
    x, y = shape["touched"]
    assert x == pytest.approx(-0.1 + 0.45 * 2.75, abs=0.02)
    assert abs(y) < 0.02
