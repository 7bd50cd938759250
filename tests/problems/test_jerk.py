"""Limits of joint jerks: where they come from, both forms, and that only motions have them."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import scipy

from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState, time_derivatives
from cnpgen.problems.conditions import measured_needs, symbolic_needs
from cnpgen.problems.constraints.joint import JointJerk
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem
from cnpgen.problems.problem_file import load_problem
from cnpgen.problems.problem_record import record_problem
from cnpgen.refine.solver.residuals import stage_jacobian, stage_values
from cnpgen.world.world import World
from tests.examples.jerk_limits import jerk_limited
from tests.examples.plans import PROBLEMS
from tests.refusals import is_refused

JERK = JointJerk(tolerance=0.01)


def test_a_problem_gives_one_limit_for_all_joints_or_one_for_each(
    tmp_path: Path,
) -> None:
    shipped = PROBLEMS["airhockey"].path
    text = (
        shipped.read_text()
        + '\n[[constraint]]\nuse = "joint-jerk"\ntolerance = "1 %"\n'
    )
    (tmp_path / "iiwa14_striker.urdf").write_bytes(
        (shipped.parent / "iiwa14_striker.urdf").read_bytes()
    )

    def limits(jerk: str) -> list[float]:
        (tmp_path / "problem.toml").write_text(
            text.replace("[limits]", f"[limits]\njerk = {jerk}")
        )
        return load_robot(load_problem(tmp_path / "problem.toml")).jerk_limit.tolist()

    assert limits('"500 rad/s^3"') == [500.0] * 6
    assert limits("[1, 2, 3, 4, 5, 6]") == [1, 2, 3, 4, 5, 6]
    np.testing.assert_allclose(limits('"180 deg/s^3"'), np.pi)
    with is_refused(RecipeError):
        limits("[1, 2]")
    with is_refused(RecipeError):
        limits('"5 rad/s^2"')


def test_where_none_are_given_they_are_five_a_second_times_those_of_the_accelerations() -> (
    None
):
    robot = load_robot(PROBLEMS["airhockey"])
    np.testing.assert_array_equal(robot.jerk_limit, 5 * robot.acceleration_limit)


def test_a_problem_without_them_is_written_down_as_before_there_were_any() -> None:
    assert "jerk" not in record_problem(PROBLEMS["airhockey"]).recipe
    problem, robot = jerk_limited("airhockey")
    with record_problem(problem).restored() as restored:
        np.testing.assert_array_equal(load_robot(restored).jerk_limit, robot.jerk_limit)


def test_the_jerk_along_a_path_is_the_third_difference_in_time() -> None:
    """Of q(t), by solving ds/dt = r(s) with ever smaller steps: no derivative of a spline in it."""
    random, n, h = np.random.default_rng(2), 3, 2e-3
    knots = [np.r_[np.zeros(8), np.linspace(0, 1, 5)[1:-1], np.ones(8)]] * 2
    p, r = (
        scipy.interpolate.BSpline(knots[0], random.normal(size=(11, n)), 7),
        scipy.interpolate.BSpline(knots[1], random.uniform(1, 2, 11), 7),
    )
    columns = [ca.SX.sym(f"p{order}", n) for order in (1, 2, 3)], ca.SX.sym("r", 3)
    _, _, formula = time_derivatives(
        [ca.vertsplit(each) for each in columns[0]], ca.vertsplit(columns[1])
    )
    jerk = ca.Function("jerk", [*columns[0], columns[1]], [ca.vertcat(*formula)])
    for s in (0.2, 0.5, 0.8):
        times, phases = h * np.arange(-2, 3), []
        for t in times:
            at, steps = s, 200
            for _ in range(steps):  # the classical method of Runge and Kutta
                k1 = r(at)
                k2 = r(at + t / steps / 2 * k1)
                k3 = r(at + t / steps / 2 * k2)
                at += t / steps / 6 * (k1 + 2 * k2 + 2 * k3 + r(at + t / steps * k3))
            phases.append(at)
        q = p(np.array(phases))
        differences = (q[4] - 2 * q[3] + 2 * q[1] - q[0]) / (2 * h**3)
        found = np.array(
            jerk(
                *(p(s, order) for order in (1, 2, 3)),
                [r(s, order) for order in range(3)],
            )
        ).ravel()
        np.testing.assert_allclose(
            found, differences, rtol=2e-2, atol=2e-2 * np.abs(found).max()
        )


def test_a_path_without_a_third_derivative_has_none() -> None:
    assert time_derivatives([[1.0], [2.0]], [1.0, 0.5]) == ([1.0], [2.5], None)


def state_of(problem: Problem, jerk: list | None) -> SymbolicState:
    robot = load_robot(problem)
    q, dq, ddq = (symbols(name, robot.n)[1] for name in ("q", "dq", "ddq"))
    return SymbolicState(robot, q, dq, ddq, [], (), None, jerk)


def test_both_forms_state_the_same_limits_of_what_they_are_given() -> None:
    problem, robot = jerk_limited("airhockey")
    column, jerk = symbols("jerk", robot.n)
    (symbolic,) = JERK.symbolic(state_of(problem, jerk))
    world, values = World(robot), np.random.default_rng(1).normal(size=robot.n)
    world.set_state(robot.home, 0 * values, 0 * values, np.zeros(0), values)
    (measured,) = JERK.measured(world)
    np.testing.assert_array_equal(measured.g, values)
    np.testing.assert_array_equal(
        np.array(ca.Function("g", [column], [ca.vertcat(*symbolic.g)])(values)).ravel(),
        values,
    )
    for each in (symbolic, measured):
        np.testing.assert_array_equal(each.upper, robot.jerk_limit)
        np.testing.assert_array_equal(each.lower, -robot.jerk_limit)
        assert (each.name, each.unit, each.tolerance_kind) == (
            "joint jerk",
            "rad/s^3",
            "limit",
        )
    np.testing.assert_allclose(JERK.allowed(measured), 0.01 * robot.jerk_limit)
    assert symbolic_needs(symbolic, ca.SX.sym("dq"), ca.SX.sym("ddq"), column) == 3


def test_a_boundary_state_has_no_jerk_and_meets_the_limits() -> None:
    problem, robot = jerk_limited("airhockey")
    world = World(robot)
    assert JERK.measured(world) == JERK.measured_at(world, "goal") == ()
    assert (
        JERK.symbolic(state_of(problem, None))
        == JERK.symbolic_at(state_of(problem, None), "start")
        == ()
    )


def test_what_depends_on_the_jerk_is_found_out() -> None:
    problem, robot = jerk_limited("airhockey")
    forms = [constraint.measured for constraint in problem.constraint]
    assert measured_needs(forms, World(robot), jerk=True) == [0, 1, 2, 2, *[0] * 3, 3]
    assert measured_needs(forms, World(robot)) == [0, 1, 2, 2, *[0] * 3]


def test_residuals_of_a_motion_have_the_jerk_and_its_derivatives() -> None:
    problem, robot = jerk_limited("airhockey")
    n, random = robot.n, np.random.default_rng(4)
    w = np.concatenate([robot.home, random.normal(size=3 * n), [0.9, 0.4, -0.3]])
    p1, p2, p3, (r, r1, r2) = (
        w[n : 2 * n],
        w[2 * n : 3 * n],
        w[3 * n : 4 * n],
        w[4 * n :],
    )
    value = stage_values(robot, problem)
    g, columns = (np.array(part) for part in stage_jacobian(robot, problem)(w, []))
    jacobian = columns.reshape(len(w), -1).T
    jerk = p3 * r**3 + 3 * p2 * r1 * r**2 + p1 * (r2 * r + r1**2) * r
    np.testing.assert_allclose(g[-n:, 0], jerk / robot.jerk_limit, rtol=1e-12)
    assert not jacobian[:-n, 3 * n : 4 * n].any()
    for column in range(len(w)):
        step = 1e-6 * np.eye(len(w))[column]
        expected = (
            np.array(value(w + step, [])) - np.array(value(w - step, []))
        ).ravel() / 2e-6
        np.testing.assert_allclose(jacobian[:, column], expected, rtol=1e-6, atol=1e-6)


def test_residuals_of_other_problems_are_of_no_third_derivative() -> None:
    assert PROBLEMS["airhockey"].path_orders == 3
    plain, n = PROBLEMS["airhockey"], 6
    limited = replace(
        plain, limits=jerk_limited("airhockey")[0].limits
    )  # given, and not constrained
    for problem in (plain, limited):
        assert stage_values(load_robot(problem), problem).size1_in(0) == 3 * n + 2
