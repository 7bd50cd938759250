"""Pages that any browser opens: what is in them is what Pinocchio says, and Chromium draws it."""

import base64
import json
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import cnpgen
from cnpgen.addons.view.page import stamp
from cnpgen.addons.view.view_bodies import robot_bodies, tube, wrapped
from cnpgen.cli.main import main
from cnpgen.plans.export import export_plans
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem
from cnpgen.trajectories import load_trajectories
from tests.conftest import HANGING, some
from tests.examples.plan_files import plans_of
from tests.examples.plans import load, perturbed
from tests.examples.shaped_robot import WEDGE, write_problem
from tests.refusals import assert_said

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium on this machine"
)


def _has_meshcat() -> bool:
    try:
        metadata.distribution("meshcat")
    except metadata.PackageNotFoundError:
        return False
    return True


def needs_meshcat(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test of pages: they are in the slow run, as MeshCat brings two dozen packages that nothing else needs."""
    skipped = pytest.mark.skipif(not _has_meshcat(), reason="MeshCat is not installed")
    return pytest.mark.slow(skipped(test))


def content(page: Path) -> dict[str, Any]:
    """Content of a page."""
    return in_page(page.read_text(encoding="utf-8"))


def in_page(text: str, view: int = 0) -> dict[str, Any]:
    """Data of a page: those of the robot and of one view."""
    data: dict[str, Any] = json.loads(
        re.search(r'type="application/json">(.*?)</script>', text, re.S)[1]
    )
    return data | data["views"][view]


def array(text: str, dtype: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(shape)


@pytest.fixture(scope="module")
def plans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two plans of a carried object, and a folder of rows beside them."""
    folder = tmp_path_factory.mktemp("view")
    cnpgen.make_dataset("heavy-object", folder / "rows", n=40, workers=1)
    cnpgen.save_plans(
        folder / "plans.h5", plans_of(load("dragging"), load("transport"))
    )
    return folder / "plans.h5"


@pytest.fixture(scope="module")
def page(plans: Path) -> Path:
    assert (
        main(
            ["view", str(plans), "--row", "1", "-o", str(plans.with_name("plan.html"))]
        )
        == 0
    )
    return plans.with_name("plan.html")


@needs_meshcat
def test_the_joints_of_a_plan_are_where_pinocchio_has_them(page, plans):
    shown, problem = content(page), load_problem("heavy-object")
    robot, motion = load_robot(problem), cnpgen.load_plans(plans).motion[1:2]
    poses = array(shown["poses"], "<f4", -1, shown["joints_and_tip"], 4, 4).transpose(
        0, 1, 3, 2
    )
    assert len(poses) == len(shown["times"]) == len(shown["labels"]) == 240
    assert shown["times"][-1] == pytest.approx(motion.duration()[0])
    data = robot.model.createData()
    for k in (0, 100, 239):
        q = motion.at_times(np.array([[shown["times"][k]]])).q[0, 0]
        pin.framesForwardKinematics(robot.model, data, q)
        np.testing.assert_allclose(poses[k, 3], data.oMi[3].homogeneous, atol=1e-6)
        np.testing.assert_allclose(
            poses[k, -1],
            data.oMf[robot.model.getFrameId("object")].homogeneous,
            atol=1e-6,
        )


@needs_meshcat
def test_the_curves_are_shares_of_the_limits(page, plans):
    shown, robot = content(page), load_robot(load_problem("heavy-object"))
    curves = {curve["name"]: np.array(curve["shares"]) for curve in shown["curves"]}
    assert list(curves) == ["position", "velocity", "acceleration", "torque"]
    states = cnpgen.load_plans(plans).motion[1:2].at_times(np.array([shown["times"]]))
    np.testing.assert_allclose(
        curves["velocity"], states.dq[0].T / robot.velocity_limit[:, None], atol=1e-4
    )
    data = robot.model.createData()
    torque = pin.rnea(
        robot.model, data, *(each[0, 120] for each in (states.q, states.dq, states.ddq))
    )
    np.testing.assert_allclose(
        curves["torque"][:, 120], torque / robot.torque_limit, atol=1e-4
    )


@needs_meshcat
def test_obstacles_the_object_and_the_path_are_shown(page):
    shown = content(page)
    assert [body["name"] for body in shown["world"]] == ["pedestal-1", "pedestal-2"]
    assert [(body["name"], body["joint"]) for body in shown["held"]] == [("object", 8)]
    assert [body["name"] for body in shown["path"]] == ["path of the tip"]
    assert shown["title"] == "heavy-object: plans.h5, plan 1"


@needs_meshcat
def test_a_page_asks_no_network(page):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r'<(script|link|img)[^>]*(src|href)="(?!data:)', text)


@needs_meshcat
def test_names_cannot_become_a_part_of_the_page(plans, tmp_path):
    named = tmp_path / "<!--<script>alert(1)<b>.h5"
    shutil.copy(plans, named)
    assert main(["view", str(named), "-o", str(tmp_path / "page.html")]) == 0
    assert "<script>alert" not in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert (
        content(tmp_path / "page.html")["title"]
        == "heavy-object: <!--<script>alert(1)<b>.h5, plan 0"
    )


@needs_meshcat
def test_a_row_without_a_plan_is_shown_at_its_start_and_goal(
    plans, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    folder = plans.with_name("rows")
    assert main(["view", str(folder), "--split", "train", "--row", "3"]) == 0
    assert capsys.readouterr().out == "rows.html\n"
    shown = content(tmp_path / "rows.html")
    assert (shown["labels"], shown["curves"]) == (["start", "goal"], [])
    tips = array(shown["poses"], "<f4", 2, -1, 4, 4)[:, -1, 3, :3]
    rows = cnpgen.load_dataset(folder).arrays("train", fields=["start_xyz", "goal_xyz"])
    np.testing.assert_allclose(
        tips, [rows["start_xyz"][3], rows["goal_xyz"][3]], atol=1e-6
    )


@needs_meshcat
def test_a_problem_is_shown_in_its_base_configuration(tmp_path):
    assert main(["view", "airhockey", "-o", str(tmp_path / "arm.html")]) == 0
    shown = content(tmp_path / "arm.html")
    assert (shown["labels"], shown["note"]) == (
        ["base"],
        "drawn as the line through its joints' origins",
    )
    assert [body["name"] for body in shown["world"]] == ["table"]
    assert len(shown["robot"]) > 3


@needs_meshcat
def test_a_robot_with_a_shape_has_capsules(tmp_path):
    assert (
        main(["view", str(write_problem(tmp_path)), "-o", str(tmp_path / "crane.html")])
        == 0
    )
    shown = content(tmp_path / "crane.html")
    assert shown["note"].startswith("drawn with the convex parts")
    assert {body["name"] for body in shown["capsules"]} == {
        body["name"] for body in shown["robot"]
    }
    assert [body["name"] for body in shown["world"]] == ["wall", "roof"]


def _with_visual(folder: Path, name: str) -> Path:
    file = write_problem(folder)
    urdf = folder / "crane" / "crane.urdf"
    mesh = f'<mesh filename="{name}" scale="0.001 0.001 0.001"/>'
    visual = f'<visual><origin xyz="0.1 0 0"/><geometry>{mesh}</geometry></visual>'
    urdf.write_text(
        urdf.read_text().replace('<link name="fore">', f'<link name="fore">{visual}')
    )
    return file


def test_visual_meshes_are_shown_where_they_are_found(tmp_path):
    problem = load_problem(_with_visual(tmp_path, "package://crane/meshes/wedge.stl"))
    robot = load_robot(problem)
    (body,), kind = robot_bodies(problem, robot)
    assert (kind, body.name, body.joint, len(body.triangles)) == (
        "meshes",
        "fore",
        3,
        8,
    )
    np.testing.assert_allclose(
        body.corners.max(axis=0), WEDGE.max(axis=0) / 1000 + [0.1, 0, 0], atol=1e-9
    )


@pytest.mark.parametrize(
    "name", some(["meshes/none.stl", "meshes/broken.stl"], 1, "slow")
)
def test_without_its_meshes_a_robot_is_shown_as_judges_see_it(name, tmp_path):
    problem = load_problem(_with_visual(tmp_path, name))
    (tmp_path / "crane" / "meshes" / "broken.stl").write_bytes(b"no mesh")
    assert robot_bodies(problem, load_robot(problem))[1] == "convex parts"


def volume(body) -> float:
    a, b, c = (body.corners[body.triangles[:, side]] for side in range(3))
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("corners", "radius", "expected"),
    [
        ([[0, 0, 0]], 0.5, 4 / 3 * np.pi * 0.5**3),
        ([[0, 0, 0], [0, 0, 1]], 0.2, 4 / 3 * np.pi * 0.2**3 + np.pi * 0.2**2),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], 0.0, 1 / 6),
    ],
)
def test_a_body_is_closed_and_its_triangles_face_outwards(corners, radius, expected):
    assert volume(
        wrapped("body", 0, np.array(corners, float), radius)
    ) == pytest.approx(expected, rel=0.02)


def test_a_line_is_a_tube_round_its_points():
    points = np.stack(
        [np.linspace(0, 1, 20), np.sin(np.linspace(0, 3, 20)), np.linspace(0, 0.5, 20)],
        axis=1,
    )
    body = tube("line", points, 0.01)
    away = np.linalg.norm(body.corners.reshape(20, 6, 3) - points[:, None], axis=2)
    np.testing.assert_allclose(away, 0.01, rtol=1e-9)
    assert body.triangles.max() == len(body.corners) - 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["airhockey", "--row", "1"],
            "--row needs plans or the folder of a dataset, got airhockey",
        ),
        (
            ["airhockey", "--split", "train"],
            "--split needs plans or the folder of a dataset, got airhockey",
        ),
        (
            ["airhockey", "--problem", "airhockey"],
            "--problem needs plans or the folder of a dataset",
        ),
        (
            ["airhockey", "-o", "page.png"],
            "expected a file that ends in .html, got 'page.png'",
        ),
        (["airhockey", "--serve", "65536"], "expected a port, 0 to 65535, got '65536'"),
        (["airhockey", "--serve", "-o", "page.html"], "not allowed with"),
        (
            ["airhokey"],
            "airhokey is neither a folder nor a file, problem, pipeline or dataset (did you mean 'airhockey'?)",
        ),
    ],
)
def test_what_cannot_be_meant_is_refused(words, said, capsys):
    assert main(["view", *words]) == 2
    assert said in capsys.readouterr().err


@needs_meshcat
def test_a_plan_is_shown_with_meshes_where_its_problem_is_named(tmp_path, capsys):
    file = _with_visual(tmp_path, "package://crane/meshes/wedge.stl")
    base, still = load_robot(load_problem(file)).home[None], np.zeros((1, 4))
    boundary = cnpgen.Boundary(base, still, still, base, still)
    points, rate = np.tile(base, (1, 15, 1)), np.ones((1, 20))
    plans = cnpgen.make_plans(
        str(file), boundary, path_control_points=points, rate_control_points=rate
    )
    cnpgen.save_plans(tmp_path / "plans.h5", plans)
    page = tmp_path / "plan.html"
    assert main(["view", str(tmp_path / "plans.h5"), "-o", str(page)]) == 0
    assert (
        len(content(page)["robot"]) > 3
    )  # the pieces: what a file from elsewhere names is not read
    assert (
        main(
            [
                "view",
                str(tmp_path / "plans.h5"),
                "--problem",
                str(file),
                "-o",
                str(page),
            ]
        )
        == 0
    )
    assert [body["name"] for body in content(page)["robot"]] == ["fore"]
    assert (
        main(
            [
                "view",
                str(tmp_path / "plans.h5"),
                "--problem",
                "airhockey",
                "-o",
                str(page),
            ]
        )
        == 1
    )
    assert_said(capsys.readouterr().err)


@needs_meshcat
def test_a_row_is_not_shown_with_another_problem(plans, tmp_path, capsys):
    rows, page = str(plans.with_name("rows")), str(tmp_path / "row.html")
    assert main(["view", rows, "--problem", "heavy-object", "-o", page]) == 0
    assert main(["view", rows, "--problem", "airhockey", "-o", page]) == 1
    assert_said(capsys.readouterr().err)


def test_a_plan_that_is_not_there_is_refused(plans, capsys):
    assert main(["view", str(plans), "--row", "2"]) == 2
    assert_said(capsys.readouterr().err)


def test_without_the_viewer_it_is_said_what_to_install(monkeypatch, capsys):
    def missing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", missing)
    assert main(["view", "airhockey"]) == 3
    assert_said(capsys.readouterr().err)


@contextmanager
def served(*words: str) -> Iterator[str]:
    """The address of what ``cnpgen view --serve`` serves; in the end it is interrupted."""
    command = [sys.executable, "-m", "cnpgen", "view", *words, "--serve", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.send_signal(signal.SIGINT)
    assert process.returncode == 130


def got(address: str, **headers: str) -> tuple[int, dict[str, str], str]:
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=HANGING) as answer:
            return answer.status, dict(answer.headers), answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read().decode()


@needs_meshcat
def test_a_page_is_served_to_this_machine_and_follows_its_files(plans, tmp_path):
    file = tmp_path / "plans.h5"
    shutil.copy(plans, file)
    with served(str(file)) as address:
        status, _, text = got(address)
        assert (status, in_page(text)["title"]) == (
            200,
            "heavy-object: plans.h5, plan 0",
        )
        assert (
            in_page(got(f"{address}?row=1")[2])["title"]
            == "heavy-object: plans.h5, plan 1"
        )
        assert got(f"{address}stamp")[2] == in_page(text)["stamp"] != ""
        status, headers, said = got(f"{address}?row=2")
        assert (status, headers["Refresh"]) == (500, "2")
        assert "has no plan 2" in said
        assert "expected a number from 0" in got(f"{address}?row=-1")[2]
        assert got(f"{address}../plans.h5")[0] == 404
        assert got(address, Host="a.stranger.example:80")[0] == 403
        file.write_bytes(b"no plan")
        assert got(f"{address}stamp")[2] != in_page(text)["stamp"]
        assert got(address)[0] == 500


@needs_meshcat
def test_idle_malformed_and_leaving_clients_do_not_disturb_others(plans):
    with served(str(plans)) as address:
        port = int(address.rstrip("/").rpartition(":")[2])

        def send(request: bytes) -> bytes:
            with socket.create_connection(("127.0.0.1", port), HANGING) as client:
                client.sendall(request)
                return client.makefile("rb").readline()

        with (
            socket.create_connection(("127.0.0.1", port), HANGING),  # idle
            socket.create_connection(("127.0.0.1", port), HANGING) as slow,
        ):
            slow.sendall(b"GET / HT")
            assert got(f"{address}stamp")[0] == 200
        for _ in range(3):  # leave before the answer
            with socket.create_connection(("127.0.0.1", port), HANGING) as leaving:
                leaving.sendall(b"GET / HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
                leaving.setsockopt(
                    socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
                )
        status, _, said = got(f"{address}?row={'9' * 5000}")
        assert (status, len(said) < 200) == (500, True)
        assert b" 400 " in send(b"GET http://[ HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
        assert b"404" in send(b"GET /%00%ff HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
        assert got(address)[0] == 200


@needs_meshcat
def test_a_change_beside_a_recipe_is_seen(tmp_path):
    file = write_problem(tmp_path)
    before = stamp([file])
    (file.parent / "crane.urdf").write_text("<robot/>")
    assert stamp([file]) != before


@needs_meshcat
@needs_chromium
def test_a_browser_runs_the_page_that_is_served(plans):
    with served(str(plans)) as address:
        assert 'data-ready="yes"' in chromium(plans, "--dump-dom", address=address)


def test_a_port_that_is_taken_is_said(capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["view", "airhockey", "--serve", str(port)]) == 3
    assert f"cannot listen on port {port}" in capsys.readouterr().err


def chromium(
    page: Path,
    *options: str,
    address: str = "",
    state: str = "time=120&ends",
    stream: str = "stdout",
) -> str:
    """Open a page from disk in a browser without a screen; return what it prints."""
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ]
    flags += [
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
    ]
    flags += ["--disable-sync", f"--user-data-dir={page.parent / 'browser'}"]
    flags += (
        []
        if any("--window-size" in option for option in options)
        else ["--window-size=1200,700"]
    )
    command = [
        str(CHROMIUM),
        *flags,
        "--virtual-time-budget=8000",
        *options,
        f"{address or page.as_uri()}#{state}",
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=HANGING, check=True
    )
    return str(getattr(done, stream))


@needs_meshcat
@needs_chromium
def test_a_browser_runs_the_page(page):
    found = chromium(page, "--dump-dom")
    assert 'data-ready="yes"' in found
    shown = content(page)
    assert (
        shown["labels"][120] in re.search(r'<output id="time">(.*?)</output>', found)[1]
    )
    assert (len(shown["curves"]), len(shown["conditions"])) == (4, 4)
    assert (
        found.count("<canvas") == 1 + 4 + 4
    )  # the scene, the limits and the conditions


@needs_meshcat
@needs_chromium
def test_a_browser_draws_the_arm_its_start_and_its_goal(page):
    image = pytest.importorskip("matplotlib.image")
    picture = page.with_suffix(".png")
    chromium(page, f"--screenshot={picture}")
    scene = image.imread(picture)[60:560, 20:780, :3]
    red, blue = scene[..., 0], scene[..., 2]
    assert (blue > red + 0.15).mean() > 0.005  # the start
    assert (red > blue + 0.2).mean() > 0.01  # the goal and the object
    assert (np.ptp(scene, axis=2) < 0.03).mean() > 0.3  # the arm, and nothing


@pytest.fixture(scope="module")
def rejected(plans: Path) -> Path:
    """A page of three plans: one valid, one that violates several conditions, one that cannot be evaluated."""
    valid, broken = load("transport"), perturbed(load("transport"), 0.2)
    backwards = valid.changed(rate=-valid.motion.rate)
    file = plans.with_name("rejected.h5")
    cnpgen.save_plans(file, plans_of(valid, broken, backwards))
    assert (
        main(["view", str(file), "--rows", "0-2", "-o", str(file.with_suffix(".html"))])
        == 0
    )
    return file.with_suffix(".html")


@needs_meshcat
def test_a_rejected_plan_shows_the_time_and_the_place_of_its_violations(rejected):
    text = rejected.read_text(encoding="utf-8")
    verdict = cnpgen.evaluate_plans(
        cnpgen.load_plans(rejected.with_suffix(".h5"))
    ).verdicts[1]
    valid, broken = in_page(text, 0), in_page(text, 1)
    assert (valid["verdict"]["valid"], valid["verdict"]["reason"]) == (True, "ok")
    assert all(cause["ok"] for cause in valid["verdict"]["causes"])
    causes = {cause["name"]: cause for cause in broken["verdict"]["causes"]}
    assert (broken["verdict"]["valid"], broken["verdict"]["reason"]) == (
        False,
        verdict.reason,
    )
    violated = [margin for margin in verdict.margins.values() if not margin.ok]
    assert len(violated) >= 3
    for margin in violated:
        cause = causes[f"{margin.name} {margin.part}".strip()]
        assert not cause["ok"]
        assert broken["times"][cause["frame"]] == pytest.approx(margin.time, abs=1e-9)
    contact = next(margin for margin in violated if margin.name == "object contact")
    cause = causes[f"{contact.name} {contact.part}"]
    body = next(body for body in broken["world"] if body["name"] == contact.part)
    corners = array(body["corners"], "<f4", -1, 3)
    assert (corners.min(axis=0) - 0.03 < cause["point"]).all()
    assert (cause["point"] < corners.max(axis=0) + 0.03).all()


@needs_meshcat
def test_a_plan_that_cannot_be_evaluated_is_shown_at_its_ends_with_the_reason(rejected):
    shown = in_page(rejected.read_text(encoding="utf-8"), 2)
    assert shown["labels"] == ["start", "goal"]
    assert shown["verdict"] == {
        "valid": False,
        "reason": "rate not positive",
        "causes": [],
    }


@needs_meshcat
def test_several_rows_of_a_dataset_are_on_one_page(plans, tmp_path):
    folder, page = plans.with_name("rows"), tmp_path / "rows.html"
    assert (
        main(
            [
                "view",
                str(folder),
                "--split",
                "train",
                "--rows",
                "0,2-3",
                "-o",
                str(page),
            ]
        )
        == 0
    )
    data = content(page)
    assert [view["title"].rpartition(" ")[2] for view in data["views"]] == [
        "0",
        "2",
        "3",
    ]
    assert data["n_rows"] == cnpgen.load_dataset(folder).splits["train"]
    assert all(view["verdict"] is None for view in data["views"])


@needs_meshcat
def test_the_puck_is_ahead_of_the_goal_and_the_mallet_on_the_tip(tmp_path):
    plan = load("hit")
    cnpgen.save_plans(tmp_path / "hit.h5", plans_of(plan))
    assert (
        main(["view", str(tmp_path / "hit.h5"), "-o", str(tmp_path / "hit.html")]) == 0
    )
    shown = content(tmp_path / "hit.html")
    (puck,) = (body for body in shown["world"] if body["name"] == "puck")
    corners = array(puck["corners"], "<f4", -1, 3)
    model, data, frame = (
        plan.robot.model,
        plan.robot.model.createData(),
        plan.robot.tip_frame,
    )
    jacobian = pin.computeFrameJacobian(
        model, data, plan.boundary.goal_q[0], frame, pin.LOCAL_WORLD_ALIGNED
    )
    direction = (jacobian[:3] @ plan.boundary.goal_dq[0])[:2]
    distance = (corners.min(axis=0) + corners.max(axis=0))[:2] / 2 - plan.goal_xyz[
        0, :2
    ]
    np.testing.assert_allclose(
        distance / np.linalg.norm(distance),
        direction / np.linalg.norm(direction),
        atol=1e-4,
    )
    assert [body["name"] for body in shown["mallet"]] == ["mallet"]
    assert "puck distance" in [curve["name"] for curve in shown["conditions"]]


@needs_meshcat
@needs_chromium
def test_joint_sliders_move_the_tip_as_pinocchio_computes_it(page):
    q = [0.3, -0.4, 0.5, -1.2, 0.6, 0.7, -0.8]
    found = chromium(page, "--dump-dom", state="q=" + ",".join(map(str, q)))
    tip = np.array(re.search(r'data-tip="([^"]*)"', found)[1].split(), float)
    robot = load_robot(load_problem("heavy-object"))
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, np.array(q))
    np.testing.assert_allclose(tip, data.oMf[robot.tip_frame].translation, atol=2e-6)
    assert ">posed<" in found


@needs_meshcat
@needs_chromium
@pytest.mark.parametrize("width", [1280, 500])
def test_a_browser_shows_the_verdict_without_an_error(rejected, width):
    picture = rejected.with_name(f"rejected-{width}.png")
    flags = ["--enable-logging=stderr", "--v=0", f"--window-size={width},800"]
    found = chromium(rejected, "--dump-dom", *flags, state="plan=1")
    assert "rejected: " in re.search(r'<span id="badge"[^>]*>([^<]*)', found)[1]
    assert found.count('class="violated"') >= 3
    assert ">2 of 3<" in found
    log = chromium(
        rejected, f"--screenshot={picture}", *flags, state="plan=1", stream="stderr"
    )
    messages = [
        line
        for line in log.splitlines()
        if "CONSOLE" in line and "GL Driver Message" not in line
    ]
    assert messages == []
    image = pytest.importorskip("matplotlib.image").imread(picture)[..., :3]
    scene = image[100:360, : width // 2]
    assert np.ptp(scene, axis=(0, 1)).min() > 0.3  # the arm and its obstacles are drawn
    reddish = (image[..., 0] > 0.6) & (image[..., 1] < 0.3) & (image[..., 2] < 0.3)
    assert reddish.mean() > 0.003  # the badge and the violated conditions


@needs_meshcat
def test_conditions_that_samples_do_not_determine_have_no_number(tmp_path):
    path = tmp_path / "a.csv"
    t = np.arange(0, 0.6001, 0.01)
    q = np.tile([-0.3, 0.6975, 0, -0.5049, 0, 1.9286], (len(t), 1))
    x = t / 0.6
    q[:, 0] += 0.3 * (10 * x**3 - 15 * x**4 + 6 * x**5)
    head = "t,q1,q2,q3,q4,q5,q6"
    table = np.column_stack([t, q])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.17g")
    out = tmp_path / "a.html"
    assert main(["view", str(path), "--problem", "airhockey", "-o", str(out)]) == 0
    page = in_page(out.read_text(encoding="utf-8"), 0)
    texts = {cause["name"]: cause["text"] for cause in page["verdict"]["causes"]}
    unknown = [name for name, text in texts.items() if text.startswith("not measured")]
    assert [name.rpartition(" ")[0] for name in sorted(unknown)] == [
        "joint acceleration",
        "joint torque",
    ]
    assert not any("e+0" in text for text in texts.values())
    assert [curve["name"] for curve in page["curves"]] == ["position", "velocity"]
    drawn = {curve["name"] for curve in page["conditions"]}
    assert not any("acceleration" in name or "torque" in name for name in drawn)


@needs_meshcat
def test_sampled_trajectories_are_shown_with_their_verdicts(tmp_path, capsys):
    hit = load("hit")
    export_plans(
        plans_of(hit, perturbed(hit, 0.1)), tmp_path / "csv", to="csv", rate=500
    )
    words = [
        "view",
        str(tmp_path / "csv"),
        "--problem",
        "airhockey",
        "--rows",
        "0,1",
        "-o",
        str(tmp_path / "a.html"),
    ]
    assert main(words) == 0
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    valid, invalid = in_page(text, 0), in_page(text, 1)
    assert (valid["verdict"]["valid"], valid["verdict"]["reason"]) == (True, "ok")
    assert "puck" in {body["name"] for body in valid["world"]}
    expected = cnpgen.evaluate_trajectories(
        "airhockey", load_trajectories(tmp_path / "csv", "airhockey").trajectories
    )
    verdict = expected.verdicts[1]
    assert invalid["verdict"]["reason"] == str(verdict)
    causes = {cause["name"]: cause for cause in invalid["verdict"]["causes"]}
    for entry in verdict.conditions.values():
        margin = entry.margin
        cause = causes[f"{margin.name} {margin.part}".strip()]
        assert cause["ok"] == margin.ok
        assert margin.ok or invalid["times"][cause["frame"]] == pytest.approx(
            margin.time, abs=1e-9
        )
    assert main([*words[:-4], "--row", "2"]) == 2
    assert_said(capsys.readouterr().err)
    assert main(["view", "airhockey", "--unit", "deg"]) == 2
    assert_said(capsys.readouterr().err)
