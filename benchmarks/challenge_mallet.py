"""The mallet's passive joint in the Air Hockey Challenge: scored hits with changes of the environment.

The environment hangs a mallet of 0.283 kg on a universal joint with a soft position controller. The arm's controller
does not model its mass. Each row changes one of both, or replaces the arm's motion by perfect tracking.

    python benchmarks/challenge_mallet.py path/to/air_hockey_challenge --figure mallet.svg
"""

import argparse
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, progress, report, table
from numpy.typing import NDArray

from cnpgen.addons.benchmark.answers import execution_of
from cnpgen.addons.benchmark.benchmark_planner import Setting, load_kind
from cnpgen.addons.benchmark.results_file import answer_to_dict
from cnpgen.addons.benchmark.simulator.challenge import (
    JOINTS,
    _environment,
    challenge_plant,
)
from cnpgen.addons.benchmark.simulator.plant import Plant
from cnpgen.addons.benchmark.suite import load_suite
from cnpgen.plans.plans import Plans
from cnpgen.store.files.figure_file import new_figure, save_figure

Array = NDArray[np.float64]

PLANNERS = ("aqp", "cnpgen")
MALLET, DISC = "iiwa_1/striker_mallet", "iiwa_1/ee"
LIGHT_KG = 1e-3
STIFFNESS_N_M_RAD, DAMPING_N_M_S_RAD, MAX_TORQUE_N_M = (
    200.0,
    2.2,
    10.0,
)  # of a nearly rigid universal joint
LATERAL_WINDOW_TICKS = 25  # before the planned contact


@dataclass(frozen=True)
class Change:
    """Change of the environment.

    Attributes:
        title: Description.
        light: Whether the mallet has almost no mass.
        rigid: Whether the universal joint is nearly rigid.
        exact: Whether the arm is put on its reference at every tick.
    """

    title: str
    light: bool = False
    rigid: bool = False
    exact: bool = False


CHANGES = (
    Change("none"),
    Change("mallet without mass", light=True),
    Change("rigid universal joint", rigid=True),
    Change("exact tracking of the arm", exact=True),
    Change("rigid joint, exact tracking", rigid=True, exact=True),
)


def rigid_joint(plugin: Any) -> Callable[[], None]:
    """Return the control of a nearly rigid universal joint."""

    def control() -> None:
        desired = plugin._compute_universal_joint()
        q, dq = (
            values[plugin.universal_joint_ids].copy()
            for values in (plugin.env_data.qpos, plugin.env_data.qvel)
        )
        plugin.u_joint_pos_prev = q
        torque = STIFFNESS_N_M_RAD * (desired - q) - DAMPING_N_M_S_RAD * dq
        plugin.env_data.ctrl[plugin.universal_joint_ctrl_ids] = np.clip(
            torque, -MAX_TORQUE_N_M, MAX_TORQUE_N_M
        )

    return control


def exact_tracking(environment: Any) -> Callable[..., Array]:
    """Return a controller that puts the arm on its reference."""

    def control(q: Array, dq: Array, ddq: Array, *_: Array) -> Array:
        for name, position, velocity in zip(
            JOINTS, q.tolist(), dq.tolist(), strict=True
        ):
            joint = environment._data.joint(f"iiwa_1/{name}")
            joint.qpos, joint.qvel = position, velocity
        return np.array(type(environment)._controller(environment, q, dq, ddq, q, dq))

    return control


def apply(change: Change, environment: Any, mass: float) -> None:
    """Change the environment, from its original state."""
    environment._model.body(MALLET).mass = LIGHT_KG if change.light else mass
    plugin = environment.universal_joint_plugin
    for target, name in (
        (plugin, "_control_universal_joint"),
        (environment, "_controller"),
    ):
        vars(target).pop(name, None)
    if change.rigid:
        plugin._control_universal_joint = rigid_joint(plugin)
    if change.exact:
        environment._controller = exact_tracking(environment)


def measure_hit(
    environment: Any, plant: Plant, problem: Plans, content: dict[str, Any]
) -> dict[str, float]:
    """Execute one hit and measure the mallet at the contact, along and across the line from puck to goal."""
    discs: list[Array] = []

    def record(torque: Array) -> None:
        discs.append(environment._data.geom(DISC).xpos - environment._frame[:3, 3])
        type(environment).record(environment, torque)

    environment.record = record
    execution = execution_of((problem, content, None), plant)
    del environment.record
    planned = problem.problem.tip_positions(execution.reference.q)[:, :2]
    puck, first = execution.puck[0], round(1e3 * execution.executed.hit_time)
    ahead = np.array([2.478, 0.0]) - puck
    across = np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
    window = slice(max(first - LATERAL_WINDOW_TICKS, 0), first + 1)
    return {
        "scored": float(bool(execution.executed.scored)),
        "acceleration": float(
            np.abs(1e6 * np.diff(planned[window], 2, axis=0) @ across).max()
        ),
        "tracking_mm": 1e3
        * float(abs((execution.tip[first, :2] - planned[first]) @ across)),
        "swing_mm": 1e3
        * float(abs((discs[first][:2] - execution.tip[first, :2]) @ across)),
        "offset_mm": 1e3 * float(abs((discs[first][:2] - puck) @ across)),
    }


def measure(folder: Path, step: int) -> dict[str, dict[str, list[dict[str, float]]]]:
    """Return planner -> change -> hits."""
    suite, plant = load_suite("hits-81"), challenge_plant(folder)
    environment = _environment(plant.environment)
    mass = float(environment._model.body(MALLET).mass[0])
    problems = suite.problems()[0]
    chosen = [problems[index] for index in range(0, len(problems), step)]
    results: dict[str, dict[str, list[dict[str, float]]]] = {}
    for name in PLANNERS:
        plan = load_kind(name)().prepare(Setting(problems.problem, suite.model))
        found = [answer for answer in map(plan, chosen) if answer is not None]
        answers = list(map(answer_to_dict, found))
        results[name] = {}
        for change in CHANGES:
            progress(f"{name}, {change.title}")
            apply(change, environment, mass)
            results[name][change.title] = [
                measure_hit(environment, plant, problem, answer)
                for problem, answer in zip(chosen, answers, strict=True)
            ]
    return results


def draw(results: dict[str, dict[str, list[dict[str, float]]]], path: Path) -> None:
    """Draw the offset of the mallet at the contact over the planned lateral acceleration."""
    figure = new_figure(8.0, 3.2, dpi=100)
    for place, change in enumerate((CHANGES[0], CHANGES[2]), start=1):
        axes = figure.add_subplot(1, 2, place)
        for name, marker in zip(PLANNERS, "os", strict=True):
            for scored, color in ((1.0, "tab:blue"), (0.0, "tab:red")):
                hits = [
                    hit
                    for hit in results[name][change.title]
                    if hit["scored"] == scored
                ]
                label = (
                    f"{name}, {'scored' if scored else 'missed the goal'} ({len(hits)})"
                )
                x, y = (
                    [hit[key] for hit in hits] for key in ("acceleration", "offset_mm")
                )
                axes.scatter(
                    x,
                    y,
                    s=14,
                    marker=marker,
                    facecolors="none",
                    edgecolors=color,
                    label=label,
                )
        axes.set_title(
            "environment as it is" if place == 1 else change.title, fontsize=9
        )
        axes.set_xlabel(
            "planned lateral acceleration before the contact [m/s²]", fontsize=8
        )
        axes.set_ylabel("lateral offset of the mallet from the puck [mm]", fontsize=8)
        axes.set_ylim(0, 14)
        axes.legend(fontsize=7)
    save_figure(figure, path)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "environment", type=Path, help="clone of the Air Hockey Challenge"
    )
    parser.add_argument("--step", type=int, default=1, help="use every STEP-th hit")
    parser.add_argument("--figure", type=Path, help="also draw the hits")


def main() -> None:
    warnings.simplefilter("ignore")  # of the environment's libraries
    chosen = arguments(__doc__, options)
    results = measure(chosen.environment, chosen.step)
    keys = ("acceleration", "tracking_mm", "swing_mm", "offset_mm")
    rows = [
        (name, change, f"{sum(hit['scored'] for hit in hits):.0f} of {len(hits)}",
         *(f"{np.median([hit[key] for hit in hits]):.2f}" for key in keys),
         f"{max(hit['offset_mm'] for hit in hits):.1f}")
        for name, changes in results.items() for change, hits in changes.items()
    ]  # fmt: skip
    head = (
        "planner",
        "change",
        "scored",
        "lateral m/s^2",
        "tracking mm",
        "swing mm",
        "offset mm",
        "largest mm",
    )
    if chosen.figure:
        draw(results, chosen.figure)
    report(
        {"hits": results},
        [table("medians at the first contact", head, rows, left=2)],
        as_json=chosen.json,
    )


if __name__ == "__main__":
    main()
