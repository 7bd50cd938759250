"""Collision checks and distances of a robot among obstacles in compiled code, over batches of states.

Judges do not use it: verdicts measure with Coal.
"""

import ctypes
from collections.abc import Mapping, Sequence
from ctypes import c_double, c_int, c_long, c_void_p
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.arrays import Array
from cnpgen.errors import UsageError
from cnpgen.kernels.collision.body_arrays import (
    BODY,
    Bodies,
    hull_vertices,
    obstacle_bodies,
)
from cnpgen.kernels.compiled_kernel import address_of, require_memory
from cnpgen.kernels.library import KernelLibrary
from cnpgen.robots.obstacle import Obstacle
from cnpgen.robots.robot import Robot
from cnpgen.robots.shape.convex_part import Contacts
from cnpgen.robots.shape.shape import Shape

_NAMES = (
    "convex.c",
    "collision.c",
    "tree_search.c",
    "manifold_search.c",
    "clearance_loss.c",
    "hull_rows.c",
)
SOURCES = [Path(__file__).with_name(name) for name in _NAMES]
MAX_JOINTS = 56  # planned ones, of the arrays in collision.c
# Of the first call; a second one follows where it is too small.
MIN_CONTACT_CAPACITY = 1024
CAPSULE = np.dtype(
    [
        ("frame", np.int64),
        ("first", np.float64, 3),
        ("second", np.float64, 3),
        ("radius", np.float64),
    ]
)


class _RobotScene(ctypes.Structure):
    """``robot_scene`` of collision.c."""

    _fields_ = (
        *(
            (name, c_long)
            for name in (
                "n",
                "n_parts",
                "n_links",
                "n_link_pairs",
                "n_obstacles",
                "lanes",
            )
        ),
        *(
            (name, c_void_p)
            for name in (
                "place",
                "axis",
                "sliding",
                "parts",
                "links",
                "first_part",
                "part_of_link",
            )
        ),
        *(
            (name, c_void_p)
            for name in ("link_pairs", "first_pair", "pairs", "moving", "moving_frames")
        ),
        *(
            (name, c_void_p)
            for name in ("added", "pair_added", "obstacles", "boxes", "vertices")
        ),
    )


def load_collision_library(
    kernels: KernelLibrary, sources: Sequence[Path] = SOURCES
) -> ctypes.CDLL:
    """Return the library of collision checks, the same for all robots.

    Raises:
        MachineError: It is missing.
    """
    library = kernels.load_source(*sources)
    for function in (library.clear_states, library.find_contacts, library.joint_poses):
        function.restype = c_long
        function.errcheck = require_memory
    library.clear_states.argtypes = (
        c_void_p,
        c_void_p,
        c_long,
        c_double,
        c_double,
        c_void_p,
    )
    library.find_contacts.argtypes = (
        c_void_p,
        c_void_p,
        c_long,
        c_double,
        c_int,
        c_long,
        *(c_void_p,) * 5,
    )
    library.joint_poses.argtypes = (c_void_p, c_void_p, c_long, c_void_p)
    return library


class CollisionChecker:
    """A robot with link geometry among obstacles, in compiled code.

    Args:
        library: Library of ``load_collision_library``.
        robot: The robot, with link geometry.
        shape: Its link geometry, by default the robot's own.
        added: Link -> distance that is added to its required ones from obstacles [m],
            by default 0; -inf for no check.
        pair_added: Two links -> distance that is added to their required one from each
            other [m], in the same way.

    Attributes:
        link_pairs: Pairs of convex parts of links that must not touch, the one nearer
            to the base first, shape (M, 2).
        vertices: Values of the hulls of all convex parts (``HullVertices``), flat [m].

    Raises:
        UsageError: The robot has no link geometry, or too many joints.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        robot: Robot,
        shape: Shape | None = None,
        added: Mapping[str, float] | None = None,
        pair_added: Mapping[frozenset[str], float] | None = None,
    ) -> None:
        shape = robot.shape if shape is None else shape
        if shape is None or robot.n > MAX_JOINTS:
            text = (
                f"distances of hulls need link geometry and at most {MAX_JOINTS} joints"
            )
            raise UsageError(text, concerns="problem")
        self.library = library
        self._n = robot.n
        self._arrays = dict[str, Any]()
        self._scene = _RobotScene()
        self._set_chain(robot)
        parts = self._set_parts(shape)
        of_link = self._set_links(shape, parts, added or {})
        self._set_pairs(shape, parts, of_link, pair_added or {})
        self._set("moving", np.cumsum(parts["frame"] > 0) - 1)
        self._set("moving_frames", parts["frame"][parts["frame"] > 0])
        self._scene.n = robot.n
        self._scene.n_parts = len(parts)
        self.place([], np.empty(0))

    def _set_chain(self, robot: Robot) -> None:
        """Store the fixed places, axes and types of the joints."""
        joints = robot.chain.joints
        chain = [
            np.append(joint.rotation.ravel(), joint.translation) for joint in joints
        ]
        self._set("place", np.array(chain, np.float64))
        self._set("axis", np.array([joint.axis for joint in joints], np.float64))
        self._set("sliding", np.array(robot.prismatic, np.int64))

    def _set_parts(self, shape: Shape) -> Bodies:
        """Store and return the convex parts of the links, with their vertices."""
        links = {capsule.link: i for i, capsule in enumerate(shape.capsules)}
        parts = np.zeros(len(shape.convex_parts), BODY)
        blocks = list[Array]()
        first = 0
        for index, part in enumerate(shape.convex_parts):
            hull = hull_vertices(part.vertices)
            corners = part.vertices
            hull.put(parts, index, first)
            center = (corners.min(axis=0) + corners.max(axis=0)) / 2
            reach = np.linalg.norm(corners - center, axis=1).max() + part.radius
            parts["radius"][index] = part.radius
            parts["position"][index] = center
            parts["bound"][index] = reach * (1 + 1e-12)  # above rounding errors
            parts["frame"][index] = shape.joints[part.link]
            parts["link"][index] = links[part.link]
            blocks.append(hull.values)
            first += len(hull.values)
        self.vertices = np.concatenate([*blocks, np.empty(0)])
        self._set("parts", parts)
        return parts

    def _set_links(
        self, shape: Shape, parts: Bodies, added: Mapping[str, float]
    ) -> list[NDArray[np.intp]]:
        """Store the capsules of the links; return the parts of each link."""
        capsules = np.array(
            [
                (shape.joints[c.link], c.first, c.second, c.radius)
                for c in shape.capsules
            ],
            CAPSULE,
        )
        self._set("links", capsules)
        self._set("added", np.array([added.get(c.link, 0.0) for c in shape.capsules]))
        # Parts of one link are contiguous in ``part_of_link``, from
        # ``first_part[link]`` on.
        of_link = [
            np.flatnonzero(parts["link"] == link) for link in range(len(capsules))
        ]
        self._set("first_part", np.append(0, np.cumsum(list(map(len, of_link)))))
        self._set("part_of_link", np.concatenate([*of_link, np.empty(0, np.intp)]))
        self._scene.n_links = len(capsules)
        return of_link

    def _set_pairs(
        self,
        shape: Shape,
        parts: Bodies,
        of_link: list[NDArray[np.intp]],
        pair_added: Mapping[frozenset[str], float],
    ) -> None:
        """Store the pairs of links that must not touch, and of their parts."""
        links = {capsule.link: i for i, capsule in enumerate(shape.capsules)}
        # Pairs of links that always touch or never meet were left out when the shape
        # was made.
        checked = [
            (pair.first, pair.second) for pair in shape.pairs if not pair.left_out
        ]
        kept = [(links[first], links[second]) for first, second in checked]
        # The part nearer to the base first: only joints between both frames change its
        # distance.
        pairs = [
            [
                sorted(both, key=parts["frame"].__getitem__)
                for both in product(of_link[a], of_link[b])
            ]
            for a, b in kept
        ]
        self._set("link_pairs", np.array(kept, np.int64).reshape(-1, 2))
        more = [pair_added.get(frozenset(pair), 0.0) for pair in checked]
        self._set("pair_added", np.array(more, np.float64))
        self._set("first_pair", np.append(0, np.cumsum(list(map(len, pairs)))))
        self.link_pairs = np.array(
            [both for each in pairs for both in each], np.int64
        ).reshape(-1, 2)
        self._set("pairs", self.link_pairs)
        self._scene.n_link_pairs = len(kept)

    def place(self, obstacles: Sequence[Obstacle], numbers: Array) -> None:
        """Set the obstacles, with their poses and sizes, shape (width,) (``cnpgen.robots.solid``)."""
        bodies, vertices, boxes = obstacle_bodies(
            obstacles, numbers, len(self.vertices)
        )
        self._set("obstacles", bodies)
        self._set("boxes", boxes)
        self._set("vertices", np.concatenate([self.vertices, vertices]))
        self._scene.n_obstacles = len(bodies)
        self._scene.lanes = boxes.shape[1]

    @property
    def address(self) -> int:
        """Address of the scene for functions in C; valid until the obstacles change."""
        return ctypes.addressof(self._scene)

    def scene_of(self, bodies: Bodies, boxes: Array, vertices: Array) -> _RobotScene:
        """Return a copy of the scene with other obstacles for functions in C.

        The caller keeps their arrays.
        """
        scene = _RobotScene.from_buffer_copy(self._scene)
        scene.obstacles, scene.boxes, scene.vertices = map(
            address_of, (bodies, boxes, vertices)
        )
        scene.n_obstacles = bodies.shape[-1]
        scene.lanes = boxes.shape[-1]
        return scene

    def clear_states(
        self,
        q: Array,
        *,
        obstacle_distance: float | None = 0.0,
        self_distance: float | None = 0.0,
    ) -> NDArray[np.bool_]:
        """Return a mask of the states with sufficient distances, shape (K,).

        Args:
            q: Joint positions [rad], shape (n, K).
            obstacle_distance: Required distance of moving links from obstacles [m];
                None for no check.
            self_distance: Required distance of links from each other [m]; None for no
                check.
        """
        # C reads states one after the other, so the joints of a state must be
        # contiguous.
        states = np.ascontiguousarray(q.T)
        clear = np.empty(len(states), np.uint8)
        limits = [
            -np.inf if limit is None else limit
            for limit in (obstacle_distance, self_distance)
        ]
        self.library.clear_states(
            self.address, address_of(states), len(states), *limits, address_of(clear)
        )
        return clear.astype(bool)

    def close_bodies(self, q: Array, within: float, *, of_obstacles: bool) -> Contacts:
        """Measure all pairs of bodies at states where their signed distance is below ``within``.

        Args:
            q: Joint positions [rad], shape (n, K).
            within: Distance below which a pair is returned [m].
            of_obstacles: Whether to measure pairs (obstacle, moving part), numbered
                part by part; else ``link_pairs``.
        """
        # The number of contacts is not known before; C counts all and stores what fits.
        states = np.ascontiguousarray(q.T)
        capacity = MIN_CONTACT_CAPACITY
        while True:
            pair = np.empty(capacity, np.int64)
            k = np.empty(capacity, np.int64)
            distance = np.empty(capacity)
            normal = np.empty((capacity, 3))
            points = np.empty((capacity, 2, 3))
            addresses = map(address_of, (pair, k, distance, normal, points))
            count = self.library.find_contacts(
                self.address,
                address_of(states),
                len(states),
                within,
                of_obstacles,
                capacity,
                *addresses,
            )
            if count <= capacity:
                return Contacts(
                    pair[:count],
                    k[:count],
                    distance[:count],
                    normal[:count],
                    points[:count],
                )
            capacity = count

    def joint_poses(self, q: Array) -> Array:
        """Compute the joints' frames at q [rad], shape (n, K), base first: rows and position, shape (K, n + 1, 12)."""
        states = np.ascontiguousarray(q.T)
        poses = np.empty((len(states), self._n + 1, 12))
        self.library.joint_poses(
            self.address, address_of(states), len(states), address_of(poses)
        )
        return poses

    def _set(self, name: str, array: Any) -> None:
        """Keep an array and store its address in the scene."""
        # The scene holds bare addresses; this dictionary keeps their arrays alive.
        self._arrays[name] = np.ascontiguousarray(array)
        setattr(
            self._scene,
            name,
            address_of(self._arrays[name]) if self._arrays[name].size else None,
        )
