"""Control points as SX functions: the bent line that plans deviate from, and whole paths bent onto the manifold.

The straight line in joint space leaves the manifold by far: a heavy object tilts by some 10 degrees on the way. A
Gauss-Newton step removes nearly all of that before the network runs, and another one what the network adds. Planning
takes ``line_bend`` and ``landed_path``, at one plan at a time cheaper than a few operations of NumPy; training takes
``control_points``, in float32 and with gradients, and ``path_bend`` behind it. Boundary conditions come as one column:
start_q, start_dq, start_ddq, goal_q, goal_dq, and goal_ddq where the goal fixes three control points instead of two.
"""

from typing import TYPE_CHECKING, Any

from cnpgen.kernels.symbolic.kinematics import forward_kinematics
from cnpgen.kernels.symbolic.linalg import Vec, symbols
from cnpgen.planner.bending import bend
from cnpgen.problems.problem import Problem
from cnpgen.robots.solid import count_numbers
from cnpgen.trajectory.spline import end_derivatives

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot
    from cnpgen.trajectory.spec import TrajectorySpec


def tips_at_ends(robot: "Robot", *, fixed_at_goal: int) -> Any:
    """Build ``ends -> (start position, goal position)`` of the tip [m]."""
    import casadi as ca

    ends_sx, ends = symbols("ends", (3 + fixed_at_goal) * robot.n)
    q, _, _, goal_q, *_ = _split(ends, robot.n)
    tips = [ca.vertcat(*forward_kinematics(robot.chain, each).tip) for each in (q, goal_q)]
    return ca.Function("tips_at_ends", [ends_sx], tips)


def line_bend(robot: "Robot", problem: Problem, *, steps: int, fixed_at_goal: int, within_limits: bool) -> Any:
    """Build ``(ends, rate, tops) -> change`` of the interior control points on the line, at a constant rate [1/s]."""
    import casadi as ca

    ends_sx, rate, points = _line(robot, problem, fixed_at_goal)
    tops_sx, tops = symbols("tops", count_numbers(problem.obstacle))
    change = bend(robot, problem, points, tops, steps=steps, fixed_at_goal=fixed_at_goal, within_limits=within_limits)
    return ca.Function("line_bend", [ends_sx, rate, tops_sx], [ca.cse(_column(change))])


def corner_bend(robot: "Robot", problem: Problem, *, steps: int, fixed_at_goal: int, within_limits: bool) -> Any:
    """Build ``(ends, offsets, rate, tops) -> change``: the same of a line with offsets [rad], these included."""
    import casadi as ca

    ends_sx, rate, points = _line(robot, problem, fixed_at_goal)
    tops_sx, tops = symbols("tops", count_numbers(problem.obstacle))
    interior = slice(3, -fixed_at_goal)
    offsets_sx, offsets = symbols("offsets", len(points[interior]) * robot.n)
    aside = _split(offsets, robot.n)
    points[interior] = _sums(points[interior], aside)
    change = bend(robot, problem, points, tops, steps=steps, fixed_at_goal=fixed_at_goal, within_limits=within_limits)
    return ca.Function("corner_bend", [ends_sx, offsets_sx, rate, tops_sx], [ca.cse(_column(_sums(aside, change)))])


def _line(robot: "Robot", problem: Problem, fixed_at_goal: int) -> tuple[Any, Any, list[Vec]]:
    """Return symbols of boundary conditions and of a constant rate, and the control points of the line between them."""
    import casadi as ca

    (ends_sx, ends), rate = symbols("ends", (3 + fixed_at_goal) * robot.n), ca.SX.sym("rate")
    spec = problem.trajectory
    return ends_sx, rate, _points(_split(ends, robot.n), [rate] * spec.rate_control_points, spec)


def landed_path(robot: "Robot", problem: Problem, *, steps: int, fixed_at_goal: int, within_limits: bool) -> Any:
    """Build ``(ends, offsets, rates, tops) -> path``: line plus offsets [rad], bent, with boundary control points."""
    import casadi as ca

    spec, n = problem.trajectory, robot.n
    (ends_sx, ends), (tops_sx, tops) = (
        symbols("ends", (3 + fixed_at_goal) * n),
        symbols("tops", count_numbers(problem.obstacle)),
    )
    rates_sx, rates = symbols("rates", spec.rate_control_points)
    offsets_sx, offsets = symbols("offsets", (spec.path_control_points - 3 - fixed_at_goal) * n)
    points, interior = _points(_split(ends, n), rates, spec), slice(3, -fixed_at_goal)
    points[interior] = _sums(points[interior], _split(offsets, n))
    if steps:
        change = bend(
            robot, problem, points, tops, steps=steps, fixed_at_goal=fixed_at_goal, within_limits=within_limits
        )
        points[interior] = _sums(points[interior], change)
    return ca.Function("landed_path", [ends_sx, offsets_sx, rates_sx, tops_sx], [ca.cse(_column(points))])


def path_bend(robot: "Robot", problem: Problem, *, steps: int, fixed_at_goal: int, within_limits: bool) -> Any:
    """Build ``(path, tops) -> change`` of the interior control points."""
    import casadi as ca

    path, tops, change = _path_bend(robot, problem, steps, fixed_at_goal, within_limits)
    return ca.Function("path_bend", [path, tops], [ca.cse(change)])


def path_bend_adjoint(robot: "Robot", problem: Problem, *, steps: int, fixed_at_goal: int, within_limits: bool) -> Any:
    """Build ``(path, tops, seed) -> gradient`` of ``seed . change`` with respect to the path, by the reverse mode."""
    import casadi as ca

    path, tops, change = _path_bend(robot, problem, steps, fixed_at_goal, within_limits)
    seed = ca.SX.sym("seed", change.numel())
    gradient = ca.densify(ca.jtimes(change, path, seed, True))
    return ca.Function("path_bend_adjoint", [path, tops, seed], [ca.cse(gradient)])


def _path_bend(
    robot: "Robot", problem: Problem, steps: int, fixed_at_goal: int, within_limits: bool
) -> tuple[Any, Any, Any]:
    points = problem.trajectory.path_control_points
    (path_sx, path), (tops_sx, tops) = (
        symbols("path", points * robot.n),
        symbols("tops", count_numbers(problem.obstacle)),
    )
    change = bend(
        robot,
        problem,
        _split(path, robot.n),
        tops,
        steps=steps,
        fixed_at_goal=fixed_at_goal,
        within_limits=within_limits,
    )
    return path_sx, tops_sx, _column(change)


def _points(ends: list[Vec], rates: Vec, spec: "TrajectorySpec") -> list[Vec]:
    """Control points of the line, boundary ones first and last (paper, Appendix A; ``trajectory.boundary``)."""
    q, dq, ddq, goal_q, goal_dq, *goal_ddq = ends
    first = _end_points(q, dq, ddq, rates[:2], spec)
    arrival = [-each for each in goal_dq]  # reversed in phase, r' and p' change sign: the goal is a start with -dq
    last = _end_points(goal_q, arrival, goal_ddq[0] if goal_ddq else None, rates[:-3:-1], spec)[::-1]
    count = spec.path_control_points - len(first) - len(last)
    along = [i / max(count - 1, 1) for i in range(count)]
    line = [[a + (b - a) * t for a, b in zip(first[-1], last[0], strict=True)] for t in along]
    return [*first, *line, *last]


def _end_points(q: Vec, dq: Vec, ddq: Vec | None, rates: Vec, spec: "TrajectorySpec") -> list[Vec]:
    """Return the control points that an end fixes, from the outermost one: two where its acceleration is free."""
    path = end_derivatives(spec.path_control_points, spec.degree)
    slope = end_derivatives(spec.rate_control_points, spec.degree).eta * (rates[1] - rates[0])
    first = [v / rates[0] for v in dq]
    c1 = [x + v / path.eta for x, v in zip(q, first, strict=True)]
    if ddq is None:
        return [q, c1]
    second = [(a - v * slope * rates[0]) / rates[0] ** 2 for a, v in zip(ddq, first, strict=True)]
    c2 = [a / path.beta - 2 * x + 3 * c for a, x, c in zip(second, q, c1, strict=True)]
    return [q, c1, c2]


def _split(values: Vec, n: int) -> list[Vec]:
    return [values[i : i + n] for i in range(0, len(values), n)]


def _sums(points: list[Vec], others: list[Vec]) -> list[Vec]:
    return [[x + y for x, y in zip(*pair, strict=True)] for pair in zip(points, others, strict=True)]


def _column(points: list[Vec]) -> Any:
    import casadi as ca

    return ca.vertcat(*[value for point in points for value in point])
