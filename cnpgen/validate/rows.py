"""The deep check of a dataset: every row by Pinocchio and Coal and by itself, and whether rows stand there twice."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import CnpgenError, counted
from cnpgen.judges.rows.hits import hit_rule, repeated_share, shares_of
from cnpgen.judges.rows.plans import PlanCheck, check_plans
from cnpgen.judges.rows.report import RowReport, merge
from cnpgen.judges.rows.verify import verify_rows
from cnpgen.machine.engine import Engine, assembled
from cnpgen.make.load import restored
from cnpgen.problems.robot import load_robot
from cnpgen.store.blueprint import Blueprint, ShardTask
from cnpgen.store.check import DELETE, Finding
from cnpgen.store.record import load_record
from cnpgen.store.shard import read_shard
from cnpgen.validate.numbers import check_numbers

_ODD = np.random.default_rng(0).integers(0, 2**63, 64, dtype=np.uint64) * np.uint64(2) + np.uint64(1)


@dataclass(frozen=True)
class DeepCheck:
    """What the deep check found in a dataset.

    Attributes:
        rows: What Pinocchio and Coal say of all rows, or None if none could be read.
        judged: How many plans the rows hold; 0 unless the dataset is certified.
        valid: How many of them are valid.
        findings: What is wrong, by file.
    """

    rows: RowReport | None = None
    judged: int = 0
    valid: int = 0
    findings: tuple[Finding, ...] = ()


def check_rows(
    folder: Path, blueprint: Blueprint, tasks: list[ShardTask], engine: Engine, progress: Callable[[int], None] | None
) -> DeepCheck:
    """Recompute every row, shard by shard, and judge every plan.

    Args:
        folder: The dataset.
        blueprint: Its blueprint.
        tasks: The shards to read.
        engine: Where the work is shared out to.
        progress: Called with the rows of every shard that was read.
    """
    checks, findings = [], []
    with assembled(engine, len(tasks)) as team:
        verify = partial(_verify_shard, folder.absolute() if team.is_far else folder, blueprint)
        with closing(team.share_out(verify, tasks, ordered=True)) as results:
            for task, result in zip(tasks, results, strict=True):
                findings += [Finding(task.file, problem, advice=DELETE) for problem in result.problems]
                checks.append(result)
                if progress is not None:
                    progress(task.rows)
    every = np.concatenate([np.empty(0, np.uint64), *(check.keys for check in checks)])
    twice = len(every) - len(np.unique(every))
    if twice:
        findings.append(Finding("(all splits)", f"{counted(twice, 'row')} that stand in the dataset before, too"))
    findings += [Finding("(all splits)", text) for text in _slowed_down(blueprint, checks)]
    reports = [check.report for check in checks if check.report is not None]
    judged, valid = (sum(getattr(check.plans, what) for check in checks) for what in ("judged", "valid"))
    return DeepCheck(merge(reports) if reports else None, judged, valid, tuple(findings))


@dataclass(frozen=True)
class _ShardCheck:
    """What the deep check found in one shard.

    Attributes:
        report: What Pinocchio and Coal say, or None if the shard cannot be read.
        problems: What is wrong with it.
        keys: A hash of the boundary states of every row, shape (rows,).
        plans: What the verdict says of its plans.
        shares: Which fraction of the highest possible speed its hits have, shape (rows,); none if they are no hits.
        goals: A key of the goal of each of these.
    """

    report: RowReport | None
    problems: list[str]
    keys: NDArray[np.uint64]
    plans: PlanCheck
    shares: NDArray[np.float64]
    goals: NDArray[np.uint64]


def _verify_shard(folder: Path, blueprint: Blueprint, task: ShardTask) -> _ShardCheck:
    """Verify one shard; a shard that cannot be read is a finding, not an exception."""
    try:
        columns = read_shard(folder / task.file)
        record = load_record(folder, task)
    except CnpgenError as error:
        return _ShardCheck(None, [str(error)], np.empty(0, np.uint64), PlanCheck(), np.empty(0), np.empty(0, np.uint64))
    with restored(blueprint) as recipe:
        problem = recipe.pipeline.problem
        robot = load_robot(problem)
        report = verify_rows(problem, robot, columns, dtype=blueprint.dtype, rule=hit_rule(blueprint.stages))
        plans = check_plans(problem, robot, columns)
    problems = [*plans.problems, *check_numbers(blueprint, task, columns, record)]
    problems += [
        f"{check.name}: {counted(check.rows_out, 'row')} out, worst {check.worst:.3g} {check.unit}"
        f" (allowed {check.allowed:.3g}) in row {task.first_row + check.worst_row}"
        for check in report.failed
    ]
    ends = [columns[name] for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq") if name in columns]
    shares = shares_of(columns) if {"hit_speed", "hit_speed_max"} <= columns.keys() else np.empty(0)
    goals = row_keys(columns["goal_q"])[: len(shares)]
    return _ShardCheck(report, problems, row_keys(np.concatenate(ends, axis=1)), plans, shares, goals)


def _slowed_down(blueprint: Blueprint, checks: list[_ShardCheck]) -> list[str]:
    """Say that more hits have the same fraction of their highest speed than luck gives them."""
    if hit_rule(blueprint.stages).full_speed is None or not checks:
        return []
    shares, goals = (np.concatenate([getattr(check, name) for check in checks]) for name in ("shares", "goals"))
    _, once = np.unique(goals, return_index=True)  # many starts may have one goal
    count, share = repeated_share(shares[once], blueprint.dtype)
    same = f"{counted(count, 'hit')} with the same fraction of their highest speed, {share:.6g}"
    return [f"{same}, which is drawn for each: they were slowed down afterwards"] if count else []


def row_keys(values: NDArray[Any]) -> NDArray[np.uint64]:
    """Hash every row of numbers to 64 bits: equal rows have equal keys, others hardly ever.

    Args:
        values: Shape (rows, width).
    """
    bits = np.ascontiguousarray(values, np.float64).view(np.uint64)
    bits = bits ^ (bits >> np.uint64(32))  # what was float32 has zeros below, which no product carries upwards
    bits *= np.resize(_ODD, bits.shape[1])
    bits ^= bits >> np.uint64(29)
    return np.asarray((bits * np.resize(_ODD[::-1], bits.shape[1])).sum(axis=1, dtype=np.uint64))
