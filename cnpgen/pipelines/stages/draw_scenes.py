"""Stage: draw scenes from families; several candidates share a scene."""

import gc
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.errors import RecipeError, UsageError
from cnpgen.pipelines.scene_family import Layout, SceneFamily
from cnpgen.pipelines.stages.batch_scenes import batch_scenes
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.problems.constraints.clearance import RobotClearance
from cnpgen.problems.scenes.scene_problem import MAX_BASE_DEPTH_M
from cnpgen.robots.observation.primitives import depths_of_origin, table_primitives
from cnpgen.robots.scene import sample_obstacles
from cnpgen.schema import registry
from cnpgen.schema.keys import field
from cnpgen.store.scene_table import OBSTACLE_KINDS, SceneTable

TOO_MANY = "scene with more obstacles than the capacity"
AT_BASE = "obstacle at the robot's base"


@dataclass(frozen=True, kw_only=True)
class DrawScenes(Stage):
    """Stage: draw scenes from families with given shares.

    Consecutive candidates share a scene.
    """

    draws_scenes = True
    capacity: dict[str, int] = field(
        "largest numbers of obstacles of a scene by kind: box, sphere, cylinder, capsule",
        low=1,
        high=60,
        pattern=f"^({'|'.join(OBSTACLE_KINDS)})$",
    )
    per_scene: int = field(
        "candidates of a scene, on average in each batch", default=10, low=1, high=4096
    )
    family: tuple[SceneFamily, ...] = field(
        "families of the scenes", form="[[stage.family]] tables"
    )

    @property
    def family_names(self) -> tuple[str, ...]:
        """Registered names of the families, in order."""
        return tuple(
            registry.name_of(registry.FAMILIES, type(family)) for family in self.family
        )

    def describe(self) -> str:
        shares = self._shares()
        each = (
            f"{name} {100 * share:.3g} %"
            for name, share in zip(self.family_names, shares, strict=True)
        )
        return f"draw scenes for {self.per_scene} candidates each ({', '.join(each)})"

    def writes(self, context: Context) -> tuple[str, ...]:
        return ("scene",)

    def prepare(self, context: Context) -> StageFunction:
        self._check(context)
        obstacles = context.problem.obstacle
        shares = self._shares()
        capacity = sum(self.capacity.values())

        def work(candidates: CandidateBatch, random: np.random.Generator) -> None:
            count = max(round(candidates.size / self.per_scene), 1)
            # Each scene has its own seed: a family that draws more numbers changes no
            # other scene.
            seeds = random.integers(0, 2**63, count).tolist()
            families = random.choice(len(shares), count, p=shares).tolist()
            with _paused_garbage_collection():
                layouts = [
                    self.family[family].draw(np.random.Generator(np.random.SFC64(seed)))
                    for family, seed in zip(families, seeds, strict=True)
                ]
            fits = np.array([self._fits(layout) for layout in layouts], bool)
            # A scene with too many obstacles is replaced by an empty one and its
            # candidates rejected.
            kept = [
                layout if fit else Layout((), ())
                for layout, fit in zip(layouts, fits, strict=True)
            ]
            candidates.scenes = batch_scenes(
                kept, families, obstacles, capacity, context.dtype
            )
            # Consecutive candidates share a scene; indices ascend, as ``are_clear``
            # requires.
            scene = candidates.alive * count // candidates.size
            candidates["scene"] = scene[None].astype(float)
            free = base_depths(candidates.scenes.table) <= MAX_BASE_DEPTH_M
            of_scene = np.stack([fits, free])
            candidates.reject_first(of_scene[:, candidates.scene], [TOO_MANY, AT_BASE])

        return work

    def complete(self, context: Context, given: Collection[str]) -> StageFunction:
        """Refuse tasks: their obstacles are those of the problem."""
        name = context.problem.name
        raise UsageError(
            f"tasks have no scenes: complete poses among the obstacles of the problem {name!r}, or use a scene file",
            concerns="recipe",
        )

    def _shares(self) -> Array:
        shares = np.array([family.share for family in self.family])
        # A sum of 0 is refused in ``_check``; here it only must not divide by zero.
        return np.asarray(shares / max(shares.sum(), 1e-300))

    def _fits(self, layout: Layout) -> bool:
        counts = Counter(obstacle.kind for obstacle in layout.obstacles)
        return all(
            count <= self.capacity.get(kind, 0) for kind, count in counts.items()
        )

    def _check(self, context: Context) -> None:
        """Raise RecipeError if the problem cannot have these scenes."""
        problem = context.problem
        errors = list[str]()
        places = {
            kind: len(parked)
            for kind, parked in sample_obstacles(problem.obstacle).items()
            if parked
        }
        if places != self.capacity:
            errors.append(
                f"capacity: the problem has places for {places or 'no obstacles of samples'}, expected"
                f" {self.capacity}: load the pipeline from a file, which adds them"
            )
        if any(obstacle.below for obstacle in problem.obstacle):
            errors.append(
                "obstacles below the object are not supported in scenes: give them a height"
            )
        if context.robot.shape is None or problem.first(RobotClearance) is None:
            errors.append(
                'needs a constraint robot-clearance and geometry = "urdf" in [robot] of the problem'
            )
        if not any(family.share for family in self.family):
            errors.append("family: all shares are 0, expected at least one larger")
        if errors:
            raise RecipeError(errors)


@contextmanager
def _paused_garbage_collection() -> Iterator[None]:
    """Pause the search for reference cycles: thousands of new obstacles have none, and it takes a fifth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def base_depths(table: SceneTable) -> Array:
    """Return the depth of the robot's base, the origin, in the obstacles of each scene [m], negative outside."""
    return np.asarray(depths_of_origin(table_primitives(table)).max(axis=1))
