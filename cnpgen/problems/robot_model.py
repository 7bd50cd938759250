"""Robot of a problem for planner authors: limits, batched kinematics, dynamics, collisions, constraint values."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from cnpgen.arrays import Array, Mask
from cnpgen.errors import UsageError, counted
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_record import as_problem
from cnpgen.robots.scene import Scene
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import numbers
from cnpgen.schema.old_keywords import old_attribute
from cnpgen.store.dataset_spec import StoredProblem

if TYPE_CHECKING:
    from cnpgen.kernels.kernel import Kernel
    from cnpgen.kernels.library import KernelLibrary
    from cnpgen.kernels.symbolic.symbolic_state import FrozenState
    from cnpgen.problems.constraints.constraint import Condition, Constraint
    from cnpgen.robots.robot import Robot
    from cnpgen.world.world import World


@dataclass(frozen=True, eq=False)
class ConstraintValues:
    """Values of all conditions of a problem at N states, with derivatives.

    A state is valid if ``lower - tolerance <= g <= upper + tolerance``. Derivatives
    belong to the symbolic form, with closest points of distances treated as constant
    (envelope theorem).

    Attributes:
        names: Name of the constraint of each value, length m.
        g: Values in SI units, shape (N, m).
        lower: Lower bounds, shape (m,); -inf without a bound.
        upper: Upper bounds, shape (m,); inf without a bound.
        tolerance: Accepted violation of each value, shape (m,).
        jacobian_q: Derivatives with respect to joint positions, shape (N, m, n).
        jacobian_dq: Derivatives with respect to joint velocities, shape (N, m, n).
        jacobian_ddq: Derivatives with respect to joint accelerations, shape (N, m, n).
        drift: ``(dJ_q / dt) dq``, shape (N, m), 0 for conditions that depend on dq or
            ddq. The second time derivative of a condition of positions is ``jacobian_q
            @ ddq + drift``, as controllers on the manifold use it.
    """

    names: tuple[str, ...]
    g: Array
    lower: Array
    upper: Array
    tolerance: Array
    jacobian_q: Array
    jacobian_dq: Array
    jacobian_ddq: Array
    drift: Array

    @property
    def violation(self) -> Array:
        """Distance of each value from its bounds, 0 inside, shape (N, m)."""
        return np.maximum(np.maximum(self.lower - self.g, self.g - self.upper), 0.0)

    @property
    def valid(self) -> Mask:
        """Whether each state satisfies every condition up to its tolerance, shape (N,)."""
        return np.asarray((self.violation <= self.tolerance).all(axis=1))


class RobotModel:
    """The robot of a problem: limits, batched forward kinematics, Jacobians, dynamics, collisions and constraints.

    Positions, velocities and accelerations have shape (N, n) or (n,), in rad, rad/s and
    rad/s^2 (m for sliding joints). Results have the first axis N. Vectors are in the
    world frame. Kernels are compiled on first use. Distances are measured by Coal; all
    other results use the kernels of the solvers. Use an object in one thread only.

    Args:
        problem: The problem, its record, or the name or file of a problem, a pipeline
            or a dataset.
        backend: "compiled" or "numpy"; by default the fastest available.

    Attributes:
        problem: The problem.
        joint_names: Names of the n planned joints.
        tip: Name of the tip frame.
        home: Home configuration [rad], the key `base` of files, shape (n,).
        position_lower: Planning limits of joint positions [rad], shape (n,).
        position_upper: Planning limits of joint positions [rad], shape (n,).
        velocity_limit: Planning limits of joint velocities [rad/s], shape (n,).
        acceleration_limit: Planning limits of joint accelerations [rad/s^2], shape
            (n,).
        jerk_limit: Planning limits of joint jerks [rad/s^3], shape (n,).
        torque_limit: Planning limits of joint torques [N m], shape (n,).

    Raises:
        UsageError: ``problem`` is no problem, or ``backend`` is unknown.
        RecipeError: The recipe has errors.
        MachineError: The backend is not available.
    """

    base = old_attribute("base", "home")

    @checked_arguments
    def __init__(
        self,
        problem: Problem | StoredProblem | str | Path,
        *,
        backend: str | None = None,
    ) -> None:
        from cnpgen.kernels.library import choose_backend, problem_kernels

        self.problem = as_problem(problem)
        self._robot: Robot = load_robot(self.problem)
        robot = self._robot
        self.joint_names = robot.joint_names
        self.tip = robot.tip
        self.home = robot.home
        self.position_lower = robot.position_lower
        self.position_upper = robot.position_upper
        self.velocity_limit = robot.velocity_limit
        self.acceleration_limit = robot.acceleration_limit
        self.jerk_limit = robot.jerk_limit
        self.torque_limit = robot.torque_limit
        self._kernels: KernelLibrary = problem_kernels(
            self.problem, robot, *choose_backend(backend)
        )
        # Kernels and the world of Coal are built on first use: a caller of limits needs
        # neither.
        self._loaded: dict[str, Kernel] = {}
        self._world: World | None = None

    def __repr__(self) -> str:
        return f"<RobotModel of {self.problem.name!r}: {counted(len(self.joint_names), 'joint')}, tip {self.tip!r}>"

    @checked_arguments
    def forward_kinematics(self, q: ArrayLike) -> tuple[Array, Array]:
        """Compute the pose of the tip.

        Args:
            q: Joint positions [rad], shape (N, n) or (n,).

        Returns:
            Positions [m], shape (N, 3), and rotation matrices, shape (N, 3, 3).
        """
        position, rotation, _ = self._run("tip_pose", self._states("q", q))
        # Kernels return arrays with the states last, and matrices row by row.
        return position.T.copy(), rotation.T.reshape(-1, 3, 3)

    @checked_arguments
    def jacobian(self, q: ArrayLike) -> Array:
        """Compute the geometric Jacobian of the tip in world axes, linear rows first.

        Args:
            q: Joint positions [rad], shape (N, n) or (n,).

        Returns:
            Shape (N, 6, n): m/rad in the first three rows, 1 in the others.
        """
        _, _, jacobian = self._run("tip_pose", self._states("q", q))
        return jacobian.T.reshape(-1, 6, len(self.joint_names))

    @checked_arguments
    def inverse_dynamics(
        self, q: ArrayLike, dq: ArrayLike | None = None, ddq: ArrayLike | None = None
    ) -> Array:
        """Compute joint torques, payload included.

        Args:
            q: Joint positions [rad], shape (N, n) or (n,).
            dq: Joint velocities [rad/s]; zero by default.
            ddq: Joint accelerations [rad/s^2]; zero by default.

        Returns:
            Torques [N m], shape (N, n).
        """
        (torque,) = self._run("inverse_dynamics_of", *self._motion(q, dq, ddq))
        return torque.T.copy()

    @checked_arguments
    def motor_torque(
        self, q: ArrayLike, dq: ArrayLike | None = None, ddq: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Compute the torques at the motors, seen at the joints: ``tau + J ddq`` and any friction that may act.

        Without [drive] both are those of ``inverse_dynamics``.

        Args:
            q: Joint positions [rad], shape (N, n) or (n,).
            dq: Joint velocities [rad/s]; zero by default.
            ddq: Joint accelerations [rad/s^2]; zero by default.

        Returns:
            Lowest and highest torques [N m], shape (N, n) each.
        """
        low, high = self._run("motor_torque_of", *self._motion(q, dq, ddq))
        return low.T.copy(), high.T.copy()

    @checked_arguments
    def scene(
        self,
        start_xyz: ArrayLike,
        goal_xyz: ArrayLike,
        goal_velocity: ArrayLike | None = None,
        *,
        parameters: ArrayLike | None = None,
    ) -> Scene:
        """Place the obstacles of N samples; some stand below the object at the start or at the goal.

        Args:
            start_xyz: Tip positions at the start [m], shape (N, 3) or (3,).
            goal_xyz: Tip positions at the goal [m], shape (N, 3) or (3,).
            goal_velocity: Tip velocities at the goal [m/s], shape (N, 3) or (3,), from
                which the pucks of hits follow; zero by default.
            parameters: Parameters of the problem, shape (N, width) or (width,); nominal
                by default.
        """
        from cnpgen.problems.obstacles import scene_of

        vectors: dict[str, ArrayLike] = {"start_xyz": start_xyz, "goal_xyz": goal_xyz}
        if goal_velocity is not None:
            vectors["goal_velocity"] = goal_velocity
        given = {
            name: np.atleast_2d(numbers(name, xyz)) for name, xyz in vectors.items()
        }
        start = given["start_xyz"]
        goal = given["goal_xyz"]
        for name, xyz in given.items():
            if xyz.shape != (len(start), 3):
                raise UsageError(
                    f"must have shape ({len(start)}, 3) or (3,), got {xyz.shape}",
                    argument=name,
                )
        velocity = given.get("goal_velocity", np.zeros(goal.shape))
        if parameters is None:
            return scene_of(self.problem, start, goal, velocity)
        rows = self.problem.parameters.checked(numbers("parameters", parameters))
        return scene_of(
            self.problem,
            start,
            goal,
            velocity,
            np.broadcast_to(rows, (len(start), rows.shape[1])),
        )

    @checked_arguments
    def constraint_values(
        self,
        q: ArrayLike,
        dq: ArrayLike | None = None,
        ddq: ArrayLike | None = None,
        *,
        scene: Scene | None = None,
    ) -> ConstraintValues:
        """Evaluate every condition of the problem with its derivatives; conditions of jerks are left out.

        Args:
            q: Joint positions [rad], shape (N, n) or (n,).
            dq: Joint velocities [rad/s]; zero by default.
            ddq: Joint accelerations [rad/s^2]; zero by default.
            scene: Obstacles of N samples, or of one for all states; by default where
                the problem places them.
        """
        states = self._motion(q, dq, ddq)
        lanes = self._lanes(scene, states[0].shape[1])
        g, *jacobians, drift = self._run("constraint_values_of", *states, lanes)
        names, lower, upper, tolerance = self._conditions()
        shape = (len(self.joint_names), len(names))
        # The kernel stacks a Jacobian column by column, (n m, N): as (N, n, m), then
        # (N, m, n).
        by_q, by_dq, by_ddq = (
            part.T.reshape(-1, *shape).swapaxes(1, 2) for part in jacobians
        )
        return ConstraintValues(
            names,
            g.T.copy(),
            lower,
            upper,
            tolerance,
            by_q,
            by_dq,
            by_ddq,
            drift.T.copy(),
        )

    @checked_arguments
    def min_distance(self, q: ArrayLike, *, scene: Scene | None = None) -> Array:
        """Measure the smallest distance with Coal: links and held object from obstacles, and links from each other.

        Args:
            q: Joint positions [rad], shape (N, n) or (n,).
            scene: Obstacles of N samples, or of one for all states; by default where
                the problem places them.

        Returns:
            Signed distances [m], negative for penetration, shape (N,); inf without
            collision pairs. With the paper's capsule model, the distance of the capsule
            axes less the radius of ``robot-clearance``.
        """
        states = self._states("q", q)
        poses = self._lanes(scene, states.shape[1])
        return np.array(
            [
                self._distance_at(states[:, k], poses[:, k])
                for k in range(states.shape[1])
            ]
        )

    @checked_arguments
    def is_collision_free(self, q: ArrayLike, *, scene: Scene | None = None) -> Mask:
        """Return whether nothing penetrates at each state, shape (N,).

        Arguments as of ``min_distance``.
        """
        return np.asarray(self.min_distance(q, scene=scene) >= 0)

    def _distance_at(self, q: Array, poses: Array) -> float:
        from cnpgen.world.world import World

        problem = self.problem
        robot = self._robot
        if self._world is None:
            self._world = World(robot, problem.obstacle, problem.object_size)
        # Distances depend on positions only.
        world = self._world
        rest = np.zeros(robot.n)
        world.set_state(q, rest, rest, poses)
        distances: list[float] = []
        if robot.shape is not None:
            distances += [
                *world.self_distances(),
                *(world.shape_distances() if problem.obstacle else ()),
            ]
        elif problem.obstacle:
            # Capsules of the paper: the distance of axes less the radius of the
            # thickest.
            radii = [
                float(getattr(item, "radius", 0.0) or 0.0)
                for item in problem.constraint
            ]
            distances += [
                distance - max(radii, default=0.0)
                for distance in world.segment_distances()
            ]
        if problem.obstacle and problem.object_size is not None:
            distances += world.object_distances()
        return min(distances, default=np.inf)

    def _lanes(self, scene: Scene | None, n: int) -> Array:
        """Return poses of obstacles for n states, shape (width, n)."""
        if scene is None:
            from cnpgen.problems.obstacles import scene_of

            scene = scene_of(self.problem, *np.zeros((3, 1, 3)))
            # Start, goal and goal velocity are zero: only obstacles that follow them
            # depend on this.
            return np.repeat(scene.lanes, n, axis=1)
        if len(scene) not in {1, n}:
            raise UsageError(
                f"must have one sample or {n}, got {len(scene)}", argument="scene"
            )
        return scene.lanes if len(scene) == n else np.repeat(scene.lanes, n, axis=1)

    def _states(self, name: str, values: ArrayLike) -> Array:
        """Return states as kernels take them, shape (n, N)."""
        array = np.atleast_2d(numbers(name, values))
        n = len(self.joint_names)
        if array.ndim != 2 or array.shape[1] != n or not len(array):
            raise UsageError(
                f"must have shape (N, {n}) or ({n},), got {np.shape(values)}",
                argument=name,
            )
        if not np.isfinite(array).all():
            raise UsageError("must be finite", argument=name)
        return np.ascontiguousarray(array.T)

    def _motion(
        self, q: ArrayLike, dq: ArrayLike | None, ddq: ArrayLike | None
    ) -> tuple[Array, Array, Array]:
        states = self._states("q", q)
        rates = [
            np.zeros_like(states) if x is None else self._states(name, x)
            for name, x in (("dq", dq), ("ddq", ddq))
        ]
        for name, rate in zip(("dq", "ddq"), rates, strict=True):
            if rate.shape != states.shape:
                raise UsageError(
                    f"must have as many rows as q, {states.shape[1]}, got {rate.shape[1]}",
                    argument=name,
                )
        return states, rates[0], rates[1]

    def _run(self, builder: str, *arguments: Array) -> list[Array]:
        if builder not in self._loaded:
            self._loaded[builder] = self._kernels.load(globals()[builder])
        return self._loaded[builder](*arguments)

    def _conditions(self) -> tuple[tuple[str, ...], Array, Array, Array]:
        """Return name, bounds and tolerance of every value that ``constraint_values_of`` computes."""
        _, pairs = _symbolic_conditions(self._robot, self.problem)
        names = tuple(condition.name for _, condition in pairs for _ in condition.g)
        empty = [np.zeros(0)]
        lower = np.concatenate([condition.lower for _, condition in pairs] or empty)
        upper = np.concatenate([condition.upper for _, condition in pairs] or empty)
        tolerance = np.concatenate(
            [constraint.allowed(condition) for constraint, condition in pairs] or empty
        )
        return names, lower, upper, tolerance


def tip_pose(robot: Robot) -> Any:
    """Build ``q -> (p, R, J)``: position, rotation row by row, and geometric Jacobian row by row of the tip."""
    import casadi as ca

    from cnpgen.kernels.symbolic.kinematics import forward_kinematics
    from cnpgen.kernels.symbolic.linalg import symbols

    q_sx, q = symbols("q", robot.n)
    kin = forward_kinematics(robot.chain, q)
    # A prismatic joint does not turn the tip.
    angular = [
        axis if turns else [0.0, 0.0, 0.0]
        for axis, turns in zip(kin.axes, kin.revolute, strict=True)
    ]
    jacobian = [
        column[row]
        for columns in (kin.jacobian, angular)
        for row in range(3)
        for column in columns
    ]
    rotation = [value for row in kin.rotation for value in row]
    outputs = [
        ca.densify(ca.vertcat(*map(ca.SX, values)))
        for values in (kin.tip, rotation, jacobian)
    ]
    return ca.Function("tip_pose", [q_sx], ca.cse(outputs))


def inverse_dynamics_of(robot: Robot) -> Any:
    """Build ``(q, dq, ddq) -> tau``, recursive Newton-Euler."""
    import casadi as ca

    from cnpgen.kernels.symbolic.dynamics import inverse_dynamics
    from cnpgen.kernels.symbolic.linalg import symbols

    pairs = [symbols(name, robot.n) for name in ("q", "dq", "ddq")]
    torque = inverse_dynamics(robot.chain, *(values for _, values in pairs))
    return ca.Function(
        "inverse_dynamics_of",
        [sx for sx, _ in pairs],
        [ca.cse(ca.densify(ca.vertcat(*torque)))],
    )


def motor_torque_of(robot: Robot) -> Any:
    """Build ``(q, dq, ddq) -> (lowest, highest)``, the torques at the motors."""
    import casadi as ca

    from cnpgen.kernels.symbolic.linalg import symbols
    from cnpgen.kernels.symbolic.symbolic_state import SymbolicState

    columns, scalars = zip(
        *(symbols(name, robot.n) for name in ("q", "dq", "ddq")), strict=True
    )
    q, dq, ddq = scalars
    ends = SymbolicState(robot, q, dq, ddq, [], (), None).motor_torque
    outputs = [ca.densify(ca.vertcat(*map(ca.SX, end))) for end in ends]
    return ca.Function("motor_torque_of", list(columns), ca.cse(outputs))


def constraint_values_of(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, dq, ddq, obstacle poses) -> (g, dg/dq, dg/d(dq), dg/d(ddq), drift)``, Jacobians column by column."""
    import casadi as ca

    from cnpgen.problems.conditions import symbolic_needs

    state, pairs = _symbolic_conditions(robot, problem)
    inputs = [
        ca.vertcat(*values)
        for values in (state.q, state.dq, state.ddq, state.obstacle_poses)
    ]
    g = ca.vertcat(*(value for _, condition in pairs for value in condition.g))
    jacobians = [ca.vec(ca.densify(ca.jacobian(g, x))) for x in inputs[:3]]
    # Only conditions of positions have a drift: those that use dq or ddq are multiplied
    # by zero.
    still = [
        symbolic_needs(condition, *inputs[1:3]) == 0
        for _, condition in pairs
        for _ in condition.g
    ]
    positions = g * ca.DM([float(flag) for flag in still])
    # Second derivative of g along dq, which is (dJ_q / dt) dq with ddq = 0.
    drift = ca.densify(
        ca.jtimes(ca.jtimes(positions, inputs[0], inputs[1]), inputs[0], inputs[1])
    )
    # Frozen closest points become expressions again only after differentiation.
    outputs = ca.cse(state.unfrozen([ca.densify(g), *jacobians, drift]))
    return ca.Function("constraint_values_of", inputs, outputs)


def _symbolic_conditions(
    robot: Robot, problem: Problem
) -> tuple[FrozenState, list[tuple[Constraint, Condition]]]:
    from cnpgen.kernels.symbolic.symbolic_state import FrozenState

    _, state = FrozenState.of_symbols(
        robot, problem.obstacle, problem.object_size, problem.scene_width
    )
    pairs = [
        (constraint, condition)
        for constraint in problem.constraint
        # The state has no jerk.
        if not constraint.uses_jerk
        for condition in constraint.symbolic(state)
    ]
    return state, pairs
