"""Observe scenes: point clouds, camera views, signed distances, basis points and object tokens."""

from __future__ import annotations

from collections.abc import Sequence

from cnpgen.arrays import Columns
from cnpgen.errors import UsageError
from cnpgen.machine.threads import one_thread
from cnpgen.problems.scenes.scene_problem import SceneProblem
from cnpgen.robots.observation.observations import Observation, as_observation
from cnpgen.robots.observation.primitives import Primitives, scene_primitives
from cnpgen.robots.observation.surface_points import scene_seeds
from cnpgen.robots.obstacle import Obstacle, invalid_obstacle
from cnpgen.robots.scene import Scene
from cnpgen.schema.argument_types import checked_arguments
from cnpgen.schema.arguments import integer

Scenes = Scene | Primitives | SceneProblem | Sequence[SceneProblem | Sequence[Obstacle]]
MAX_SEED = 2**63 - 1


@checked_arguments
@one_thread()
def observe(
    scenes: Scenes,
    kind: str | Observation,
    *,
    seed: int = 0,
) -> Columns:
    """Observe N scenes.

    Args:
        scenes: N scene problems or sequences of obstacles, one scene problem, the
            scenes of plans or tasks, or their bodies (``scene_bodies``), which saves
            the conversion of scenes that are observed repeatedly.
        kind: "cloud", "camera", "distances", "basis" or "tokens", or an observation
            with parameters, such as ``SurfaceCloud(points=1024)``.
        seed: Seed of the points of clouds.

    Returns:
        Name -> array with a first axis of length N; see the kinds of observations.

    Raises:
        UsageError: There is no such observation, an obstacle is a mesh file, or there
            are no scenes.
        MachineError: The compiled code is missing.
    """
    from cnpgen.kernels.observation.compiled_observations import observation_backend

    observation = as_observation(kind)
    seed = integer("seed", seed, least=0, most=MAX_SEED)
    bodies = scene_bodies(scenes)
    return observation.observe(
        bodies, scene_seeds(seed, len(bodies)), observation_backend()
    )


def scene_bodies(scenes: Scenes) -> Primitives:
    """Return the bodies of N scenes, as ``observe`` takes them.

    Args:
        scenes: See ``observe``.

    Obstacles that are all in the frame of one link stay in that frame.

    Raises:
        UsageError: An obstacle is a mesh file, there are no scenes, or the obstacles of
            a scene are in several frames.
    """
    if isinstance(scenes, Primitives):
        return scenes
    if isinstance(scenes, SceneProblem):
        scenes = [scenes]
    if not isinstance(scenes, Scene | list | tuple):
        raise UsageError(
            f"must be scenes, got {type(scenes).__name__}", argument="scenes"
        )
    if len(scenes) == 0:
        raise UsageError("there are no scenes", concerns="scenes")
    if isinstance(scenes, Scene):
        return scene_primitives(scenes)
    # Poses in several frames have no common origin without the kinematics of the robot.
    for scene in scenes:
        if (
            isinstance(scene, SceneProblem)
            and len(set(scene.request.obstacle_frames)) > 1
        ):
            raise UsageError(
                f"{scene.place} has obstacles in several frames, which need the robot: see placed_scene",
                concerns="scenes",
            )
    bodies = [
        scene.obstacles if isinstance(scene, SceneProblem) else scene
        for scene in scenes
    ]
    for scene, obstacles in enumerate(bodies):
        if not isinstance(obstacles, list | tuple) or not all(
            isinstance(body, Obstacle) for body in obstacles
        ):
            raise UsageError(
                f"must contain scene problems or obstacles, not so at scene {scene}",
                argument="scenes",
            )
        if error := invalid_obstacle(obstacles):
            raise UsageError(f"scene {scene}: {error}", concerns="scenes")
    return scene_primitives(bodies)
