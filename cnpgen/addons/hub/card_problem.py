"""The part of a card on the problem: the limits and constraints that every sample meets, and what that proves.

It is read from the specification, without building the robot.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from cnpgen.addons.hub.markdown import markdown_table
from cnpgen.store.dataset_spec import DatasetSpec
from cnpgen.store.joint_units import unit_of, units_of_joints

_LIMITS = {  # key of the robot's limits -> name and unit of the column
    "velocity_limit": ("velocity", "rad/s"),
    "acceleration_limit": ("acceleration", "rad/s^2"),
    "torque_limit": ("torque", "N m"),
}
_CERTIFIED = "certified-plan"  # the stage that finds a valid plan for each sample

_PROVES = """\
A sample is a start state and a goal state. Both were checked on the stored values: they meet the limits and the
constraints of this card, within the tolerances in `manifest.json`.
"""
_MOTION = """\
Every sample has a plan, which connects them and was checked over its whole duration: `cnpgen validate --deep` checks it
again. It is a local optimum and need not be the fastest.
"""
_NO_MOTION = """\
A sample does not prove that a valid motion connects the two states: `cnpgen make-dataset --certify` keeps only samples
for which one was found.
"""
_LIMITED = """\
Nothing is proven for a robot with other limits, loads or obstacles than those of this card, and nothing about tracking
errors of a controller.
"""


def describe_frame(spec: DatasetSpec) -> str:
    """Return the frames of the positions, and the point that they belong to."""
    frames = sorted({field.frame for field in spec.fields if field.frame})
    tip = spec.robot.get("tip", "")
    named = [f"positions in the frame `{frame}`" for frame in frames]
    return ", ".join([*named, *([f"tip link `{tip}`"] if tip else [])])


def limits_table(spec: DatasetSpec) -> str:
    """Return the limits of all joints in SI units; empty if the specification lists none."""
    names = spec.robot.get("joint_names", ())
    limits = spec.robot.get("limits", {})
    if not limits:
        return ""
    position = next(field for field in spec.fields if field.names == tuple(names))
    prismatic = tuple(unit == "m" for unit in position.units)
    ends = zip(limits["position_lower"], limits["position_upper"], strict=True)
    columns = {("position", "rad"): [f"{low:.5g} ... {high:.5g}" for low, high in ends]}
    columns |= {
        head: [f"{value:.5g}" for value in limits[key]] for key, head in _LIMITS.items()
    }
    rows = [[f"`{name}`"] for name in names]
    for (_, unit), values in columns.items():
        units = units_of_joints(unit, prismatic)
        for index, (row, value) in enumerate(zip(rows, values, strict=True)):
            row.append(f"{value} {unit_of(units, index)}")
    return markdown_table(("joint", *(name for name, _ in columns)), rows)


def constraint_table(spec: DatasetSpec) -> str:
    """Return the constraints of the problem with their values in SI units; empty if the recipe lists none."""
    rows = list(_constraint_rows(problem_of(spec).get("constraint", ())))
    return markdown_table(("constraint", "values"), rows) if rows else ""


def problem_of(spec: DatasetSpec) -> Mapping[str, Any]:
    """Return the table of the problem in the recipe; empty if there is none."""
    pipeline = spec.recipe.get("pipeline")
    problem = pipeline.get("problem") if isinstance(pipeline, dict) else None
    return problem if isinstance(problem, dict) else {}


def _constraint_rows(constraints: Any) -> Iterator[tuple[str, str]]:
    """Yield kind and values, without the weights and budgets of the training loss."""
    for constraint in constraints:
        values = {
            name: value
            for name, value in constraint.items()
            if name not in {"use", "weight", "budget"} and value not in (None, "", [])
        }
        text = ", ".join(f"{name} {_number(value)}" for name, value in values.items())
        yield f"`{constraint.get('use', '')}`", text


def _number(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return f"[{', '.join(map(_number, value))}]"
    return str(value)


def what_samples_prove(spec: DatasetSpec) -> str:
    """Say what a sample proves, and what it does not."""
    certified = any(stage.get("use") == _CERTIFIED for stage in _stages(spec))
    return "\n".join([_PROVES, _MOTION if certified else _NO_MOTION, _LIMITED])


def _stages(spec: DatasetSpec) -> list[Mapping[str, Any]]:
    pipeline = spec.recipe.get("pipeline")
    stages = pipeline.get("stage", []) if isinstance(pipeline, dict) else []
    return [stage for stage in stages if isinstance(stage, dict)]
