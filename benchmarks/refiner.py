"""Benchmark of the refiner: success rate, CPU time and quality of its plans, compared with Ipopt and SLSQP.

CPU times are of one plan on one core; every part runs its variants in turn. Parts:

    grid     81 hits from rest, puck on a 9 x 9 grid, without initial guess and from a network-like one
    fresh    fresh problems of every pipeline: success rate, CPU time, and the explanation of each failure
    planned  fresh problems from the plans of the shipped planners, with the compiled and the NumPy backend
    ipopt    motion time and objective relative to Ipopt's from the same initial guess
    height   motion time lost by staying within 0.1 mm of the table's height
    slsqp    SciPy's SLSQP on the same transcription (the paper's TrajOpt), with exact derivatives
    workers  plans per second (wall clock) of one process and of two

    python benchmarks/refiner.py                          small sizes, five minutes
    python benchmarks/refiner.py --full                   1,000 hits, 1,000 replans, 300 transports; 30 beside ipopt
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
from refiner_problems import PUCKS, Made, like_a_networks, make_each
from slsqp import minimize_slsqp

from cnpgen.machine.threads import one_thread
from cnpgen.make.draw_boundary_problems import draw_boundary_problems
from cnpgen.planner.planner import Planner
from cnpgen.plans.plans import Plans
from cnpgen.problems.problem_record import open_problem
from cnpgen.refine.grid_levels import GridLevels, default_grid_levels
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.proof.explain import explain_plans
from cnpgen.refine.refine_engine import load_refiner, prepare, tasks_of
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.refine.refiner import Refiner
from cnpgen.refine.solver.sqp import Settings
from cnpgen.refine.strategy import PlanChecker
from cnpgen.trajectory.spline_motion import Motion

PIPELINES = ("airhockey-hit", "airhockey-replan", "heavy-object")
RUNS = 5  # of the grid
TURNS = 3  # of one and two processes
SMALL = {"fresh": (60, 60, 20), "planned": (60, 60, 20), "ipopt": 4, "height": 30, "slsqp": 2, "workers": 80}
FULL = {
    "fresh": (1000, 1000, 300),
    "planned": (300, 300, 300),
    "ipopt": 30,
    "height": 200,
    "slsqp": 10,
    "workers": 1000,
}
VALID = {"airhockey-hit": 0.995, "airhockey-replan": 0.995, "heavy-object": 0.97}
MEDIAN = {"airhockey-hit": 16.0, "airhockey-replan": 18.0, "heavy-object": 30.0}  # ms, from nothing
PLANNED = {"airhockey-hit": (8.0, 15.0), "airhockey-replan": (8.0, 15.0), "heavy-object": (12.0, None)}  # median, 95 %
LOSS = 1.005  # motion time in Ipopt's
NARROW = 1e-4  # m, off the table's height
Result = tuple[dict[str, Any], list[str]]


def grid(_: dict[str, Any], options: argparse.Namespace) -> Result:
    """Solve the 81 hits several times; report the median run and the minimum times of the plans."""
    problems = draw_boundary_problems("airhockey-pucks", PUCKS)
    starts = like_a_networks(problems, make_each(problems, RefineOptions()), options.seed)
    plans = {"from nothing": problems, "network-like start": starts}
    runs = [{start: make_each(given, RefineOptions()) for start, given in plans.items()} for _ in range(RUNS)]
    made = {
        start: [min(same, key=lambda each: each.ms) for same in zip(*(run[start] for run in runs), strict=True)]
        for start in plans
    }
    targets = {"from nothing": 40.0, "network-like start": 15.0}
    facts, rows = {}, []
    for start, found in made.items():
        valid, judging = sum(each.valid for each in found), judged(found)
        medians = [cpu(run[start]) for run in runs]
        facts[start] = {"valid": valid, "median_ms": medians, "least_ms": cpu(found), "verdict_ms": judging}
        met = verdict(median(medians), targets[start], at_most=True)
        times = f"{median(medians):.1f}", *met, *shown(found), f"{judging:.1f}"
        rows.append((start, str(valid), *verdict(valid, 81), *times))
    head = ("start", "valid", "target", "", "median", "target", "", *(f"{name} of least" for name in SHOWN), "verdicts")
    title = f"81 hits from rest, CPU time per plan [ms]: median of the centre one of {RUNS} runs, least of each plan's"
    return {"grid": facts}, [table(title, head, rows)]


def fresh(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Solve fresh draws of every pipeline."""
    facts, rows, failures = {}, [], []
    for name, count in zip(PIPELINES, sizes["fresh"], strict=True):
        progress(f"{count} of {name}")
        problems = draw_boundary_problems(name, count, seed=options.seed)
        found = make_each(problems, RefineOptions())
        share = float(np.mean([each.valid for each in found]))
        mean = float(np.mean([each.ms for each in found]))
        ms, target = shown(found), verdict(cpu(found), MEDIAN[name], at_most=True)
        rows.append((name, ms[0], *target, *ms[1:], f"{mean:.1f}", f"{share:.2%}", *verdict(share, VALID[name])))
        failed = [index for index, each in enumerate(found) if not each.valid]
        findings = explain_plans(problems, failed)
        failures += [(name, str(index), str(found[index].refined.reason), str(findings[index])) for index in failed]
        facts[name] = {"valid": share, "mean_ms": mean, "failures": {i: str(findings[i]) for i in failed}}
    head = ("problems", SHOWN[0], "target", "", *SHOWN[1:], "mean", "valid", "target", "")
    tables = [table(f"fresh problems, seed {options.seed}, CPU time per plan from nothing [ms]", head, rows)]
    if failures:
        tables.append(table("not valid", ("problems", "row", "because", "and its problem is"), failures, left=4))
    return {"fresh": facts}, tables


def planned(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Refine the plans of the shipped planners with the compiled and the NumPy backend."""
    facts, rows = {}, []
    for name, count in zip(PIPELINES, sizes["planned"], strict=True):
        progress(f"{count} of {name}, planned")
        plans = Planner(name).plan_batch(draw_boundary_problems(name, count, seed=options.seed + 5).boundary)
        found, plain = make_each(plans, RefineOptions()), make_each(plans, RefineOptions(), in_numpy(plans))
        center, late = (float(value) for value in np.percentile([each.ms for each in found], [50, 95]))
        ratio = np.median([one.duration / other.duration for one, other in zip(found, plain, strict=True)])
        goals = [verdict(value, goal, at_most=True) for value, goal in zip((center, late), PLANNED[name], strict=True)]
        valid = [f"{np.mean([each.valid for each in made]):.2%}" for made in (found, plain)]
        ms = f"{center:.1f}", *goals[0], f"{late:.1f}", *goals[1], f"{judged(found):.1f}", f"{cpu(plain):.1f}"
        rows.append((name, str(count), *ms, *valid, f"{ratio:.6f}"))
        facts[name] = {"ms": [each.ms for each in found], "plain_ms": [each.ms for each in plain], "valid": valid}
    head = (
        "plans",
        "n",
        "median",
        "target",
        "",
        "p95",
        "target",
        "",
        "verdict",
        "NumPy, DAQP",
        "valid",
        "theirs",
        "T ratio",
    )
    return {"planned": facts}, [table("plans of the shipped planners, CPU time per plan [ms]", head, rows)]


def in_numpy(plans: Plans) -> Refiner:
    """Return a refiner with compiled kernels and the NumPy backend."""
    tool = load_refiner(*open_problem(plans.problem))
    tool.residual_kernels = replace(tool.residual_kernels, step_library=None)
    return tool


def ipopt(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Compare with Ipopt from the same initial guess, a straight line."""
    facts, rows, worse = {}, [], []
    for name in PIPELINES:
        progress(f"{name} with ipopt")
        problems = draw_boundary_problems(name, sizes["ipopt"], seed=options.seed + 1)
        tool = prepare(problems, RefineOptions())
        own, other = (make_each(problems, RefineOptions(), each) for each in (tool, with_ipopt(tool)))
        both = [index for index in range(len(own)) if own[index].valid and other[index].valid]
        times = np.array([own[i].duration / other[i].duration for i in both])
        costs = np.array([own[i].refined.cost / other[i].refined.cost for i in both])
        late = [both[k] for k in np.flatnonzero(times > LOSS)]
        worse += [f"  {name} row {i}: {own[i].duration:.4f} s, Ipopt's {other[i].duration:.4f} s" for i in late]
        valid = [sum(each.valid for each in found) for found in (own, other)]
        speed = cpu(other) / cpu(own)
        near = verdict(len(both) - len(late), len(both))
        counts = len(own), *valid, len(both) - len(late)
        rows.append((name, *map(str, counts), *near, spread(times), spread(costs), f"{speed:.0f}"))
        facts[name] = {"time": times.tolist(), "objective": costs.tolist(), "rows": both, "times_faster": speed}
    head = (
        "problems",
        "n",
        "valid",
        "Ipopt's",
        "within 0.5 %",
        "target",
        "",
        "motion time",
        "objective",
        "times faster",
    )
    tables = [table("in Ipopt's from the same start, median and largest", head, rows)]
    if worse:
        tables.append("\n".join(["", "motion times more than 0.5 % above Ipopt's", *worse]))
    return {"ipopt": facts}, tables


def height(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Compare the refiner's narrow band around the table's height with the whole tolerance."""
    facts, rows = {}, []
    for name in PIPELINES[:2]:
        problems = draw_boundary_problems(name, sizes["height"], seed=options.seed + 2)
        narrow, wide = make_each(problems, RefineOptions()), make_each(problems, RefineOptions(), wide_band(problems))
        both = [(a, b) for a, b in zip(narrow, wide, strict=True) if a.valid and b.valid]
        lost = np.array([a.duration / b.duration - 1 for a, b in both])
        off = [off_height(problems, found) for found in (narrow, wide)]
        within = float(np.mean([each <= NARROW for each in off[0]]))
        worst = (f"{1e3 * max(each):.3f}" for each in off)
        met, cheap = verdict(within, 1.0), verdict(100 * float(lost.mean()), 0.1, at_most=True)
        rows.append((name, str(len(both)), *worst, f"{within:.1%}", *met, f"{lost.mean():.3%}", *cheap))
        facts[name] = {"off_m": off, "loss": lost.tolist()}
    head = (
        "problems",
        "n",
        "z off [mm]",
        "in the whole band",
        "within 0.1 mm",
        "target",
        "",
        "time lost [%]",
        "target",
        "",
    )
    return {"height": facts}, [table("height over the table, the worst of all plans and times", head, rows)]


def slsqp(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Compare with SLSQP, without initial guess and from network-like ones."""
    facts, rows = {}, []
    for name in ("airhockey-hit", "heavy-object"):
        problems = draw_boundary_problems(name, sizes["slsqp"], seed=options.seed + 3)
        refiner = prepare(problems, RefineOptions())
        nothing = make_each(problems, RefineOptions())
        starts = like_a_networks(problems, nothing, options.seed)
        given = make_each(starts, RefineOptions())
        for start, plans, own, target in (
            ("from nothing", problems, nothing, 50.0),
            ("network-like start", starts, given, 20.0),
        ):
            progress(f"SLSQP: {name}, {start}")
            valid, seconds = run_slsqp(refiner, plans, options.cap)
            ratio = 1e3 * median(seconds) / cpu(own)
            ours = sum(each.valid for each in own)
            counts = str(len(own)), str(ours), *verdict(ours, sum(valid))
            rows.append((name, start, *counts, f"{median(seconds):.2f}", f"{ratio:.0f}", *verdict(ratio, target)))
            facts[f"{name}, {start}"] = {"seconds": seconds, "valid": valid, "ratio": ratio}
    head = ("problems", "start", "n", "valid", "SLSQP's", "", "SLSQP, median [s]", "times faster", "target", "")
    return {"slsqp": facts}, [table(f"beside SLSQP, which is stopped after {options.cap:g} s", head, rows, left=2)]


def workers(sizes: dict[str, Any], options: argparse.Namespace) -> Result:
    """Measure plans per second, with the start of the processes, in turns, and the median of the ratios."""
    problems = draw_boundary_problems("airhockey-hit", sizes["workers"], seed=options.seed + 4)
    speeds: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(TURNS):
        progress(f"turn {turn + 1} of {TURNS}")
        for count, found in speeds.items():
            start = time.perf_counter()
            refine_plans(problems, workers=count)
            found.append(len(problems) / (time.perf_counter() - start))
    ratios = [two / one for one, two in zip(speeds[1], speeds[2], strict=True)]
    rows = [(f"{one:.1f}", f"{two:.1f}", f"{two / one:.2f}", "", "") for one, two in zip(*speeds.values(), strict=True)]
    rows.append(("", "median", f"{median(ratios):.2f}", *verdict(median(ratios), 1.8)))
    return {"workers": speeds}, [table("plans per second", ("one", "two", "ratio", "target", ""), rows, left=0)]


SHOWN = ("median", "p95", "largest")


def shown(found: list[Made]) -> tuple[str, ...]:
    """CPU times [ms], under ``SHOWN``."""
    ms = [each.ms for each in found]
    return tuple(f"{value:.1f}" for value in (*np.percentile(ms, [50, 95]), max(ms)))


def cpu(found: list[Made]) -> float:
    """Median CPU time [ms]."""
    return median(each.ms for each in found)


def judged(found: list[Made]) -> float:
    """Median CPU time of the verdicts [ms]."""
    return median(each.verdict_ms for each in found)


def spread(ratios: Any) -> str:
    """Median and largest ratio."""
    return f"{np.median(ratios):.4f} {ratios.max():.4f}" if len(ratios) else "-"


def wide_band(problems: Plans) -> Refiner:
    """Return a refiner that lets the tip use most of the tolerance of its height."""
    problem, robot = open_problem(problems.problem)
    usual = vars(default_grid_levels(problem, Settings()))
    wider = {name: replace(level, tightening=replace(level.tightening, band=0.9)) for name, level in usual.items()}
    tool = load_refiner(problem, robot, levels=GridLevels(**wider))
    tool.check.equalities = set()  # plans that use the tolerance need no finer level
    return tool


def off_height(problems: Plans, found: list[Made]) -> list[float]:
    """Return the violations of the table's height by valid plans, outside the time-varying bound [m]."""
    problem, robot = open_problem(problems.problem)
    checker = PlanChecker(problem, robot, degree=problems.degree)
    pairs = zip(tasks_of(problems), found, strict=True)
    verdicts = [checker.verdict(task, each.refined.path, each.refined.rate) for task, each in pairs if each.valid]
    return [each.margins["table height"].violation for each in verdicts]


def run_slsqp(refiner: Refiner, plans: Plans, cap: float) -> tuple[list[bool], list[float]]:
    """Solve plans with SLSQP; return which are valid and the CPU times [s]."""
    problem, robot = open_problem(plans.problem)
    checker, valid, seconds = PlanChecker(problem, robot, degree=plans.degree), [], []
    for task in tasks_of(plans):
        variables = refiner.input_variables(task)
        x = refiner.line_guess(task) if variables is None else variables
        end, took = minimize_slsqp(refiner, task, x, cap=cap)
        path, rate = refiner.check.transcription(task).unpack(end)
        forward = bool(Motion(path[None], rate[None], plans.degree).runs_forward()[0])
        valid.append(forward and checker.verdict(task, path, rate).valid)
        seconds.append(took)
    return valid, seconds


PARTS: dict[str, Callable[[dict[str, Any], argparse.Namespace], Result]] = {
    each.__name__: each for each in (grid, fresh, planned, ipopt, height, slsqp, workers)
}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("--parts", metavar="PART", nargs="+", choices=PARTS, default=list(PARTS), help=", ".join(PARTS))
    parser.add_argument("--full", action="store_true", help="all rows that the documentation's figures are from")
    parser.add_argument("--n", type=int, help="problems of each part instead")
    parser.add_argument("--seed", type=int, default=20261, help="of problems that are used for nothing else")
    parser.add_argument("--cap", type=float, default=60.0, help="CPU seconds after which SLSQP is stopped")


def main() -> None:
    """Run the benchmark."""
    options = arguments(__doc__, add)
    sizes: dict[str, Any] = dict(FULL if options.full else SMALL)
    if options.n is not None:
        sizes = {name: (options.n,) * 3 if isinstance(size, tuple) else options.n for name, size in sizes.items()}
    results: dict[str, Any] = {}
    tables: list[str] = []
    for name in options.parts:
        progress(name)
        with one_thread():
            facts, found = PARTS[name](sizes, options)
        results |= facts
        tables += found
    report(results, tables, as_json=options.json)


if __name__ == "__main__":
    main()
