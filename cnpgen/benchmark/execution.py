"""What planners return, executed: plans and sampled trajectories alike, in the scene of their boundary problem."""

from cnpgen.benchmark.trajectory import Trajectory
from cnpgen.errors import UsageError
from cnpgen.plans.plans import Plans
from cnpgen.problems.record import open_problem
from cnpgen.simulator.execute import Execution, execute
from cnpgen.simulator.executed import Executed
from cnpgen.simulator.plant import Plant
from cnpgen.simulator.reference import Reference, make_reference, reference_of
from cnpgen.simulator.scene import Scene
from cnpgen.simulator.simulate import scene_of


def execute_answer(task: tuple[Plans, Plans | Trajectory], *, plant: Plant) -> Executed:
    """Execute what a planner returned; what cannot be executed is said in ``failure``.

    Args:
        task: One boundary problem, and one plan or a trajectory for it.
        plant: The robot.
    """
    try:
        return execution_of(*task, plant)[2].executed
    except UsageError as error:
        return Executed(failure=str(error))


def execution_of(problem: Plans, answer: Plans | Trajectory, plant: Plant) -> tuple[Scene, Reference, Execution]:
    """Execute what a planner returned.

    Args:
        problem: One boundary problem.
        answer: One plan or a trajectory.
        plant: The robot.

    Returns:
        The world, what the controller followed, and what happened.

    Raises:
        UsageError: It cannot be executed.
        RecipeError: MuJoCo cannot simulate the robot.
        MachineError: MuJoCo is missing.
    """
    limit = open_problem(problem.problem)[1].acceleration_limit
    if isinstance(answer, Plans):
        reference = reference_of(answer.motion, acceleration_limit=limit)
    else:
        reference = make_reference(answer.states, answer.duration, acceleration_limit=limit)
    scene = scene_of(problem, plant)
    return scene, reference, execute(scene, reference, problem.columns["goal_xyz"][0], problem.boundary.start_dq[0])
