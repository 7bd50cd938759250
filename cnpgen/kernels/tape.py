"""Tapes: SX functions as flat lists of scalar operations, with the loop or grid that runs them."""

import hashlib
import json
from dataclasses import astuple, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

# Operations of a tape: name -> number of operands. The names are those of CasADi's OP_*
# constants.
OPERATIONS = {
    "CONST": 0, "INPUT": 0, "OUTPUT": 1,
    "ADD": 2, "SUB": 2, "MUL": 2, "DIV": 2, "NEG": 1, "SQ": 1, "TWICE": 1, "INV": 1, "SQRT": 1, "FABS": 1, "SIGN": 1,
    "SIN": 1, "COS": 1, "EXP": 1, "FMIN": 2, "FMAX": 2,
    "LT": 2, "LE": 2, "EQ": 2, "NE": 2, "NOT": 1, "AND": 2, "OR": 2, "IF_ELSE_ZERO": 2,
}  # fmt: skip
NAMES = tuple(OPERATIONS)
CODES = {name: code for code, name in enumerate(NAMES)}


@dataclass(frozen=True)
class Loop:
    """A fixed-point iteration of the tape on each lane: ``x, error = tape(x, parameters...)``.

    The first input of the tape is the state. Its outputs are the next state and the
    error of the input state. A lane whose error is below ``tolerance`` takes that last
    step and then stays constant.

    Attributes:
        tolerance: Error below which a lane has converged.
        limit: Maximum number of steps.
    """

    tolerance: float
    limit: int


Axes = Literal["point", "lane", "node", "fixed"]
Dtype = Literal["float64", "float32"]
DTYPES: tuple[Dtype, ...] = ("float64", "float32")
# Widest first, so that all are aligned.
STORED_TYPES = {
    "constant": "<f8",
    "a": "<i4",
    "b": "<i4",
    "operation": "<i2",
}


@dataclass(frozen=True)
class GridSpec:
    """Evaluation of the tape at K nodes of every lane, with results per point or summed over the nodes of a lane.

    Attributes:
        arguments: Axes of each argument: "point" (nodes and lanes), "lane", "node" or
            "fixed" (neither). Arguments without a lane axis ("node", "fixed") must not
            be nan.
        results: Axes of each result: "point" or "lane"; "lane" is the sum over the
            nodes.
    """

    arguments: tuple[Axes, ...]
    results: tuple[Axes, ...]


@dataclass(frozen=True)
class Tape:
    """A straight-line program on scalars.

    Instruction k computes value k. ``INPUT`` has a = argument, b = component;
    ``OUTPUT`` has a = value, b = argument and ``constant`` = component; every other
    operation has a, b = operand values.

    Attributes:
        name: A C identifier.
        inputs: Width of every argument.
        outputs: Width of every result.
        operation: Operation codes, shape (K,), int16.
        a: First operands, shape (K,), int32.
        b: Second operands, shape (K,), int32.
        constant: Constants, shape (K,), float64.
        loop: The iteration, or None to evaluate once.
        grid: The grid of evaluation points, or None for one point per lane.
        dtype: Precision of the arithmetic.
    """

    name: str
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    operation: NDArray[np.int16]
    a: NDArray[np.int32]
    b: NDArray[np.int32]
    constant: NDArray[np.float64]
    loop: Loop | None = None
    grid: GridSpec | None = None
    dtype: Dtype = "float64"

    def __len__(self) -> int:
        return len(self.operation)

    def to_bytes(self) -> bytes:
        """Serialize with a checksum; equal tapes have equal bytes."""
        header = {
            name: getattr(self, name)
            for name in ("name", "inputs", "outputs", "loop", "grid", "dtype")
        }
        columns = [
            getattr(self, name).astype(kind).tobytes()
            for name, kind in STORED_TYPES.items()
        ]
        content = b"".join(
            [json.dumps(header, default=astuple).encode(), b"\n", *columns]
        )
        return hashlib.sha256(content).digest() + content

    @classmethod
    def from_bytes(cls, data: bytes) -> "Tape":
        """Deserialize the result of ``to_bytes``.

        Raises:
            ValueError: The checksum is wrong.
        """
        checksum = data[:32]
        content = data[32:]
        if hashlib.sha256(content).digest() != checksum:
            raise ValueError("damaged tape: its checksum is wrong")
        head, _, body = content.partition(b"\n")
        header = json.loads(head)
        sizes = {name: np.dtype(kind).itemsize for name, kind in STORED_TYPES.items()}
        count = len(body) // sum(sizes.values())
        first = 0
        columns = {}
        for name, kind in STORED_TYPES.items():
            columns[name] = np.frombuffer(body, kind, count, first)
            first += count * sizes[name]
        return cls(
            name=header["name"],
            inputs=tuple(header["inputs"]),
            outputs=tuple(header["outputs"]),
            **columns,
            loop=Loop(*header["loop"]) if header["loop"] else None,
            grid=GridSpec(*map(tuple, header["grid"])) if header["grid"] else None,
            dtype=header["dtype"],
        )


def tape_from_function(
    function: Any,
    loop: Loop | None = None,
    *,
    grid: GridSpec | None = None,
    dtype: Dtype = "float64",
) -> Tape:
    """Flatten a CasADi SX function, whose arguments and results are columns.

    Raises:
        ValueError: The function uses an unsupported operation, or the grid does not
            match it.
    """
    operation, a, b, constant = _columns(function)
    widths_in = tuple(function.nnz_in(i) for i in range(function.n_in()))
    widths_out = tuple(function.nnz_out(i) for i in range(function.n_out()))
    _check_dense(function)
    _check_grid(function, grid)
    return Tape(
        function.name(),
        widths_in,
        widths_out,
        operation,
        a,
        b,
        constant,
        loop=loop,
        grid=grid,
        dtype=dtype,
    )


def _columns(function: Any) -> tuple[NDArray[Any], ...]:
    """Return the operations, both operands and the constants of all instructions.

    CasADi's instructions work on numbered slots. Here every value keeps its own index.
    """
    import casadi as ca

    # The codes of operations are those of the installed CasADi: find them by name.
    known = {getattr(ca, f"OP_{name}"): name for name in OPERATIONS}
    count = function.n_instructions()
    operation = np.zeros(count, np.int16)
    a = np.zeros(count, np.int32)
    b = np.zeros(count, np.int32)
    constant = np.zeros(count)
    # Slot of the work vector -> index of its present value.
    contents: dict[int, int] = {}
    for k in range(count):
        code = function.instruction_id(k)
        out = function.instruction_output(k)
        operands = function.instruction_input(k)
        name = known.get(code)
        if name is None:
            raise ValueError(
                f"{function.name()}: operation {code} is not supported in kernels"
            )
        operation[k] = CODES[name]
        if name == "CONST":
            constant[k] = function.instruction_constant(k)
        elif name == "INPUT":
            a[k], b[k] = operands
        elif name == "OUTPUT":
            # A slot of the work vector is reused: ``contents`` finds the instruction
            # that wrote it last.
            a[k] = contents[operands[0]]
            b[k] = out[0]
            constant[k] = out[1]
        else:
            a[k] = contents[operands[0]]
            b[k] = contents[operands[1]] if OPERATIONS[name] == 2 else 0
        if name != "OUTPUT":
            contents[out[0]] = k
    return operation, a, b, constant


def _check_dense(function: Any) -> None:
    """Raise ValueError for sparse arguments and results, whose components have no fixed position."""
    sparse = [
        f"argument {i}"
        for i in range(function.n_in())
        if not function.sparsity_in(i).is_dense()
    ]
    sparse += [
        f"result {i}"
        for i in range(function.n_out())
        if not function.sparsity_out(i).is_dense()
    ]
    if sparse:
        raise ValueError(f"{function.name()}: {sparse[0]} is sparse; densify it")


def _check_grid(function: Any, grid: GridSpec | None) -> None:
    """Raise ValueError if the grid does not match the function."""
    if grid is None:
        return
    if (len(grid.arguments), len(grid.results)) != (function.n_in(), function.n_out()):
        raise ValueError(
            f"{function.name()}: the grid must name {function.n_in()} arguments and {function.n_out()} results,"
            f" got {len(grid.arguments)} and {len(grid.results)}"
        )
    if not {"point", "lane"} >= set(grid.results):
        raise ValueError(
            f"{function.name()}: results of a grid are per point or per lane, got {grid.results}"
        )
