"""Kernels without a compiler: NumPy runs the tape, one operation at a time on blocks of lanes.

Kernels that use CasADi's map are the reference in tests of the fast backends.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from cnpgen.kernels.kernel import Array, GridKernel, Kernel, axis_names, check_grid, evaluate_lanes
from cnpgen.kernels.tape import NAMES, OPERATIONS, GridSpec, Tape

POINTS_PER_BLOCK = 8192  # lanes or points; smaller blocks cost more interpreter time, larger ones exceed the cache


def _if_else_zero(condition: Any, value: Any, out: Array) -> None:
    out[...] = np.where(np.not_equal(condition, 0.0), value, 0.0)  # a product would turn 0 * inf into nan


_APPLY: dict[str, Callable[..., Any]] = {
    "ADD": np.add, "SUB": np.subtract, "MUL": np.multiply, "DIV": np.divide, "NEG": np.negative, "SQ": np.square,
    "TWICE": lambda x, out: np.add(x, x, out=out),
    "INV": np.reciprocal, "SQRT": np.sqrt, "FABS": np.abs, "SIGN": np.sign, "SIN": np.sin,
    "COS": np.cos, "EXP": np.exp, "FMIN": np.fmin, "FMAX": np.fmax, "LT": np.less, "LE": np.less_equal, "EQ": np.equal,
    "NE": np.not_equal, "NOT": np.logical_not, "AND": np.logical_and, "OR": np.logical_or,
    "IF_ELSE_ZERO": _if_else_zero,
}  # fmt: skip


Read = Callable[[int, int], Any]  # component of an argument, for the lanes of a block
Write = Callable[[int, int, Any], None]  # stores a component of a result


class _LaneBlock:
    """A program bound to the work rows of a block of lanes, with functions that read and write its present lanes."""

    def __init__(self, program: "list[Bind]", rows: list[Array]) -> None:
        self.rows = rows
        self._steps = [bind(self) for bind in program]

    def run(self, read: Read, write: Write) -> None:
        """Run the program."""
        self._read, self._write = read, write
        for step in self._steps:
            step()

    def load(self, row: int, argument: int, component: int) -> None:
        """Fill a row with a component of an argument."""
        np.copyto(self.rows[row], self._read(argument, component))

    def store(self, result: int, component: int, operand: "int | float") -> None:
        """Store a row or a number as a component of a result."""
        self._write(result, component, self.rows[operand] if isinstance(operand, int) else operand)


Bind = Callable[[_LaneBlock], Callable[[], Any]]  # binding a step to its rows once halves its interpreter time


class _BlockProgram:
    """A tape with a grid, run by NumPy on blocks of points; work rows have shape (nodes, lanes)."""

    def __init__(self, tape: Tape, grid: GridSpec) -> None:
        self._grid, self._dtype = grid, tape.dtype
        self._slots, self._program = _allocate(tape)

    def run(self, arguments: Sequence[Array], out: Sequence[Array], k: int, n: int) -> None:
        """Evaluate all points of K nodes and N lanes, a few nodes at a time."""
        count = max(POINTS_PER_BLOCK // max(n, 1), 1)
        work = np.empty((self._slots, min(count, k), min(n, POINTS_PER_BLOCK)), self._dtype)
        block = _LaneBlock(self._program, list(work))
        with np.errstate(all="ignore"):
            for node in range(0, k, count):
                for lane in range(0, n, POINTS_PER_BLOCK):
                    nodes, lanes = slice(node, min(node + count, k)), slice(lane, min(lane + POINTS_PER_BLOCK, n))
                    shape = nodes.stop - node, lanes.stop - lane
                    if shape != block.rows[0].shape:
                        block = _LaneBlock(self._program, [row[: shape[0], : shape[1]] for row in work])
                    block.run(*self._points(arguments, out, nodes, lanes))

    def _points(
        self, arguments: Sequence[Array], out: Sequence[Array], nodes: slice, lanes: slice
    ) -> tuple[Read, Write]:
        """Return the functions that read and write a block of points."""
        part: dict[str, Any] = {"point": (nodes, lanes), "lane": (None, lanes), "node": (nodes, None), "fixed": ()}

        def read(argument: int, component: int) -> Any:
            return arguments[argument][(component, *part[self._grid.arguments[argument]])]

        def write(result: int, component: int, value: Any) -> None:
            if self._grid.results[result] == "point":
                out[result][component, nodes, lanes] = value
            else:
                shape = (nodes.stop - nodes.start, lanes.stop - lanes.start)
                out[result][component, lanes] += np.broadcast_to(value, shape).sum(axis=0)

        return read, write


class InterpretedKernel(Kernel):
    """A tape evaluated by NumPy, on a grid of one node."""

    def __init__(self, tape: Tape) -> None:
        super().__init__(tape)
        points = GridSpec(("point",) * len(tape.inputs), ("point",) * len(tape.outputs))
        self._program = _BlockProgram(tape, points)

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate the batch; see ``Kernel``."""
        return evaluate_lanes(self.tape, arguments, self._evaluate)

    def _evaluate(self, arguments: Sequence[Array], n: int) -> list[Array]:
        results = [np.empty((width, 1, n)) for width in self.tape.outputs]
        self._program.run([argument[:, None] for argument in arguments], results, 1, n)
        return [result[:, 0] for result in results]


class InterpretedGridKernel(GridKernel):
    """A tape with a grid evaluated by NumPy."""

    def __init__(self, tape: Tape) -> None:
        super().__init__(tape)
        self._program = _BlockProgram(tape, self.grid)

    def __call__(self, *arguments: Array, out: Sequence[Array]) -> None:
        """Evaluate the grid; see ``GridKernel``."""
        self._program.run(arguments, out, *check_grid(self.tape, self.grid, arguments, out))


def _allocate(tape: Tape) -> tuple[int, list[Bind]]:
    """Assign a work row to every value, reusing rows of dead values; bind instructions to their operands."""
    last = np.zeros(len(tape), int)
    names = [NAMES[code] for code in tape.operation]
    for k, name in enumerate(names):
        for operand in _operands(tape, k, name):
            last[operand] = k
    free: list[int] = []
    place: dict[int, Any] = {}  # value -> row, or the constant itself
    count = 0
    program: list[Bind] = []
    for k, name in enumerate(names):
        if name == "CONST":
            place[k] = float(tape.constant[k])  # a Python number does not promote float32
            continue
        operands = [place[operand] for operand in _operands(tape, k, name)]
        dying = {operand for operand in _operands(tape, k, name) if last[operand] == k}
        free.extend(place[operand] for operand in dying if isinstance(place[operand], int))
        if name == "OUTPUT":
            program.append(_bind_method(_LaneBlock.store, int(tape.b[k]), int(tape.constant[k]), operands[0]))
            continue
        place[k] = row = free.pop() if free else count
        count = max(count, row + 1)
        load = name == "INPUT"
        program.append(
            _bind_method(_LaneBlock.load, row, int(tape.a[k]), int(tape.b[k])) if load else _bind(name, operands, row)
        )
        if last[k] == 0:
            free.append(row)
    return max(count, 1), program


def _operands(tape: Tape, k: int, name: str) -> list[int]:
    return [int(tape.a[k]), int(tape.b[k])][: OPERATIONS[name]]


def _bind_method(method: Callable[..., None], *arguments: float) -> Bind:
    return lambda block: partial(method, block, *arguments)


def _bind(name: str, operands: list[Any], row: int) -> Bind:
    apply = _APPLY[name]

    def bind(block: _LaneBlock) -> Callable[[], Any]:
        rows = block.rows
        values = (rows[operand] if isinstance(operand, int) else operand for operand in operands)
        return partial(apply, *values, rows[row])

    return bind


class MappedKernel(Kernel):
    """An SX function evaluated lane by lane by CasADi's virtual machine."""

    def __init__(self, tape: Tape, function: Any) -> None:
        super().__init__(tape)
        self._function = function

    def __call__(self, *arguments: Array) -> list[Array]:
        """Evaluate the batch; see ``Kernel``."""
        widths = self.tape.outputs
        return evaluate_lanes(self.tape, arguments, lambda inputs, n: _map(self._function, inputs, n, widths))


class MappedGridKernel(GridKernel):
    """An SX function evaluated point by point by CasADi's virtual machine, always in float64."""

    def __init__(self, tape: Tape, function: Any) -> None:
        super().__init__(tape)
        self._function = function

    def __call__(self, *arguments: Array, out: Sequence[Array]) -> None:
        """Evaluate the grid; see ``GridKernel``."""
        nodes, lanes = check_grid(self.tape, self.grid, arguments, out)
        points = []
        for argument, axes in zip(arguments, self.grid.arguments, strict=True):
            names = axis_names(axes)
            shape = len(argument), nodes if "nodes" in names else 1, lanes if "lanes" in names else 1
            spread = np.broadcast_to(argument.reshape(shape), (len(argument), nodes, lanes))
            points.append(spread.reshape(len(argument), nodes * lanes))
        results = _map(self._function, points, nodes * lanes, self.tape.outputs)
        for result, values, axes in zip(out, results, self.grid.results, strict=True):
            grid = values.reshape(len(values), nodes, lanes)
            result[...] = grid if axes == "point" else result + grid.sum(axis=1)


def _map(function: Any, arguments: Sequence[Array], n: int, widths: Sequence[int]) -> list[Array]:
    if n == 0:
        return [np.empty((width, 0)) for width in widths]
    results = function.map(n)(*arguments)
    results = results if isinstance(results, tuple) else (results,)
    return [np.ascontiguousarray(np.array(result)) for result in results]
