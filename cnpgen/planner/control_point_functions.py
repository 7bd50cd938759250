"""Build control points as CasADi SX functions: the projected line, and whole paths projected onto the manifold.

The straight line in joint space is far off the manifold: a heavy object tilts by about
10 degrees. One Gauss-Newton step removes most of this error before the network runs,
and another step the error that the network adds. The planner uses ``line_change`` and
``projected_path``, which take less time for one plan than a few NumPy operations.
Training uses ``control_points``, in float32 and with gradients, followed by
``path_change``. Boundary conditions are one column: start_q, start_dq, start_ddq,
goal_q, goal_dq, and goal_ddq if the goal fixes three control points.

The equalities are evaluated at one phase per interior control point, where that point
has the largest effect, and at one more phase before the goal, where fast arrivals leave
the manifold most. Among all steps that cancel the residuals to first order, the one
with the smallest second differences is taken, so that motions stay smooth.
"""

from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.symbolic.kinematics import forward_kinematics, tip_velocity
from cnpgen.kernels.symbolic.linalg import Vec, add, dot, solve, symbols
from cnpgen.problems.conditions import equality_residuals
from cnpgen.problems.problem import Problem
from cnpgen.robots.robot import Robot
from cnpgen.trajectory.spline import basis, clamped_knots, end_derivatives
from cnpgen.trajectory.trajectory_spec import TrajectorySpec

CHANGE_WEIGHT = 0.05  # weight of the change relative to its second differences
PROJECTION_DAMPING = 1e-6  # limits steps near singularities of the equalities
MAX_STEP_RAD = 0.6  # per control point and joint


def tips_at_ends(robot: Robot, problem: Problem, *, fixed_at_goal: int) -> Any:
    """Build ``ends -> (start position, goal position)`` of the tip [m], and its velocity at the goal if it is used."""
    import casadi as ca

    ends_sx, ends = symbols("ends", (3 + fixed_at_goal) * robot.n)
    # Order of the ends: q, dq, ddq at the start, then q, dq and maybe ddq at the goal.
    q, _, _, goal_q, goal_dq, *_ = _split(ends, robot.n)
    start, goal = (
        forward_kinematics(robot.chain, position) for position in (q, goal_q)
    )
    tips = [ca.vertcat(*kinematics.tip) for kinematics in (start, goal)]
    if problem.scene_constraint is not None:
        tips.append(ca.vertcat(*tip_velocity(goal, goal_dq)))
    return ca.Function("tips_at_ends", [ends_sx], tips)


def line_change(
    robot: Robot,
    problem: Problem,
    *,
    steps: int,
    fixed_at_goal: int,
    within_limits: bool,
    with_offsets: bool,
) -> Any:
    """Build ``(ends, rate, obstacle_poses) -> change`` of the line's interior points at a constant rate [1/s].

    With offsets [rad] from the line it is ``(ends, offsets, rate, obstacle_poses) ->
    offsets + change``.
    """
    import casadi as ca

    (ends_sx, ends) = symbols("ends", (3 + fixed_at_goal) * robot.n)
    rate = ca.SX.sym("rate")
    spec = problem.trajectory
    poses_sx, obstacle_poses = symbols("obstacle_poses", problem.scene_width)
    # Equal rate control points are a constant rate: r' = 0 at the ends.
    points = _points(_split(ends, robot.n), [rate] * spec.rate_control_points, spec)
    interior = slice(3, -fixed_at_goal)
    offsets_sx, scalars = symbols(
        "offsets", len(points[interior]) * robot.n if with_offsets else 0
    )
    offsets = _split(scalars, robot.n)
    if with_offsets:
        points[interior] = _sums(points[interior], offsets)
    change = projection_change(
        robot,
        problem,
        points,
        obstacle_poses,
        steps=steps,
        fixed_at_goal=fixed_at_goal,
        within_limits=within_limits,
    )
    change = _sums(offsets, change) if with_offsets else change
    columns = [ends_sx, *([offsets_sx] if with_offsets else []), rate, poses_sx]
    return ca.Function("line_change", columns, [ca.cse(_column(change))])


def projected_path(
    robot: Robot,
    problem: Problem,
    *,
    steps: int,
    fixed_at_goal: int,
    within_limits: bool,
) -> Any:
    """Build ``(ends, offsets, rates, obstacle_poses) -> path``: line plus offsets [rad], projected.

    Without steps, control points are clipped once to the joint limits if they must be
    within them.
    """
    import casadi as ca

    spec, n = problem.trajectory, robot.n
    ends_sx, ends = symbols("ends", (3 + fixed_at_goal) * n)
    poses_sx, obstacle_poses = symbols("obstacle_poses", problem.scene_width)
    rates_sx, rates = symbols("rates", spec.rate_control_points)
    offsets_sx, offsets = symbols(
        "offsets", (spec.path_control_points - 3 - fixed_at_goal) * n
    )
    points, interior = _points(_split(ends, n), rates, spec), slice(3, -fixed_at_goal)
    points[interior] = _sums(points[interior], _split(offsets, n))
    if steps:
        options: dict[str, Any] = {
            "steps": steps,
            "fixed_at_goal": fixed_at_goal,
            "within_limits": within_limits,
        }
        change = projection_change(robot, problem, points, obstacle_poses, **options)
        points[interior] = _sums(points[interior], change)
    # Clipping interior points suffices: the path lies in the hull of its control
    # points.
    elif within_limits:
        zero = [0.0] * n
        change = [clipped_to_limits(robot, point, zero) for point in points[interior]]
        points[interior] = _sums(points[interior], change)
    return ca.Function(
        "projected_path",
        [ends_sx, offsets_sx, rates_sx, poses_sx],
        [ca.cse(_column(points))],
    )


def path_change(robot: Robot, problem: Problem, **options: Any) -> Any:
    """Build ``(path, obstacle_poses) -> change``: the ``projection_change`` of a path as one column."""
    import casadi as ca

    path, obstacle_poses, change = _path_change(robot, problem, options)
    return ca.Function("path_change", [path, obstacle_poses], [ca.cse(change)])


def path_change_adjoint(robot: Robot, problem: Problem, **options: Any) -> Any:
    """Build ``(path, obstacle_poses, seed) -> d(seed . change)/d(path)``, by reverse mode."""
    import casadi as ca

    path, obstacle_poses, change = _path_change(robot, problem, options)
    seed = ca.SX.sym("seed", change.numel())
    # Reverse mode: one product with the transposed Jacobian, whatever its size.
    gradient = ca.densify(ca.jtimes(change, path, seed, True))
    return ca.Function(
        "path_change_adjoint", [path, obstacle_poses, seed], [ca.cse(gradient)]
    )


def _path_change(
    robot: Robot, problem: Problem, options: dict[str, Any]
) -> tuple[Any, Any, Any]:
    path_sx, path = symbols("path", problem.trajectory.path_control_points * robot.n)
    poses_sx, obstacle_poses = symbols("obstacle_poses", problem.scene_width)
    change = projection_change(
        robot, problem, _split(path, robot.n), obstacle_poses, **options
    )
    return path_sx, poses_sx, _column(change)


def _points(ends: list[Vec], rates: Vec, spec: TrajectorySpec) -> list[Vec]:
    """Return all control points of the line (paper, Appendix A, as ``trajectory.boundary``)."""
    q, dq, ddq, goal_q, goal_dq, *goal_ddq = ends
    # A rate at an end depends on its two outermost control points only.
    first = _end_points(q, dq, ddq, rates[:2], spec)
    # in reversed phase r' and p' change sign: the goal is a start with -dq
    arrival = [-v for v in goal_dq]
    last = _end_points(
        goal_q, arrival, goal_ddq[0] if goal_ddq else None, rates[:-3:-1], spec
    )[::-1]
    count = spec.path_control_points - len(first) - len(last)
    along = [i / max(count - 1, 1) for i in range(count)]
    # C_{3+i} = first + (last - first) i / (m - 1): the line joins the points that the
    # ends determine.
    line = [
        [a + (b - a) * t for a, b in zip(first[-1], last[0], strict=True)]
        for t in along
    ]
    return [*first, *line, *last]


def _end_points(
    q: Vec, dq: Vec, ddq: Vec | None, rates: Vec, spec: TrajectorySpec
) -> list[Vec]:
    """Return the control points that an end fixes, from the outermost one: two if its acceleration is free."""
    # eta and beta are the first and second derivatives of the clamped basis at an end:
    #   p'(0) = eta (c1 - c0),   r'(0) = eta (r1 - r0),   p''(0) = beta (c2 - 3 c1 + 2 c0).
    path = end_derivatives(spec.path_control_points, spec.degree)
    gradient = end_derivatives(spec.rate_control_points, spec.degree).eta * (
        rates[1] - rates[0]
    )
    # dq = p' r and ddq = p'' r^2 + p' r' r, solved for p' and p''.
    first = [v / rates[0] for v in dq]
    c1 = [x + v / path.eta for x, v in zip(q, first, strict=True)]
    if ddq is None:
        return [q, c1]
    second = [
        (a - v * gradient * rates[0]) / rates[0] ** 2
        for a, v in zip(ddq, first, strict=True)
    ]
    c2 = [a / path.beta - 2 * x + 3 * c for a, x, c in zip(second, q, c1, strict=True)]
    return [q, c1, c2]


def _split(values: Vec, n: int) -> list[Vec]:
    return [values[i : i + n] for i in range(0, len(values), n)]


def _sums(points: list[Vec], others: list[Vec]) -> list[Vec]:
    return [add(*pair) for pair in zip(points, others, strict=True)]


def _column(points: list[Vec]) -> Any:
    import casadi as ca

    return ca.vertcat(*[value for point in points for value in point])


def projection_change(
    robot: Robot,
    problem: Problem,
    control: list[Vec],
    obstacle_poses: Vec,
    *,
    steps: int,
    fixed_at_goal: int,
    within_limits: bool,
) -> list[Vec]:
    """Return the change of a path's interior control points [rad] by Gauss-Newton steps onto the equalities.

    ``control`` has all control points, and ``within_limits`` clips the interior ones to
    the limits after every step.
    """
    control, interior = list(control), slice(3, len(control) - fixed_at_goal)
    # Boundary control points stay: they meet the boundary conditions exactly.
    table, response = collocation(problem.trajectory.degree, len(control), interior)
    equality = equality_residuals(robot, problem)
    total = [[0.0] * robot.n for _ in response]
    for _ in range(steps):
        # Positions at the phases; only interior points move them.
        q = [_combined(row, control) for row in table]
        step = _gauss_newton(equality, q, obstacle_poses, table[:, interior], response)
        if within_limits:
            step = [
                clipped_to_limits(robot, *pair)
                for pair in zip(control[interior], step, strict=True)
            ]
        control[interior] = _sums(control[interior], step)
        total = _sums(total, step)
    return total


def clipped_to_limits(robot: Robot, point: Vec, step: Vec) -> Vec:
    """Change a step so that its end is within the joint limits.

    Then the whole path is, too.
    """
    import casadi as ca

    ends = zip(
        robot.position_lower.tolist(),
        robot.position_upper.tolist(),
        add(point, step),
        strict=True,
    )
    return [
        ca.fmin(ca.fmax(end, low), high) - start
        for (low, high, end), start in zip(ends, point, strict=True)
    ]


def _linearized(
    equality: Any, q: list[Vec], obstacle_poses: Vec
) -> tuple[Vec, list[Vec], list[int]]:
    """Return residual, row of the Jacobian and phase of every equation at every phase."""
    import casadi as ca

    residuals, rows, phases = [], [], []
    for phase, position in enumerate(q):
        residual, jacobian = equality(
            ca.vertcat(*position), ca.vertcat(*obstacle_poses)
        )
        # The kernel has the Jacobian in one column, CasADi stores matrices column by
        # column.
        columns = ca.reshape(jacobian, residual.numel(), len(position))
        for equation in range(residual.numel()):
            residuals.append(residual[equation])
            rows.append(ca.vertsplit(columns[equation, :].T))
            phases.append(phase)
    return residuals, rows, phases


def _gauss_newton(
    equality: Any, q: list[Vec], obstacle_poses: Vec, inner: Array, response: Array
) -> list[Vec]:
    """Return the change of the interior control points that cancels the residuals at the phases to first order."""
    import casadi as ca

    residuals, rows, phases = _linearized(equality, q, obstacle_poses)
    # Step of the control points: dC = -M N^T G^T lambda with the basis N at the phases,
    # the mobility M = (D^T D + w I)^-1 of second differences D, and the Jacobians G.
    # The multipliers solve (G N M N^T G^T + damping I) lambda = residuals.
    coupling = inner @ response
    lower = [
        [
            dot(rows[i], rows[j]) * float(coupling[phases[i], phases[j]])
            for j in range(i + 1)
        ]
        for i in range(len(rows))
    ]
    for i, entries in enumerate(lower):
        entries[i] += PROJECTION_DAMPING
    # The matrix is symmetric, hence its lower triangle; the damping makes it positive
    # definite.
    force = solve(lower, residuals)
    # Forces of all equations of one phase add up, before they spread over control
    # points.
    forces: list[Vec] = [[0.0] * len(q[0]) for _ in q]
    for strength, row, phase in zip(force, rows, phases, strict=True):
        forces[phase] = [
            total + strength * gradient
            for total, gradient in zip(forces[phase], row, strict=True)
        ]
    return [
        [
            ca.fmin(ca.fmax(-x, -MAX_STEP_RAD), MAX_STEP_RAD)
            for x in _combined(row, forces)
        ]
        for row in response
    ]


def _combined(factors: Array, points: list[Vec]) -> Vec:
    """Return the sum of points times factors; zero factors are skipped."""
    used = [
        (float(factor), point)
        for factor, point in zip(factors, points, strict=True)
        if factor
    ]
    return [
        sum(factor * point[joint] for factor, point in used)
        for joint in range(len(points[0]))
    ]


def collocation(degree: int, points: int, interior: slice) -> tuple[Array, Array]:
    """Return the basis at K phases, (K, points), and responses of interior points to forces there, (K - 1, K)."""
    # Greville abscissae: phases at which the control points have the largest effect.
    # The abscissa of control point i is the mean of the knots i + 1 to i + degree.
    knots, indices = clamped_knots(points, degree), range(points)[interior]
    greville = [knots[i + 1 : i + degree + 1].mean() for i in indices]
    # One more phase before the goal, where fast arrivals leave the manifold most.
    phases = np.array([*greville, (greville[-1] + 1) / 2])
    table = basis(phases, points, degree)
    # Small second differences: a smooth change; the weight keeps the inverse finite.
    second = np.diff(np.eye(points), 2, axis=0)[:, interior]
    mobility = np.linalg.inv(second.T @ second + CHANGE_WEIGHT * np.eye(len(greville)))
    return table, mobility @ table[:, interior].T
