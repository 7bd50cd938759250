"""Benchmark of the refiner: success rate, CPU time and quality of its plans, compared with Ipopt and SLSQP.

CPU times are of one plan on one core; every part runs its variants in turn. Parts:

    grid     81 hits from rest, puck on a 9 x 9 grid, without initial guess and from a network-like one
    fresh    new problems of every pipeline: success rate, CPU time, and the explanation of each failure
    planned  new problems from the plans of the shipped planners, with the compiled and the NumPy backend
    ipopt    motion time and objective relative to Ipopt's from the same initial guess
    height   motion time cost of staying within 0.1 mm of the table's height
    slsqp    SciPy's SLSQP on the same transcription (the paper's TrajOpt), with exact derivatives
    workers  plans per second (wall clock) of one process and of two

    python benchmarks/refiner.py                          small sizes, five minutes
    python benchmarks/refiner.py --full                   1,000 hits, 1,000 replans, 300 transports; 30 for Ipopt
    python benchmarks/refiner.py --parts fresh --seed 7
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from common import arguments, median, progress, report, table, verdict
from ipopt import with_ipopt
from refiner_problems import PUCKS, Made, make_each, network_like_plans
from slsqp import minimize_slsqp

from cnpgen.machine.threads import one_thread
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.grid_levels import GridLevels, default_grid_levels
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.proof.explain import explain_plans
from cnpgen.refine.refine_engine import prepare, tasks_of
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.sqp import Settings
from cnpgen.refine.strategy import PlanChecker
from cnpgen.trajectory.spline_motion import Motion

PIPELINES = ("airhockey-hit", "airhockey-replan", "heavy-object")
GRID_RUNS = 5
WORKER_RUNS = 3  # of one and of two processes
SMALL = {
    "fresh": (60, 60, 20),
    "planned": (60, 60, 20),
    "ipopt": 4,
    "height": 30,
    "slsqp": 2,
    "workers": 80,
}
FULL = {
    "fresh": (1000, 1000, 300),
    "planned": (300, 300, 300),
    "ipopt": 30,
    "height": 200,
    "slsqp": 10,
    "workers": 1000,
}
VALID_TARGETS = {
    "airhockey-hit": 0.995,
    "airhockey-replan": 0.995,
    "heavy-object": 0.97,
}
SOLVED_MS = {
    "airhockey-hit": 16.0,
    "airhockey-replan": 18.0,
    "heavy-object": 30.0,
}  # median, without initial guess
PLANNED_MS = {
    "airhockey-hit": (8.0, 15.0),
    "airhockey-replan": (8.0, 15.0),
    "heavy-object": (12.0, None),
}  # median, 95 %
MAX_TIME_RATIO = 1.005  # of the motion times of the refiner and of Ipopt
MAX_HEIGHT_ERROR_M = 1e-4
Result = tuple[dict[str, Any], list[str]]


def grid(_: dict[str, Any], options: argparse.Namespace) -> Result:
    """Solve the 81 hits several times; report the median run and the minimum times of the plans."""
    problems = draw_boundary_problems("airhockey-pucks", PUCKS)
    guesses = network_like_plans(
        problems, make_each(problems, RefineOptions()), options.seed
    )
    plans = {"without guess": problems, "network-like guess": guesses}
    runs = [
        {
            guess: make_each(problem_set, RefineOptions())
            for guess, problem_set in plans.items()
        }
        for _ in range(GRID_RUNS)
    ]
    fastest = {
        guess: [
            min(same, key=lambda result: result.ms)
            for same in zip(*(run[guess] for run in runs), strict=True)
        ]
        for guess in plans
    }
    targets = {"without guess": 40.0, "network-like guess": 15.0}
    facts, rows = {}, []
    for guess, results in fastest.items():
        valid, judging = (
            sum(result.valid for result in results),
            median_verdict_ms(results),
        )
        medians = [median_ms(run[guess]) for run in runs]
        facts[guess] = {
            "valid": valid,
            "median_ms": medians,
            "minimum_ms": median_ms(results),
            "verdict_ms": judging,
        }
        target = verdict(median(medians), targets[guess], at_most=True)
        times = (
            f"{median(medians):.1f}",
            *target,
            *statistics(results),
            f"{judging:.1f}",
        )
        rows.append((guess, str(valid), *verdict(valid, 81), *times))
    head = (
        "initial guess", "valid", "target", "", "median", "target", "", *(f"{name} of minima" for name in STATISTICS),
        "verdict",
    )  # fmt: skip
    title = f"81 hits from rest, CPU time per plan [ms]: median of {GRID_RUNS} runs, and minimum times"
    return {"grid": facts}, [table(title, head, rows)]


def fresh(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Solve new problems of every pipeline."""
    facts, rows, failures = {}, [], []
    for name, count in zip(PIPELINES, sizes["fresh"], strict=True):
        progress(f"{count} of {name}")
        problems = draw_boundary_problems(name, count, seed=options.seed)
        results = make_each(problems, RefineOptions())
        share = float(np.mean([result.valid for result in results]))
        mean = float(np.mean([result.ms for result in results]))
        ms, target = (
            statistics(results),
            verdict(median_ms(results), SOLVED_MS[name], at_most=True),
        )
        rows.append(
            (
                name,
                ms[0],
                *target,
                *ms[1:],
                f"{mean:.1f}",
                f"{share:.2%}",
                *verdict(share, VALID_TARGETS[name]),
            )
        )
        failed = [index for index, result in enumerate(results) if not result.valid]
        findings = explain_plans(problems, failed)
        failures += [
            (name, str(index), str(results[index].refined.reason), str(findings[index]))
            for index in failed
        ]
        facts[name] = {
            "valid": share,
            "mean_ms": mean,
            "failures": {i: str(findings[i]) for i in failed},
        }
    head = (
        "problems",
        STATISTICS[0],
        "target",
        "",
        *STATISTICS[1:],
        "mean",
        "valid",
        "target",
        "",
    )
    tables = [
        table(
            f"new problems, seed {options.seed}, CPU time per plan without initial guess [ms]",
            head,
            rows,
        )
    ]
    if failures:
        tables.append(
            table(
                "invalid",
                ("problems", "row", "reason", "explanation"),
                failures,
                left=4,
            )
        )
    return {"fresh": facts}, tables


def planned(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Refine the plans of the shipped planners."""
    facts, rows = {}, []
    for name, count in zip(PIPELINES, sizes["planned"], strict=True):
        progress(f"{count} of {name}, planned")
        plans = Planner(name).plan_batch(
            draw_boundary_problems(name, count, seed=options.seed + 5).boundary
        )
        results = make_each(plans, RefineOptions())
        center, p95 = (
            float(value)
            for value in np.percentile([result.ms for result in results], [50, 95])
        )
        targets = [
            verdict(value, goal, at_most=True)
            for value, goal in zip((center, p95), PLANNED_MS[name], strict=True)
        ]
        valid = f"{np.mean([result.valid for result in results]):.2%}"
        ms = (
            f"{center:.1f}",
            *targets[0],
            f"{p95:.1f}",
            *targets[1],
            f"{median_verdict_ms(results):.1f}",
        )
        rows.append((name, str(count), *ms, valid))
        facts[name] = {
            "ms": [result.ms for result in results],
            "valid": valid,
        }
    head = (
        "plans", "n", "median", "target", "", "p95", "target", "", "verdict", "valid",
    )  # fmt: skip
    return {"planned": facts}, [
        table("plans of the shipped planners, CPU time per plan [ms]", head, rows)
    ]


def ipopt(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Compare with Ipopt from the same initial guess, a straight line."""
    facts, rows, worse = {}, [], []
    for name in PIPELINES:
        progress(f"{name} with Ipopt")
        problems = draw_boundary_problems(name, sizes["ipopt"], seed=options.seed + 1)
        refiner = prepare(problems, RefineOptions())
        own, other = (
            make_each(problems, RefineOptions(), variant)
            for variant in (refiner, with_ipopt(refiner))
        )
        both = [
            index
            for index in range(len(own))
            if own[index].valid and other[index].valid
        ]
        times = np.array([own[i].duration / other[i].duration for i in both])
        costs = np.array([own[i].refined.cost / other[i].refined.cost for i in both])
        slower = [both[k] for k in np.flatnonzero(times > MAX_TIME_RATIO)]
        worse += [
            f"  {name} row {i}: {own[i].duration:.4f} s, Ipopt {other[i].duration:.4f} s"
            for i in slower
        ]
        valid = [sum(variant.valid for variant in results) for results in (own, other)]
        speed = median_ms(other) / median_ms(own)
        target = verdict(len(both) - len(slower), len(both))
        counts = len(own), *valid, len(both) - len(slower)
        rows.append(
            (
                name,
                *map(str, counts),
                *target,
                spread(times),
                spread(costs),
                f"{speed:.0f}",
            )
        )
        facts[name] = {
            "time": times.tolist(),
            "objective": costs.tolist(),
            "rows": both,
            "times_faster": speed,
        }
    head = (
        "problems", "n", "valid", "valid, Ipopt", "within 0.5 %", "target", "", "motion time", "objective",
        "times faster",
    )  # fmt: skip
    tables = [
        table(
            "ratios to Ipopt from the same initial guess, median and maximum",
            head,
            rows,
        )
    ]
    if worse:
        tables.append(
            "\n".join(["", "motion times more than 0.5 % above those of Ipopt", *worse])
        )
    return {"ipopt": facts}, tables


def height(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Compare the refiner's narrow band around the table's height with the whole tolerance."""
    facts, rows = {}, []
    for name in PIPELINES[:2]:
        problems = draw_boundary_problems(name, sizes["height"], seed=options.seed + 2)
        narrow, wide = (
            make_each(problems, RefineOptions()),
            make_each(problems, RefineOptions(), wide_band(problems)),
        )
        pairs = [
            (a, b) for a, b in zip(narrow, wide, strict=True) if a.valid and b.valid
        ]
        time_costs = np.array([a.duration / b.duration - 1 for a, b in pairs])
        errors = [height_errors(problems, results) for results in (narrow, wide)]
        within = float(np.mean([error <= MAX_HEIGHT_ERROR_M for error in errors[0]]))
        worst = (f"{1e3 * max(values):.3f}" for values in errors)
        target, cost_target = (
            verdict(within, 1.0),
            verdict(100 * float(time_costs.mean()), 0.1, at_most=True),
        )
        rows.append(
            (
                name,
                str(len(pairs)),
                *worst,
                f"{within:.1%}",
                *target,
                f"{time_costs.mean():.3%}",
                *cost_target,
            )
        )
        facts[name] = {"errors_m": errors, "loss": time_costs.tolist()}
    head = (
        "problems", "n", "z error [mm]", "whole band", "within 0.1 mm", "target", "", "time lost [%]", "target", "",
    )  # fmt: skip
    return {"height": facts}, [
        table("maximum height error of all plans and times", head, rows)
    ]


def slsqp(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Compare with SLSQP, without initial guess and from network-like ones."""
    facts, rows = {}, []
    for name in ("airhockey-hit", "heavy-object"):
        problems = draw_boundary_problems(name, sizes["slsqp"], seed=options.seed + 3)
        refiner = prepare(problems, RefineOptions())
        solved = make_each(problems, RefineOptions())
        guesses = network_like_plans(problems, solved, options.seed)
        guess_results = make_each(guesses, RefineOptions())
        for guess, plans, own, target in (
            ("without guess", problems, solved, 50.0),
            ("network-like guess", guesses, guess_results, 20.0),
        ):
            progress(f"SLSQP: {name}, {guess}")
            valid, seconds = run_slsqp(refiner, plans, options.cap)
            ratio = 1e3 * median(seconds) / median_ms(own)
            ours = sum(result.valid for result in own)
            counts = str(len(own)), str(ours), *verdict(ours, sum(valid))
            rows.append(
                (
                    name,
                    guess,
                    *counts,
                    f"{median(seconds):.2f}",
                    f"{ratio:.0f}",
                    *verdict(ratio, target),
                )
            )
            facts[f"{name}, {guess}"] = {
                "seconds": seconds,
                "valid": valid,
                "ratio": ratio,
            }
    head = (
        "problems", "initial guess", "n", "valid", "valid, SLSQP", "", "SLSQP, median [s]", "times faster", "target",
        "",
    )  # fmt: skip
    return {"slsqp": facts}, [
        table(
            f"comparison with SLSQP, stopped after {options.cap:g} s",
            head,
            rows,
            left=2,
        )
    ]


def workers(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Measure plans per second including the start of the processes, and the median of the ratios."""
    problems = draw_boundary_problems(
        "airhockey-hit", sizes["workers"], seed=options.seed + 4
    )
    speeds: dict[int, list[float]] = {1: [], 2: []}
    for number in range(WORKER_RUNS):
        progress(f"repetition {number + 1} of {WORKER_RUNS}")
        for count, rates in speeds.items():
            start = time.perf_counter()
            refine_plans(problems, workers=count)
            rates.append(len(problems) / (time.perf_counter() - start))
    ratios = [two / one for one, two in zip(speeds[1], speeds[2], strict=True)]
    rows = [
        (f"{one:.1f}", f"{two:.1f}", f"{two / one:.2f}", "", "")
        for one, two in zip(*speeds.values(), strict=True)
    ]
    rows.append(("", "median", f"{median(ratios):.2f}", *verdict(median(ratios), 1.8)))
    return {"workers": speeds}, [
        table("plans per second", ("one", "two", "ratio", "target", ""), rows, left=0)
    ]


STATISTICS = ("median", "p95", "maximum")


def statistics(results: list[Made]) -> tuple[str, ...]:
    """Format the ``STATISTICS`` of CPU times [ms]."""
    ms = [result.ms for result in results]
    return tuple(f"{value:.1f}" for value in (*np.percentile(ms, [50, 95]), max(ms)))


def median_ms(results: list[Made]) -> float:
    """Return the median CPU time [ms]."""
    return median(result.ms for result in results)


def median_verdict_ms(results: list[Made]) -> float:
    """Return the median CPU time of the verdicts [ms]."""
    return median(result.verdict_ms for result in results)


def spread(ratios: Any) -> str:
    """Format the median and the maximum of ratios."""
    return f"{np.median(ratios):.4f} {ratios.max():.4f}" if len(ratios) else "-"


def wide_band(problems: Plans) -> Refiner:
    """Return a refiner that uses most of the tolerance of the tip height."""
    problem, robot = open_problem(problems.problem)
    usual = vars(default_grid_levels(problem, Settings()))
    wider = {
        name: replace(level, tightening=replace(level.tightening, band=0.9))
        for name, level in usual.items()
    }
    refiner = Refiner(problem, robot, levels=GridLevels(**wider))
    refiner.check.equalities = set()  # plans that use the tolerance need no finer level
    return refiner


def height_errors(problems: Plans, results: list[Made]) -> list[float]:
    """Return the violations of the table's height by valid plans, outside the time-varying bound [m]."""
    problem, robot = open_problem(problems.problem)
    checker = PlanChecker(problem, robot, degree=problems.degree)
    pairs = zip(tasks_of(problems), results, strict=True)
    verdicts = [
        checker.verdict(task, result.refined.path, result.refined.rate)
        for task, result in pairs
        if result.valid
    ]
    return [result.margins["table height"].violation for result in verdicts]


def run_slsqp(
    refiner: Refiner, plans: Plans, cap: float
) -> tuple[list[bool], list[float]]:
    """Solve plans with SLSQP; return which are valid and the CPU times [s]."""
    problem, robot = open_problem(plans.problem)
    checker, valid, seconds = PlanChecker(problem, robot, degree=plans.degree), [], []
    for task in tasks_of(plans):
        variables = refiner.input_variables(task)
        x = refiner.line_guess(task) if variables is None else variables
        end, elapsed = minimize_slsqp(refiner, task, x, cap=cap)
        path, rate = refiner.check.transcription(task).unpack(end)
        forward = bool(Motion(path[None], rate[None], plans.degree).runs_forward()[0])
        valid.append(forward and checker.verdict(task, path, rate).valid)
        seconds.append(elapsed)
    return valid, seconds


PARTS: dict[str, Callable[[dict[str, Any], argparse.Namespace], Result]] = {
    part.__name__: part
    for part in (grid, fresh, planned, ipopt, height, slsqp, workers)
}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--parts",
        metavar="PART",
        nargs="+",
        choices=PARTS,
        default=list(PARTS),
        help=", ".join(PARTS),
    )
    parser.add_argument(
        "--full", action="store_true", help="the sizes of the documentation's figures"
    )
    parser.add_argument("--n", type=int, help="problems of each part")
    parser.add_argument("--seed", type=int, default=20261, help="seed of the problems")
    parser.add_argument(
        "--cap",
        type=float,
        default=60.0,
        help="CPU seconds after which SLSQP is stopped",
    )


def main() -> None:
    """Run the benchmark."""
    options = arguments(__doc__, add)
    sizes: dict[str, Any] = dict(FULL if options.full else SMALL)
    if options.n is not None:
        sizes = {
            name: (options.n,) * 3 if isinstance(size, tuple) else options.n
            for name, size in sizes.items()
        }
    results: dict[str, Any] = {}
    tables: list[str] = []
    for name in options.parts:
        progress(name)
        with one_thread():
            facts, part_tables = PARTS[name](sizes, options)
        results |= facts
        tables += part_tables
    report(results, tables, as_json=options.json)


if __name__ == "__main__":
    main()
