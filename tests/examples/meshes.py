"""An independent look at collisions: Pinocchio and Coal on a URDF's own geometry, its meshes as they are."""

import re
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import scipy

from cnpgen.plans import Plans
from cnpgen.problems.problem import Problem
from cnpgen.robots.chain import LINK_SUFFIX, name_links_uniquely
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from tests.examples.obstacles import coal_obstacle


class Meshes:
    """A robot as Pinocchio reads it from its file, and what it holds, among the problem's obstacles, all fixed.

    Args:
        problem: The problem, just read from its file.
        robot: Its robot; of its shape only the excluded pairs are used.
        packages: Where ``package://`` begins.
    """

    def __init__(self, problem: Problem, robot: Robot, packages: Path) -> None:
        beside = f'filename="{problem.urdf_path.parent}/'
        text = re.sub(
            r'filename="(?!package:|/)', beside, problem.urdf_path.read_text()
        )
        full = pin.buildModelFromXML(text)
        geometry = pin.buildGeomFromUrdfString(
            full, text, pin.COLLISION, package_dirs=[str(packages)]
        )
        name_links_uniquely(full)
        locked = [
            full.getJointId(name)
            for name in full.names[1:]
            if name not in robot.joint_names
        ]
        self.model, (self.geometry,) = pin.buildReducedModel(
            full, [geometry], locked, pin.neutral(full)
        )
        objects = (
            self.geometry.geometryObjects
        )  # places of memory that are given up when objects are added
        links = [
            (
                each.parentJoint,
                self.model.frames[each.parentFrame].name.removesuffix(LINK_SUFFIX),
            )
            for each in objects
        ]
        moving = [i for i, (joint, _) in enumerate(links) if joint > 0]
        moving += [] if problem.object is None else [self._hold(problem)]
        for obstacle in problem.obstacle:
            self._add(obstacle, moving)
        self.with_obstacles = len(self.geometry.collisionPairs)
        left_out = {
            frozenset((pair.first, pair.second))
            for pair in robot.shape.pairs
            if pair.left_out
        }
        for i, (one, name) in enumerate(links):
            for j, (other, its_name) in enumerate(links[:i]):
                if one != other and frozenset((name, its_name)) not in left_out:
                    self.geometry.addCollisionPair(pin.CollisionPair(j, i))
        self.data, self.results = self.model.createData(), self.geometry.createData()
        for request in self.results.distanceRequests:
            request.gjk_tolerance = 1e-9

    def _hold(self, problem: Problem) -> int:
        """Put the held cuboid about the tip, as the problem's keys say; it may touch what holds it."""
        frame = self.model.frames[self.model.getFrameId(problem.robot.tip)]
        turn = scipy.spatial.transform.Rotation.from_euler(
            "xyz", problem.robot.tip_rotation
        ).as_matrix()  # about fixed axes
        pose = frame.placement * pin.SE3(turn, np.array(problem.robot.tip_offset))
        held = pin.GeometryObject(
            "what is held", frame.parentJoint, pose, coal.Box(*problem.object.size)
        )
        return int(self.geometry.addGeometryObject(held))

    def _add(self, obstacle: Obstacle, moving: list[int]) -> None:
        solid, place = coal_obstacle(obstacle)
        pose = pin.SE3(place.getRotation(), place.getTranslation())
        index = self.geometry.addGeometryObject(
            pin.GeometryObject(obstacle.name, 0, pose, solid)
        )
        for each in moving:
            self.geometry.addCollisionPair(pin.CollisionPair(each, index))

    def distances(self, q: np.ndarray) -> tuple[float, float]:
        """The smallest distance from obstacles, and between links, at a state [m]."""
        pin.computeDistances(
            self.model, self.data, self.geometry, self.results, self._state(q)
        )
        found = [result.min_distance for result in self.results.distanceResults]
        return min(found[: self.with_obstacles], default=np.inf), min(
            found[self.with_obstacles :], default=np.inf
        )

    def touches(self, q: np.ndarray) -> bool:
        """Return whether any pair collides at a state."""
        return bool(
            pin.computeCollisions(
                self.model, self.data, self.geometry, self.results, self._state(q), True
            )
        )

    def _state(self, q: np.ndarray) -> np.ndarray:
        """Return joint positions as Pinocchio's, which are cosine and sine for continuous joints."""
        return np.asarray(pin.integrate(self.model, pin.neutral(self.model), q))


def states(plans: Plans, index: int, step: float = 1e-3) -> np.ndarray:
    """Joint positions of a plan every ``step`` seconds [rad], shape (K, n), by SciPy's splines."""
    path, rate, degree = (
        plans.path_control_points[index],
        plans.rate_control_points[index],
        plans.degree,
    )
    p, r = (
        scipy.interpolate.BSpline(
            np.concatenate(
                [[0] * degree, np.linspace(0, 1, len(c) - degree + 1), [1] * degree]
            ),
            c,
            degree,
        )
        for c in (path, rate)
    )
    s = np.linspace(0, 1, 20001)
    t = np.concatenate(
        [[0], np.cumsum((1 / r(s[:-1]) + 1 / r(s[1:])) / 2 * np.diff(s))]
    )
    return np.asarray(p(np.interp(np.arange(0, t[-1], step), t, s)))
