"""Steps in compiled code, ``step.c`` and ``nearest.c``: those of NumPy and DAQP but for rounding, and much faster."""

import ctypes
from collections.abc import Callable, Sequence
from ctypes import c_double, c_int, c_long, c_void_p
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.kernels.compiled import LINE, address_of, aligned
from cnpgen.kernels.library import KernelLibrary
from cnpgen.refine.solver.bounds import Bounds
from cnpgen.refine.solver.criterion import ROUNDED
from cnpgen.refine.solver.grid import Bases
from cnpgen.refine.solver.quadratic import (
    CHANGES,
    FEASIBLE,
    MULTIPLIER,
    NEAR_OTHERS,
    SOFTNESS,
    USED,
    Mask,
    Model,
    Near,
    PlainSteps,
    Step,
)
from cnpgen.refine.solver.transcription import Transcription
from cnpgen.trajectory.spline import end_derivatives

Array = NDArray[np.float64]

SOURCES = [Path(__file__).with_name(name) for name in ("nearest.c", "step.c")]
WIDEST, BLOCK, TILE = 8, 32, 8  # at least as many as step.c's W, B and TILE


class _Bases(ctypes.Structure):
    _fields_ = (
        *((name, c_long) for name in ("orders", "points")),
        *((name, c_void_p) for name in ("path", "rate", "path_at", "rate_at", "path_from", "rate_from")),
    )


class _Polyhedron(ctypes.Structure):
    """``polyhedron`` of nearest.c."""

    _fields_ = (
        *((name, c_long) for name in ("dim", "stride", "count")),
        *((name, c_void_p) for name in ("rows", "low", "high", "norm", "scratch", "active", "begin")),
    )


class _Motion(ctypes.Structure):
    """``motion`` of step.c."""

    _fields_ = (
        *(
            (name, c_long)
            for name in ("n", "path", "rate", "support", "fixed", "nx", "stride", "m", "gauss", "criteria", "thin")
        ),
        *((name, _Bases) for name in ("grid", "nodes")),
        *((name, c_void_p) for name in ("values", "jacobian", "criterion")),
        *((name, c_void_p) for name in ("start_q", "start_dq", "start_ddq", "goal_q", "goal_dq", "goal_ddq")),
        *((name, c_void_p) for name in ("top", "quadrature", "weights", "criterion_weights", "smooth")),
        *((name, c_void_p) for name in ("lower", "upper", "sharp", "accelerated")),
        *((name, c_void_p) for name in ("control", "rates", "slope", "w", "gradient", "hessian", "factor", "scratch")),
        *((name, c_void_p) for name in ("where", "first")),
        ("programme", _Polyhedron),
        *((name, c_double) for name in ("eta", "beta", "rate_eta", "rounded", "violation", "gain", "left")),
        *((name, c_long * 6) for name in ("point", "variable")),
        *((name, c_long) for name in ("slopes", "held")),
    )


def load_steps(kernels: KernelLibrary) -> ctypes.CDLL | None:
    """Return the library of step.c, or None where kernels are not compiled."""
    library = kernels.load_source(*SOURCES)
    if library is not None:
        library.look.argtypes, library.look.restype = (c_void_p,) * 3, c_double
        library.model.restype, library.model.argtypes = None, (*(c_void_p,) * 3, *(c_double,) * 4, *(c_void_p,) * 3)
        solve = (*(c_void_p,) * 3, c_double, c_double, c_int, c_void_p, c_double, c_double, c_int, c_void_p, c_void_p)
        library.solve.argtypes = solve
    return library


class CompiledSteps:
    """Steps whose numbers are computed by step.c; see ``Steps``.

    Args:
        motion: The transcription.
        bounds: Bounds of its residuals.
        thin: As of ``choose``.
    """

    def __init__(self, motion: Transcription, bounds: Bounds, thin: int) -> None:
        library = motion.stage.steps
        assert library is not None
        self._look, self._model, self._solve = library.look, library.model, library.solve
        self._kept: list[Any] = []  # arrays that step.c refers to
        self._points, self._m, self._nx = len(motion.grid.s), motion.stage.values.tape.outputs[0], motion.nx
        self._motion = self._describe(motion, bounds, thin)
        self._at = ctypes.addressof(self._motion)
        self._plain = PlainSteps(motion, bounds, thin)

    def value(self, x: Array) -> tuple[float, Array, float]:
        """Evaluate; see ``Steps``."""
        g = np.empty((self._m, self._points))
        cost = self._look(self._at, address_of(x), address_of(g))
        return cost, g.T, self._motion.violation

    def model(self, x: Array, g: Array, near: Near, *, proximal: float, penalty: float) -> "CompiledModel":
        """Model the motion; see ``Steps``."""
        held, missed = np.zeros((self._m, self._points), bool), np.ascontiguousarray(near.missed.T)
        before = None if near.multipliers is None else np.ascontiguousarray(near.multipliers.T)
        addresses = address_of(missed), None if before is None else address_of(before), address_of(held)
        self._motion.violation = near.violation
        self._model(self._at, address_of(x), address_of(g.T), proximal, near.near, NEAR_OTHERS, near.leap, *addresses)
        plain = partial(self._plain.model, x, g, near, proximal=proximal, penalty=penalty)
        return CompiledModel(self, plain, g, held.T, penalty * near.violation + USED)

    def solve(self, model: "CompiledModel", box: Array, warm: Array | None, *, relax: bool) -> Step | None:
        """Solve the programme of the model that was laid out last."""
        dx, multipliers = np.empty(self._nx), np.zeros((self._m, self._points))
        before = None if warm is None else np.ascontiguousarray(warm.T)
        numbers = None if before is None else address_of(before), MULTIPLIER, FEASIBLE, CHANGES
        arrays, results = (address_of(model.g.T), address_of(box)), (address_of(dx), address_of(multipliers))
        if not self._solve(self._at, *arrays, model.slope, SOFTNESS, relax, *numbers, *results):
            return None
        found = self._motion
        return Step(dx, found.left, multipliers.T, found.gain) if np.isfinite(dx).all() else None

    def _describe(self, motion: Transcription, bounds: Bounds, thin: int) -> _Motion:
        spec, stride = motion.spec, motion.nx + 2 + -(motion.nx + 2) % WIDEST
        path = end_derivatives(spec.path_control_points, spec.degree)
        rate = end_derivatives(spec.rate_control_points, spec.degree)
        return _Motion(
            n=motion.n,
            path=spec.path_control_points,
            rate=spec.rate_control_points,
            support=motion.grid.bases.support,
            fixed=3 + motion.interior,
            nx=motion.nx,
            stride=stride,
            m=self._m,
            thin=thin,
            eta=path.eta,
            beta=path.beta,
            rate_eta=rate.eta,
            programme=self._programme(stride),
            **self._given(motion, bounds),
            **self._kernels(motion),
            **self._memory(motion, stride),
        )

    def _given(self, motion: Transcription, bounds: Bounds) -> dict[str, Any]:
        """Numbers that no step changes."""
        grid, weight = motion.grid, 0.0 if motion.stage.criterion is None else motion.stage.criterion.weight
        said = {
            **vars(motion.boundary),
            "top": motion.tops_along,
            "quadrature": grid.gauss,
            "weights": grid.weights,
            "criterion_weights": weight * grid.criterion_weights,
            "smooth": motion.smooth,
            "lower": bounds.lower.T,
            "upper": bounds.upper.T,
            "sharp": bounds.sharp.T,
            "accelerated": bounds.accelerated,
        }
        found: dict[str, Any] = {name: None if array is None else self._keep(array) for name, array in said.items()}
        found |= {"grid": self._bases(grid.bases), "nodes": self._bases(grid.criterion)}
        return {**found, "gauss": len(grid.weights)}

    def _kernels(self, motion: Transcription) -> dict[str, Any]:
        """The compiled kernels, and what the criterion's are of."""
        stage = motion.stage
        found = {"values": stage.values.address, "jacobian": stage.jacobian.address}
        if stage.criterion is None or stage.residuals is None:
            return found
        rounded = ROUNDED if stage.criterion.kind == "centrifugal" else 0.0
        count = stage.residuals.tape.outputs[0]
        return {**found, "criterion": stage.residuals.address, "criteria": count, "rounded": rounded}

    def _memory(self, motion: Transcription, stride: int) -> dict[str, int]:
        """Memory of as many numbers as step.c says."""
        spec, n, nx, size = motion.spec, motion.n, motion.nx, self._m * self._points
        width, nodes = motion.stage.values.tape.inputs[0], len(motion.grid.criterion_weights)
        count = 0 if motion.stage.residuals is None else motion.stage.residuals.tape.outputs[0]
        criterion = nodes * ((4 * n + 3) * (count + 1) + (2 + stride) * count) + stride
        duration = len(motion.grid.weights) * (spec.rate_control_points + WIDEST) + stride
        sizes = {
            "control": spec.path_control_points * n,
            "rates": spec.rate_control_points,
            "slope": 6 * (n + WIDEST),
            "w": width * self._points,
            "gradient": nx,
            "hessian": nx * stride + BLOCK,
            "factor": nx * stride,
            "scratch": max(size + (width + 1) * self._m * TILE + stride, criterion, duration) + BLOCK,
            "where": size,
            "first": size,
        }
        return dict(zip(sizes, self._room(list(sizes.values())), strict=True))

    def _programme(self, stride: int) -> _Polyhedron:
        dim = self._nx + 1
        rows = dim + self._m * self._points + BLOCK
        scratch = (2 * dim + BLOCK) * stride + 8 * (stride + BLOCK)
        blocks = rows  # some fewer: they are of 8 rows or more
        sizes = (rows * dim, rows, rows, rows, scratch, dim, blocks)  # as in _Polyhedron
        return _Polyhedron(dim, stride, 0, *self._room(sizes))

    def _room(self, sizes: Sequence[int]) -> list[int]:
        """Return addresses of memory for so many numbers each, at beginnings of the cache's lines."""
        lines = [size + -size % LINE for size in sizes]
        array = aligned(sum(lines))
        self._kept.append(array)
        begin = address_of(array)
        return [begin + array.itemsize * before for before in accumulate(lines, initial=0)][:-1]

    def _bases(self, bases: Bases) -> _Bases:
        orders, points, _ = bases.path.shape
        arrays = (*bases.along, bases.path_at, bases.rate_at, *bases.supported_from)
        return _Bases(orders, points, *map(self._keep, arrays))

    def _keep(self, array: NDArray[Any]) -> int:
        array = np.ascontiguousarray(array)
        self._kept.append(array)
        return address_of(array)


@dataclass(frozen=True)
class CompiledModel:
    """The quadratic programmes that step.c has laid out; see ``Model``.

    Attributes:
        steps: Whose they are.
        plain: Makes the same model in NumPy.
        g: Residuals where it is made, shape (K, m).
        held: Which of them the programmes hold, shape (K, m).
        slope: Cost of all violations.
    """

    steps: CompiledSteps
    plain: Callable[[], Model]
    g: Array
    held: Mask
    slope: float

    def solve(self, box: Array, *, warm: Array | None = None, relax: bool = False) -> Step | None:
        """Return the best step within the box; see ``Model``. Where nearest.c finds none, DAQP has its turn."""
        found = self.steps.solve(self, box, warm, relax=relax)
        return self.plain().solve(box, warm=warm, relax=relax) if found is None else found
