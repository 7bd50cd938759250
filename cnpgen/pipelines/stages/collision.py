"""Stage: collisions of the arm and the held object with the obstacles, checked at both ends.

The broad phase tests the capsule axes against every obstacle, exactly for boxes, and
rejects most collisions cheaply. Coal checks the remaining candidates. Obstacles may
differ between candidates, so each is a sliding joint of the Pinocchio model: one call
checks a whole batch without Python code per candidate.

For a robot with a shape, candidates with clearance of all capsules are kept. Coal
checks the others with the convex parts of the links.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cnpgen.arrays import Array, Mask
from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.obstacle_distances import symbolic_solids
from cnpgen.kernels.symbolic.symbolic_state import SymbolicState
from cnpgen.pipelines.stages.stage import CandidateBatch, Context, Stage, StageFunction
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.obstacles import scene_of, table_frame_of
from cnpgen.problems.problem import Problem
from cnpgen.robots.obstacle_shapes.convex_solid import Box, Solid
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.hull import coal_hull
from cnpgen.robots.shape.shape import Shape
from cnpgen.robots.solid import height_places, place_obstacles, solids_of
from cnpgen.schema.keys import field
from cnpgen.store.field import Field, Fields


@dataclass(frozen=True, kw_only=True)
class Collision(Stage):
    """Stage: reject configurations with a collision of the arm or the held object with an obstacle."""

    end: str = field("end that is checked", choices=("start", "goal", "both"))
    judge: str = field(
        "decision by the exact segment test alone, or also by Coal",
        choices=("segments", "coal"),
    )

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*(f"{end}_q" for end in self._ends()), "start_xyz", "goal_xyz")

    def describe(self) -> str:
        ends = "both ends" if self.end == "both" else f"the {self.end} configuration"
        how = (
            "by an exact segment-to-box test"
            if self.judge == "segments"
            else "checked by Coal with arm and object"
        )
        return f"require {ends} to be free of collision, {how}"

    def outputs(self, context: Context) -> Fields:
        if self.judge == "coal" or context.robot.shape is not None:
            return ()
        text = "distance of the arm's capsule axes from the nearest obstacle at the {}, less the capsules' radius"
        return tuple(
            Field(f"{end}_clearance", "m", text.format(end), role="diagnostic")
            for end in self._ends()
        )

    def prepare(self, context: Context) -> StageFunction:
        clearance = context.constraint(RobotClearance)
        if context.robot.shape is not None:
            return self._by_convex_parts(context, clearance.distance)
        # Without geometry of links the robot is the paper's capsules.
        radius = clearance.radius or 0.0
        if self.judge == "coal":
            return self._by_coal(context, radius + clearance.distance)
        return self._by_segments(context, radius, clearance.distance)

    def _ends(self) -> tuple[str, ...]:
        return ("start", "goal") if self.end == "both" else (self.end,)

    def _by_segments(
        self, context: Context, radius: float, clearance: float
    ) -> StageFunction:
        kernel = context.kernels.load_by_structure(capsule_axes_distance)

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            for end in self._ends():
                (distance,) = kernel(
                    candidates[f"{end}_q"], candidate_poses(context.problem, candidates)
                )
                candidates[f"{end}_clearance"] = distance - radius
                candidates.reject(
                    distance[0] > radius + clearance, f"arm in collision at the {end}"
                )

        return work

    def _by_convex_parts(self, context: Context, distance: float) -> StageFunction:
        kernel = context.kernels.load_by_structure(capsule_clearance)
        with_object = self.judge == "coal"
        # Without Coal the stage checks the links only.
        depth = _contact_depth(context) if with_object else 0.0
        problem = (
            context.problem if with_object else replace(context.problem, object=None)
        )
        judge = coal_judge(problem, context.robot, distance, depth)

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            for end in self._ends():
                q = candidates[f"{end}_q"]
                obstacle_poses = candidate_poses(context.problem, candidates)
                remaining = np.ones(q.shape[1], bool)
                if not with_object:
                    (clearance,) = kernel(q, obstacle_poses)
                    # Capsules with clearance contain parts with clearance, so only the
                    # others need Coal.
                    remaining = ~(clearance[0] > distance)
                hit = np.zeros(q.shape[1], bool)
                if remaining.any():
                    hit[remaining] = judge(
                        q[:, remaining], obstacle_poses[:, remaining]
                    )
                candidates.reject(~hit, f"arm in collision at the {end}")

        return work

    def _by_coal(self, context: Context, radius: float) -> StageFunction:
        depth = _contact_depth(context)
        judge = coal_judge(context.problem, context.robot, radius, depth)

        def work(candidates: CandidateBatch, _random: np.random.Generator) -> None:
            obstacle_poses = candidate_poses(context.problem, candidates)
            # Both ends of all candidates in one call of Coal.
            hit = judge(
                np.concatenate(
                    [candidates[f"{end}_q"] for end in self._ends()], axis=1
                ),
                np.tile(obstacle_poses, len(self._ends())),
            )
            candidates.reject(
                ~hit.reshape(len(self._ends()), -1).any(0), "collision (Coal)"
            )

        return work


def _contact_depth(context: Context) -> float:
    """Return the depth of legal contacts of the held object [m].

    0 if the problem has none.
    """
    return (
        0.0
        if context.problem.object is None
        else context.constraint(ObjectContact).depth
    )


def candidate_poses(problem: Problem, candidates: CandidateBatch) -> Array:
    """Return the scene of every candidate, shape (width, n): poses of the obstacles, and the puck of a hit."""
    goal = candidates["goal_xyz"].T
    angle = candidates.columns.get("hit_angle")
    direction = np.zeros(goal.shape)
    if angle is not None:
        # Columns that are not finite are rejected.
        with np.errstate(invalid="ignore"):
            direction[:, :2] = np.concatenate([np.cos(angle), np.sin(angle)]).T
    poses = (
        None if candidates.scenes is None else candidates.scenes.poses[candidates.scene]
    )
    parameters = candidates["parameters"].T if problem.parameters else None
    if (frame := table_frame_of(problem, parameters)) is not None:
        direction = frame.along_world(direction)
    return scene_of(
        problem,
        candidates["start_xyz"].T,
        goal,
        direction,
        parameters,
        obstacle_poses=poses,
    ).lanes


def capsule_axes_distance(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, obstacle_poses) -> minimum distance of a capsule axis from an obstacle`` [m]."""
    return _minimum_distance(
        "capsule_axes_distance",
        robot,
        problem,
        lambda state: [(*x, 0.0) for x in state.segments],
    )


def capsule_clearance(robot: Robot, problem: Problem) -> Any:
    """Build ``(q, obstacle_poses) -> minimum distance of link capsules from obstacles`` [m], at least -radius."""
    links = (
        [capsule.link for capsule in robot.shape.moving_capsules] if robot.shape else []
    )
    return _minimum_distance(
        "capsule_clearance",
        robot,
        problem,
        lambda state: [state.capsules[link] for link in links],
    )


def _minimum_distance(
    name: str,
    robot: Robot,
    problem: Problem,
    capsules: Callable[[SymbolicState], list[Any]],
) -> Any:
    """Build the minimum distance of capsules (first point, second point, radius) from the obstacles [m]."""
    import casadi as ca

    q_sx, q = symbols("q", robot.n)
    poses_sx, poses = symbols("obstacle_poses", problem.scene_width)
    zero = [0.0] * robot.n
    state = SymbolicState(robot, q, zero, zero, poses, problem.obstacle, None)
    nearest = ca.SX(np.inf)
    for first, second, radius in capsules(state):
        for solid in symbolic_solids(state):
            nearest = ca.fmin(nearest, solid.distance(first, second) - radius)
    return ca.Function(name, [q_sx, poses_sx], [nearest])


def coal_judge(problem: Problem, robot: Robot, radius: float, depth: float) -> Any:
    """Return a collision check with Coal, ``(q (n, N), obstacle_poses (width, N)) -> collides (N,)``.

    The arm consists of capsules of the radius, or of its convex parts, inflated by the
    radius. The held object is smaller by ``depth`` on every side. Legal contact is
    therefore not a collision, and Coal avoids the touching pair, the most expensive
    case of its algorithms.
    """
    import coal
    import pinocchio as pin

    model = robot.model.copy()
    geometry = pin.GeometryModel()
    moving = (
        _add_convex_parts(geometry, robot.shape, radius)
        if robot.shape
        else _add_capsules(geometry, robot, radius)
    )
    if problem.object is not None:
        # Legal contacts are at most this deep on each side: a box smaller by the depth
        # must be free.
        size = np.array(problem.object.size) - 2 * depth
        frame = model.frames[robot.tip_frame]
        box = pin.GeometryObject(
            "object", frame.parentJoint, 0, frame.placement, coal.Box(*size)
        )
        moving.append(geometry.addGeometryObject(box))
    heights = _add_obstacles(model, geometry, problem, moving)
    pool = pin.GeometryPool(model, geometry, 1)

    def judge(q: Array, obstacle_poses: Array) -> Mask:
        # Positions of the sliding joints of the obstacles follow those of the robot.
        states = np.asfortranarray(np.concatenate([q, obstacle_poses[heights]]))
        return np.asarray(
            pin.computeCollisionsInParallel(1, pool, states, True)
        ).astype(bool)

    return judge


def _add_obstacles(
    model: Any, geometry: Any, problem: Problem, moving: list[int]
) -> list[int]:
    """Add the obstacles, each on a vertical slide, and their pairs with the moving bodies.

    Return the columns of the scene that are positions of the slides.
    """
    import pinocchio as pin

    # Heights are the positions of sliding joints, so one model serves all candidates.
    poses = place_obstacles(problem.obstacle)
    heights = height_places(problem.obstacle)
    poses[heights] = 0.0
    solids = solids_of(problem.obstacle, poses)
    for index, (obstacle, solid) in enumerate(
        zip(problem.obstacle, solids, strict=True)
    ):
        x, y, z = solid.position
        slide = model.addJoint(
            0,
            pin.JointModelPZ(),
            pin.SE3(np.eye(3), np.array([x, y, 0.0])),
            f"obstacle_{index}",
        )
        below = pin.SE3(np.eye(3), np.array([0.0, 0.0, z]))
        added = geometry.addGeometryObject(
            pin.GeometryObject(obstacle.name, slide, 0, below, _coal_shape(solid))
        )
        for body in moving:
            geometry.addCollisionPair(pin.CollisionPair(body, added))
    return heights


def _coal_shape(solid: Solid) -> Any:
    import coal

    if isinstance(solid, Box):
        return coal.Box(*np.ptp(solid.corners, axis=0))
    hull = coal_hull(solid.corners)
    hull.setSweptSphereRadius(solid.radius)
    return hull


def _add_convex_parts(geometry: Any, shape: Shape, distance: float) -> list[int]:
    """Add the moving convex parts of a robot, inflated by a distance [m]."""
    import pinocchio as pin

    added: list[int] = []
    for part in shape.moving_convex_parts:
        hull = coal_hull(part.vertices)
        name = f"{part.link}_{len(added)}"
        # A body inflated by the distance collides exactly if the distance is not kept.
        hull.setSweptSphereRadius(part.radius + distance)
        solid = pin.GeometryObject(
            name, shape.joints[part.link], 0, pin.SE3.Identity(), hull
        )
        added.append(geometry.addGeometryObject(solid))
    return added


def _add_capsules(geometry: Any, robot: Robot, radius: float) -> list[int]:
    """Add one capsule per capsule axis, attached to the joint that moves it."""
    import coal
    import pinocchio as pin

    if any(joint.prismatic for joint in robot.chain.joints):
        raise RecipeError(
            ['judge: "coal" needs revolute joints: links that slide change length']
        )
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    # At the neutral state: lengths of the links do not depend on it.
    origins = [data.oMi[i].translation.copy() for i in range(1, model.njoints)]
    origins.append(data.oMf[robot.tip_frame].translation.copy())
    added = []
    for a, b in robot.capsule_axes:
        # The body that carries origin b; the joints between a and b lie on the
        # segment's line.
        joint = b
        first = data.oMi[joint].actInv(origins[a])
        second = data.oMi[joint].actInv(origins[b])
        length = float(np.linalg.norm(second - first))
        turn = pin.Quaternion.FromTwoVectors(
            np.array([0.0, 0.0, 1.0]), (second - first) / length
        ).toRotationMatrix()
        # Capsules of Coal are along z about their center.
        placement = pin.SE3(turn, (first + second) / 2)
        capsule = pin.GeometryObject(
            f"capsule_{a}_{b}", joint, 0, placement, coal.Capsule(radius, length)
        )
        added.append(geometry.addGeometryObject(capsule))
    return added
