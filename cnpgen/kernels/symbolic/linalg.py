"""Small linear algebra on SX scalars and floats, without branches and pivoting."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Scalar = Any  # a CasADi SX of shape (1, 1) or a float
Vector = Sequence[Scalar]
Matrix = Sequence[Sequence[Scalar]]
Vec = list[Scalar]


def dot(a: Vector, b: Vector) -> Scalar:
    """Return the dot product of two vectors of equal length, without the products with a float zero.

    CasADi drops them as well, but takes ten times as long to find them.
    """
    products = [
        x * y for x, y in zip(a, b, strict=True) if not (_is_zero(x) or _is_zero(y))
    ]
    return sum(products[1:], products[0]) if products else 0.0


def _is_zero(x: Scalar) -> bool:
    return isinstance(x, float) and x == 0.0


def cross(a: Vector, b: Vector) -> list[Scalar]:
    """Return the cross product of two 3-vectors."""
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def add(a: Vector, b: Vector) -> list[Scalar]:
    """Return ``a + b``."""
    return [x + y for x, y in zip(a, b, strict=True)]


def subtract(a: Vector, b: Vector) -> list[Scalar]:
    """Return ``a - b``."""
    return [x - y for x, y in zip(a, b, strict=True)]


def scale(a: Vector, factor: Scalar) -> list[Scalar]:
    """Return ``factor * a``."""
    return [x * factor for x in a]


def gram(rows: Matrix, damping: float = 0.0) -> list[list[Scalar]]:
    """Return the lower triangle of ``A A^T + damping I`` for the rows of A."""
    m = len(rows)
    return [
        [dot(rows[i], rows[j]) + (damping if i == j else 0.0) for j in range(i + 1)]
        for i in range(m)
    ]


def factorize(
    lower: Matrix, safeguard: Callable[[Scalar], Scalar] | None = None
) -> tuple[list[list[Scalar]], list[Scalar]]:
    """Factorize a symmetric matrix, given by its lower triangle, as ``L D L^T``: return strictly lower L, and 1 / D.

    The safeguard is applied to every pivot, for example to keep it positive.
    """
    # Column by column without pivoting, which is stable for positive definite matrices:
    #   d_i = a_ii - sum_j l_ij^2 d_j,   l_ij = (a_ij - sum_k l_ik d_k l_jk) / d_j.
    factor: list[list[Scalar]] = []
    inverse: list[Scalar] = []
    for i, entries in enumerate(lower):
        row: list[Scalar] = []
        # Row i of L D.
        scaled: list[Scalar] = []
        for j in range(i):
            value = entries[j] - dot(scaled, factor[j]) if j else entries[0]
            scaled.append(value)
            row.append(value * inverse[j])
        pivot = entries[i] - dot(row, scaled) if i else entries[0]
        inverse.append(1.0 / (safeguard(pivot) if safeguard else pivot))
        factor.append(row)
    return factor, inverse


def substitute(factor: Matrix, inverse: Vector, right: Vector) -> list[Scalar]:
    """Solve ``L D L^T x = right`` with the result of ``factorize``."""
    x = list(right)
    m = len(x)
    # Forward with L, divided by D, then backward with L^T.
    for i in range(m):
        for j in range(i):
            x[i] = x[i] - factor[i][j] * x[j]
    x = [value * pivot for value, pivot in zip(x, inverse, strict=True)]
    for i in reversed(range(m)):
        for j in range(i + 1, m):
            x[i] = x[i] - factor[j][i] * x[j]
    return x


def solve(lower: Matrix, right: Vector) -> list[Scalar]:
    """Solve a symmetric system given by its lower triangle."""
    return substitute(*factorize(lower), right)


def inverse3(columns: Matrix) -> list[list[Scalar]]:
    """Return the rows of the inverse of the 3 x 3 matrix with these columns."""
    # Rows of the adjugate are cross products of columns; the determinant is c0 . (c1 x
    # c2).
    rows = [
        cross(columns[1], columns[2]),
        cross(columns[2], columns[0]),
        cross(columns[0], columns[1]),
    ]
    reciprocal = 1.0 / dot(columns[0], rows[0])
    return [scale(row, reciprocal) for row in rows]


def symbols(name: str, width: int) -> tuple[Any, Vec]:
    """Return a fresh SX column of ``width`` symbols and the list of its scalars."""
    import casadi as ca

    column = ca.SX.sym(name, width)
    return column, ca.vertsplit(column)


def constants(values: NDArray[np.float64]) -> Vec:
    """Return an array as a vector of floats."""
    return [float(value) for value in values]


def rows_of(matrix: NDArray[np.float64]) -> list[Vec]:
    """Return an array as a list of rows of floats."""
    return [constants(row) for row in matrix]


def times(matrix: list[Vec], vector: Vec) -> Vec:
    """Return ``A x`` for the rows of a matrix of three columns."""
    return [dot(row, vector) for row in matrix]


def transposed_times(matrix: list[Vec], vector: Vec) -> Vec:
    """Return ``A^T x`` for the rows of a 3 x 3 matrix."""
    return [
        dot([matrix[row][column] for row in range(3)], vector) for column in range(3)
    ]


def product(a: list[Vec], b: list[Vec]) -> list[Vec]:
    """Return the rows of ``A B`` for those of two 3 x 3 matrices."""
    return [
        [dot(row, [b[k][column] for k in range(3)]) for column in range(3)] for row in a
    ]
