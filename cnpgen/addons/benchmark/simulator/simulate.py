"""Execution of sets of plans in several processes."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from cnpgen.addons.benchmark.simulator.challenge import challenge_plant, check_challenge
from cnpgen.addons.benchmark.simulator.execute import Execution, execute, load_mujoco
from cnpgen.addons.benchmark.simulator.executed import Executed
from cnpgen.addons.benchmark.simulator.hockey import puck_of
from cnpgen.addons.benchmark.simulator.plant import Plant, as_plant
from cnpgen.addons.benchmark.simulator.reference import (
    StatesAt,
    make_reference,
    states_of,
)
from cnpgen.addons.benchmark.simulator.simulator_scene import SimulatorScene
from cnpgen.addons.benchmark.simulator.tip import Tip
from cnpgen.arrays import Array
from cnpgen.documents import JsonObject
from cnpgen.errors import UsageError, counted
from cnpgen.machine.workers import distribute, worker_count
from cnpgen.plans.plans import Plans
from cnpgen.plans.tips import correct_tips
from cnpgen.problems.problem_record import open_problem, with_payload_of
from cnpgen.robots.table_frame import table_frame, upright_axes
from cnpgen.schema.argument_types import checked_arguments

SIMULATION_FORMAT = "cnpgen-simulation"
SIMULATION_VERSION = 1
COUNTED_FLAGS = ("success", "finished", "hit", "scored", "touched_early", "collided")
MAX_SIMULATIONS_OF_ONE_PROCESS = 20  # a second process pays off for more plans


@dataclass(frozen=True, eq=False)
class Simulation:
    """Results of the execution of N plans.

    Attributes:
        plans: The plans.
        executed: Result of each plan, in the same order.
        plant: The robot that executed them.
    """

    plans: Plans
    executed: tuple[Executed, ...]
    plant: Plant

    def __repr__(self) -> str:
        succeeded = sum(result.success for result in self.executed)
        plans = f"{counted(len(self.executed), 'plan')} of {self.plans.problem.name!r}"
        return f"<{plans} executed by the {self.plant.name} plant, {succeeded:,} with success>"

    def summary(self) -> JsonObject:
        """Return the summary of all plans for JSON."""
        rows = [result.to_dict() for result in self.executed]
        counts = {
            name: sum(row[name] for row in rows if name in row)
            for name in COUNTED_FLAGS
            if any(name in r for r in rows)
        }
        names = {
            name: None
            for row in rows
            for name, value in row.items()
            if isinstance(value, float)
        }
        medians = {
            name: float(np.median([row[name] for row in rows if name in row]))
            for name in names
        }
        return {
            "format": SIMULATION_FORMAT,
            "format_version": SIMULATION_VERSION,
            "problem": self.plans.problem.name,
            "plant": self.plant.name,
            "plans": len(rows),
            **counts,
            "medians": medians,
        }


@checked_arguments
def simulate_plans(
    plans: Plans,
    *,
    plant: Plant | str = "nominal",
    environment: str | Path | None = None,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Simulation:
    """Execute plans in MuJoCo: computed torque at 1 kHz on a robot with friction; its controller knows that of drives.

    On a table, a plan that ends in motion is a hit, and the puck lies 7 cm ahead of its
    end. Plans are executed independently of each other and of the number of processes.

    Args:
        plans: The plans.
        plant: The robot, or its name: "nominal", "heavier" or "delayed".
        environment: A clone of the Air Hockey Challenge's environment, which replaces
            ``plant``.
        workers: Processes; default one per available core, or one for few plans.
        progress: Called with the number of plans executed since the last call.

    Raises:
        UsageError: The plant is unknown, there is less than one worker, or
            ``environment`` is not a clone or does not support the plans.
        RecipeError: MuJoCo cannot simulate the robot, or the problem needs a plug-in
            that is not installed.
        MachineError: MuJoCo is missing, the environment cannot be imported, or a worker
            died.
    """
    plant = as_plant(plant)
    plans = correct_tips(plans)
    load_mujoco()
    if environment is not None:
        if plans.problem.parameters.tilts_table:
            raise UsageError(
                f"plans of {plans.problem.name!r} are not simulated: the environment's table does not move",
                concerns="plans",
            )
        plant = challenge_plant(environment)
        check_challenge(*open_problem(plans.problem))
    count = worker_count(
        1
        if workers is None and len(plans) <= MAX_SIMULATIONS_OF_ONE_PROCESS
        else workers,
        max(len(plans), 1),
    )
    executed: list[Executed] = []
    with closing(
        distribute(partial(_simulate, plant=plant), iter(plans), count, ordered=True)
    ) as results:
        for result in results:
            executed.append(result)
            if progress is not None:
                progress(1)
    return Simulation(plans, tuple(executed), plant)


def _simulate(plan: Plans, *, plant: Plant) -> Executed:
    try:
        return execute_plan(plan, plant).executed
    except UsageError as error:
        return Executed(failure=str(error))


def execute_plan(plan: Plans, plant: Plant) -> Execution:
    """Execute one plan; raise UsageError if it is not finite, never arrives, or takes too long."""
    return execute_states(plan, states_of(plan.motion), float(plan.duration[0]), plant)


def execute_states(
    problem: Plans,
    states: StatesAt,
    duration: float,
    plant: Plant,
    start_dq: Array | None = None,
) -> Execution:
    """Execute a trajectory of a duration [s] for one boundary problem.

    See ``execute`` and ``execute_plan``.
    """
    _, robot = open_problem(problem.problem)
    reference = make_reference(
        states, duration, acceleration_limit=robot.acceleration_limit
    )
    return execute(
        simulator_scene(problem, plant),
        reference,
        problem.columns["goal_xyz"][0],
        start_dq,
    )


def simulator_scene(problem: Plans, plant: Plant) -> SimulatorScene:
    """Build the simulated world of one boundary problem: obstacles, and the puck if the goal is a hit.

    Parameters of the problem determine the load, the pose of the table and the upright
    direction. The columns ``puck_xy`` [m] and ``puck_velocity`` [m/s] of hits of moving
    pucks define the puck at the start.
    """
    record = problem.problem
    values = problem.boundary.parameters
    loaded, robot = open_problem(
        record if values is None else with_payload_of(record, values[0])
    )
    scene = SimulatorScene(loaded, robot, plant, problem.scene.poses[0])
    if values is not None:
        table = table_frame(record.parameters, loaded.table_origin, values)
        up = upright_axes(record.parameters, values)
        position = table.to_world(np.zeros((1, 3)))[0]
        scene = replace(
            scene,
            table_rotation=table.axes[0],
            table_position=position,
            upright=up[0].T,
        )
    if scene.height is None:
        return scene
    if "puck_xy" in problem.columns:
        puck = problem.columns["puck_xy"][0]
        vx, vy = problem.columns["puck_velocity"][0].tolist()
        return replace(scene, puck=puck, puck_velocity=(vx, vy))
    velocity = (
        Tip(robot).at(problem.boundary.goal_q[0])[2][:3] @ problem.boundary.goal_dq[0]
    )
    goal_xyz = scene.on_table(problem.columns["goal_xyz"][0])
    return replace(scene, puck=puck_of(goal_xyz, velocity @ scene.table_rotation))
