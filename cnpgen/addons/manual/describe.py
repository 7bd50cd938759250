"""Output of ``cnpgen show``: recipes in words and numbers."""

import math
from collections.abc import Iterable, Sequence
from textwrap import wrap
from typing import Any

from cnpgen.cli.terminal import LINE_WIDTH, table
from cnpgen.documents import JsonObject, TextRows
from cnpgen.make.any_recipe import Recipe
from cnpgen.make.recipe import DatasetRecipe, recipe_digest
from cnpgen.pipelines.pipeline import Pipeline
from cnpgen.pipelines.stages.boundary_motion import AtRest, TableAcceleration
from cnpgen.pipelines.stages.stage import Stage
from cnpgen.planner.model import Model
from cnpgen.problems.constraints.constraint import Constraint
from cnpgen.problems.constraints.joint import judged_torque
from cnpgen.problems.idle_keys import idle_keys, idle_text
from cnpgen.problems.limit_sources import WORDS, limit_sources
from cnpgen.problems.load_robot import load_robot
from cnpgen.problems.problem import Problem, resolved
from cnpgen.problems.urdf_dynamics import friction_in, joint_notes
from cnpgen.robots.drive import Drive
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.inline import corners_of
from cnpgen.robots.shape.link_pairs import LinkPair
from cnpgen.robots.shape.shape import Shape
from cnpgen.robots.urdf import urdf_tree
from cnpgen.robots.urdf_parameters import urdf_parameters
from cnpgen.schema import registry
from cnpgen.schema.keys import PerJoint, Range, keys
from cnpgen.store.joint_units import unit_of

LIMITS = {  # with their units at joints that turn
    "position_lower": "rad",
    "position_upper": "rad",
    "velocity_limit": "rad/s",
    "acceleration_limit": "rad/s^2",
    "jerk_limit": "rad/s^3",
    "torque_limit": "N m",
}


_LEFT_OUT = {
    "adjacent": "ignored: joined by a joint",
    "always": "ignored: always in contact",
    "disabled": "ignored: disabled by the SRDF or by ignored_pairs",
}


def describe(recipe: Recipe) -> str:
    """Describe a recipe, with everything that it refers to.

    Raise RecipeError if the URDF does not fit the problem.
    """
    if isinstance(recipe, DatasetRecipe):
        return f"{describe_dataset(recipe)}\n\n{describe(recipe.pipeline)}"
    if isinstance(recipe, Pipeline):
        return f"{describe_pipeline(recipe)}\n\n{describe(recipe.problem)}"
    return describe_problem(recipe)


def describe_dataset(recipe: DatasetRecipe) -> str:
    """Describe how many rows a dataset has, from which seed, split how."""
    splits = ", ".join(f"{name} {rows:,}" for name, rows in recipe.splits.items())
    facts = [
        ("rows", f"{sum(recipe.splits.values()):,}: {splits}"),
        ("seed", str(recipe.seed)),
        ("licence", recipe.license or "none stated"),
        ("recipe", f"sha256 {recipe_digest(recipe)}"),
        ("file", recipe.path),
    ]
    head = f"dataset {recipe.name} {recipe.version}"
    return "\n".join([head, *title_lines(recipe.title), *table(facts, indent="  ")])


def describe_pipeline(pipeline: Pipeline) -> str:
    """Describe the stages of a pipeline, numbered."""
    steps = [
        (f"{number}.", kind_name(stage), stage.describe())
        for number, stage in enumerate(pipeline.stage, 1)
    ]
    steps.append(
        ("", "(always)", "reject samples whose stored values violate a constraint")
    )
    if not any(_prescribes_goal_acceleration(stage) for stage in pipeline.stage):
        steps.append(("", "(goal)", 'goal_acceleration = "free": no stage writes it'))
    return "\n".join(
        [
            f"pipeline {pipeline.name}",
            *title_lines(pipeline.title),
            *table(steps, indent="  "),
        ]
    )


def _prescribes_goal_acceleration(stage: Stage) -> bool:
    """Return whether a stage writes goal accelerations, with which motions must end."""
    if isinstance(stage, AtRest):
        return (stage.end, stage.acceleration) == ("goal", "zero")
    return isinstance(stage, TableAcceleration) and stage.end == "goal"


def describe_problem(problem: Problem) -> str:
    """Describe a problem: its robot, limits and constraints.

    Raise RecipeError if the URDF does not fit.
    """
    spec = problem.robot
    facts = [
        ("robot", f"{spec.urdf}, {len(spec.joints)} planned joints, tip {spec.tip!r}")
    ]
    facts += [("object", numbers(problem.object))] if problem.object else []
    facts += [("payload", numbers(problem.payload))] if problem.payload else []
    facts += [("parameter", text) for text in problem.parameters.describe()]
    facts += [
        ("obstacle", f"{each.name}: {_obstacle(each)}") for each in problem.obstacle
    ]
    facts += [("motion", numbers(problem.trajectory))]
    # The duration is always part of the objective; the text has the other terms.
    objective = numbers(problem.objective)
    facts += [
        ("objective", f"minimum time, and {objective}" if objective else "minimum time")
    ]
    constraints = [(kind_name(item), numbers(item)) for item in problem.constraint]
    robot = load_robot(problem)
    return "\n".join(
        [
            f"problem {problem.name}",
            *title_lines(problem.title),
            *table(facts, indent="  "),
            "",
            "  planning limits",
            *table(_limit_rows(problem, robot), indent="    "),
            "",
            "  sources of the limits",
            *table(_source_rows(problem, robot), indent="    "),
            *_wrapped(filter(None, [idle_text(idle_keys(problem))])),
            *_drive(problem, robot),
            *_shape(problem, robot),
            "",
            "  constraints",
            *table(constraints or [("none", "")], indent="    "),
        ]
    )


def _drive(problem: Problem, robot: Robot) -> list[str]:
    """Describe which torque is judged, the drives, and further elements of the URDF's joints."""
    torque = judged_torque(problem.constraint, robot)
    lines = ["", f"  torque: {torque}"] if torque else []
    if (drive := robot.drive) is not None:
        stated = f"friction that is certain {drive.friction_help:.0%}, reversal speed {drive.reversal_speed:g} rad/s"
        lines += [f"    {stated}", *table(_drive_rows(robot, drive), indent="    ")]
    tree = urdf_tree(problem.urdf_text)
    by_name = {each.name: each for each in urdf_parameters(tree).joints.values()}
    joints = [by_name[name] for name in robot.joint_names]
    notes = list(joint_notes(tree, joints, soft=problem.limits.soft == "use"))
    frictions = friction_in(joints)
    if torque and frictions and problem.drive.urdf_dynamics == "ignore":
        text = ", ".join(map(str, frictions))
        notes.append(f"friction of the URDF that is not used: {text}")
    return lines + _wrapped(notes)


def _wrapped(notes: Iterable[str]) -> list[str]:
    """Wrap notes as lines of a section."""
    return [
        line
        for note in notes
        for line in wrap(
            note, LINE_WIDTH, initial_indent="    ", subsequent_indent="      "
        )
    ]


def _drive_rows(robot: Robot, drive: Drive) -> TextRows:
    """List the drive of every joint."""
    columns = [
        ("rotor inertia", "kg m^2", drive.armature),
        ("viscous", "N m s/rad", drive.viscous),
        ("dry", "N m", drive.coulomb),
        ("motor torque", "N m", drive.torque_limit),
    ]
    # The line torque = at rest - slope |dq| reaches 0 at |dq| = at rest / slope.
    for number, line in enumerate(drive.lines, 1):
        columns += [
            (f"line {number} at rest", "N m", line.torque),
            ("no torque at", "rad/s", line.torque / line.slope),
        ]
    shown = [
        (name, *with_units(robot.units(unit), [f"{x:.4g}" for x in values]))
        for name, unit, values in columns
    ]
    if drive.power_limit is not None:
        shown.append(("power", "W", *(f"{x:.4g}" for x in drive.power_limit)))
    return list(zip(("joint", "", *robot.joint_names), *shown, strict=True))


def _obstacle(obstacle: Obstacle) -> str:
    """Describe an obstacle; a mesh by the number of its corners."""
    same = [
        key.name for key in keys(Obstacle) if getattr(obstacle, key.name) == key.default
    ]
    text = numbers(obstacle, leave_out=("name", "mesh", "shape", *same))
    if obstacle.shape is not None:
        name = registry.name_of(registry.SHAPES, type(obstacle.shape))
        return f"{text}, {name}: {numbers(obstacle.shape)}"
    return (
        f"{text}, the hull of {len(corners_of(obstacle.mesh))} corners"
        if obstacle.mesh
        else text
    )


def _shape(problem: Problem, robot: Robot) -> list[str]:
    """Describe the robot's shape: its links, its pairs of links, and the free space that its convex parts reject."""
    if robot.shape is None:
        return []
    gap = problem.robot.hull_gap
    states = "of the random states in which no triangle meshes overlap are rejected by the convex parts"
    return [
        "",
        "  link geometry: collision geometry of the URDF, and capsules that enclose it",
        *table(link_rows(robot.shape), indent="    ", right=range(1, 6)),
        "",
        "  pairs of links, by random states",
        *table(pair_rows(robot.shape), indent="    ", right=(2, 3)),
        *([] if gap is None else ["", f"  gap: {gap:.2%} {states}"]),
    ]


def link_rows(shape: Shape) -> TextRows:
    """List the links: numbers of convex parts and corners, and the capsule that covers them."""
    head = (
        "link",
        "convex parts",
        "corners",
        "capsule length [mm]",
        "radius [mm]",
        "overhang [mm]",
        "joint",
    )
    rows: TextRows = [head]
    for capsule in shape.capsules:
        parts = [part for part in shape.convex_parts if part.link == capsule.link]
        corners = sum(len(part.vertices) for part in parts)
        length = math.dist(capsule.first, capsule.second)
        lengths = (
            f"{1e3 * value:.1f}" for value in (length, capsule.radius, capsule.overhang)
        )
        joint = shape.joints[capsule.link]
        rows.append(
            (
                capsule.link,
                str(len(parts)),
                str(corners),
                *lengths,
                str(joint) if joint else "none",
            )
        )
    return rows


def pair_rows(shape: Shape) -> TextRows:
    """List the pairs of links: share of random states in which they collide, and their users."""
    head = ("links", "", "colliding", "false capsule contacts", "checked by")
    return [
        head,
        *(
            (pair.first, pair.second, *_shares(pair), _use(pair))
            for pair in shape.pairs
        ),
    ]


def _shares(pair: LinkPair) -> tuple[str, str]:
    return (
        ("", "")
        if math.isnan(pair.colliding)
        else (f"{pair.colliding:.2%}", f"{pair.mistaken:.2%}")
    )


def _use(pair: LinkPair) -> str:
    if pair.left_out:
        return _LEFT_OUT[pair.left_out]
    return "judges and solvers" if pair.for_solvers else "judges"


def shape_to_dict(shape: Shape) -> JsonObject:
    """Return links and pairs for JSON, in SI units."""
    capsules = [
        {
            "link": each.link,
            "joint": shape.joints[each.link],
            "convex_parts": sum(part.link == each.link for part in shape.convex_parts),
            "capsule": {
                "first": each.first.tolist(),
                "second": each.second.tolist(),
                "radius": each.radius,
            },
            "overhang": each.overhang,
        }
        for each in shape.capsules
    ]
    pairs = [
        {
            "links": [pair.first, pair.second],
            "left_out": pair.left_out,
            "colliding": None if math.isnan(pair.colliding) else pair.colliding,
            "mistaken": None if math.isnan(pair.mistaken) else pair.mistaken,
            "for_solvers": pair.for_solvers,
        }
        for pair in shape.pairs
    ]
    return {"links": capsules, "pairs": pairs}


def _limit_rows(problem: Problem, robot: Robot) -> TextRows:
    """List the limits of every joint; the jerk limit if the problem limits jerks."""
    ends = zip(robot.position_lower, robot.position_upper, strict=True)
    columns = [
        ("position", "rad", [f"{low:.4g} to {high:.4g}" for low, high in ends]),
        ("velocity", "rad/s", [f"{x:.4g}" for x in robot.velocity_limit]),
        ("acceleration", "rad/s^2", [f"{x:.4g}" for x in robot.acceleration_limit]),
        ("jerk", "rad/s^3", [f"{x:.6g}" for x in robot.jerk_limit]),
        ("torque", "N m", [f"{x:.4g}" for x in robot.torque_limit]),
        ("base", "rad", [f"{x:.4g}" for x in robot.home]),
    ]
    shown = [
        (name, *with_units(robot.units(unit), cells))
        for name, unit, cells in columns
        if _shows_jerk(problem) or name != "jerk"
    ]
    return list(zip(("joint", "", *robot.joint_names), *shown, strict=True))


def _source_rows(problem: Problem, robot: Robot) -> TextRows:
    """List who states each limit; that of jerks as in the table of limits."""
    return [
        (name, WORDS[each.basis], each.source)
        for name, each in limit_sources(problem, robot).items()
        if _shows_jerk(problem) or name != "jerk"
    ]


def _shows_jerk(problem: Problem) -> bool:
    """Return whether the limit of jerks is shown: where the problem uses it or states it."""
    return problem.uses_jerk or problem.limits.jerk is not None


def with_units(units: str, cells: Sequence[str]) -> tuple[str, ...]:
    """Return a column of a table: the unit, then a cell per joint.

    Cells have theirs where joints turn and slide.
    """
    each = [unit_of(units, index) for index in range(len(cells))]
    # Equal units are written once, others behind each value.
    if len(set(each)) == 1:
        return f"[{each[0]}]", *cells
    return "", *(f"{cell} {unit}" for cell, unit in zip(cells, each, strict=True))


def title_lines(title: str) -> list[str]:
    """Wrap a title as lines below a name."""
    return wrap(title, LINE_WIDTH - 2, initial_indent="  ", subsequent_indent="  ")


def numbers(obj: Any, *, leave_out: Sequence[str] = ()) -> str:
    """List the keys of an object that was read from a table, with values and units, without those left at nothing."""
    values = [
        (key, getattr(obj, key.name))
        for key in keys(type(obj))
        if key.name not in leave_out
    ]
    # A key at its default is shown if this says something: not for none, 0 and "".
    shown = [(key, value) for key, value in values if value != key.default or value]
    return ", ".join(f"{key.name} {quantity(value, key.unit)}" for key, value in shown)


def quantity(value: Any, unit: str = "1") -> str:
    """Write a value of a recipe with its unit: ``"[0.6, 1.3] m"``."""
    text = _number(value)
    return text if unit == "1" or value in (None, (), "") else f"{text} {unit}"


def _number(value: Any) -> str:
    if isinstance(value, Range):
        return (
            f"[{value.low:.6g}, {value.high:.6g}]"
            if value.low < value.high
            else f"{value.low:.6g}"
        )
    if isinstance(value, PerJoint):
        return _number(value.values)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, tuple) and value:
        # Several ranges are the sides of a box.
        joint = " x " if isinstance(value[0], Range) else ", "
        text = joint.join(_number(item) for item in value)
        return text if joint == " x " else f"({text})"
    return "none" if value in (None, "", ()) else str(value)


def kind_name(item: Stage | Constraint) -> str:
    """Return the name under which the kind of a stage or constraint is registered."""
    group = registry.STAGES if isinstance(item, Stage) else registry.CONSTRAINTS
    return registry.name_of(group, type(item))


def model_to_dict(model: Model) -> JsonObject:
    """Describe a model for JSON: its problem, its network, and whether motions may end with an acceleration."""
    return {
        "kind": "model",
        "problem": model.problem.name,
        "network": str(model.architecture),
        "goal_acceleration": model.goal_acceleration,
    }


def describe_model(facts: JsonObject) -> str:
    """Describe a model in two lines."""
    text = {
        "free": "motions may end with a step of acceleration",
        "given": "motions end with that of the problem, 0 by default",
    }[facts["goal_acceleration"]]
    return (
        f"model of {facts['problem']}: a network of {facts['network']}\n"
        f'  goal_acceleration = "{facts["goal_acceleration"]}": {text}'
    )


def recipe_to_dict(recipe: Recipe) -> JsonObject:
    """Describe a recipe for JSON: everything it refers to resolved, in SI units, with derived values."""
    # A data set has a pipeline, and a pipeline has a problem.
    pipeline = recipe.pipeline if isinstance(recipe, DatasetRecipe) else recipe
    problem = pipeline.problem if isinstance(pipeline, Pipeline) else pipeline
    robot = load_robot(problem)
    kind = {Problem: "problem", Pipeline: "pipeline", DatasetRecipe: "dataset"}[
        type(recipe)
    ]
    content: JsonObject = {
        "kind": kind,
        "file": str(recipe.path),
        "recipe": resolved(recipe),
    }
    if isinstance(pipeline, Pipeline):
        content["recipe_sha256"] = recipe_digest(pipeline)
        content["stages"] = [
            {"use": kind_name(stage), "text": stage.describe()}
            for stage in pipeline.stage
        ]
    content["joints"] = list(robot.joint_names)
    if robot.shape:
        content["shape"] = shape_to_dict(robot.shape) | {
            "hull_gap": problem.robot.hull_gap
        }
    content["limits"] = {
        name: {"unit": robot.units(unit), "values": list(getattr(robot, name))}
        for name, unit in LIMITS.items()
    }
    content["limit_sources"] = {
        name: source.to_dict() for name, source in limit_sources(problem, robot).items()
    }
    content["idle_keys"] = idle_keys(problem)
    if torque := judged_torque(problem.constraint, robot):
        content["torque"] = torque
    return content
