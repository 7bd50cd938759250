"""Draw action chunks as they are and as executed: python docs/chunk_picture.py (extras `plot` and `robots`).

A Panda with 3 kg executes chunks of 50 samples at 30 Hz, a new one every 0.5 s. They follow a smooth motion, with noise of
5e-4 rad, and an offset of up to 0.02 rad of each chunk.
"""

import numpy as np
from pictures import BLUE, GRAY, RED, figure, save

import cnpgen
from cnpgen.results import ChunkExecutor

RATE, LENGTH, PERIOD_S, TICK_S, CHUNKS = 30.0, 50, 0.5, 2e-3, 6
JOINT = 1  # that is drawn
READY = np.radians([0, -45, 0, -135, 0, 90, 45])
AMPLITUDE = np.array([0.4, 0.5, 0.3, 0.3, 0.4, 0.4, 0.5])


def policy(t: float, random: np.random.Generator) -> np.ndarray:
    """Return a chunk of the reference motion from a time on [rad], shape (LENGTH, 7)."""
    times = t + np.arange(LENGTH)[:, None] / RATE
    q = READY + AMPLITUDE * (1 - np.cos(1.4 * times)) / 2
    q = q + random.uniform(-5e-4, 5e-4, q.shape)
    return q + random.uniform(-0.02, 0.02, 7)


def execute() -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the executed states, and the raw samples up to the next chunk, shape (K, 2): time and position."""
    random, states, raw = np.random.default_rng(4), [], []
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
        raw += zip(begin + kept / RATE, chunk[kept, JOINT], strict=True)
        for time in begin + np.arange(1, round(PERIOD_S / TICK_S) + 1) * TICK_S:
            point = executor.set_point(float(time))
            states.append([time, *(values[JOINT] for values in point[:3])])
    columns = np.array(states).T
    return dict(zip(("t", "q", "dq", "ddq"), columns, strict=True)), np.array(raw)


def main() -> None:
    """Draw the positions, velocities and accelerations of a joint, with their limits."""
    executed, raw = execute()
    robot = cnpgen.RobotModel("panda-3kg")
    t, q = raw.T
    dq, ddq = np.diff(q) * RATE, np.diff(q, n=2) * RATE**2
    drawn = figure(6.4, 5.6)
    parts = drawn.subplots(3, 1, sharex=True)
    titles = "q [rad]", "dq [rad/s]", "ddq [rad/s²]"
    limits = None, robot.velocity_limit[JOINT], robot.acceleration_limit[JOINT]
    series = (t, q), (t[1:], dq), (t[1:-1], ddq)
    names = zip(parts, ("q", "dq", "ddq"), titles, limits, series, strict=True)
    for axes, name, title, limit, (times, values) in names:
        axes.step(times, values, where="post", color=RED, linewidth=0.7, label="raw")
        axes.plot(executed["t"], executed[name], color=BLUE, label="executed")
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
    use = np.abs(executed["ddq"]).max() / limits[2]
    print(f"largest executed acceleration: {use:.2f} of the limit")


if __name__ == "__main__":
    main()
