"""The loss of plans and its gradient: microseconds per quadrature point, milliseconds per batch, errors of the rules.

The clock is the process's CPU time, and the elapsed time on a GPU. Every repetition measures all cases in turn. Times
are medians over the repetitions, ratios are medians of the ratios within one repetition.

    python benchmarks/loss.py
    python benchmarks/loss.py --torch --device cuda --batch 4096
    python benchmarks/loss.py --batch 64 --nodes 32 --repeat 50
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np
from common import arguments, cpu_of, median, progress, report, table, verdict

from cnpgen.losses import quadrature as rules
from cnpgen.losses.plan_loss import PlanLoss
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem_file import load_problem

Array = np.ndarray[Any, np.dtype[Any]]
PROBLEMS = ("airhockey", "heavy-object")
VARIANTS = (
    ("compiled", "float32"),
    ("compiled", "float64"),
    ("numpy", "float32"),
)
TARGET_US = 0.3  # per point of the gradient kernel in float32
REFERENCE_NODES = 4096
MAX_NOISE_RAD = 0.05


@dataclass(frozen=True)
class Plans:
    """Arguments of a loss: lines between random configurations, with noise on every control point."""

    path: Array
    rate: Array
    obstacle_poses: Array


def draw_plans(name: str, count: int) -> Plans:
    problem, random = load_problem(name), np.random.default_rng(0)
    robot, spec = load_robot(problem), load_problem(name).trajectory
    ends = robot.home + random.uniform(-0.5, 0.5, (2, count, 1, robot.n))
    along = np.linspace(0, 1, spec.path_control_points)[:, None]
    path = ends[0] * (1 - along) + ends[1] * along
    path += MAX_NOISE_RAD * random.uniform(-1, 1, path.shape)
    rate = random.uniform(0.8, 1.4, (count, spec.rate_control_points))
    return Plans(path, rate, random.uniform(0.1, 0.4, (count, problem.scene_width)))


@dataclass
class Case:
    """One problem on one backend with one type.

    Attributes:
        calls: CPU time of a call with gradient [s], one per repetition.
        kernels: CPU time of the gradient kernel [s].
        values: CPU time of a call without gradient [s].
    """

    problem: str
    backend: str
    dtype: str
    loss: PlanLoss
    plans: Plans
    calls: list[float] = field(default_factory=list)
    kernels: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def call(self, *, gradient: bool = True) -> None:
        """Evaluate the batch."""
        plans, weights = self.plans, np.ones(len(self.loss.terms) - 1)
        self.loss(
            plans.path,
            plans.rate,
            weights=weights,
            obstacle_poses=plans.obstacle_poses,
            gradient=gradient,
        )

    def measure(self) -> None:
        """Time a call with gradient, the kernel in it, and a call without gradient."""
        kernel = Timed(self.loss._gradient)
        with mock.patch.dict(vars(self.loss), {"_gradient": kernel}):
            self.calls.append(cpu_of(self.call))
        self.kernels.append(kernel.seconds)
        self.values.append(cpu_of(lambda: self.call(gradient=False)))


class Timed:
    """Kernel that measures its CPU time."""

    def __init__(self, kernel: Any) -> None:
        self.kernel, self.tape, self.seconds = kernel, kernel.tape, 0.0

    def __call__(self, *inputs: Array, out: Any) -> None:
        """Run the kernel."""
        self.seconds += cpu_of(lambda: self.kernel(*inputs, out=out))


def elapsed(function: Callable[[], Any]) -> float:
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def prepare(
    problem: str, backend: str, dtype: str, options: argparse.Namespace
) -> Case:
    choice: dict[str, Any] = {"dtype": dtype, "backend": backend}
    loss = PlanLoss(load_problem(problem), nodes=options.nodes, **choice)
    plans = draw_plans(problem, options.batch)
    if dtype == "float32":
        plans = Plans(*(value.astype(np.float32) for value in vars(plans).values()))
    case = Case(problem, backend, dtype, loss, plans)
    case.call()
    case.call(gradient=False)
    return case


def speed_table(cases: list[Case], points: int) -> str:
    rows = []
    for case in cases:
        first = next(other for other in cases if other.problem == case.problem)
        slower = median(
            other / own for own, other in zip(first.calls, case.calls, strict=True)
        )
        per_point = 1e6 * median(case.kernels) / points
        target = (
            TARGET_US if (case.backend, case.dtype) == ("compiled", "float32") else None
        )
        rows.append(
            (case.problem, case.backend, case.dtype, f"{len(case.loss._gradient.tape):,}", f"{per_point:.3f}",
             f"{1e3 * median(case.calls):.2f}", f"{1e3 * median(case.values):.2f}", f"{slower:.1f}",
             *verdict(per_point, target, at_most=True))
        )  # fmt: skip
    head = (
        "problem",
        "backend",
        "type",
        "operations",
        "us/point",
        "ms/batch",
        "no gradient",
        "times slower",
        "target",
    )
    title = (
        f"Loss and gradient: kernel per point, whole call per batch ({points:,} points)"
    )
    return table(title, (*head, ""), rows, left=3)


def torch_row(case: Case, options: argparse.Namespace) -> tuple[str, ...]:
    import torch

    from cnpgen.interop.torch import TensorLoss

    torch.set_num_threads(1)
    dtype, device, poses = (
        getattr(torch, options.dtype),
        options.device,
        case.plans.obstacle_poses,
    )
    path, rate = (
        torch.tensor(x, requires_grad=True, dtype=dtype, device=device)
        for x in (case.plans.path, case.plans.rate)
    )
    loss, weights = (
        TensorLoss(case.loss, compiled=options.compiled),
        np.ones(len(case.loss.terms) - 1),
    )
    fixed = {
        "weights": torch.tensor(weights, device=device),
        "obstacle_poses": torch.tensor(poses, device=device),
    }

    def gradient() -> Any:
        return (
            torch.autograd.grad(loss(path, rate, **fixed)[0].sum(), [path])[0]
            .cpu()
            .numpy()
        )  # waits for the GPU

    first, seconds = elapsed(gradient), cpu_of if device == "cpu" else elapsed
    times = [(seconds(gradient), cpu_of(case.call)) for _ in range(options.repeat)]
    expected = case.loss(
        case.plans.path, case.plans.rate, weights=weights, obstacle_poses=poses
    ).path_gradient
    error = np.abs(gradient() - expected).max() / np.abs(expected).max()
    slower = median(a / b for a, b in times)
    return (
        case.problem,
        f"{first:.1f}",
        f"{1e3 * median(a for a, _ in times):.1f}",
        f"{slower:.2f}",
        f"{error:.1e}",
    )


def torch_table(cases: list[Case], options: argparse.Namespace) -> str:
    """Compare the loss in torch operations with the compiled one on one thread of the CPU."""
    rows = [torch_row(case, options) for case in cases]
    head = (
        "problem",
        "first call, s",
        "ms/batch",
        "times slower",
        "relative difference of the gradient",
    )
    title = f"TensorLoss with its gradient on {options.device}, {options.dtype}, {options.batch} plans"
    return table(
        f"{title}, against the compiled loss in float64 on one thread", head, rows
    )


@dataclass(frozen=True)
class RuleError:
    """Error of a rule: means over plans, relative to ``REFERENCE_NODES`` nodes."""

    problem: str
    rule: str
    nodes: int
    total: float
    gradient: float


def rule_errors(problem: str, plans: Plans) -> list[RuleError]:
    """Return the errors of the available rules and of equidistant nodes."""

    def evaluate(rule: str, nodes: int) -> tuple[Array, Array]:
        rules.basis_table.cache_clear()
        loss = PlanLoss(load_problem(problem), dtype="float64", nodes=nodes, rule=rule)
        value = loss(
            plans.path,
            plans.rate,
            weights=np.ones(len(loss.terms) - 1),
            obstacle_poses=plans.obstacle_poses,
        )
        rules.basis_table.cache_clear()
        return value.total, value.path_gradient.reshape(len(plans.path), -1)

    total, gradient = evaluate("cosine", REFERENCE_NODES)

    def error(label: str, nodes: int, rule: str) -> RuleError:
        value_total, computed_gradient = evaluate(rule, nodes)
        gradient_errors = np.linalg.norm(
            computed_gradient - gradient, axis=1
        ) / np.linalg.norm(gradient, axis=1)
        return RuleError(
            problem,
            label,
            nodes,
            float(np.mean(np.abs(value_total - total) / total)),
            float(np.mean(gradient_errors)),
        )

    errors = [
        error(rule, nodes, rule) for nodes in (32, 64, 128) for rule in rules.RULES
    ]
    with mock.patch.object(rules, "quadrature", uniform):
        return errors + [error("uniform", nodes, "cosine") for nodes in (64, 256, 1024)]


def rule_table(errors: list[RuleError]) -> str:
    rows = [
        (e.rule, str(e.nodes), f"{100 * e.total:.2f} %", f"{100 * e.gradient:.2f} %")
        for e in errors
    ]
    title = f"{errors[0].problem}: errors of quadrature rules against {REFERENCE_NODES} nodes"
    return table(title, ("rule", "nodes", "total", "gradient"), rows)


def uniform(_rule: str, nodes: int, _shift: float = 0.0) -> tuple[Array, Array]:
    """Return equidistant nodes, ends included, with equal weights."""
    return np.linspace(0, 1, nodes), np.full(nodes, 1 / nodes)


def results(
    cases: list[Case], points: int, errors: list[list[RuleError]]
) -> dict[str, Any]:
    return {
        "points": points,
        "rules": [vars(error) for of_problem in errors for error in of_problem],
        "cases": [
            {
                "problem": case.problem,
                "backend": case.backend,
                "dtype": case.dtype,
                "operations": len(case.loss._gradient.tape),
                "us_per_point": 1e6 * median(case.kernels) / points,
                "ms_per_batch": 1e3 * median(case.calls),
                "ms_per_batch_without_gradient": 1e3 * median(case.values),
            }
            for case in cases
        ],
    }


def add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--batch", type=int, default=128, help="plans per batch")
    parser.add_argument("--nodes", type=int, default=64, help="quadrature nodes")
    parser.add_argument(
        "--torch",
        action="store_true",
        help="compare with the loss in torch operations, and stop",
    )
    parser.add_argument(
        "--device", default="cpu", help="device of the torch operations"
    )
    parser.add_argument(
        "--dtype", choices=("float32", "float64"), default="float64", help="their type"
    )
    parser.add_argument(
        "--compiled",
        action="store_true",
        help="fuse them with torch.compile, which takes minutes",
    )
    parser.add_argument("--repeat", type=int, default=15, help="repetitions")


def main() -> None:
    options = arguments(__doc__, add_options)
    points = options.batch * options.nodes
    if options.torch:
        cases = [
            prepare(problem, "compiled", "float64", options) for problem in PROBLEMS
        ]
        report({}, [torch_table(cases, options)], as_json=options.json)
        return
    cases = [
        prepare(problem, *variant, options)
        for problem in PROBLEMS
        for variant in VARIANTS
    ]
    for number in range(options.repeat):
        progress(f"repetition {number + 1} of {options.repeat}")
        for case in cases:
            case.measure()
    errors = [rule_errors(problem, draw_plans(problem, 64)) for problem in PROBLEMS]
    tables = [speed_table(cases, points), *map(rule_table, errors)]
    report(results(cases, points, errors), tables, as_json=options.json)


if __name__ == "__main__":
    main()
