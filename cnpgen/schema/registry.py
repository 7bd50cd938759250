"""Registry of what recipes, commands and options name: the kinds of the core, of add-ons and of installed packages.

A group is a kind of extension with a contract. The core lists its own kinds here;
add-ons and other packages register theirs by entry points of the same groups.
"""

import contextlib
import dataclasses
import functools
import hashlib
import inspect
import pkgutil
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cnpgen.errors import MissingAddonError, RecipeError, nearest
from cnpgen.schema import addons
from cnpgen.schema.entry_points import entry_points

STAGES = "cnpgen.stages"
CONSTRAINTS = "cnpgen.constraints"
OBJECTIVES = "cnpgen.objectives"
EXPORTERS = "cnpgen.exporters"
FAMILIES = "cnpgen.families"
READERS = "cnpgen.readers"
ENGINES = "cnpgen.engines"
DOCUMENTS = "cnpgen.documents"
RULES = "cnpgen.rules"
SHAPES = "cnpgen.shapes"
RECIPES = "cnpgen.recipes"  # types of recipe files; they have no common base class
# Modules with the functions of ``cnpgen.cli.parser.add_command``.
COMMANDS = "cnpgen.commands"

PROJECT = "cnpgen"  # the distribution of core and add-ons

CONTRACTS: dict[str, str] = {  # base class of the kinds of a group
    STAGES: "cnpgen.pipelines.stages.stage:Stage",
    CONSTRAINTS: "cnpgen.problems.constraints.constraint:Constraint",
    OBJECTIVES: "cnpgen.problems.objectives:ObjectiveTerm",
    EXPORTERS: "cnpgen.plans.exporter:Exporter",
    FAMILIES: "cnpgen.pipelines.scene_family:SceneFamily",
    READERS: "cnpgen.problems.scenes.scene_reader:SceneReader",
    ENGINES: "cnpgen.machine.engine:ClusterEngine",
    DOCUMENTS: "cnpgen.store.dataset_document:DatasetDocument",
    RULES: "cnpgen.problems.published_rules:PublishedRules",
    SHAPES: "cnpgen.robots.obstacle_shapes.obstacle_shape:ObstacleShape",
}

BUILT_IN: dict[str, dict[str, str]] = {
    STAGES: {
        "draw-positions": "cnpgen.pipelines.stages.draw:DrawPositions",
        "draw-parameters": "cnpgen.pipelines.stages.draw:DrawParameters",
        "draw-goal": "cnpgen.pipelines.stages.draw:DrawGoal",
        "given-positions": "cnpgen.pipelines.stages.draw:GivenPositions",
        "start-ik": "cnpgen.pipelines.stages.ik:StartIK",
        "goal-ik": "cnpgen.pipelines.stages.ik:GoalIK",
        "hit-angle-to-goal": "cnpgen.pipelines.stages.hit_angle:HitAngleToGoal",
        "hit-angle-in-cone": "cnpgen.pipelines.stages.hit_angle:HitAngleInCone",
        "behind-puck": "cnpgen.pipelines.stages.hit_angle:BehindPuck",
        "home": "cnpgen.pipelines.stages.ik:Home",
        "hitting-configuration": "cnpgen.pipelines.stages.hitting_configuration:HittingConfiguration",
        "hitting-velocity": "cnpgen.pipelines.stages.hitting_velocity:HittingVelocity",
        "at-rest": "cnpgen.pipelines.stages.boundary_motion:AtRest",
        "table-velocity": "cnpgen.pipelines.stages.boundary_motion:TableVelocity",
        "table-acceleration": "cnpgen.pipelines.stages.boundary_motion:TableAcceleration",
        "ballistic-reach": "cnpgen.pipelines.stages.reach:BallisticReach",
        "braking-reach": "cnpgen.pipelines.stages.reach:BrakingReach",
        "collision": "cnpgen.pipelines.stages.collision:Collision",
        "gravity-torque": "cnpgen.pipelines.stages.torque:GravityTorque",
        "draw-scenes": "cnpgen.pipelines.stages.draw_scenes:DrawScenes",
        "scene-ends": "cnpgen.pipelines.stages.scene_ends:SceneEnds",
        "start-on-plan": "cnpgen.make.on_plan:StartOnPlan",
        "goal-of-plan": "cnpgen.make.on_plan:GoalOfPlan",
        "certified-plan": "cnpgen.make.certify:CertifiedPlan",
    },
    CONSTRAINTS: {
        "joint-position": "cnpgen.problems.constraints.joint:JointPosition",
        "joint-velocity": "cnpgen.problems.constraints.joint:JointVelocity",
        "joint-acceleration": "cnpgen.problems.constraints.joint:JointAcceleration",
        "joint-jerk": "cnpgen.problems.constraints.joint:JointJerk",
        "joint-torque": "cnpgen.problems.constraints.joint:JointTorque",
        "table": "cnpgen.problems.constraints.table:Table",
        "plane": "cnpgen.problems.constraints.plane:Plane",
        "line": "cnpgen.problems.constraints.plane:Line",
        "vertical": "cnpgen.problems.constraints.axis:Vertical",
        "axis": "cnpgen.problems.constraints.axis:Axis",
        "pose": "cnpgen.problems.constraints.pose:Pose",
        "tip-speed": "cnpgen.problems.constraints.joint:TipSpeed",
        "robot-clearance": "cnpgen.problems.constraints.clearance:RobotClearance",
        "self-clearance": "cnpgen.problems.constraints.link_clearance:SelfClearance",
        "object-clearance": "cnpgen.problems.constraints.link_clearance:ObjectClearance",
        "object-contact": "cnpgen.problems.constraints.clearance:ObjectContact",
        "puck-contact": "cnpgen.problems.constraints.puck_contact:PuckContact",
    },
    OBJECTIVES: {
        "centrifugal": "cnpgen.problems.objectives:Centrifugal",
        "effort": "cnpgen.problems.objectives:Effort",
        "jerk": "cnpgen.problems.objectives:Jerk",
        "path-length": "cnpgen.problems.objectives:PathLength",
        "tip-reference": "cnpgen.problems.objectives:TipReference",
    },
    SHAPES: {
        "box": "cnpgen.robots.obstacle_shapes.box_shape:BoxShape",
        "sphere": "cnpgen.robots.obstacle_shapes.sphere_shape:SphereShape",
        "cylinder": "cnpgen.robots.obstacle_shapes.cylinder_shape:CylinderShape",
        "capsule": "cnpgen.robots.obstacle_shapes.capsule_shape:CapsuleShape",
        "mesh": "cnpgen.robots.obstacle_shapes.mesh_shape:MeshShape",
    },
    EXPORTERS: {
        "npz": "cnpgen.plans.formats:NumpyArchive",
        "csv": "cnpgen.plans.formats:CsvTables",
        "joint-trajectory": "cnpgen.plans.formats:JointTrajectory",
        "ros2-control": "cnpgen.plans.formats:TrajectoryControllerGoal",
        "parquet": "cnpgen.plans.formats:ParquetTable",
        "mpd": "cnpgen.plans.formats:PathSplines",
    },
}

# Group -> old name -> new name.
RENAMED = {"cnpgen.planners": {"cnp-b": "cnpgen", "cnp-b+refine": "cnpgen+refine"}}


def names(group: str) -> tuple[str, ...]:
    """List the kinds of a group: the built-in ones in their order, then those of installed packages by name."""
    own = BUILT_IN.get(group, {})
    others = {entry.name for entry in addons.installed(group)} - own.keys()
    return (*own, *sorted(others))


def load(group: str, name: str, base: type[Any] | None = None) -> type[Any]:
    """Import the class of a kind by its name in recipes, a concrete subclass of the contract of the group.

    ``base`` is the contract of a group that an add-on defines.

    Raises:
        RecipeError: The kind is unknown, defined twice, or cannot be imported.
        MissingAddonError: The kind belongs to an add-on that this installation lacks.
    """
    noun = noun_of(group)
    sources = _sources(group, name)
    if not sources:
        # A missing add-on raises an error that names it.
        if entry := addons.find(group, name):
            addons.load_entry(entry, f"{noun} {name!r}")
        known = f"known: {', '.join(names(group))}, and those of packages with the entry point group {group!r}"
        raise RecipeError([f"unknown {noun} {name!r}{name_hint(group, name)}; {known}"])
    if len(sources) > 1:
        raise RecipeError(
            [
                f"{noun} {name!r} is defined more than once: by {' and by '.join(sources)}"
            ]
        )
    source, importer = next(iter(sources.items()))
    what = f"{noun} {name!r} of {source}"
    base = base or contract(group)
    try:
        kind: type[Any] = importer()
    except MissingAddonError:
        raise
    except Exception as error:
        # Imported modules may raise any exception.
        raise RecipeError(
            [f"{what} cannot be imported: {type(error).__name__}: {error}"]
        ) from error
    if not (inspect.isclass(kind) and issubclass(kind, base)):
        raise RecipeError(
            [
                f"{what} is not a subclass of {base.__module__}.{base.__name__}, got {kind!r}"
            ]
        )
    if faults := list(_faults(kind)):
        raise RecipeError([f"{what}: {fault}" for fault in faults])
    return kind


def name_hint(group: str, name: str) -> str:
    """Return the new name of a renamed kind, or the most similar name, in parentheses; empty if there is none."""
    renamed = RENAMED.get(group, {}).get(name)
    return (
        nearest(name, names(group))
        if renamed is None
        else f" (its name is now {renamed!r})"
    )


def contract(group: str) -> type[Any]:
    """Import the base class of a group."""
    kind: type[Any] = pkgutil.resolve_name(CONTRACTS[group])
    return kind


def noun_of(group: str) -> str:
    """Return the noun of a group, such as "stage"."""
    return group.removeprefix("cnpgen.").replace("ies", "ys").removesuffix("s")


def group_of(kind: type) -> str:
    """Return the group of a class; empty for other classes."""
    # Names, not classes: the contracts need not be imported.
    bases = {f"{base.__module__}:{base.__qualname__}" for base in kind.__mro__}
    return next((group for group, name in CONTRACTS.items() if name in bases), "")


def name_of(group: str, kind: type) -> str:
    """Return the name under which a class is registered in a group, or ``"module:Class"`` if it is not."""
    spec = f"{kind.__module__}:{kind.__qualname__}"
    for name, built_in in BUILT_IN.get(group, {}).items():
        if built_in == spec:
            return name
    for entry in addons.installed(group):
        with contextlib.suppress(RecipeError):  # ignores broken plug-ins
            if entry.value == spec or load(group, entry.name) is kind:
                return entry.name
    return spec


def source_digest(kind: type) -> str:
    """Hash the source of the package that a plug-in comes from; empty for built-in kinds.

    What a plug-in computes decides rows and kernels as much as its parameters do.
    """
    package = kind.__module__.partition(".")[0]
    return "" if package == "cnpgen" else package_digest(package)


def package_digest(package: str) -> str:
    """Hash the source files of an imported top-level package or module.

    Empty if it has none.
    """
    module = sys.modules.get(package)
    # A namespace package has several.
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    source = getattr(module, "__file__", None)
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    if not folders and source:
        files = [Path(source)]
    return (
        hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
        if files
        else ""
    )


def package_of(group: str, kind: type) -> str:
    """Return the name of the installed package that registers a class.

    Empty for built-in and unregistered ones.
    """
    name = name_of(group, kind)
    return next(
        (
            entry.distribution
            for entry in addons.installed(group)
            if entry.name == name and entry.distribution != PROJECT
        ),
        "",
    )


def package_in(error: BaseException) -> str:
    """Return the installed package of plug-ins in whose code an error was raised.

    Empty if there is none.
    """
    packages = {
        entry.module.partition(".")[0]: entry.distribution
        for entries in entry_points().values()
        for entry in entries
    }
    packages.pop(PROJECT, None)
    modules = [
        frame.f_globals.get("__name__", "")
        for frame, _ in traceback.walk_tb(error.__traceback__)
    ]
    return next(
        (
            packages[top]
            # From the innermost frame outwards.
            for top in (name.partition(".")[0] for name in modules[::-1])
            if top in packages
        ),
        "",
    )


def why_missing(group: str, use: str, package: str) -> str:
    """Return a message with the package of a missing kind, which may be empty if unknown; empty if the kind exists."""
    if use in names(group):
        return ""
    noun = noun_of(group)
    if not package:
        return f"{noun} {use!r} is not installed: install the package that registers it (entry point group {group!r})"
    return (
        f"{noun} {use!r} comes from the package {package!r}, which is not installed:"
        f" run 'pip install {package}', or install it from its source"
    )


def _sources(group: str, name: str) -> dict[str, Callable[[], Any]]:
    """List the packages that define a kind, with import paths."""
    found: dict[str, Callable[[], Any]] = {}
    if name in BUILT_IN.get(group, {}):
        found[PROJECT] = functools.partial(pkgutil.resolve_name, BUILT_IN[group][name])
    for entry in addons.installed(group):
        if entry.name == name:
            package = entry.distribution or "an installed package"
            own = f"the add-on {addons.addon_of(entry.module)!r}"
            source = own if package == PROJECT else f"{package} ({entry.value})"
            found[source] = functools.partial(
                addons.load_entry, entry, f"{noun_of(group)} {name!r}"
            )
    return found


def _faults(kind: type[Any]) -> Iterator[str]:
    """Return the reason why a class cannot be read from a table."""
    if inspect.isabstract(kind):
        yield f"{kind.__name__} is abstract, it does not define {', '.join(sorted(kind.__abstractmethods__))}"
    if "__dataclass_params__" not in vars(kind):
        yield f"{kind.__name__} is not a dataclass"
    for spec in dataclasses.fields(kind):
        if (
            spec.init
            and spec.default is dataclasses.MISSING
            and "doc" not in spec.metadata
        ):
            yield f"the field {spec.name!r} is not declared with cnpgen.plugins.field"
