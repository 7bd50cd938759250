"""Verdicts on recorded data: false verdicts, planted faults, valid motions shown, and CPU time against another version.

    python benchmarks/recorded.py PLANS... [--count 10] [--against PYTHON] [--json]

Each file of valid plans is sampled as recordings are: slowed, at 10 to 500 Hz, rounded,
with noise, velocities of ten times the noise, and late times. ``--against`` names the
Python of another installed version; the same episodes of 10 s at 30 Hz are judged by both,
and the ratios of their CPU times are printed.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import arguments, machine_line

from cnpgen.addons.trajectories.judge_family import FamilyJudge
from cnpgen.addons.trajectories.judge_samples import judge_samples, refute
from cnpgen.addons.trajectories.refuted_limits import largest_values
from cnpgen.addons.trajectories.sample_errors import SampleErrors
from cnpgen.addons.trajectories.sampled_trajectory import Trajectory
from cnpgen.addons.trajectories.trajectory_verdict import Decision, Statement
from cnpgen.plans import Plans, load_plans, open_problem
from cnpgen.plans.evaluate import evaluate_plans

Array = np.ndarray[Any, np.dtype[np.float64]]

RATES = (10, 30, 50, 100, 500)
KINDS = {  # name -> decimals, noise of positions [rad], jitter [s]
    "exact": (None, 0.0, 0.0),
    "5 decimals": (5, 5e-6, 0.0),
    "4 decimals": (4, 5e-5, 0.0),
    "noise 1e-4": (None, 1e-4, 0.0),
    "noise 1e-3": (None, 1e-3, 0.0),
    "jitter 2 ms": (None, 1e-4, 2e-3),
}
EPISODE_S = 10.0
# Judges the episodes of a problem in one call, in a process that may have another version.
TIMER = """
import json, sys, time
import numpy as np, cnpgen
from cnpgen.trajectories import Trajectory
found = []
for problem, paths, noise in json.load(open(sys.argv[1])):
    data = [np.load(path) for path in paths]
    episodes = [Trajectory(each["t"], each["q"]) for each in data]
    cnpgen.evaluate_trajectories(problem, episodes[:1], noise=noise, workers=1)
    start = time.process_time()
    verdicts = cnpgen.evaluate_trajectories(problem, episodes, noise=noise, workers=1).verdicts
    spent = (time.process_time() - start) / len(episodes)
    found.append((spent, [str(verdict.decision) for verdict in verdicts]))
print(json.dumps(found))
"""


@dataclass(frozen=True)
class Sampling:
    """A way of recording a motion: how much it is slowed, and rate [Hz], rounding, noise [rad] and jitter [s]."""

    slow: float
    rate: float
    decimals: int | None = None
    noise: float = 0.0
    jitter: float = 0.0

    def errors(self) -> SampleErrors:
        """Return the errors of its samples."""
        factor = 1 if self.decimals else 10
        noise = self.noise + 1e-15
        return SampleErrors(noise, factor * noise, 0.0, self.jitter, "")

    def sample(
        self, plans: Plans, index: int, random: np.random.Generator
    ) -> Trajectory:
        """Sample a plan with positions and velocities."""
        motion = plans.motion[[index]]
        duration = float(motion.duration()[0]) * self.slow
        count = int(np.floor(duration * self.rate - 1e-9)) + 1
        t = np.append(np.arange(count) / self.rate, duration)
        late = self.jitter * random.uniform(-1, 1, t.shape)
        at = np.clip(t + late, 0, duration)
        states = motion.at_times((at / self.slow)[None])
        q, dq = states.q[0], states.dq[0] / self.slow
        if self.decimals is not None:
            q, dq = q.round(self.decimals), dq.round(self.decimals)
        else:
            q = q + self.noise * random.uniform(-1, 1, q.shape)
            dq = dq + 10 * self.noise * random.uniform(-1, 1, q.shape)
        return Trajectory(t, q, dq, parameters=_parameters(plans, index))


def _parameters(plans: Plans, index: int) -> Array | None:
    found = plans.boundary.parameters
    return None if found is None else np.asarray(found[index])


def valid_plans(path: str, count: int) -> Plans:
    """Load the first valid plans of a file."""
    plans = load_plans(path)
    valid = np.flatnonzero(evaluate_plans(plans, workers=1).valid)
    return plans[valid[:count].tolist()]


def false_verdicts(plans: Plans) -> Counter[str]:
    """Count the checks of valid data, and those that bounds call invalid."""
    judge, random = FamilyJudge(*open_problem(plans.problem)), np.random.default_rng(0)
    counts: Counter[str] = Counter()
    for slow in (1.0, 2.0):
        for rate in RATES:
            for decimals, noise, jitter in KINDS.values():
                sampling = Sampling(slow, rate, decimals, noise, jitter)
                for index in range(len(plans)):
                    full = sampling.sample(plans, index, random)
                    for trajectory in (full, replace(full, dq=None)):
                        counts["checks"] += 1
                        found = refute(judge, trajectory, sampling.errors())
                        counts["false"] += found is not None
    return counts


@dataclass(frozen=True)
class Place:
    """Place of a fault: sample k, joint j, velocity limit of the joint [rad/s], and a sign."""

    k: int
    j: int
    fastest: float
    sign: int


Fault = Callable[[Trajectory, Place], tuple[Array, Array, Array]]


def _aside(size: float) -> Fault:
    def plant(x: Trajectory, place: Place) -> Any:
        q = x.q.copy()
        q[place.k, place.j] += size * place.sign
        return x.t, q, np.array(x.dq)

    return plant


def _speed(factor: float) -> Fault:
    """A joint at a multiple of its velocity limit for 100 ms, with ramps of 100 ms."""

    def plant(x: Trajectory, place: Place) -> Any:
        q, dq, t0, j = x.q.copy(), np.array(x.dq), x.t[place.k], place.j
        fine = np.linspace(0, x.t[-1], 4001)
        corners = [t0 - 0.15, t0 - 0.05, t0 + 0.05, t0 + 0.15]
        sign = np.sign(dq[place.k, j]) or 1.0

        def added(at: Array) -> Array:
            share = np.interp(at, corners, [0, 1, 1, 0], left=0, right=0)
            own = np.interp(at, x.t, np.array(x.dq)[:, j])
            return np.asarray(share * (sign * factor * place.fastest - own))

        steps = (added(fine)[1:] + added(fine)[:-1]) / 2 * np.diff(fine)
        q[:, j] += np.interp(x.t, fine, np.concatenate([[0], np.cumsum(steps)]))
        dq[:, j] += added(x.t)
        return x.t, q, dq

    return plant


def _from(change: Callable[[Array, Array, int], tuple[Array, Array]]) -> Fault:
    def plant(x: Trajectory, place: Place) -> Any:
        q, dq = change(x.q.copy(), np.array(x.dq), place.j)
        late = np.arange(len(x.t))[:, None] >= place.k
        return x.t, np.where(late, q, x.q), np.where(late, dq, np.array(x.dq))

    return plant


def _swapped(values: Array, j: int) -> Array:
    order = np.arange(values.shape[1])
    other = (j + 1) % len(order)
    order[[j, other]] = order[[other, j]]
    return np.asarray(values[:, order])


def _at(j: int, size: int) -> Array:
    return np.asarray(np.arange(size) == j, float)


def _held(length: Callable[[Trajectory, int], Any]) -> Fault:
    def plant(x: Trajectory, place: Place) -> Any:
        rows = length(x, place.k)
        q, dq = x.q.copy(), np.array(x.dq)
        q[rows], dq[rows] = q[place.k], 0.0
        return x.t, q, dq

    return plant


def _dropped(x: Trajectory, place: Place) -> Any:
    k = place.k
    kept = np.r_[0:k, min(k + 5, len(x.t) - 2) : len(x.t)]
    return x.t[: len(kept)], x.q[kept], np.array(x.dq)[kept]


def _late(x: Trajectory, place: Place) -> Any:
    t, k = x.t.copy(), place.k
    t[k] += 0.6 * (t[k + 1] - t[k])
    return t, x.q, np.array(x.dq)


def _velocities(change: Callable[[Array, int], Array]) -> Fault:
    def plant(x: Trajectory, place: Place) -> Any:
        return x.t, x.q, change(np.array(x.dq), place.j)

    return plant


FAULTS: dict[str, Fault] = {
    "none": lambda x, _: (x.t, x.q, np.array(x.dq)),
    "one sample 0.01 rad aside": _aside(0.01),
    "one sample 0.05 rad aside": _aside(0.05),
    "one sample 0.2 rad aside": _aside(0.2),
    "velocity 1.1 x for 100 ms": _speed(1.1),
    "velocity 2 x for 100 ms": _speed(2.0),
    "jump of 0.05 rad": _from(lambda q, dq, j: (q + 0.05 * _at(j, q.shape[1]), dq)),
    "joints swapped": _from(lambda q, dq, j: (_swapped(q, j), _swapped(dq, j))),
    "degrees": _from(lambda q, dq, _: (np.degrees(q), np.degrees(dq))),
    "wrap of 2 pi": _from(lambda q, dq, j: (q + 2 * np.pi * _at(j, q.shape[1]), dq)),
    "stuck for 0.3 s": _held(lambda x, k: (x.t >= x.t[k]) & (x.t < x.t[k] + 0.3)),
    "3 equal frames": _held(lambda x, k: np.arange(k, min(k + 3, len(x.t)))),
    "5 frames dropped": _dropped,
    "a time 60 % late": _late,
    "dq all 0": _velocities(lambda dq, _: 0 * dq),
    "dq in deg/s": _velocities(lambda dq, _: np.degrees(dq)),
    "one dq with other sign": _velocities(
        lambda dq, j: dq * (1 - 2 * _at(j, dq.shape[1]))
    ),
    "dq one sample late": _velocities(lambda dq, _: np.concatenate([dq[:1], dq[:-1]])),
    "two dq swapped": _velocities(_swapped),
}


def found_faults(plans: Plans, rate: float, noise: float) -> dict[str, list[float]]:
    """Return the shares of planted faults that are proven invalid, from positions and with velocities."""
    judge, random = FamilyJudge(*open_problem(plans.problem)), np.random.default_rng(1)
    sampling, shares = Sampling(2.0, rate, noise=noise), {}
    limit = largest_values(judge.limits())["dq"]
    for name, plant in FAULTS.items():
        found: list[tuple[bool, bool]] = []
        for index in range(len(plans)):
            exact = Sampling(2.0, rate).sample(plans, index, random)
            edge = max(3, len(exact.t) // 5)
            k = int(random.integers(edge, max(edge + 1, len(exact.t) - edge)))
            j = int(random.integers(exact.q.shape[1]))
            sign = int(random.choice([-1, 1]))
            t, q, dq = plant(exact, Place(k, j, float(limit[j]), sign))
            bad = replace(
                exact,
                t=t,
                q=q + noise * random.uniform(-1, 1, q.shape),
                dq=dq + 10 * noise * random.uniform(-1, 1, q.shape),
            )
            pair = (replace(bad, dq=None), bad)
            found.append(
                tuple(refute(judge, x, sampling.errors()) is not None for x in pair)  # type: ignore[arg-type]
            )
        shares[name] = np.mean(found, axis=0).tolist()
    return shares


def shown_motions(plans: Plans, slow: float, noise: float) -> Counter[str]:
    """Count the statements on positions of valid plans at 30 Hz."""
    judge, random = FamilyJudge(*open_problem(plans.problem)), np.random.default_rng(2)
    sampling, counts = Sampling(slow, 30, noise=noise), Counter[str]()
    for index in range(len(plans)):
        positions = replace(sampling.sample(plans, index, random), dq=None)
        scene = plans.scene.poses[index] if len(plans.scene.poses) else None
        verdict = judge_samples(judge, positions, sampling.errors(), scene=scene)
        counts[str(verdict.statement)] += 1
        counts["torque"] += _is_undecided(verdict.conditions, "joint torque")
    return counts


def _is_undecided(conditions: Any, name: str) -> bool:
    return name in conditions and conditions[name].decision == Decision.UNDECIDED


def long_episodes(plans: Plans, folder: Path) -> dict[str, list[Path]]:
    """Write plans slowed to 10 s at 30 Hz, valid and with a sample 0.2 rad aside: kind -> files."""
    random, found = np.random.default_rng(3), dict[str, list[Path]]()
    for index in range(len(plans)):
        slow = EPISODE_S / float(plans.motion[[index]].duration()[0])
        good = Sampling(slow, 30, noise=5e-5).sample(plans, index, random)
        bad = good.q.copy()
        bad[100, 0] += 0.2
        for kind, q in (("valid", good.q), ("faulty", bad)):
            path = folder / f"{index}-{kind}.npz"
            np.savez(path, t=good.t, q=q)
            found.setdefault(kind, []).append(path)
    return found


def cpu_times(
    python: str, problem: str, episodes: dict[str, list[Path]], folder: Path
) -> list[tuple[float, list[str]]]:
    """Return the CPU time [s] of an episode and the decisions by a Python, for each kind of episode."""
    listing = folder / "episodes.json"
    tasks = [(problem, list(map(str, paths)), 5e-5) for paths in episodes.values()]
    listing.write_text(json.dumps(tasks))
    command = [python, "-P", "-c", TIMER, str(listing)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return [tuple(each) for each in json.loads(done.stdout)]


def _add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("plans", nargs="+", help="files of plans")
    parser.add_argument("--count", type=int, default=10, help="plans of a file")
    text = "Python of another installed version, whose CPU times are compared"
    parser.add_argument("--against", metavar="PYTHON", help=text)


def main() -> None:
    """Measure all files and print tables or JSON."""
    options = arguments(__doc__, _add)
    start, results = time.process_time(), {}
    for path in options.plans:
        plans = valid_plans(path, options.count)
        entry: dict[str, Any] = {"plans": len(plans), "problem": plans.problem.name}
        entry["valid data"] = dict(false_verdicts(plans))
        entry["faults"] = {
            f"{rate} Hz, noise {noise:g}": found_faults(plans, rate, noise)
            for rate in (30, 100)
            for noise in (5e-5, 1e-3)
        }
        entry["shown"] = {
            f"slowed {slow:g}, noise {noise:g}": dict(shown_motions(plans, slow, noise))
            for slow in (1.0, 1.5, 3.0)
            for noise in (5e-5, 1e-3)
        }
        if options.against:
            with tempfile.TemporaryDirectory() as folder:
                entry["cpu"] = compared_times(plans, Path(folder), options.against)
        results[path] = entry
        if not options.json:
            print(_text(path, entry), flush=True)
    if options.json:
        print(json.dumps(results, indent=2))
    else:
        print(f"\n{machine_line()}; {time.process_time() - start:.0f} s of CPU time")


def compared_times(plans: Plans, folder: Path, python: str) -> dict[str, Any]:
    """Return CPU times [ms] of an episode by both versions, and their ratio, by kind of episode."""
    name = plans.problem.name  # a recipe, or a folder of 'cnpgen init'
    problem = str(Path(name) / "problem.toml") if Path(name).is_dir() else name
    episodes, found = long_episodes(plans, folder), {}
    both = [
        cpu_times(each, problem, episodes, folder) for each in (sys.executable, python)
    ]
    for kind, (own, decisions), (other, others) in zip(episodes, *both, strict=True):
        found[kind] = {
            "ms": 1e3 * own,
            "ms_other": 1e3 * other,
            "ratio": other / own,
            "decisions": dict(Counter(decisions)),
            "decisions_other": dict(Counter(others)),
        }
    return found


def _text(path: str, entry: dict[str, Any]) -> str:
    """Format the results of one file."""
    valid = entry["valid data"]
    lines = [f"\n{path}: {entry['plans']} valid plans of {entry['problem']}"]
    lines.append(f"  false verdicts: {valid['false']} of {valid['checks']} checks")
    heads = list(entry["faults"])
    lines.append(f"  share proven invalid, q / q and dq: {'; '.join(heads)}")
    for name in FAULTS:
        cells = [
            "{:.2f} / {:.2f}".format(*entry["faults"][head][name]) for head in heads
        ]
        lines.append(f"    {name:<28}{'   '.join(cells)}")
    for name, counts in entry["shown"].items():
        shown = counts.get(str(Statement.EXISTS), 0)
        texts = ", ".join(
            f"{count} {what}" for what, count in counts.items() if what != "torque"
        )
        lines.append(
            f"  {name}: a valid motion shown for {shown} of {entry['plans']} ({texts})"
        )
    for kind, values in entry.get("cpu", {}).items():
        lines.append(
            f"  10 s at 30 Hz, {kind}: {values['ms']:.1f} ms, other version {values['ms_other']:.0f} ms,"
            f" ratio {values['ratio']:.0f}; {values['decisions']}, other {values['decisions_other']}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
