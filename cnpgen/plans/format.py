"""Plan file format: names, units and definitions of its datasets ('cnpgen docs plan-format'), and status of plans."""

import difflib
import logging
import re
from collections.abc import Collection, Mapping
from enum import IntEnum
from pathlib import Path

from cnpgen.documents import Names
from cnpgen.errors import DatasetError, listed
from cnpgen.plans.stated_units import UNIT_ATTRIBUTES
from cnpgen.store.field import Field
from cnpgen.store.files.hdf5 import Hdf5
from cnpgen.store.joint_units import units_of_joints
from cnpgen.store.scene_table import OBSTACLE_POSES

FORMAT = "cnpgen-plans"
PLAN_FILE_VERSION = 1

BOUNDARY = ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq")
# Only for given goal accelerations, and problems with parameters.
CONDITIONS = *BOUNDARY, "goal_ddq", "parameters"
REQUIRED = (*BOUNDARY, "path_control_points", "rate_control_points")

FLOATS = (*REQUIRED, "goal_ddq", "parameters", "duration")
INTEGERS = ("sample_id", "status")
NOTES = ("source", "refined_with")
ATTRIBUTES = (
    "format",
    "format_version",
    "degree",
    "problem",
    "problem_recipe",
    "problem_urdf",
    "problem_sha256",
)

# Of the metadata of exported Parquet tables, as JSON.

JOINT_NAMES = "joint_names"  # in files of other software
JOINT_NAMES_KEY = b"cnpgen_joint_names"
PLAN_COLUMN = "plan"  # of exported tables with several plans: the index of the plan
PHASE_COLUMN = "path_phase"  # of exported tables: the phase of each sample

# Column with the number of a goal state among those of one sample_id, the nearest
# first.
GOAL_OPTION = "goal_option"

# For revolute joints.
UNITS = {
    "q": "rad",
    "dq": "rad/s",
    "ddq": "rad/s^2",
    "jerk": "rad/s^3",
}
# Similarity ratio of names from which one is treated as a misspelling of the other.
MIN_NAME_SIMILARITY = 0.8
_DESCRIPTIONS = {
    "q": "joint positions",
    "dq": "joint velocities",
    "ddq": "joint accelerations",
    "xyz": "tip position",
}
_OTHERS = (
    Field("rate_control_points", "1/s", "control points of the rate r(s) = ds/dt"),
    Field("duration", "s", "integral of 1 / r(s)", role="diagnostic"),
    Field("sample_id", "1", "index of the sample in its split", role="diagnostic"),
    Field("status", "1", "what is known of the plan", role="diagnostic"),
    Field("refine_outcome", "1", "how refining ended", role="diagnostic"),
    Field(
        "refine_iterations", "1", "steps of all attempts together", role="diagnostic"
    ),
    Field(
        "refine_objective",
        "s",
        "what was minimised: time and what is added to it",
        role="diagnostic",
    ),
    Field(
        "hit_angle",
        "rad",
        "direction of the hit about world z, from world x",
        role="context",
        frame="world",
    ),
    Field(
        OBSTACLE_POSES,
        "m",
        "poses and sizes of the obstacles",
        role="context",
        frame="world",
    ),
    Field(
        GOAL_OPTION,
        "1",
        "number of the goal state among those of its task",
        role="context",
    ),
    Field(
        "hit_speed",
        "m/s",
        "speed of the tip along the hit at the goal",
        role="context",
        frame="world",
    ),
)


def plan_fields(
    joints: tuple[str, ...], prismatic: tuple[bool, ...]
) -> dict[str, Field]:
    """Describe the datasets that have a fixed definition, for planned joints that are prismatic or not."""
    fields = {item.name: item for item in _OTHERS}
    for end, goal in (("start", "the start"), ("goal", "the goal")):
        for what, text in _DESCRIPTIONS.items():
            axes, frame = (("x", "y", "z"), "world") if what == "xyz" else (joints, "")
            unit = "m" if what == "xyz" else units_of_joints(UNITS[what], prismatic)
            name = f"{end}_{what}"
            fields[name] = Field(
                name, unit, f"{text} at {goal}", len(axes), axes, frame=frame
            )
    name = "path_control_points"
    unit = units_of_joints(UNITS["q"], prismatic)
    fields[name] = Field(name, unit, "control points of the path p(s)", names=joints)
    return fields


MAX_LISTED = 12  # unused elements in a message
# Attributes of datasets that describe them, and units, which are checked.
_DESCRIBING = {
    *UNIT_ATTRIBUTES,
    *("long_name", "names", "frame", "role", "valid_min", "valid_max"),
    *("flag_values", "flag_meanings", JOINT_NAMES),
}
_LOG = logging.getLogger(__name__)
KNOWN = frozenset(plan_fields((), ()))  # names with a fixed definition
# Dataset -> SI unit, for joints that of revolute ones; that of parameters differs.
SI_UNITS = {name: item.unit for name, item in plan_fields(("",), (False,)).items()} | {
    "parameters": ""
}


def refuse_misspelt(path: Path, names: Collection[str], asked: Collection[str]) -> None:
    """Raise DatasetError for a misspelled name of a missing optional dataset among names, which would be ignored."""
    missing = [name for name in asked if name not in names]
    for name in names:
        meant = difflib.get_close_matches(
            name.lower(), missing, n=1, cutoff=MIN_NAME_SIMILARITY
        )
        # Names with a definition of their own are no misspellings, however similar.
        if meant and name not in KNOWN:
            raise DatasetError(
                f"{path}: {name!r} is almost {meant[0]!r}, which the file lacks: rename or remove it"
            )


def report_unused(
    path: Path, file: Hdf5, attributes: Collection[str], names: Collection[str]
) -> None:
    """Report the attributes and datasets of a file of other software that are not read; a misspelled attribute is refused.

    The attributes and datasets of the given names are read.
    """
    refuse_misspelt(path, [*file.attributes], attributes)
    unused = [f"attribute {name}" for name in file.attributes if name not in attributes]
    unused += [name for name in file.names() if name not in names]
    unused += [
        f"attribute {key} of {name}"
        for name in file
        if name in names
        for key in file.attributes_of(name)
        if key not in _DESCRIBING
    ]
    if unused:
        _LOG.info("%s: not used: %s", path, listed(unused, MAX_LISTED))


def stated_joints(file: Hdf5) -> dict[str, Names]:
    """Return the names of joints that a file states, in the order of its columns: place -> names.

    They are attributes of the file or of columns with one value per joint, texts or
    lists, or a dataset of texts.
    """
    columns = [name for name in (*REQUIRED, "goal_ddq") if name in file]
    found = {
        f"{key} of {name}": attributes.texts(key)
        for name in columns
        if name != "rate_control_points"
        for attributes in (file.attributes_of(name),)
        for key in ("names", JOINT_NAMES)
        if key in attributes
    }
    if JOINT_NAMES in file.attributes:
        found[f"the attribute {JOINT_NAMES}"] = file.attributes.texts(JOINT_NAMES)
    if JOINT_NAMES in file:
        found[JOINT_NAMES] = file.texts(JOINT_NAMES)
    # One text is a list in JSON, or separated by commas or spaces.
    return {
        place: tuple(re.findall(r"[^][\",\s]+", texts[0])) if len(texts) == 1 else texts
        for place, texts in found.items()
    }


def refuse_other_joints(path: Path, stated: Mapping[str, Names], joints: Names) -> None:
    """Raise DatasetError for columns of other joints than those of the problem, or in another order."""
    for place, names in stated.items():
        if names != joints:
            raise DatasetError(
                f"{path}: {place} is {', '.join(names)}, expected the problem's order, {', '.join(joints)}"
            )


class PlanStatus(IntEnum):
    """Status of a plan; the first one that applies.

    Files store the names with the values, so that members can be added later.
    """

    UNKNOWN = 0
    VALID = 1
    INVALID = 2
    NOT_FINITE = 3
    NOT_FORWARD = 4

    @property
    def text(self) -> str:
        """Text of the status."""
        return {
            PlanStatus.UNKNOWN: "not checked yet",
            PlanStatus.VALID: "satisfies every constraint and the boundary conditions at every time",
            PlanStatus.INVALID: "violates a constraint or a boundary condition",
            PlanStatus.NOT_FINITE: "a boundary condition or a control point is not a finite number",
            PlanStatus.NOT_FORWARD: "the rate ds/dt is not positive throughout",
        }[self]
