"""Stage: collisions of the arm and the held object with the obstacles, judged by Coal on both ends.

A test of every capsule's segment against every obstacle comes first, exact for boxes, and rejects almost all collisions
cheaply; Coal then judges every sample that is left. Obstacles may move with the sample, so each becomes a sliding joint
of the Pinocchio model: one call checks a whole round without any Python per sample.

A robot with a shape is covered by its capsules: samples whose capsules are clear are kept, of all others Coal decides
with the convex pieces of the links.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import RecipeError
from cnpgen.kernels.symbolic.linalg import symbols
from cnpgen.kernels.symbolic.solids import symbolic_solids
from cnpgen.kernels.symbolic.state import SymbolicState
from cnpgen.pipelines.context import Context
from cnpgen.pipelines.stages.stage import Array, Round, Stage, Work
from cnpgen.problems.constraints.clearance import ObjectContact, RobotClearance
from cnpgen.problems.obstacles import obstacle_tops
from cnpgen.problems.problem import Problem
from cnpgen.robots.shape.hull import coal_hull
from cnpgen.robots.shape.shape import Shape
from cnpgen.robots.solid import Box, Solid, count_numbers, height_places, place_obstacles, solids_of
from cnpgen.schema.keys import field
from cnpgen.store.field import Field

if TYPE_CHECKING:
    from cnpgen.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class Collision(Stage):
    """Rejects configurations where the arm or the object enters an obstacle."""

    end: str = field("which end is looked at", choices=("start", "goal", "both"))
    judge: str = field("what decides: the exact segment test alone, or Coal after it", choices=("segments", "coal"))

    @property
    def needs(self) -> tuple[str, ...]:
        """Configurations, and the positions that the obstacles stand below."""
        return (*(f"{end}_q" for end in self._ends()), "start_xyz", "goal_xyz")

    def describe(self) -> str:
        """Say who judges what."""
        ends = "both ends" if self.end == "both" else f"the {self.end} configuration"
        how = "by an exact segment-to-box test" if self.judge == "segments" else "judged by Coal on arm and object"
        return f"require {ends} to be free of collision, {how}"

    def provides(self, context: Context) -> tuple[Field, ...]:
        """The clearance, where the segment test computes it."""
        if self.judge == "coal" or context.robot.shape is not None:
            return ()
        text = "distance of the arm's skeleton from the nearest obstacle at the {}, less the capsules' radius"
        return tuple(Field(f"{end}_clearance", "m", text.format(end), role="diagnostic") for end in self._ends())

    def prepare(self, context: Context) -> Work:
        """Load the kernel or build the geometry."""
        clearance = context.constraint(RobotClearance)
        if context.robot.shape is not None:
            return self._by_pieces(context, clearance.distance)
        radius = clearance.radius or 0.0
        if self.judge == "coal":
            return self._by_coal(context, radius + clearance.distance)
        return self._by_segments(context, radius, clearance.distance)

    def _ends(self) -> tuple[str, ...]:
        return ("start", "goal") if self.end == "both" else (self.end,)

    def _by_segments(self, context: Context, radius: float, least: float) -> Work:
        kernel = context.kernels.load(skeleton_distance)

        def work(draws: Round, _random: np.random.Generator) -> None:
            for end in self._ends():
                (distance,) = kernel(draws[f"{end}_q"], sample_tops(context.problem, draws))
                draws[f"{end}_clearance"] = distance - radius
                draws.reject(distance[0] > radius + least, f"arm in collision at the {end}")

        return work

    def _by_pieces(self, context: Context, distance: float) -> Work:
        kernel = context.kernels.load(capsule_clearance)
        with_object = self.judge == "coal"
        depth = context.constraint(ObjectContact).depth if with_object else 0.0
        problem = context.problem if with_object else replace(context.problem, object=None)
        judge = coal_judge(problem, context.robot, distance, depth)

        def work(draws: Round, _random: np.random.Generator) -> None:
            for end in self._ends():
                q, tops = draws[f"{end}_q"], sample_tops(context.problem, draws)
                doubtful = np.ones(q.shape[1], bool)
                if not with_object:
                    (clearance,) = kernel(q, tops)
                    doubtful = ~(clearance[0] > distance)
                hit = np.zeros(q.shape[1], bool)
                if doubtful.any():
                    hit[doubtful] = judge(q[:, doubtful], tops[:, doubtful])
                draws.reject(~hit, f"arm in collision at the {end}")

        return work

    def _by_coal(self, context: Context, radius: float) -> Work:
        depth = context.constraint(ObjectContact).depth
        judge = coal_judge(context.problem, context.robot, radius, depth)

        def work(draws: Round, _random: np.random.Generator) -> None:
            tops = sample_tops(context.problem, draws)
            hit = judge(
                np.concatenate([draws[f"{end}_q"] for end in self._ends()], axis=1), np.tile(tops, len(self._ends()))
            )
            draws.reject(~hit.reshape(len(self._ends()), -1).any(0), "collision (Coal)")

        return work


def sample_tops(problem: Problem, draws: Round) -> Array:
    """Where the obstacles are for every draw, as ``obstacle_tops`` says, shape (numbers, n)."""
    return np.ascontiguousarray(obstacle_tops(problem, draws["start_xyz"].T, draws["goal_xyz"].T).T)


def skeleton_distance(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, tops) -> smallest distance of a segment of the skeleton from an obstacle`` [m]."""
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", count_numbers(problem.obstacle))
    zero = [0.0] * robot.n
    state = SymbolicState(robot, q, zero, zero, tops, problem.obstacle, None)
    nearest = ca.SX(np.inf)
    for first, second in state.segments:
        for solid in symbolic_solids(state):
            nearest = ca.fmin(nearest, solid.distance(first, second))
    return ca.Function("skeleton_distance", [q_sx, tops_sx], [nearest])


def capsule_clearance(robot: "Robot", problem: Problem) -> Any:
    """Build ``(q, tops) -> smallest distance of a link's capsule from an obstacle`` [m], minus the radius at most."""
    import casadi as ca

    (q_sx, q), (tops_sx, tops) = symbols("q", robot.n), symbols("tops", count_numbers(problem.obstacle))
    zero = [0.0] * robot.n
    state = SymbolicState(robot, q, zero, zero, tops, problem.obstacle, None)
    moving = robot.shape.moving_capsules if robot.shape else ()
    nearest = ca.SX(np.inf)
    for first, second, radius in (state.capsules[capsule.link] for capsule in moving):
        for solid in symbolic_solids(state):
            nearest = ca.fmin(nearest, solid.distance(first, second) - radius)
    return ca.Function("capsule_clearance", [q_sx, tops_sx], [nearest])


def coal_judge(problem: Problem, robot: "Robot", radius: float, depth: float) -> Any:
    """Return a function ``(q (n, N), tops (obstacles, N)) -> collides (N,)`` that asks Coal.

    The arm is capsules of the radius, or the pieces of its shape, thicker by the radius. The held object is made
    smaller by ``depth`` on every side: the contact that is legal does not count, and the touching pair, the slowest
    case of Coal's algorithms, becomes a clear one.
    """
    import coal
    import pinocchio as pin

    model = robot.model.copy()
    geometry = pin.GeometryModel()
    moving = _add_pieces(geometry, robot.shape, radius) if robot.shape else _add_capsules(geometry, robot, radius)
    if problem.object is not None:
        size = np.array(problem.object.size) - 2 * depth
        frame = model.frames[robot.tip_frame]
        box = pin.GeometryObject("object", frame.parentJoint, 0, frame.placement, coal.Box(*size))
        moving.append(geometry.addGeometryObject(box))
    numbers, heights = place_obstacles(problem.obstacle), height_places(problem.obstacle)
    numbers[heights] = 0.0
    solids = solids_of(problem.obstacle, numbers)
    for index, (obstacle, solid) in enumerate(zip(problem.obstacle, solids, strict=True)):
        x, y, z = solid.position
        slide = model.addJoint(0, pin.JointModelPZ(), pin.SE3(np.eye(3), np.array([x, y, 0.0])), f"obstacle_{index}")
        below = pin.SE3(np.eye(3), np.array([0.0, 0.0, z]))
        added = geometry.addGeometryObject(pin.GeometryObject(obstacle.name, slide, 0, below, _coal_shape(solid)))
        for body in moving:
            geometry.addCollisionPair(pin.CollisionPair(body, added))
    pool = pin.GeometryPool(model, geometry, 1)

    def judge(q: Array, tops: Array) -> NDArray[np.bool_]:
        states = np.asfortranarray(np.concatenate([q, tops[heights]]))
        return np.asarray(pin.computeCollisionsInParallel(1, pool, states, True)).astype(bool)

    return judge


def _coal_shape(solid: Solid) -> Any:
    import coal

    if isinstance(solid, Box):
        return coal.Box(*np.ptp(solid.corners, axis=0))
    hull = coal_hull(solid.corners)
    hull.setSweptSphereRadius(solid.radius)
    return hull


def _add_pieces(geometry: Any, shape: Shape, distance: float) -> list[int]:
    """Add the pieces of a robot's shape that move, thicker by a distance [m]."""
    import pinocchio as pin

    added: list[int] = []
    for piece in shape.moving_pieces:
        hull, name = coal_hull(piece.vertices), f"{piece.link}_{len(added)}"
        hull.setSweptSphereRadius(piece.radius + distance)
        solid = pin.GeometryObject(name, shape.joints[piece.link], 0, pin.SE3.Identity(), hull)
        added.append(geometry.addGeometryObject(solid))
    return added


def _add_capsules(geometry: Any, robot: "Robot", radius: float) -> list[int]:
    """Add one capsule per segment of the skeleton, attached to the joint that moves it."""
    import coal
    import pinocchio as pin

    if any(joint.prismatic for joint in robot.chain.joints):
        raise RecipeError(['judge: "coal" needs revolute joints: links that slide change length'])
    model = robot.model
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    origins = [data.oMi[i].translation.copy() for i in range(1, model.njoints)]
    origins.append(data.oMf[robot.tip_frame].translation.copy())
    added = []
    for a, b in robot.skeleton:
        joint = b  # the body that carries origin b; the joints between a and b lie on the segment's line
        first, second = data.oMi[joint].actInv(origins[a]), data.oMi[joint].actInv(origins[b])
        length = float(np.linalg.norm(second - first))
        turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), (second - first) / length).toRotationMatrix()
        placement = pin.SE3(turn, (first + second) / 2)
        capsule = pin.GeometryObject(f"capsule_{a}_{b}", joint, 0, placement, coal.Capsule(radius, length))
        added.append(geometry.addGeometryObject(capsule))
    return added
