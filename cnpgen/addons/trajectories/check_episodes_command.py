"""Check the episodes of recorded robot data before training.

PATH is a folder of LeRobot v3, USER/NAME in LeRobot's home, an HDF5 file of robomimic or
Minari, or a folder of CSV files. Each episode is PASS, REVIEW or EXCLUDE, with joint,
time and statement. EXCLUDE is proven from facts: limits of the vendor and a known noise
('cnpgen docs recorded-data'). The exit code is 1 if an episode is excluded.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cnpgen.cli import values
from cnpgen.cli.parser import Parser, refuse
from cnpgen.documents import Names
from cnpgen.errors import UsageError, counted, listed

if TYPE_CHECKING:
    from cnpgen.addons.trajectories.arm_registry import RecordedArm
    from cnpgen.addons.trajectories.episode_checks import EpisodeReport, Scale
    from cnpgen.addons.trajectories.episode_files import Episode, Recording

FORMAT = "cnpgen-episode-check"
EPISODE_CHECK_VERSION = 1
JOINT_SUFFIXES = ("", ".pos", "_pos", "_position", ".position", ".q")


def add_options(parser: Parser) -> None:
    option = parser.add_argument
    option("path", metavar="PATH", help="folder or file of episodes, or USER/NAME")
    text = "arm of the registry (default: by the type of robot that the data state)"
    option("--arm", metavar="NAME", help=text)
    text = "names or indices of the arm's joints in the data, in order"
    option("--joints", metavar="A,B,...", type=values.names, help=text)
    text = "unit of the joints (default: rad; for SO-100 and SO-101 none)"
    option("--unit", choices=("rad", "deg"), help=text)
    text = "LeRobot's calibration of the arm, JSON, for values of -100 to 100"
    option("--calibration", metavar="FILE", type=Path, help=text)
    text = "largest error of positions [rad] (default: the registry's)"
    option("--noise", metavar="E", type=values.errors, help=text)
    text = "largest error of the times (default: half a period without a clock)"
    option("--time-jitter", metavar="T", type=values.seconds, help=text)
    text = "numbers of the episodes to check, such as 0,3,5 (default: all)"
    option("--episodes", metavar="N,...", type=values.names, help=text)
    option(
        "--rate",
        metavar="HZ",
        type=values.hertz,
        help="frames per second of data without times",
    )
    option("--key", metavar="NAME", help="name of the positions in an HDF5 file")
    option("--json", action="store_true", help="write JSON")


def run(arguments: argparse.Namespace) -> int:
    """Check the episodes of a path."""
    from cnpgen.addons.trajectories.episode_checks import Level, check_episode
    from cnpgen.addons.trajectories.episode_files import chosen, read_recording

    if isinstance(arguments.noise, tuple):
        raise UsageError("--noise is one number, the error of positions [rad]")
    recording = read_recording(arguments.path, key=arguments.key, rate=arguments.rate)
    arm = _arm(arguments, recording)
    if recording.kind != "hdf5":
        refuse(arguments, ["key"], "{} is for HDF5 files")
    if arm is None:
        refuse(arguments, ["joints", "unit", "calibration"], "{} needs --arm")
    if arguments.calibration is not None:
        refuse(arguments, ["unit"], "{} is not for values with a --calibration")
    episodes = chosen(recording, _numbers(arguments.episodes))
    reports = [
        check_episode(
            episode,
            arm,
            None if arm is None else _scale(arguments, arm, episode),
            noise=arguments.noise,
            jitter=arguments.time_jitter,
        )
        for episode in episodes
    ]
    if arguments.json:
        _write_json(arguments.path, arm, reports)
    else:
        print("\n".join(_lines(arguments.path, recording, arm, reports)))
    return int(any(report.level == Level.EXCLUDE for report in reports))


def _arm(arguments: argparse.Namespace, recording: "Recording") -> "RecordedArm | None":
    """Return the stated arm, or that of the data; report on stderr if it is unknown."""
    from cnpgen.addons.trajectories.arm_registry import find_arm, known_arm

    if arguments.arm is not None:
        return find_arm(arguments.arm)
    arm = known_arm(recording.robot) if recording.robot else None
    if arm is None:
        robot = f"the robot {recording.robot!r}" if recording.robot else "the robot"
        print(
            f"{robot} is not in the registry of arms: only checks without units run; --arm names it",
            file=sys.stderr,
        )
    return arm


def _numbers(texts: Names | None) -> list[int] | None:
    """Return the numbers of episodes."""
    if texts is None:
        return None
    bad = [text for text in texts if not text.isdecimal()]
    if bad:
        raise UsageError(
            f"--episodes must be numbers from 0, such as 0,3; got {bad[0]!r}"
        )
    return [int(text) for text in texts]


def _scale(
    arguments: argparse.Namespace, arm: "RecordedArm", episode: "Episode"
) -> "Scale | None":
    """Return the conversion of an episode's joints to radians, or None if their unit is unknown."""
    import numpy as np

    from cnpgen.addons.trajectories.episode_checks import Scale

    columns = _columns(arguments.joints, arm, episode)
    if arguments.calibration is not None:
        factor = _calibrated(arguments.calibration, arm)
        return Scale(columns, np.array(factor), has_zero=False)
    if episode.has_units and arguments.unit is not None:
        text = (
            f"--unit is for columns without a unit, those of {episode.name} have some"
        )
        raise UsageError(text)
    if arguments.unit is None and arm.is_normalized and not episode.has_units:
        return None
    unit = np.pi / 180 if arguments.unit == "deg" else 1.0
    return Scale(columns, np.full(len(columns), unit))


def _columns(
    names: Names | None, arm: "RecordedArm", episode: "Episode"
) -> tuple[int, ...]:
    """Return the column of each joint of an arm."""
    from cnpgen.addons.trajectories.episode_files import joint_name

    wanted = arm.joints if names is None else names
    if len(wanted) != len(arm.joints):
        raise UsageError(
            f"--joints must have {len(arm.joints)} names, got {len(wanted)}"
        )
    found = []
    for joint in map(joint_name, wanted):
        spellings = [f"{joint}{suffix}" for suffix in JOINT_SUFFIXES]
        # A prefix of the robot, as in "panda_joint1", if it is of one column.
        # "dq panda_joint1" has a space, and velocities.
        longer = [name for name in episode.names if name.endswith(f"_{joint}")]
        longer = [name for name in longer if " " not in name]
        spellings += longer if len(longer) == 1 else []
        known = [name for name in spellings if name in episode.names]
        column = episode.names.index(known[0]) if known[:1] else None
        if (
            column is None
            and names is not None
            and joint.isdecimal()
            and int(joint) < len(episode.names)
        ):
            column = int(joint)
        if column is None:
            text = f"there is no joint {joint!r}, only {listed(episode.names, 12)}: state {{joints}}"
            raise UsageError(text, concerns="joints", remedies={"joints": None})
        found.append(column)
    return tuple(found)


def _calibrated(path: Path, arm: "RecordedArm") -> list[float]:
    """Return the radians per unit of values of -100 to 100 of the ranges of a calibration."""
    import math

    from cnpgen.store.files.atomic import read_file
    from cnpgen.store.files.documents import parse_json

    if arm.steps_per_turn is None:
        raise UsageError(
            f"--calibration: the encoder of {arm.name} is not in the registry"
        )
    step = 2 * math.pi / arm.steps_per_turn
    factors = []
    try:
        document = parse_json(read_file(path, max_bytes=1 << 20).decode())
        for joint in arm.joints:
            entry = document[joint]
            steps = float(entry["range_max"]) - float(entry["range_min"])
            factors.append(steps / 200 * step)
    except (ValueError, KeyError, TypeError) as error:
        text = f"{path} is not a calibration of {arm.name}: {error!r:.120}"
        raise UsageError(text, concerns="calibration") from error
    if not all(0 < factor <= math.pi / 100 for factor in factors):
        # A turn for 200.
        text = f"{path}: every range must be above 0 and at most a turn of {arm.name}"
        raise UsageError(text, concerns="calibration")
    return factors


def _by_level(reports: "list[EpisodeReport]") -> dict[str, list[str]]:
    """Return the names of the episodes of every level."""
    from cnpgen.addons.trajectories.episode_checks import Level

    return {
        str(level): [report.name for report in reports if report.level == level]
        for level in Level
    }


def _kept(reports: "list[EpisodeReport]") -> list[str]:
    """Return the names of the episodes that are not excluded."""
    return [report.name for report in reports if str(report.level) != "EXCLUDE"]


def _lines(
    path: str,
    recording: "Recording",
    arm: "RecordedArm | None",
    reports: "list[EpisodeReport]",
) -> list[str]:
    """Return one line for each episode, the summary, and what to do next."""
    lines = []
    for report in reports:
        first = f"  {report.findings[0]}" if report.findings else ""
        more = f"; {len(report.findings) - 1} more" if len(report.findings) > 1 else ""
        lines.append(f"{report.name:>8}  {report.level:<7}{first}{more}")
    names = _by_level(reports)
    counts = ", ".join(f"{len(found):,} {level}" for level, found in names.items())
    lines += ["", f"{path}: {counted(len(reports), 'episode')}: {counts}"]
    if arm is not None:
        for quantity, limit in arm.limits.items():
            lines.append(
                f"  {quantity} limits of {arm.name}: {limit.basis}, {limit.source}"
            )
    reasons = {
        name: text for report in reports for name, text in report.not_run.items()
    }
    lines += [f"  not checked: {name}: {text}" for name, text in reasons.items()]
    if (excluded := names["EXCLUDE"]) and recording.kind == "lerobot":
        lines += [
            f"  train without them: --dataset.episodes='[{', '.join(_kept(reports))}]'",
            f"  delete them: lerobot-edit-dataset --repo_id {path} --operation.type delete_episodes"
            f" --operation.episode_indices '[{', '.join(excluded)}]'",
        ]
    return lines


def _write_json(
    path: str, arm: "RecordedArm | None", reports: "list[EpisodeReport]"
) -> None:
    """Write the reports as JSON."""
    document = {
        "format": FORMAT,
        "format_version": EPISODE_CHECK_VERSION,
        "path": path,
        "arm": None if arm is None else arm.name,
        "limits": {
            quantity: {"basis": limit.basis, "source": limit.source}
            for quantity, limit in ({} if arm is None else arm.limits).items()
        },
        "counts": {level: len(names) for level, names in _by_level(reports).items()},
        "kept": _kept(reports),
        "episodes": [report.to_dict() for report in reports],
    }
    print(json.dumps(document, indent=2, ensure_ascii=False))
