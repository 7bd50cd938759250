"""Draw action chunks as they are and as executed: python docs/chunk_picture.py (extras `benchmark`, `plot`, `robots`).

A Panda with 3 kg executes chunks of 50 samples at 30 Hz, a new one every 0.5 s. They follow a smooth motion, with noise of
5e-4 rad, and an offset of up to 0.02 rad of each chunk. In MuJoCo, computed torque at 1 kHz tracks the samples as they
are, each held until the next, and the set points of the executor.
"""

import itertools
from collections.abc import Callable

import numpy as np
from pictures import BLUE, FOLDER, GRAY, RED, figure, save
from PIL import Image

import cnpgen
from cnpgen.addons.benchmark.simulator.execute import (
    Controller,
    compile_scene,
    load_mujoco,
)
from cnpgen.addons.benchmark.simulator.plant import PLANTS
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene
from cnpgen.problems.load_robot import load_robot
from cnpgen.results import ChunkExecutor

RATE, LENGTH, PERIOD_S, TICK_S, CHUNKS = 30.0, 50, 0.5, 2e-3, 6
JOINT = 1  # that is drawn
READY = np.radians([0, -45, 0, -135, 0, 90, 45])
AMPLITUDE = np.array([0.4, 0.5, 0.3, 0.3, 0.4, 0.4, 0.5])
CONTROL_S, STEPS = 1e-3, 4  # period of the controller, and steps of MuJoCo in it
SIZE = (640, 560)  # of a picture of the arm [pixels]
VIEW = (0.5, 0.12, 0.55, 0.65, 135.0, -15.0)  # target, distance [m]; angles [deg]
TRACE_RADIUS_M, TRACE_STEP = 0.0025, 8

State = tuple[np.ndarray, np.ndarray, np.ndarray]


def policy(t: float, random: np.random.Generator) -> np.ndarray:
    """Return a chunk of the reference motion from a time on [rad], shape (LENGTH, 7)."""
    times = t + np.arange(LENGTH)[:, None] / RATE
    q = READY + AMPLITUDE * (1 - np.cos(1.4 * times)) / 2
    q = q + random.uniform(-5e-4, 5e-4, q.shape)
    return q + random.uniform(-0.02, 0.02, 7)


def execute() -> tuple[np.ndarray, list[State], np.ndarray]:
    """Return the times and states of the executor, and the raw samples up to the next chunk, shape (K, 8)."""
    random, times, states, raw = np.random.default_rng(4), [], [], []
    executor = ChunkExecutor(
        "panda-3kg",
        rate=RATE,
        length=LENGTH,
        join=0.02,
        max_distance=0.1,
        tracking_error=0.01,
        stale_after=0.5,
    )
    executor.reset((READY, np.zeros(7)))
    point = executor.set_point(0.0)
    for index in range(CHUNKS):
        begin = index * PERIOD_S
        chunk = policy(begin, random)
        if not executor.step(begin, chunk, begin, (point.q, point.dq)).accepted:
            raise SystemExit(f"chunk {index} was refused")
        kept = np.arange(int(PERIOD_S * RATE))
        raw += [np.r_[begin + k / RATE, chunk[k]] for k in kept]
        for time in begin + np.arange(1, round(PERIOD_S / TICK_S) + 1) * TICK_S:
            point = executor.set_point(float(time))
            times.append(float(time))
            states.append((point.q, point.dq, point.ddq))
    return np.array(times), states, np.array(raw)


def draw_joint(times: np.ndarray, states: list[State], raw: np.ndarray) -> None:
    """Draw the positions, velocities and accelerations of a joint, with their limits."""
    robot = cnpgen.RobotModel("panda-3kg")
    t, q = raw[:, 0], raw[:, 1 + JOINT]
    dq, ddq = np.diff(q) * RATE, np.diff(q, n=2) * RATE**2
    executed = np.array(states)[:, :, JOINT].T
    drawn = figure(6.4, 5.6)
    parts = drawn.subplots(3, 1, sharex=True)
    titles = "q [rad]", "dq [rad/s]", "ddq [rad/s²]"
    limits = None, robot.velocity_limit[JOINT], robot.acceleration_limit[JOINT]
    series = (t, q), (t[1:], dq), (t[1:-1], ddq)
    rows = zip(parts, executed, titles, limits, series, strict=True)
    for axes, motion, title, limit, (moments, values) in rows:
        axes.step(moments, values, where="post", color=RED, linewidth=0.7, label="raw")
        axes.plot(times, motion, color=BLUE, label="executed")
        for sign in () if limit is None else (-1, 1):
            axes.axhline(sign * limit, color=GRAY, linestyle="--", linewidth=0.8)
        axes.set_ylabel(title)
    parts[0].legend(fontsize=9)
    parts[0].set_title(
        f"joint {JOINT + 1}: a chunk every {PERIOD_S:g} s; limits dashed"
    )
    parts[-1].set_xlabel("t [s]")
    save(drawn, "chunks")
    print(f"largest raw acceleration: {np.abs(ddq).max() / limits[2]:.1f} of the limit")
    use = np.abs(executed[2]).max() / limits[2]
    print(f"largest executed acceleration: {use:.2f} of the limit")


def draw_arm(desired: Callable[[float], State], color: str) -> Image.Image:
    """Track set points in MuJoCo, and draw the arm at the end with the path of its tip."""
    mujoco = load_mujoco()
    problem = cnpgen.load_problem("panda-3kg")
    robot = load_robot(problem)
    scene = SimulatorScene(problem, robot, PLANTS["nominal"], np.zeros(0))
    model, control = (
        compile_scene(scene),
        Controller(problem, robot, PLANTS["nominal"]),
    )
    data = mujoco.MjData(model)
    data.qpos[:] = READY
    tips = []
    for tick in range(round(CHUNKS * PERIOD_S / CONTROL_S)):
        data.qfrc_applied[:] = control(
            data.qpos.copy(), data.qvel.copy(), desired(tick * CONTROL_S)
        )
        for _ in range(STEPS):
            mujoco.mj_step(model, data)
        tips.append(data.site("tip").xpos.copy())
    renderer, camera = mujoco.Renderer(model, SIZE[1], SIZE[0]), mujoco.MjvCamera()
    camera.lookat[:] = VIEW[:3]
    camera.distance, camera.azimuth, camera.elevation = VIEW[3:]
    renderer.update_scene(data, camera)
    rgba = [int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)] + [1.0]
    path = tips[::TRACE_STEP]
    for one, other in itertools.pairwise(path):
        geom = renderer.scene.geoms[renderer.scene.ngeom]
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        mujoco.mjv_initGeom(
            geom, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba
        )
        mujoco.mjv_connector(geom, capsule, TRACE_RADIUS_M, one, other)
        renderer.scene.ngeom += 1
    return Image.fromarray(renderer.render())


def main() -> None:
    """Draw a joint over time, and the arm that tracks raw samples beside the arm that tracks the executor."""
    times, states, raw = execute()
    draw_joint(times, states, raw)
    still = np.zeros(7)

    def held(time: float) -> State:
        sample = raw[np.searchsorted(raw[:, 0], time, side="right") - 1, 1:]
        return sample, still, still

    def executed(time: float) -> State:
        return states[min(np.searchsorted(times, time), len(times) - 1)]

    arms = [draw_arm(held, RED), draw_arm(executed, BLUE)]
    both = Image.new("RGB", (2 * SIZE[0], SIZE[1]))
    for index, arm in enumerate(arms):
        both.paste(arm, (index * SIZE[0], 0))
    both.save(FOLDER / "chunk-arms.png", optimize=True)


if __name__ == "__main__":
    main()
