"""Constants and tables of a planner in C: sizes, bases of splines, bounds, and the weights of its network."""

from collections.abc import Iterable
from math import ceil, log2
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.addons.deploy.c_text import number, table
from cnpgen.addons.deploy.planner_parts import LANES, PlannerParts
from cnpgen.arrays import Array
from cnpgen.planner.network.architecture import Layer
from cnpgen.planner.network.features import count_features
from cnpgen.planner.time_parametrization import (
    MAX_RATE_DECREASE,
    MAX_RATE_INCREASE,
    moves_of,
)
from cnpgen.planner.time_scaling import MAX_TIME_SCALE, TIME_SCALE_MARGIN
from cnpgen.trajectory.spline import basis, graded_edges, taylor_coefficients

LAYER_BLOCK = 32  # outputs of a layer that are accumulated together
INPUTS = 4  # of a layer that pass at once
GAUSS_NODES = (
    4  # half of those of ``Motion.duration``: errors of 1e-9 in the same cells
)
NEWTON_STEPS = 5  # three or four reach rounding (``Motion.phase_at``)


def padded(width: int, block: int = LAYER_BLOCK) -> int:
    """Return the width of a layer, filled up to whole blocks."""
    return ceil(width / block) * block


def cells(parts: PlannerParts) -> Array:
    """Return the edges of the quadrature cells of t(s)."""
    spec = parts.problem.trajectory
    return graded_edges(spec.rate_control_points, spec.degree)


def sizes(parts: PlannerParts) -> dict[str, int]:
    """Return the whole-number constants of the C file by name."""
    return {
        **_task_sizes(parts),
        **_motion_sizes(parts),
        **_grid_sizes(parts),
        **_fit_sizes(parts),
    }


def _task_sizes(parts: PlannerParts) -> dict[str, int]:
    """Return the sizes of a request, its scene and its features."""
    model, problem, n = parts.model, parts.problem, parts.robot.n
    blocks = model.features.blocks
    first = blocks.index("expected_time") if "expected_time" in blocks else -1
    # The C code replaces the time in the features by its logarithm, at this index.
    before = count_features(blocks[: max(first, 0)], n, len(problem.parameters))
    return {
        "JOINTS": n,
        "CONDITIONS": len(parts.conditions),
        "ENDS": n * len(parts.conditions),
        "PARAMETERS": len(problem.parameters),
        "SCENE": problem.scene_width,
        "RELAXED": len(parts.relaxed),
        "FEATURES": model.architecture.inputs,
        "FEATURE_WIDTH": padded(model.architecture.inputs, INPUTS),
        "TIME_FEATURE": before if first >= 0 else -1,
    }


def _motion_sizes(parts: PlannerParts) -> dict[str, int]:
    """Return the sizes of a motion and of its states in the column of a phase."""
    problem, spec, n = parts.problem, parts.problem.trajectory, parts.robot.n
    orders = problem.path_orders
    return {
        "DEGREE": spec.degree,
        "PATH_POINTS": spec.path_control_points,
        "RATE_POINTS": spec.rate_control_points,
        "PATH_SPANS": spec.path_control_points - spec.degree,
        "RATE_SPANS": spec.rate_control_points - spec.degree,
        "OFFSETS": n * (spec.path_control_points - 3 - parts.model.fixed_at_goal),
        "LINE_STEPS": int("line_change" in parts.tapes),
        "ORDERS": orders,
        "JERK": int(orders > 3),
        # Derivatives of p, those of r, and the scene.
        "COLUMNS": n * orders + orders - 1 + problem.scene_width,
    }


def _grid_sizes(parts: PlannerParts) -> dict[str, int]:
    """Return the sizes of the check, of quadrature and of loops."""
    edges = cells(parts)
    return {
        "PHASES": len(parts.phases),
        "CHECKED_PHASES": len(parts.checked_phases),
        "CONSTRAINTS": len(parts.problem.constraint),
        "POSITION_ROWS": len(parts.position_constraints),
        "MOVING_ROWS": len(parts.moving_constraints),
        "CELLS": len(edges) - 1,
        # Steps of a bisection over the edges.
        "CELL_STEPS": ceil(log2(len(edges))) + 1,
        "NODES": GAUSS_NODES,
        "NEWTON_STEPS": NEWTON_STEPS,
        "BLOCK": LAYER_BLOCK,
        "INPUTS": INPUTS,
        "LANES": LANES,
    }


def _fit_sizes(parts: PlannerParts) -> dict[str, int]:
    """Return the sizes of the time parametrization and of time scaling, where the planner has them."""
    values = {}
    if (fit := parts.parametrization) is not None:
        points = parts.problem.trajectory.rate_control_points
        values["ROWS"] = len(fit.lower)
        values["MOVES"] = len(moves_of(points, fit.fixed)[0])
        values["FIXED_RATES"] = fit.fixed
    if parts.scaling is not None:
        values["RESIDUALS"] = len(parts.scaling.lower)
    return values


def amounts(parts: PlannerParts) -> dict[str, float]:
    """Return the real constants of the C file by name."""
    values = {
        "PATH_SCALE": float(parts.model.config.path_scale),
        # Rad, and rates below in 1/s: larger ones are no motions.
        "MAX_POSITION": 1e6,
        "MIN_RATE": 1e-6,
        "MAX_RATE": 1e6,
    }
    if (fit := parts.parametrization) is not None:
        values |= {
            "MAX_INCREASE": MAX_RATE_INCREASE,
            "MAX_DECREASE": MAX_RATE_DECREASE,
            "RATE_MARGIN": fit.margin,
            "MIN_INCREASE": fit.min_increase,
            "BOUND_TOLERANCE": fit.violation_tolerance,
        }
    if parts.scaling is not None:
        values |= {"SCALE_MARGIN": TIME_SCALE_MARGIN, "MAX_SCALE": MAX_TIME_SCALE}
    return values


def constants_text(parts: PlannerParts) -> str:
    """Return the definitions of all constants."""
    values: dict[str, str] = {name: str(v) for name, v in sizes(parts).items()}
    values |= {name: number(value) for name, value in amounts(parts).items()}
    return "".join(f"#define {name} {value}\n" for name, value in values.items())


def tables_text(parts: PlannerParts) -> str:
    """Return the definitions of all tables but those of the network."""
    return "\n".join(
        [
            *_task_tables(parts),
            *_spline_tables(parts),
            *_grid_tables(parts),
            *_bounds(parts),
        ]
    )


def _task_tables(parts: PlannerParts) -> Iterable[str]:
    model = parts.model
    zero = [name in model.zero_conditions for name in parts.conditions]
    yield table("int", "must_be_zero", zero)
    yield table("double", "zero_tolerance", parts.zero_tolerance)
    if len(parts.problem.parameters):
        low, high = parts.parameter_ranges
        yield table("double", "parameter_low", low)
        yield table("double", "parameter_high", high)
    yield table("double", "input_low", parts.ranges.low)
    yield table("double", "input_high", parts.ranges.high)
    yield table("double", "feature_mean", model.features.mean)
    yield table("double", "feature_scale", model.features.scale)


def _spline_tables(parts: PlannerParts) -> Iterable[str]:
    spec = parts.problem.trajectory
    edges, spans = cells(parts), spec.rate_control_points - spec.degree
    # The midpoint of a cell is inside its span of knots in spite of rounding.
    midpoints = (edges[1:] + edges[:-1]) / 2
    nodes, weights = np.polynomial.legendre.leggauss(GAUSS_NODES)
    yield table("double", "path_taylor", _taylor(spec.path_control_points, spec.degree))
    yield table("double", "rate_taylor", _taylor(spec.rate_control_points, spec.degree))
    yield table("double", "cell_edge", edges)
    yield table("int", "cell_span", np.floor(midpoints * spans))
    # Nodes and weights of [-1, 1] are mapped to [0, 1].
    nodes, weights = (nodes + 1) / 2, weights / 2
    yield table("double", "node", nodes)
    yield table("double", "node_weight", weights)
    # Those of all cells: offsets from the left knot of the span, and parts of the width.
    width = np.diff(edges)[:, None]
    left = edges[:-1, None] - np.floor(midpoints * spans)[:, None] / spans
    yield table("double", "node_offset", left + width * nodes)
    yield table("double", "node_width", width * weights)


def _taylor(points: int, degree: int) -> Array:
    """Return the Taylor coefficients at the left knots of the functions that are not 0 there, (spans, D + 1, D + 1)."""
    every = taylor_coefficients(points, degree)
    spans = range(points - degree)
    return np.array([every[:, span, span : span + degree + 1] for span in spans])


def _grid_tables(parts: PlannerParts) -> Iterable[str]:
    spec, s = parts.problem.trajectory, parts.phases
    orders = range(parts.problem.path_orders)
    path = [basis(s, spec.path_control_points, spec.degree, i).T for i in orders]
    rate = [basis(s, spec.rate_control_points, spec.degree, i).T for i in orders[:-1]]
    yield table("double", "phase", s)
    yield table("int", "checked_phase", parts.checked_phases)
    yield table("double", "path_basis", np.array(path))
    yield table("double", "rate_basis", np.array(rate))
    yield table("int", "path_support", _support(np.array(path)))
    yield table("int", "rate_support", _support(np.array(rate)))
    if parts.position_constraints:
        yield table("int", "position_constraint", parts.position_constraints)
    if parts.moving_constraints:
        yield table("int", "moving_constraint", parts.moving_constraints)


def _range(table_of_basis: Array) -> NDArray[np.int64]:
    """Return first and last phase, in whole lanes, at which each function or a derivative is not 0, shape (points, 2)."""
    nonzero = (table_of_basis != 0).any(axis=0)
    # Ranges begin and end at whole lanes.
    first = nonzero.argmax(axis=1)
    last = nonzero.shape[1] - nonzero[:, ::-1].argmax(axis=1)
    return np.stack([first - first % LANES, last + -last % LANES], axis=1)


def _support(table_of_basis: Array) -> NDArray[np.int64]:
    """Return the first function that is not 0 in each group of lanes, and the end of those, shape (groups, 2)."""
    orders, points, _ = table_of_basis.shape
    groups = table_of_basis.reshape(orders, points, -1, LANES)
    nonzero = (groups != 0).any(axis=(0, 3)).T
    # The reversed search finds the last function that is not 0.
    end = points - nonzero[:, ::-1].argmax(axis=1)
    return np.stack([nonzero.argmax(axis=1), end], axis=1)


def _bounds(parts: PlannerParts) -> Iterable[str]:
    fit, scaling = parts.parametrization, parts.scaling
    if fit is not None:
        points = parts.problem.trajectory.rate_control_points
        order, fractions = moves_of(points, fit.fixed)
        lower, upper = fit.relaxed_bounds
        yield table("double", "lower_bound", lower)
        yield table("double", "upper_bound", upper)
        yield table("int", "move_order", order)
        yield table("double", "step_fraction", fractions)
        yield table("int", "move_range", _range(fit.rate.swapaxes(1, 2)))
    if scaling is not None:
        yield table("double", "residual_lower", scaling.lower)
        yield table("double", "residual_upper", scaling.upper)
        yield table("int", "is_cubic", scaling.cubic)


def network_text(parts: PlannerParts) -> str:
    """Return the weights of all layers, and the function that evaluates the network."""
    model = parts.model
    architecture = model.architecture
    weights = architecture.split(model.parameters)
    texts = []
    for layer, (weight, bias) in zip(architecture.all_layers, weights, strict=True):
        texts += [
            table("float", f"{layer.name}_weight", _blocked(weight)),
            table("float", f"{layer.name}_bias", _filled(bias[None])[0]),
        ]
    steps = ["  const float *x = memory->x;\n"]
    # Two memories alternate: each layer reads one and writes the other.
    for index, layer in enumerate(architecture.trunk):
        steps.append(_step(layer, "x", f"memory->hidden[{index % 2}]", activated=True))
        steps.append(f"  x = memory->hidden[{index % 2}];\n")
    hidden, path, rate = architecture.heads
    # The last layer is in one memory, so the head of the path uses the other one.
    other = f"memory->hidden[{len(architecture.trunk) % 2}]"
    steps += [
        _step(rate, "x", "memory->log_rate", activated=False),
        _step(hidden, "x", other, activated=True),
        _step(path, other, "memory->phi", activated=True),
        "  *phi = memory->phi;\n  *log_rate = memory->log_rate;\n",
    ]
    head = "static void network(NAME_memory *memory, const float **phi, const float **log_rate) {\n"
    return "\n".join(texts) + "\n" + head + "".join(steps) + "}\n"


def _step(layer: Layer, source: str, target: str, *, activated: bool) -> str:
    inputs, width = padded(layer.inputs, INPUTS), padded(layer.outputs)
    arrays = f"{layer.name}_weight, {layer.name}_bias"
    text = (
        f"  affine({arrays}, {inputs}, {width // LAYER_BLOCK}, {source}, {target});\n"
    )
    return text + (
        f"  hyperbolic_tangent({target}, {width // LAYER_BLOCK});\n"
        if activated
        else ""
    )


def _filled(matrix: NDArray[Any]) -> NDArray[Any]:
    """Fill rows up to a multiple of ``INPUTS``, and columns up to whole blocks, with zeros."""
    rows, columns = matrix.shape
    more = padded(rows, INPUTS) - rows, padded(columns) - columns
    # Zero weights add nothing: padding changes no result.
    return np.pad(matrix, ((0, more[0]), (0, more[1])))


def _blocked(weight: NDArray[Any]) -> NDArray[Any]:
    """Return a matrix as blocks of columns, shape (blocks, inputs, LAYER_BLOCK)."""
    filled = _filled(weight)
    # All inputs of a block of outputs are contiguous, in the order in which they are
    # read.
    return filled.reshape(len(filled), -1, LAYER_BLOCK).swapaxes(0, 1)
