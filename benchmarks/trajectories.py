"""Verdicts on sampled plans: how many are decided, and whether a decision contradicts the verdict on the plan.

Every plan is sampled at several rates, with and without derivatives, rounding and noise. A second set of plans exceeds
one limit by its tolerance and 1 %. With a bound of the jerk, the plan is one of the judged curves: a decision that
contradicts the verdict on the plan is then wrong. Without one, the samples' resolution decides; such a decision must
not contradict the verdict on the plan either.

With ``--import``, sampled plans are imported and refined, and the valid ones are counted. So are motions of Ruckig
between the ends of the plans, and paths of the plans that TOPP-RA has timed (extra ``benchmark``).

    cnpgen solve airhockey-hit --n 210 --seed 30303 -o hits.h5
    python benchmarks/trajectories.py hits.h5
    python benchmarks/trajectories.py hits.h5 --case "q dq ddq, 500 Hz" --case "q dq, 100 Hz"
    python benchmarks/trajectories.py hits.h5 --import --at-rest start
    python benchmarks/trajectories.py hits.h5 --import --stay-within 2

With ``--formats``, plans are exported at 500 Hz in every format, read back and judged.

    python benchmarks/trajectories.py hits.h5 --n 20 --formats
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from common import arguments, progress, report, table

from cnpgen.addons.benchmark.planners.rrtconnect import timed_by_toppra
from cnpgen.addons.benchmark.planners.ruckig import load_ruckig, time_optimal_motion
from cnpgen.addons.trajectories.evaluate_trajectories import evaluate_trajectories
from cnpgen.addons.trajectories.import_trajectories import import_trajectories
from cnpgen.addons.trajectories.interpolate import bounded_jerk
from cnpgen.addons.trajectories.judge_family import FamilyJudge
from cnpgen.addons.trajectories.judge_samples import judge_samples
from cnpgen.addons.trajectories.load_trajectories import load_trajectories
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_verdict import Decision, TrajectoryVerdict
from cnpgen.judges.plans import Verdict
from cnpgen.plans import Plans, load_plans, open_problem, save_plans
from cnpgen.plans.evaluate import evaluate_plans
from cnpgen.plans.export import export_plans
from cnpgen.plans.exporter import SampledPlan, sample_plan
from cnpgen.refine.options import RefineOptions
from cnpgen.refine.refine_plans import refine_plans
from cnpgen.store.scene_table import OBSTACLE_POSES
from cnpgen.trajectories import LoadOptions
from cnpgen.trajectory.spline_motion import Motion

EXCESS = 0.01  # outside a limit with its tolerance, relative to the limit
JERK_FACTOR = 1.01  # of the largest jerk of a plan: the stated bound
PATH_POINTS = 100  # of the paths that TOPP-RA times
JERK_SAMPLES = 20_000  # at which it is searched


FORMATS = (
    ("csv", "plans"),
    ("npz", "plans.npz"),
    ("parquet", "plans.parquet"),
    ("joint-trajectory", "plans"),
    ("ros2-control", "plans"),
    ("lerobot", "plans"),  # float32
)
EXPORT_RATE_HZ = 500.0


@dataclass(frozen=True)
class Case:
    """A way of sampling plans.

    Attributes:
        name: Name in the table.
        rate: Samples per second.
        orders: Number of derivatives beside the positions.
        decimals: Decimals of the values, or None for all.
        noise: Largest random error of the values in SI units.
        jerk: Whether every curve under a bound of the jerk is judged.
        source: Planner of the trajectories; "plan" for the sampled plans.
        degrees: Whether a file in degrees is read.
    """

    name: str
    rate: float
    orders: int
    decimals: int | None = None
    noise: float = 0.0
    jerk: bool = False
    source: str = "plan"
    degrees: bool = False

    @property
    def error(self) -> float:
        """Largest error of the values in SI units."""
        return self.noise + (
            0.0 if self.decimals is None else 0.5 * 10.0**-self.decimals
        )


CASES = (
    Case("q dq ddq, 500 Hz", 500, 2),
    Case("q dq, 500 Hz", 500, 1),
    Case("q dq, 100 Hz", 100, 1),
    Case("q, 100 Hz", 100, 0),
    Case("q dq, 30 Hz", 30, 1),
    Case("q, 30 Hz", 30, 0),
    Case("q dq ddq, 30 Hz, rounded to 1e-4", 30, 2, decimals=4),
    Case("q, 30 Hz, rounded to 1e-4", 30, 0, decimals=4),
    Case("q, 30 Hz, noise of 1e-3", 30, 0, noise=1e-3),
    Case("q dq, 100 Hz, noise of 1e-3", 100, 1, noise=1e-3),
    Case("q dq ddq, 500 Hz, bound of jerk", 500, 2, jerk=True),
    Case("q, 1 kHz, bound of jerk", 1000, 0, jerk=True),
    Case("q, 30 Hz, rounded to 1e-4, bound of jerk", 30, 0, decimals=4, jerk=True),
    Case("q, 30 Hz, noise of 1e-3, bound of jerk", 30, 0, noise=1e-3, jerk=True),
)


IMPORTS = (
    Case("q, 30 Hz", 30, 0),
    Case("q, 100 Hz", 100, 0),
    Case("q dq, 100 Hz", 100, 1),
    Case("q dq ddq, 500 Hz", 500, 2),
    Case("q, 100 Hz, rounded to 1e-4", 100, 0, decimals=4),
    Case("q, 30 Hz, noise of 1e-3", 30, 0, noise=1e-3),
    Case("q, 100 Hz, noise of 1e-3", 100, 0, noise=1e-3),
    Case("q dq, 100 Hz, CSV in degrees", 100, 1, decimals=6, degrees=True),
    Case("Ruckig, q dq ddq at its knots", 0, 2, source="ruckig"),
    Case("TOPP-RA, q dq, 100 Hz", 100, 1, source="toppra"),
    Case("TOPP-RA, q dq ddq, 10 Hz, as of MoveIt", 10, 2, source="toppra"),
)


@dataclass
class Counts:
    """Decisions of one case on plans of one file.

    Attributes:
        decisions: Decision on the whole trajectory -> number.
        conditions: Condition -> decision -> number.
        wrong: Decisions on conditions that contradict the verdict on the plan.
    """

    decisions: Counter[str] = field(default_factory=Counter)
    conditions: dict[str, Counter[str]] = field(default_factory=dict)
    wrong: int = 0

    def add(self, verdict: TrajectoryVerdict, truth: Verdict) -> None:
        """Count one verdict."""
        self.decisions[str(verdict.decision)] += 1
        for name, entry in verdict.conditions.items():
            self.conditions.setdefault(name, Counter())[str(entry.decision)] += 1
            ok = truth.margins[name].ok
            self.wrong += entry.decision == (Decision.INVALID if ok else Decision.VALID)

    def shares(self) -> dict[str, float]:
        """Return the decided share of every condition."""
        return {
            name: 1 - c[str(Decision.UNDECIDED)] / c.total()
            for name, c in self.conditions.items()
        }


def trajectory_of(
    plan: SampledPlan, case: Case, random: np.random.Generator
) -> Trajectory:
    """Return a sampled plan with the errors of a case."""
    values = []
    for array in (plan.q, plan.dq, plan.ddq)[: case.orders + 1]:
        noisy = array + case.noise * random.uniform(-1, 1, array.shape)
        values.append(noisy if case.decimals is None else noisy.round(case.decimals))
    trajectory = Trajectory(plan.t, *values)
    parameters = np.array(plan.parameters) if plan.parameters else None
    return replace(trajectory, phase=plan.phase, parameters=parameters)


def too_fast(motion: Motion, verdict: Verdict, name: str) -> Motion:
    """Return a motion at a speed that exceeds one limit by its tolerance and 1 %."""
    margin = verdict.margins[name]
    target = 1 + margin.tolerance / abs(margin.bound) + EXCESS
    share = abs(margin.value / margin.bound)
    power = 1 if name == "joint velocity" else 2
    return motion.time_scaled((share / target) ** (1 / power))


def measure(plans: Plans, case: Case, truths: tuple[Verdict, ...]) -> Counts:
    """Judge sampled plans."""
    problem, robot = open_problem(plans.problem)
    judge, counts, random = (
        FamilyJudge(problem, robot),
        Counts(),
        np.random.default_rng(0),
    )
    error = np.full(3, case.error)
    for index, truth in enumerate(truths):
        motion = plans.motion[[index]]
        sampled = trajectory_of(sampled_plan(plans, case, index), case, random)
        scene = plans.scene.poses[index] if OBSTACLE_POSES in plans.columns else None
        if case.jerk:
            t = np.linspace(0, float(motion.duration()[0]), JERK_SAMPLES)
            bound = JERK_FACTOR * np.abs(motion.at_times(t[None]).jerk[0]).max(axis=0)
            family = bounded_jerk(sampled, bound, error)
        else:
            errors = SampleErrors(case.error, case.error, case.error, 0.0, "")
            counts.add(judge_samples(judge, sampled, errors, scene=scene), truth)
            continue
        if family is None:
            counts.decisions["contradiction"] += 1
            counts.wrong += 1  # the plan itself passes through the samples
        else:
            counts.add(judge(family, sampled, scene=scene), truth)
    return counts


def sampled_plan(plans: Plans, case: Case, index: int) -> SampledPlan:
    """Return a plan at the rate of a case."""
    parameters = plans.boundary.parameters
    values = () if parameters is None else tuple(parameters[index].tolist())
    return sample_plan(plans.motion[[index]], case.rate, index, values)


def trajectories_of(plans: Plans, case: Case) -> list[Trajectory]:
    """Return the trajectories of a case; planners may fail for some plans."""
    random, robot = np.random.default_rng(0), open_problem(plans.problem)[1]
    found = []
    for index in range(len(plans)):
        if case.source == "ruckig":
            found.append(
                time_optimal_motion(
                    load_ruckig(), robot, plans.boundary[index : index + 1]
                )
            )
        elif case.source == "toppra":
            path = plans.motion[[index]].at(np.linspace(0, 1, PATH_POINTS)[None]).q[0]
            found.append(
                resampled(
                    timed_by_toppra(path, robot, plans.boundary.goal_dq[index]), case
                )
            )
        else:
            found.append(trajectory_of(sampled_plan(plans, case, index), case, random))
    return [trajectory for trajectory in found if trajectory is not None]


def resampled(trajectory: Trajectory | None, case: Case) -> Trajectory | None:
    """Sample a trajectory at the rate of a case."""
    if trajectory is None:
        return None
    t = np.linspace(
        0, trajectory.duration, int(np.ceil(trajectory.duration * case.rate)) + 1
    )
    q, *derivatives = trajectory.states(t)
    return Trajectory(t, q, *derivatives[: case.orders])


def through_degrees(trajectory: Trajectory, plans: Plans) -> Trajectory:
    """Write a trajectory as CSV in degrees and read it."""
    names = plans.problem.joint_names
    assert trajectory.dq is not None
    columns = [trajectory.t, *np.rad2deg(trajectory.q).T, *np.rad2deg(trajectory.dq).T]
    head = ",".join(["t", *names, *(f"{name}_velocity" for name in names)])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "degrees.csv"
        np.savetxt(
            path,
            np.stack(columns, axis=1),
            delimiter=",",
            header=head,
            comments="",
            fmt="%.6f",
        )
        return load_trajectories(
            path, plans.problem.name, options=LoadOptions(unit="deg")
        ).trajectories[0]


def chosen(cases: Sequence[Case], names: Sequence[str]) -> list[Case]:
    """Return the named cases, or all."""
    unknown = set(names) - {case.name for case in cases}
    if unknown:
        raise SystemExit(
            f"no case {', '.join(unknown)}; expected {'; '.join(case.name for case in cases)}"
        )
    return [case for case in cases if case.name in names or not names]


def refined(
    plans: Plans,
    case: Case,
    stay_within: float | None,
    at_rest: bool | Literal["start", "goal"],
) -> tuple[str, ...]:
    """Import and refine sampled plans; return a row of the table."""
    sampled = trajectories_of(plans, case)
    if case.degrees:
        sampled = [through_degrees(trajectory, plans) for trajectory in sampled]
    imported = import_trajectories(
        plans.problem, sampled, noise=case.error, at_rest=at_rest
    )
    valid = evaluate_plans(imported.plans, workers=1).valid
    options = RefineOptions(
        stay_within=None if stay_within is None else np.deg2rad(stay_within)
    )
    refinement = refine_plans(imported.plans, options=options, workers=1)
    after = evaluate_plans(refinement.plans, workers=1)
    reasons = Counter(
        str(verdict.reason) for verdict in after.verdicts if not verdict.valid
    )
    text = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    counts = (
        str(len(sampled)),
        f"{int(valid.sum())}",
        f"{int(after.valid.sum())}",
        f"{after.valid.mean():.1%}",
    )
    moved = float(np.nanmax(imported.snapped, initial=0.0))
    progress(
        f"{plans.problem.name}, {case.name}: {int(after.valid.sum())} of {len(sampled)} valid; {text}"
    )
    lengths = [
        f"{length:.1e}"
        for length in (imported.deviation.max(), moved, refinement.deviation.max())
    ]
    return plans.problem.name, case.name, *counts, *lengths, text


def import_all(given: argparse.Namespace) -> None:
    """Import and refine the plans of all files in all cases."""
    head = (
        "problem", "samples", "plans", "valid before", "valid after", "share", "fit [rad]", "ends moved [rad]",
        "refined from [rad]", "reasons",
    )  # fmt: skip
    rows = []
    for file in given.files:
        plans = load_plans(file)
        plans = plans[np.flatnonzero(evaluate_plans(plans, workers=1).valid)[: given.n]]
        rows += [
            refined(plans, case, given.stay_within, given.at_rest)
            for case in chosen(IMPORTS, given.case)
        ]
        progress(f"{file}: done")
    results = {"rows": [dict(zip(head, row, strict=True)) for row in rows]}
    report(results, [table("imported plans", head, rows, left=2)], as_json=given.json)


def read_back(plans: Plans, to: str, name: str) -> int:
    """Return how many exported plans are valid when they are read back."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / name
        export_plans(plans, out, to=to, rate=EXPORT_RATE_HZ)
        scenes = None
        if OBSTACLE_POSES in plans.columns and to != "lerobot":
            scenes = Path(folder) / "scenes.h5"
            save_plans(scenes, plans)
        loaded = load_trajectories(out, plans.problem, scenes=scenes)
    trajectories = loaded.trajectories
    values = plans.boundary.parameters
    if values is not None:  # messages have no parameters
        trajectories = tuple(
            replace(each, parameters=row)
            for each, row in zip(trajectories, values, strict=True)
        )
    return int(evaluate_trajectories(loaded.problem, trajectories).valid.sum())


def export_all(given: argparse.Namespace) -> None:
    """Export the plans of all files in all formats, and count those that are valid when read back."""
    head = ("problem", "plans", *(to for to, _ in FORMATS))
    rows = []
    for file in given.files:
        plans = load_plans(file)
        plans = plans[np.flatnonzero(evaluate_plans(plans, workers=1).valid)[: given.n]]
        counts = [str(read_back(plans, to, name)) for to, name in FORMATS]
        rows.append((file.stem, str(len(plans)), *counts))
        progress(f"{file}: {rows[-1]}")
    results = {"rows": [dict(zip(head, row, strict=True)) for row in rows]}
    report(results, [table("exported plans", head, rows, left=1)], as_json=given.json)


def main() -> None:
    """Judge the plans of all files in all cases, or import them."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("files", nargs="+", type=Path, help="files of plans")
        parser.add_argument(
            "--n", type=int, default=200, help="valid plans of each file (default: 200)"
        )
        parser.add_argument(
            "--case", action="append", default=[], help="only the samples of this name"
        )
        parser.add_argument(
            "--import",
            dest="imports",
            action="store_true",
            help="import and refine instead",
        )

        text = "export the plans and read them back instead"
        parser.add_argument("--formats", action="store_true", help=text)
        text = "end of imported motions at rest; both without a value"
        parser.add_argument(
            "--at-rest",
            choices=("start", "goal"),
            nargs="?",
            const=True,
            default=False,
            help=text,
        )
        parser.add_argument(
            "--stay-within",
            metavar="DEG",
            type=float,
            help="largest distance from the imported path",
        )

    given = arguments(__doc__, add)
    if given.formats:
        export_all(given)
        return
    import_all(given) if given.imports else judge_all(given)


def shares_text(shares: dict[str, float]) -> str:
    """Return the shares below 1, by condition."""
    return (
        ", ".join(f"{name} {share:.1%}" for name, share in shares.items() if share < 1)
        or "all"
    )


def judge_all(given: argparse.Namespace) -> None:
    """Judge the plans of all files in all cases."""
    rows = []
    for file in given.files:
        plans = load_plans(file)
        evaluation = evaluate_plans(plans, workers=1)
        valid = np.flatnonzero(evaluation.valid)[: given.n]
        plans, truths = (
            plans[valid],
            tuple(evaluation.verdicts[index] for index in valid.tolist()),
        )
        names = ("joint velocity", "joint acceleration")
        fast = [
            too_fast(plans.motion[[k]], truth, names[k % 2])
            for k, truth in enumerate(truths)
        ]
        rates = np.concatenate([motion.rate for motion in fast])
        faster = replace(plans, rate_control_points=rates)
        sets = {
            "valid": (plans, truths),
            "too fast": (faster, evaluate_plans(faster, workers=1).verdicts),
        }
        for label, (members, verdicts) in sets.items():
            for case in chosen(CASES, given.case):
                counts = measure(members, case, verdicts)
                found = {
                    str(decision): counts.decisions[str(decision)]
                    for decision in Decision
                }
                rows.append(
                    {
                        "problem": plans.problem.name,
                        "plans": f"{len(members)} {label}",
                        "samples": case.name,
                        **found,
                        "wrong": counts.wrong,
                        "decided": counts.shares(),
                    }
                )
                progress(f"{file}: {label}, {case.name}: {rows[-1]}")
    head = (
        "problem",
        "plans",
        "samples",
        *map(str, Decision),
        "wrong",
        "decided conditions",
    )
    cells = [
        [
            shares_text(value) if isinstance(value, dict) else str(value)
            for value in row.values()
        ]
        for row in rows
    ]
    report(
        {"rows": rows},
        [table("sampled plans", head, cells, left=3)],
        as_json=given.json,
    )


if __name__ == "__main__":
    main()
