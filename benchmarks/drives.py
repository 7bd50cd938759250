"""Plans with drives: torques by two independent judges, duration and CPU time against the rigid problem in one run.

Boundary problems of both shipped pipelines with drives are solved with [drive] and without it. Both sets of plans are
judged at 2,001 phases by Pinocchio's inverse dynamics with rotors, viscous friction and the exact sign of dry friction,
and by MuJoCo's inverse dynamics with armature and damping (its dry friction is a soft constraint whose sign is wrong near
a reversal, so it is added as c sign(dq)). A plan exceeds a limit above 1.005 of it, the tolerance of the problems. Columns
"motor" count motor torques with the exact law, "no friction" those without friction, "joint" torques at the joint.
Other plants have a Stribeck law and drives that differ by up to 30 % (benchmarks/drive_plant.py); some plans are also
executed there, and problems are solved with the plant's breakaway friction and errors, as a margin. The CPU time of
solving is that of batches in alternation, with compiled kernels. That of planning 1,024 problems is of a shipped planner
with these drives and without: heavy-object-drive, and panda-scenes, whose problem has free jerks and goal accelerations.

    python benchmarks/drives.py
    python benchmarks/drives.py --problems 40 --executed 10
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from common import arguments, cpu_of, median, progress, report, table
from drive_plant import STRIBECK_RATIO, execute, torque_errors
from scipy.spatial.transform import Rotation

import cnpgen
from cnpgen.kernels.library import choose_backend, problem_kernels
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.model_file import load_model
from cnpgen.planner.time_parametrization import make_time_parametrization
from cnpgen.plans.join import concatenate
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import ProblemRecord, open_problem
from cnpgen.refine.refine_plans import solve_plans
from cnpgen.robots.drive import Drive
from cnpgen.robots.robot import Robot

# Pipelines with drives, and planners to which these drives are given.
PLANNERS = {
    "heavy-object-drive": "heavy-object-drive",
    "panda-scenes-drive": "panda-scenes",
}
PHASES = 2001  # of every plan
TOLERANCE = 1.005  # of a limit
ERRORS = (-0.3, -0.15, 0.0, 0.15, 0.3)  # of rotors and friction of other plants
BATCH = 30  # problems that are solved at a time
PLANNED = 1024  # problems in a batch
MOTIONS, CALLS, SLOWER = 512, 9, 0.8  # of the time parametrization; factor of rates
MOVING = 1e-9  # rad/s, above which dry friction has a direction


@dataclass(frozen=True)
class States:
    """States of all plans, shape (N, K, n) each."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    duration: np.ndarray  # shape (N,)

    @property
    def sign(self) -> np.ndarray:
        """Directions of dry friction, zero at rest."""
        return np.asarray(np.sign(self.dq) * (np.abs(self.dq) > MOVING))


def states_of(plans: Plans) -> States:
    """Evaluate plans at equidistant times."""
    rows = [
        plans.states_at(share * plans.duration) for share in np.linspace(0, 1, PHASES)
    ]
    q, dq, ddq = (np.stack(each, axis=1) for each in zip(*rows, strict=True))
    return States(q, dq, ddq, plans.duration)


def pinocchio_torque(robot: Robot, armature: np.ndarray) -> Callable[..., np.ndarray]:
    """Return Pinocchio's inverse dynamics with rotors."""
    import pinocchio as pin

    model = robot.model.copy()
    model.armature = armature.copy()
    data = model.createData()
    return lambda q, dq, ddq: pin.rnea(model, data, q, dq, ddq).copy()


def mujoco_torque(robot: Robot, drive: Drive) -> Callable[..., np.ndarray]:
    """Return MuJoCo's inverse dynamics with armature and damping, which does not share code with Pinocchio."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(_mjcf(robot, drive))
    data = mujoco.MjData(model)

    def torque(q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
        mujoco.mj_inverse(model, data)
        return np.array(data.qfrc_inverse)

    return torque


def _mjcf(robot: Robot, drive: Drive) -> str:
    """Write the chain of a robot with its drives as MJCF."""

    def text(values: Any) -> str:
        return " ".join(repr(float(value)) for value in np.ravel(values))

    parts = ['<mujoco><compiler angle="radian" autolimits="true"/>']
    parts.append(f'<option gravity="{text(robot.chain.gravity)}"/><worldbody>')
    for joint, rotor, damping in zip(
        robot.chain.joints, drive.armature, drive.viscous, strict=True
    ):
        x, y, z, w = Rotation.from_matrix(joint.rotation).as_quat()
        tensor = joint.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        parts.append(
            f'<body pos="{text(joint.translation)}" quat="{text([w, x, y, z])}">'
            f'<inertial pos="{text(joint.com)}" mass="{joint.mass!r}" fullinertia="{text(tensor)}"/>'
            f'<joint axis="{text(joint.axis)}" armature="{rotor}" damping="{damping}"/>'
        )
    return "".join([*parts, "</body>" * robot.n, "</worldbody></mujoco>"])


def along(torque: Callable[..., np.ndarray], states: States) -> np.ndarray:
    """Evaluate torques of all states, shape (N, K, n)."""
    out = np.empty_like(states.q)
    for index in np.ndindex(out.shape[:2]):
        out[index] = torque(states.q[index], states.dq[index], states.ddq[index])
    return out


def exceeding(torque: np.ndarray, limit: np.ndarray) -> dict[str, Any]:
    """Count the plans above the tolerance of a limit, and return the largest ratio."""
    ratio = (np.abs(torque) / limit).max(axis=(1, 2))
    return {"plans": int((ratio > TOLERANCE).sum()), "largest": float(ratio.max())}


def judge(plans: Plans, drive: Drive, robot: Robot) -> dict[str, Any]:
    """Count the plans whose torques exceed a limit, by both judges and on another plant."""
    states = states_of(plans)
    sign = states.sign
    b, c, limit = drive.viscous, drive.coulomb, drive.torque_limit
    rotors = along(pinocchio_torque(robot, drive.armature), states)
    smooth = rotors + b * states.dq
    other = along(mujoco_torque(robot, drive), states)
    joint = rotors - drive.armature * states.ddq
    others = torque_errors(joint, (states.dq, states.ddq, sign), drive, ERRORS)
    rate = np.diff(smooth, axis=1) / (states.duration[:, None, None] / (PHASES - 1))
    return {
        "motor": exceeding(smooth + c * sign, limit),
        "motor, MuJoCo": exceeding(other + c * sign, limit),
        "no friction": exceeding(rotors, limit),
        "joint": exceeding(joint, robot.torque_limit),
        "other plants": {
            f"{error:+.0%}": exceeding(each, limit) for error, each in others.items()
        },
        "difference of judges [N m]": float(np.abs(other - smooth).max()),
        "torque rate [N m/s]": np.abs(rate).max(axis=(0, 1)).round(1).tolist(),
    }


def with_drive(problems: Plans, drive: dict[str, Any] | None) -> Plans:
    """Return the same boundary problems of the robot with these drives, or of the rigid robot."""
    record = problems.problem
    content = {key: value for key, value in record.content.items() if key != "drive"}
    content |= {"drive": drive} if drive else {}
    text = json.dumps(content, ensure_ascii=False)
    return replace(problems, problem=ProblemRecord(text, record.urdf))


def solve_alternately(
    sets: dict[str, Plans],
) -> tuple[dict[str, Plans], dict[str, list[float]]]:
    """Solve the sets in batches, in alternation; return plans and CPU times [s] of the batches."""
    names = list(sets)
    cpu: dict[str, list[float]] = {key: [] for key in sets}
    parts: dict[str, list[Plans]] = {key: [] for key in sets}
    for key in names:  # kernels are compiled before
        solve_plans(sets[key][:2], workers=1)
    for first in range(0, len(sets[names[0]]), BATCH):
        for key in names:
            before = time.process_time()
            batch = sets[key][first : first + BATCH]
            parts[key].append(solve_plans(batch, workers=1).plans)
            cpu[key].append(time.process_time() - before)
        names.reverse()
    return {key: concatenate(each) for key, each in parts.items()}, cpu


def planning(name: str, drive: dict[str, Any]) -> dict[str, Any]:
    """Return the CPU times of planning a batch with and without drives, by the same planner [s]."""
    model = load_model(PLANNERS[name])
    problems = draw_boundary_problems(PLANNERS[name], PLANNED, seed=17)
    sets = {"drives": drive, "rigid": None}
    calls = {}
    for key, each in sets.items():
        record = with_drive(problems, each).problem
        planner = cnpgen.Planner(replace(model, problem=record))
        batch = partial(planner.plan_batch, columns=problems.columns)
        calls[key] = partial(batch, problems.boundary)
        calls[key]()  # compiles
    cpu: dict[str, list[float]] = {key: [] for key in sets}
    for _ in range(3 * CALLS):
        for key, call in calls.items():
            cpu[key].append(cpu_of(call))
    pairs = zip(cpu["drives"], cpu["rigid"], strict=True)
    return {"CPU [s]": cpu, "CPU ratio": median([x / y for x, y in pairs])}


def executions(plans: Plans, robot: Robot, drive: Drive) -> dict[str, Any]:
    """Execute plans on plants with late and limited currents."""
    found = {}
    for error in (ERRORS[0], 0.0, ERRORS[-1]):
        runs = execute(plans, robot, drive, error)
        found[f"{error:+.0%}"] = {
            "plans": sum(each.use > TOLERANCE for each in runs),
            "largest": max(each.use for each in runs),
            "away [rad]": max(each.error for each in runs),
        }
    return found


def margins(plans: Plans, robot: Robot, drive: Drive) -> dict[str, Any]:
    """Solve the problems of plans with the breakaway friction of a plant and drives as large as its, and judge on it."""
    stated, found = plans.problem.content["drive"], {}
    for error in (each for each in ERRORS if each >= 0):
        factors = dict.fromkeys(("armature", "rotor_inertia", "viscous"), 1 + error)
        factors["coulomb"] = (1 + error) * STRIBECK_RATIO
        larger = {
            key: np.multiply(stated[key], factor).tolist()
            for key, factor in factors.items()
            if key in stated
        }
        solved = solve_plans(with_drive(plans, stated | larger), workers=1).plans
        valid = cnpgen.evaluate_plans(solved, workers=1).valid
        states = states_of(solved[np.flatnonzero(valid)])
        joint = along(pinocchio_torque(robot, 0 * drive.armature), states)
        moving = states.dq, states.ddq, states.sign
        other = torque_errors(joint, moving, drive, (error,))[error]
        found[f"{error:+.0%}"] = {
            **exceeding(other, drive.torque_limit),
            "valid": int(valid.sum()),
            "duration ratio": float(
                solved.duration[valid].mean() / plans.duration[valid].mean()
            ),
        }
    return found


def parametrization_us(solved: dict[str, Plans]) -> dict[str, float] | None:
    """Return the CPU time of the time parametrization of one motion [us]; None if the problem bounds the jerk."""
    problems = {key: open_problem(plans.problem) for key, plans in solved.items()}
    if any(problem.uses_jerk for problem, _ in problems.values()):
        return None
    backend = choose_backend(None)
    parametrizations = {
        key: make_time_parametrization(
            problem, robot, problem_kernels(problem, robot, *backend), at_rest=True
        )
        for key, (problem, robot) in problems.items()
    }
    plans = solved["drives"]
    motion = plans.motion[np.resize(np.arange(len(plans)), MOTIONS)]
    motion = replace(motion, rate=SLOWER * motion.rate)
    poses = np.resize(plans.scene.poses, (MOTIONS, plans.scene.poses.shape[1]))
    times: dict[str, list[float]] = {key: [] for key in solved}
    for _ in range(CALLS):
        for key, each in parametrizations.items():
            times[key].append(cpu_of(partial(each.parametrize, motion, poses)))
    return {key: 1e6 * median(values) / MOTIONS for key, values in times.items()}


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Solve the problems of a pipeline with and without drives, and judge both."""
    progress(f"{name}: {options.problems} problems")
    problems = draw_boundary_problems(name, options.problems, seed=options.seed)
    _, robot = open_problem(problems.problem)
    assert robot.drive is not None
    sets = {"rigid": with_drive(problems, None), "drives": problems}
    solved, cpu = solve_alternately(sets)
    valid = {
        key: cnpgen.evaluate_plans(each, workers=1).valid
        for key, each in solved.items()
    }
    both = valid["rigid"] & valid["drives"]
    ratios = solved["drives"].duration[both] / solved["rigid"].duration[both]
    return {
        "problems": len(problems),
        "valid": {key: int(each.sum()) for key, each in valid.items()},
        "duration ratio": {
            "mean": float(
                solved["drives"].duration[both].mean()
                / solved["rigid"].duration[both].mean()
            ),
            "median": float(np.median(ratios)),
            "largest": float(ratios.max()),
        },
        "CPU ratio": sum(cpu["drives"]) / sum(cpu["rigid"]),
        "CPU [s]": cpu,
        "planning": planning(name, problems.problem.content["drive"]),
        "time parametrization [us]": parametrization_us(solved),
        "executed": executions(
            solved["drives"][np.flatnonzero(valid["drives"])[: options.executed]],
            robot,
            robot.drive,
        ),
        "margins": margins(solved["drives"][: options.executed], robot, robot.drive),
        **{
            key: judge(each[np.flatnonzero(valid[key])], robot.drive, robot)
            for key, each in solved.items()
        },
    }


def tables(results: dict[str, dict[str, Any]]) -> list[str]:
    """Format the results."""
    counted = ("motor", "motor, MuJoCo", "no friction", "joint")
    head = ["problem", "plans", "valid", *counted]
    rows = [
        [name, key, f"{found['valid'][key]} of {found['problems']}"]
        + [_counted(found[key][c]) for c in counted]
        for name, found in results.items()
        for key in ("rigid", "drives")
    ]
    second = [
        [
            name,
            *(
                f"{found['duration ratio'][c]:.4f}"
                for c in ("mean", "median", "largest")
            ),
            f"{found['CPU ratio']:.2f}",
            f"{found['planning']['CPU ratio']:.2f}",
            _fitting(found["time parametrization [us]"]),
            f"{found['drives']['difference of judges [N m]']:.1e}",
        ]
        for name, found in results.items()
    ]
    plants = [
        [name, key, *(_counted(each) for each in found[key]["other plants"].values())]
        for name, found in results.items()
        for key in ("rigid", "drives")
    ]
    executed = [
        [name, error, _counted(each), f"{each['away [rad]']:.4f}"]
        for name, found in results.items()
        for error, each in found["executed"].items()
    ]
    larger = [
        [
            name,
            error,
            _counted(each),
            f"{each['valid']}",
            f"{each['duration ratio']:.4f}",
        ]
        for name, found in results.items()
        for error, each in found["margins"].items()
    ]
    rates = [
        [
            name,
            ", ".join(f"{rate:g}" for rate in found["drives"]["torque rate [N m/s]"]),
        ]
        for name, found in results.items()
    ]
    title = "plans above 1.005 of a limit (largest torque / limit)"
    ratio = [
        *(
            "problem",
            "duration: mean",
            "median",
            "largest",
            "CPU of solving",
            "of planning",
        ),
        *("time parametrization [us]", "judges differ [N m]"),
    ]
    return [
        table(title, head, rows, left=2),
        table("with drives / rigid", ratio, second),
        table(
            "other plants, by the error of rotors and friction: plans above 1.005",
            ["problem", "plans", *(f"{error:+.0%}" for error in ERRORS)],
            plants,
            left=2,
        ),
        table(
            "executed on other plants with late and limited currents",
            ["problem", "error", "above 1.005", "away [rad]"],
            executed,
        ),
        table(
            "solved with the breakaway friction and the errors of the plant",
            ["problem", "error", "above 1.005", "valid", "duration / without"],
            larger,
        ),
        table(
            "largest rate of motor torques by joint [N m/s]",
            ["problem", "rates"],
            rates,
            left=2,
        ),
    ]


def _counted(found: dict[str, Any]) -> str:
    """Format a number of plans and the largest ratio."""
    return f"{found['plans']} ({found['largest']:.3f})"


def _fitting(times: dict[str, float] | None) -> str:
    """Format the times of the time parametrization."""
    return "-" if times is None else f"{times['drives']:.0f} / {times['rigid']:.0f}"


def main() -> None:
    """Print the figures."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--problems", type=int, default=300)
        parser.add_argument("--seed", type=int, default=11)
        parser.add_argument("--executed", type=int, default=40, help="plans to execute")
        parser.add_argument("--sets", nargs="+", choices=PLANNERS, default=[*PLANNERS])

    options = arguments(__doc__, add)
    results = {name: measure(name, options) for name in options.sets}
    report(results, tables(results), as_json=options.json)


if __name__ == "__main__":
    main()
