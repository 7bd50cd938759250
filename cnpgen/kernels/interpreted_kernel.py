"""Kernels without machine code: NumPy runs the tape, one operation at a time on blocks of lanes."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from cnpgen.arrays import Array
from cnpgen.kernels.kernel import (
    GridKernel,
    Kernel,
    check_grid,
    evaluate_lanes,
)
from cnpgen.kernels.tape import NAMES, OPERATIONS, Axes, GridSpec, Tape

# Lanes or points; smaller blocks cost more interpreter time, larger ones exceed the
# cache.
POINTS_PER_BLOCK = 8192


def _if_else_zero(condition: Any, value: Any, out: Array) -> None:
    # A product would turn 0 * inf into nan.
    out[...] = np.where(np.not_equal(condition, 0.0), value, 0.0)


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


# Operation; row of its result; rows of its operands, or numbers.
Step = tuple[str, int, tuple[Any, ...]]


class _LaneBlock:
    """A program bound to the work rows of a block of lanes, which halves its interpreter time.

    Functions read and write the present lanes.
    """

    def __init__(self, program: list[Step], rows: list[Array]) -> None:
        self.rows = rows
        self._steps = [self._bound(*step) for step in program]

    def _bound(
        self, name: str, row: int, operands: tuple[Any, ...]
    ) -> Callable[[], Any]:
        if name == "INPUT":
            return partial(self._load, row, *operands)
        if name == "OUTPUT":
            return partial(self._store, *operands)
        return partial(_APPLY[name], *map(self._value, operands), self.rows[row])

    def _value(self, operand: int | float) -> Any:
        return self.rows[operand] if isinstance(operand, int) else operand

    def run(self, read: Read, write: Write) -> None:
        """Run the program."""
        self._read = read
        self._write = write
        for step in self._steps:
            step()

    def _load(self, row: int, argument: int, component: int) -> None:
        np.copyto(self.rows[row], self._read(argument, component))

    def _store(self, result: int, component: int, operand: int | float) -> None:
        self._write(result, component, self._value(operand))


class _BlockProgram:
    """A tape with a grid, run by NumPy on blocks of points.

    Work rows have shape (nodes, lanes).
    """

    def __init__(self, tape: Tape, grid: GridSpec) -> None:
        self._grid = grid
        self._dtype = tape.dtype
        self._slots, self._program = _allocate(tape)

    def run(
        self, arguments: Sequence[Array], out: Sequence[Array], k: int, n: int
    ) -> None:
        """Evaluate all points of K nodes and N lanes, a few nodes at a time."""
        # Nodes of a block: as many as fit into it with all lanes, at least one.
        count = max(POINTS_PER_BLOCK // max(n, 1), 1)
        work = np.empty(
            (self._slots, min(count, k), min(n, POINTS_PER_BLOCK)), self._dtype
        )
        block = _LaneBlock(self._program, list(work))
        # Values inf and nan are results like others, as in machine code.
        with np.errstate(all="ignore"):
            for node in range(0, k, count):
                for lane in range(0, n, POINTS_PER_BLOCK):
                    nodes = slice(node, min(node + count, k))
                    lanes = slice(lane, min(lane + POINTS_PER_BLOCK, n))
                    shape = nodes.stop - node, lanes.stop - lane
                    # The last block along an axis is smaller; it works on parts of the
                    # same rows.
                    if shape != block.rows[0].shape:
                        block = _LaneBlock(
                            self._program, [row[: shape[0], : shape[1]] for row in work]
                        )
                    block.run(*self._points(arguments, out, nodes, lanes))

    def _points(
        self,
        arguments: Sequence[Array],
        out: Sequence[Array],
        nodes: slice,
        lanes: slice,
    ) -> tuple[Read, Write]:
        """Return the functions that read and write a block of points."""
        part: dict[str, Any] = {
            "point": (nodes, lanes),
            "lane": (None, lanes),
            "node": (nodes, None),
            "fixed": (),
        }

        def read(argument: int, component: int) -> Any:
            return arguments[argument][
                (component, *part[self._grid.arguments[argument]])
            ]

        def write(result: int, component: int, value: Any) -> None:
            if self._grid.results[result] == "point":
                out[result][component, nodes, lanes] = value
            else:
                shape = (nodes.stop - nodes.start, lanes.stop - lanes.start)
                # A result without a node axis is the sum over the nodes.
                out[result][component, lanes] += np.broadcast_to(value, shape).sum(
                    axis=0
                )

        return read, write


class InterpretedKernel(Kernel):
    """A tape evaluated by NumPy, on a grid of one node."""

    def __init__(self, tape: Tape) -> None:
        super().__init__(tape)
        every: Axes = "point"
        self._program = _BlockProgram(
            tape, GridSpec((every,) * len(tape.inputs), (every,) * len(tape.outputs))
        )

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
        self._program.run(
            arguments, out, *check_grid(self.tape, self.grid, arguments, out)
        )


def _allocate(tape: Tape) -> tuple[int, list[Step]]:
    """Assign a work row to every value, reusing rows of dead values.

    Return the number of rows and the program.
    """
    columns = (
        tape.operation.tolist(),
        tape.a.tolist(),
        tape.b.tolist(),
        tape.constant.tolist(),
    )
    # Last instruction that reads each value; 0 for none, as number 0 reads none.
    last = np.zeros(len(tape), int)
    for k, (code, a, b, _) in enumerate(zip(*columns, strict=True)):
        last[[a, b][: OPERATIONS[NAMES[code]]]] = k
    free: list[int] = []
    # Value -> row, or the constant itself.
    place: dict[int, Any] = {}
    count = 0
    program: list[Step] = []
    for k, (code, a, b, constant) in enumerate(zip(*columns, strict=True)):
        name = NAMES[code]
        if name == "CONST":
            # A Python number does not promote float32.
            place[k] = constant
            continue
        operands = (a, b)[: OPERATIONS[name]]
        places = tuple(place[operand] for operand in operands)
        dying = {operand for operand in operands if last[operand] == k}
        # A result may take the row of an operand, since operations are elementwise.
        free.extend(
            place[operand] for operand in dying if isinstance(place[operand], int)
        )
        if name == "OUTPUT":
            program.append((name, -1, (b, int(constant), *places)))
            continue
        place[k] = row = free.pop() if free else count
        count = max(count, row + 1)
        program.append((name, row, (a, b) if name == "INPUT" else places))
        if last[k] == 0:
            free.append(row)
    return max(count, 1), program
