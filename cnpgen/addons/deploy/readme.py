"""README of an exported planner."""

from cnpgen.addons.deploy.c_source import CODES, Names, filled
from cnpgen.addons.deploy.c_text import comment_text
from cnpgen.addons.deploy.planner_parts import PlannerParts
from cnpgen.errors import counted
from cnpgen.machine.versions import __version__


def readme_text(parts: PlannerParts, names: Names) -> str:
    """Return the README: use, codes, limits of validity and identity."""
    name = names.name
    joints = ", ".join(map(comment_text, parts.robot.joint_names))
    rows = "\n".join(
        f"| {value} | `{name.upper()}_{code}` | {cause} |"
        for value, (code, cause) in enumerate(CODES.items())
    )
    constraints = ", ".join(
        comment_text(type(each).__name__) for each in parts.problem.constraint
    )
    values = {
        "NAME": name,
        "SIZE": counted(parts.robot.n, "joint"),
        "VERSION": __version__,
        "MODEL": comment_text(names.model),
        "JOINTS": joints,
        "STOP": _stop(parts, name),
        "CODES": rows,
        "CONSTRAINTS": constraints,
        "PHASES": str(len(parts.phases)),
        "CHECKED_PHASES": str(len(parts.checked_phases)),
        "RANGES": parts.ranges.source,
        "MODEL_SHA256": names.model_sha256,
        "PROBLEM_SHA256": parts.model.problem.comparable_sha256,
    }
    return filled("readme.txt", values)


def _stop(parts: PlannerParts, name: str) -> str:
    """Return the line about stops; there are none for problems with limits of the jerk."""
    if parts.problem.uses_jerk:
        return (
            "- A stop is not part of this file, because the problem limits the jerk.\n"
        )
    return f"- `{name}_find_stop` finds the earliest feasible stop after a time, and `{name}_stop_state` is its state.\n"
