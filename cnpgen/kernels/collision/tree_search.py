"""Joint-space paths among obstacles by RRT-Connect in compiled code (Kuffner and LaValle 2000).

Where there are equalities, the states of an edge are first projected onto the manifold
by Gauss-Newton steps within the joint limits (CBiRRT, Berenson et al. 2009).
"""

import ctypes
from ctypes import c_double, c_long, c_ulonglong, c_void_p
from dataclasses import astuple, dataclass

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.collision.collision_checker import CollisionChecker
from cnpgen.kernels.compiled_kernel import address_of, require_memory
from cnpgen.kernels.kernel import Kernel

MAX_PATH_POINTS = 2000
STATES_PER_CALL = 16  # BLOCK in tree_search.c
MAX_PROJECTION_ERROR = 1e-4  # of residuals [rad or m]
CORNER_TIME_S = 0.12  # of a corner of a path, added to the time at the velocity limits


class _TreeSettings(ctypes.Structure):
    """``tree_settings`` of tree_search.c."""

    _fields_ = (
        *(
            (name, c_void_p)
            for name in ("scene", "start", "goal", "lower", "upper", "velocity")
        ),
        *(
            (name, c_double)
            for name in ("obstacle_distance", "self_distance", "margin", "ramp")
        ),
        *((name, c_double) for name in ("spacing", "extension")),
        *((name, c_long) for name in ("max_extensions", "max_nodes", "shortcuts")),
        *(("corner_time", c_double), ("seed", c_ulonglong), ("goals", c_long)),
        *(
            (name, c_void_p)
            for name in ("at_rest", "w", "rest_scene", "rest_lower", "rest_upper", "g")
        ),
        ("rest_rows", c_long),
    )


@dataclass(frozen=True)
class TreeSettings:
    """Settings of a search, in the order of ``tree_settings`` of tree_search.c.

    Attributes:
        obstacle_distance: Required distance from obstacles [m]; None for no check.
        self_distance: Required distance of links from each other [m]; None for no
            check.
        margin: Additional distance away from both ends [m].
        margin_ramp: Largest joint difference from an end below which the margin is
            smaller [rad or m].
        spacing: Largest joint difference of neighboring checked states [rad or m].
        extension: Largest length of an edge [rad or m].
        max_extensions: Largest number of extensions of the trees.
        max_nodes: Largest number of nodes of both trees: trees that fill so much space
            are probably not connected.
        shortcuts: Attempts to shorten a path.
    """

    obstacle_distance: float | None
    self_distance: float | None
    margin: float = 0.0
    margin_ramp: float = 0.3
    spacing: float = 0.03
    extension: float = 1.0
    max_extensions: int = 4000
    max_nodes: int = 3000
    shortcuts: int = 100


@dataclass(frozen=True)
class EqualityKernel:
    """Equalities that the states of a path meet.

    Attributes:
        residuals: Compiled kernel ``(q, scene) -> (r, dr/dq)``, the Jacobian column by
            column.
        scene: Values of the scene that it takes, shape (width,).
        accuracy: Largest residual of a state on the manifold, if it is less than
            ``MAX_PROJECTION_ERROR``.
    """

    residuals: Kernel
    scene: Array
    accuracy: float


@dataclass(frozen=True)
class RestConditions:
    """Conditions of a robot at rest that every state of a path meets, beside distances of hulls.

    Attributes:
        residuals: Kernel ``(w, scene) -> g``, where w begins with q.
        w: Values of w at rest, of which q is replaced, shape (width,).
        scene: Values of the scene that it takes, shape (width,).
        lower: Bounds of g, shape (m,), each infinite where it does not hold.
        upper: In the same way.
    """

    residuals: Kernel
    w: Array
    scene: Array
    lower: Array
    upper: Array

    def arrays(self) -> list[Array]:
        """Return the arrays of ``tree_settings``: arguments for every lane, bounds, and memory for g."""
        lanes = (np.repeat(x, STATES_PER_CALL) for x in (self.w, self.scene))
        return [
            *lanes,
            self.lower,
            self.upper,
            np.empty((len(self.lower), STATES_PER_CALL)),
        ]


def find_tree_path(
    checker: CollisionChecker,
    ends: tuple[Array, Array],
    box: tuple[Array, Array],
    velocity_limit: Array,
    settings: TreeSettings,
    *,
    seed: int,
    manifold: EqualityKernel | None = None,
    at_rest: RestConditions | None = None,
) -> Array | None:
    """Search for a path whose straight lines are valid; it is shortened by its estimated duration.

    Of several goals, shape (G, n), all are roots of one tree: the path ends in any of them.
    On a manifold the path consists of projected states at small distances, and fewer of
    them make it shorter. The equalities must hold at both ends, which are not checked
    themselves. The start, one goal and the corners of the box of random configurations
    [rad] have shape (n,), as velocity limits [rad/s] have.

    Returns:
        Corners of the path [rad], shape (K, n), or None if the trees do not connect.
    """
    # C reads the arrays by address, so they must be contiguous and outlive the call.
    arrays = [
        np.ascontiguousarray(array, np.float64)
        for array in (*ends, *box, velocity_limit)
    ]
    # Without a check the required distance is -inf, which every distance exceeds.
    numbers = [-np.inf if value is None else value for value in astuple(settings)]
    memory = [] if at_rest is None else at_rest.arrays()
    kernel = (
        ()
        if at_rest is None
        else (at_rest.residuals.address, *map(address_of, memory), len(at_rest.lower))
    )
    native = _TreeSettings(
        checker.address,
        *map(address_of, arrays),
        *numbers,
        CORNER_TIME_S,
        seed + 1,
        arrays[1].size // len(arrays[0]),
        *kernel,
    )
    path = np.empty((MAX_PATH_POINTS, len(arrays[0])))
    count = _search(checker, native, manifold, path)
    return path[:count].copy() if count else None


def _search(
    checker: CollisionChecker,
    native: _TreeSettings,
    manifold: EqualityKernel | None,
    path: Array,
) -> int:
    """Write the corners of a path into an array; return their number, 0 if there is no path."""
    if manifold is None:
        search = checker.library.find_path
        search.restype = c_long
        search.argtypes = (c_void_p, c_void_p, c_long)
        search.errcheck = require_memory
        count = search(ctypes.addressof(native), address_of(path), len(path))
    else:
        # The kernel projects a block of states at once, so the scene is repeated for
        # each lane.
        search = checker.library.find_manifold_path
        scene = np.repeat(manifold.scene, STATES_PER_CALL)
        search.restype = c_long
        search.argtypes = (*(c_void_p,) * 3, c_long, c_double, c_void_p, c_long)
        search.errcheck = require_memory
        residuals = manifold.residuals.address
        rows = manifold.residuals.tape.outputs[0]
        errors = rows, min(manifold.accuracy, MAX_PROJECTION_ERROR)
        count = search(
            ctypes.addressof(native),
            residuals,
            address_of(scene),
            *errors,
            address_of(path),
            len(path),
        )
    return int(count)


def estimated_duration(path: Array, velocity_limit: Array) -> float:
    """Estimate the duration along a path [rad], shape (K, n): lines at the velocity limits [rad/s], and its corners."""
    # The slowest joint of a straight line determines its duration.
    lines = (np.abs(np.diff(path, axis=0)) / velocity_limit).max(axis=1)
    return float(lines.sum() + CORNER_TIME_S * max(len(path) - 2, 0))
