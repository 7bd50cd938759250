"""Draw the pictures of the concept pages and of a training: python docs/pictures.py (extra `plot`).

Each picture shows computed data: plans of the refiner, control points of the boundary layer, obstacles of samples.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from scipy.interpolate import BSpline

import cnpgen
from cnpgen.problems.constraints.puck_contact import PuckContact
from cnpgen.problems.problem_record import open_problem, record_problem
from cnpgen.robots.drive import NO_DRIVE
from cnpgen.robots.robot import Robot
from cnpgen.training.log import plot_curve
from cnpgen.world.path import PathWorld

FOLDER = Path(__file__).parent / "images"
BLUE, RED, GRAY, GREEN = "#1f5fa8", "#c0392b", "#7f8c8d", "#2e8b57"
START = np.array(
    [[-0.031, 0.728, -0.177, -0.573, -0.139, 1.590]]
)  # on the table, as in the tutorial
MAX_SPEED = 3.0  # [m/s] of the colours of paths
GOAL = np.array([[0.025, 0.884, 0.185, -0.505, 0.112, 1.189]])


def figure(width: float, height: float) -> Figure:
    """Return an empty figure with a size [inch]."""
    return Figure(figsize=(width, height), layout="constrained", dpi=150)


def save(drawn: Figure, name: str) -> None:
    """Write a picture."""
    drawn.savefig(FOLDER / f"{name}.png", metadata={"Software": None})


def knots(count: int, degree: int) -> np.ndarray:
    """Return the clamped uniform knots of a B-spline."""
    inner = np.linspace(0, 1, count - degree + 1)
    return np.concatenate([np.zeros(degree), inner, np.ones(degree)])


def rest_problem() -> cnpgen.Boundary:
    """Return one motion from rest to rest on the air-hockey table."""
    zero = np.zeros((1, 6))
    return cnpgen.Boundary(START, zero, zero, GOAL, zero)


def solved_plan() -> cnpgen.Plans:
    """Return the refiner's plan of that motion."""
    shape = cnpgen.load_problem("airhockey").trajectory
    unplanned = cnpgen.make_plans(
        "airhockey",
        rest_problem(),
        path_control_points=np.full((1, shape.path_control_points, 6), np.nan),
        rate_control_points=np.full((1, shape.rate_control_points), np.nan),
    )
    return cnpgen.solve_plans(unplanned, workers=1).plans


def draw_splines(plans: cnpgen.Plans) -> None:
    """Draw path and rate over the phase, and their composition over time."""
    motion, joint, degree = plans.motion, 2, plans.motion.degree
    s = np.linspace(0, 1, 400)
    drawn = figure(6.4, 5.2)
    parts = drawn.subplot_mosaic([["path", "rate"], ["motion", "motion"]])
    path, rate, result = parts["path"], parts["rate"], parts["motion"]
    for axes, points, color in (
        (path, motion.path[0, :, joint], BLUE),
        (rate, motion.rate[0], RED),
    ):
        basis = BSpline(knots(len(points), degree), np.eye(len(points)), degree)(s)
        low, high = points.min(), points.max()
        axes.plot(
            s,
            low - 0.45 * (high - low) + 0.3 * (high - low) * basis,
            color=GRAY,
            linewidth=0.6,
        )
        axes.plot(s, basis @ points, color=color)
        greville = [
            knots(len(points), degree)[i + 1 : i + 1 + degree].mean()
            for i in range(len(points))
        ]
        axes.plot(greville, points, "o--", color=color, markersize=3, linewidth=0.5)
        axes.set_xlabel("phase s")
    path.set_title("path p(s) [rad]: joint 3")
    rate.set_title("rate r(s) = ds/dt [1/s]")
    t = np.linspace(0, motion.duration()[0], 400)
    states = motion.at(motion.phase_at(t[None]))
    result.plot(t, states.q[0, :, joint], color=BLUE, label="q [rad]")
    result.plot(t, states.dq[0, :, joint], color=GREEN, label="dq [rad/s]")
    result.plot(t, states.ddq[0, :, joint] / 10, color=RED, label="ddq / 10 [rad/s²]")
    result.set_title("motion q(t) = p(s(t))")
    result.set_xlabel("t [s]")
    result.legend()
    save(drawn, "splines")


def draw_manifold(plans: cnpgen.Plans) -> None:
    """Draw the height of the tip for a line of joint positions, the projected line and a valid plan."""
    robot, s = cnpgen.RobotModel("airhockey"), np.linspace(0, 1, 200)
    layer = cnpgen.BoundaryLayer("airhockey", projection_steps=0)
    tasks = layer.tasks(rest_problem())
    projected = layer.plans(
        tasks, np.zeros((1, layer.path_outputs)), np.zeros((1, layer.rate_outputs))
    )
    line = START + s[:, None] * (GOAL - START)
    paths = {
        "line in joint space": (line, RED),
        "line, projected onto T": (projected.motion.at(s).q[0], GREEN),
        "valid plan": (plans.motion.at(s).q[0], BLUE),
    }
    drawn = figure(6.4, 3.2)
    side, top = drawn.subplots(1, 2)
    for name, (q, color) in paths.items():
        x, y, z = robot.forward_kinematics(q)[0].T
        side.plot(s, 1000 * z, color=color, label=name)
        top.plot(y, x, color=color)
    side.axhspan(159, 161, color=GRAY, alpha=0.4, linewidth=0)
    side.set(title="height of the tip [mm]", xlabel="phase s")
    side.legend(fontsize=9)
    top.add_patch(Rectangle((-0.45, 0.6), 0.9, 1.4, fill=False, color=GRAY))
    top.set(
        title="the tip seen from above [m]",
        xlabel="y",
        ylabel="x",
        xlim=(0.5, -0.5),
        ylim=(0.55, 1.25),
    )
    save(drawn, "manifold")


def draw_verdict(plans: cnpgen.Plans) -> None:
    """Draw the accelerations of all joints over their limits, and one of them between samples with chord bounds."""
    motion, step = plans.motion, 64
    t = np.linspace(0, motion.duration()[0], 25 * step + 1)
    limit = np.asarray(cnpgen.RobotModel("airhockey").acceleration_limit)
    use = motion.at(motion.phase_at(t[None])).ddq[0] / limit
    drawn = figure(6.4, 3.2)
    limits, between = drawn.subplots(1, 2)
    limits.plot(t, np.abs(use), color=GRAY, linewidth=0.7)
    limits.plot(t, np.abs(use).max(axis=1), color=BLUE)
    value = use[:, 3]
    for first in range(0, len(t) - 1, step):
        part = slice(first, first + step + 1)
        second = np.gradient(np.gradient(value[part], t[part]), t[part])
        chord = np.interp(t[part], t[part][[0, -1]], value[part][[0, -1]])
        swell = (
            0.5 * (t[part] - t[first]) * (t[first + step] - t[part])
        )  # at most h^2 / 8
        low, high = chord - swell * second.max(), chord - swell * second.min()
        between.fill_between(t[part], low, high, color=BLUE, alpha=0.3, linewidth=0)
    between.plot(t, value, color=BLUE, linewidth=1)
    between.plot(t[::step], value[::step], "o", color=BLUE, markersize=4)
    for axes in (limits, between):
        axes.axhline(1, color=RED, linewidth=0.8)
        axes.set_xlabel("t [s]")
    limits.set(title="accelerations / limit", ylim=(0, 1.15))
    between.set(
        title="joint 4: samples, bounds, value", xlim=(0.03, 0.16), ylim=(-0.35, 1.15)
    )
    save(drawn, "verdict")


def draw_scenes() -> None:
    """Draw the obstacles of three samples with the object's path, from the side."""
    problems = cnpgen.draw_boundary_problems("heavy-object", 3, seed=1)
    plans = cnpgen.solve_plans(problems, workers=1).plans
    robot = cnpgen.RobotModel("heavy-object")
    drawn = figure(6.4, 1.9)
    for sample, axes in enumerate(drawn.subplots(1, 3, sharey=True)):
        for body in plans.scene.bodies(sample):
            low, high = (
                body.position + body.corners.min(axis=0),
                body.position + body.corners.max(axis=0),
            )
            axes.add_patch(
                Rectangle(
                    (low[1], 0),
                    high[1] - low[1],
                    high[2],
                    color=GRAY,
                    alpha=0.6,
                    linewidth=0,
                )
            )
        positions, _ = robot.forward_kinematics(
            plans.motion.at(np.linspace(0, 1, 7)).q[sample]
        )
        for number, (_, y, z) in enumerate(positions):
            ends = number in {0, len(positions) - 1}
            axes.add_patch(
                Rectangle(
                    (y - 0.1, z - 0.15),
                    0.2,
                    0.3,
                    fill=False,
                    color=BLUE,
                    alpha=1.0 if ends else 0.4,
                )
            )
        axes.set(
            title=f"sample {sample}",
            xlabel="y [m]",
            xlim=(-0.8, 0.8),
            ylim=(0, 1.0),
            aspect="equal",
        )
    drawn.axes[0].set_ylabel("z [m]")
    save(drawn, "scenes")


def draw_certification() -> None:
    """Draw the paths of the tip of valid plans of certified samples, coloured by their speed."""
    problems = cnpgen.draw_boundary_problems("airhockey-replan", 8, seed=3)
    refinement = cnpgen.solve_plans(problems, workers=1)
    assert refinement.valid.all()
    robot, s = cnpgen.RobotModel("airhockey"), np.linspace(0, 1, 80)
    (contact,) = (
        each
        for each in cnpgen.load_problem("airhockey").constraint
        if isinstance(each, PuckContact)
    )
    states, times = refinement.plans.motion.at(s), refinement.plans.motion.time_at(s)
    drawn = figure(5.4, 4.2)
    axes = drawn.subplots(1, 1)
    for plan in range(len(refinement.valid)):
        xy = robot.forward_kinematics(states.q[plan])[0][:, :2]
        speed = np.linalg.norm(np.diff(xy, axis=0), axis=1) / np.diff(times[plan])
        lines = LineCollection(
            np.stack([xy[:-1], xy[1:]], axis=1),
            array=speed,
            clim=(0, MAX_SPEED),
            cmap="viridis_r",
            linewidths=2.5,
        )
        axes.add_collection(lines)
        axes.plot(*xy[0], "o", color=GRAY, markersize=6)
        along = (xy[-1] - xy[-2]) / np.linalg.norm(xy[-1] - xy[-2])
        puck = xy[-1] + contact.contact_distance * along
        axes.add_patch(Circle(tuple(puck), contact.puck_radius, color=RED, alpha=0.8))
    axes.add_patch(Rectangle((0.6, -0.45), 1.4, 0.9, fill=False, color=GRAY))
    axes.set(
        xlabel="x [m]", ylabel="y [m]", xlim=(0.55, 1.4), ylim=(-0.5, 0.5), aspect=1
    )
    drawn.colorbar(lines, label="speed of the mallet [m/s]")
    save(drawn, "certification")


def torques_of(plan: cnpgen.Plans, robot: Robot) -> tuple[np.ndarray, ...]:
    """Return times [s], and torques at the joints and lowest and highest ones at the motors [N m], shape (n, K) each."""
    t = np.linspace(0, plan.duration[0], 600)
    states = [plan.states_at(np.array([each])) for each in t]
    q, dq, ddq = (np.concatenate(each).T for each in zip(*states, strict=True))
    world = PathWorld(robot)
    world.set_path(q, dq, ddq, np.empty(0))
    return t, world.torque, *world.motor_torque


def draw_drives() -> None:
    """Draw the torques of one joint by two plans of a problem: solved for the rigid body, and for both sides of the gear."""
    problems = cnpgen.draw_boundary_problems("heavy-object-drive", 6, seed=11)
    problem, robot = open_problem(problems.problem)
    rigid = record_problem(replace(problem, drive=NO_DRIVE))
    plans = {
        "plan for the rigid body": replace(problems, problem=rigid),
        "plan for both sides": problems,
    }
    solved = {
        key: cnpgen.solve_plans(each, workers=1).plans for key, each in plans.items()
    }
    first = solved["plan for the rigid body"]
    limit = robot.drive.torque_limit
    uses = [
        np.abs(torques_of(first[[row]], robot)[3]).max(axis=1) / limit
        for row in range(len(first))
    ]
    row, joint = np.unravel_index(np.argmax(uses), (len(first), robot.n))
    drawn = figure(7.6, 3.2)
    for axes, (title, each) in zip(
        drawn.subplots(1, 2, sharey=True), solved.items(), strict=True
    ):
        t, tau, low, high = torques_of(each[[row]], robot)
        for sign in (-1, 1):
            axes.axhline(sign * limit[joint], color=RED, linewidth=0.9, linestyle="--")
        axes.fill_between(
            t, low[joint], high[joint], color=BLUE, alpha=0.35, linewidth=0
        )
        axes.plot(t, high[joint], color=BLUE, label="at the motor, with any friction")
        axes.plot(t, tau[joint], color=GREEN, label="at the joint")
        axes.set(title=title, xlabel="time [s]")
    drawn.axes[0].set_ylabel(f"torque of joint {joint + 1} [N m]")
    drawn.axes[0].plot([], [], color=RED, linestyle="--", label="limit of both")
    labels = drawn.axes[0].get_legend_handles_labels()
    drawn.legend(*labels, loc="outside lower center", ncols=3, fontsize=9)
    save(drawn, "drives")


def draw_training() -> None:
    """Draw the learning curve of a shipped planner from the log in its file."""
    plot_curve(cnpgen.load_model("airhockey-hit").log, FOLDER / "training.png")


def main() -> None:
    """Draw all pictures."""
    import matplotlib as mpl

    mpl.rcParams.update({"font.size": 10, "axes.titlesize": 10})
    plans = solved_plan()
    draw_splines(plans)
    draw_manifold(plans)
    draw_verdict(plans)
    draw_scenes()
    draw_certification()
    draw_drives()
    draw_training()


if __name__ == "__main__":
    main()
