"""Forward and backward pass of the network."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.network.architecture import Weights

Array = NDArray[Any]


@dataclass(frozen=True)
class Activations:
    """Outputs of every layer for N inputs, as needed by the backward pass.

    Attributes:
        trunk: The input and every trunk layer's output, shape (N, inputs) and (N, hidden).
        path_hidden: The configuration head's hidden layer, shape (N, hidden).
        path: The configuration head, in (-1, 1), shape (N, path_outputs): the paper's phi.
        log_rate: The time head before its exponential, shape (N, rate_outputs).
    """

    trunk: tuple[Array, ...]
    path_hidden: Array
    path: Array
    log_rate: Array


def forward(weights: Weights, features: Array) -> Activations:
    """Evaluate the network.

    Args:
        weights: Result of ``Architecture.split``, float32 or float64.
        features: Inputs, shape (N, inputs), of the same type.
    """
    *trunk_weights, hidden_weights, path_weights, (rate_weight, rate_bias) = weights
    trunk = [features]
    for layer in trunk_weights:
        trunk.append(_tanh_layer(layer, trunk[-1]))
    hidden = _tanh_layer(hidden_weights, trunk[-1])
    log_rate = trunk[-1] @ rate_weight
    log_rate += rate_bias
    return Activations(tuple(trunk), hidden, _tanh_layer(path_weights, hidden), log_rate)


def _tanh_layer(layer: tuple[Array, Array], x: Array) -> Array:
    weight, bias = layer
    y: Array = x @ weight
    y += bias
    np.tanh(y, out=y)
    return y


def backward(
    weights: Weights, activations: Activations, *, path_gradient: Array, log_rate_gradient: Array, out: Weights
) -> None:
    """Write the gradient of a scalar with respect to all weights.

    Args:
        weights: Weights that the activations were computed with.
        activations: Result of ``forward``.
        path_gradient: Gradient of the scalar with respect to ``activations.path``, shape (N, path_outputs).
        log_rate_gradient: Gradient of the scalar with respect to ``activations.log_rate``, shape (N, rate_outputs).
        out: Output arrays, structured as ``weights``.
    """
    top, hidden = activations.trunk[-1], activations.path_hidden
    gradient = _through_tanh(path_gradient, activations.path)
    _weight_gradient(hidden, gradient, out[-2])
    gradient = _through_tanh(gradient @ weights[-2][0].T, hidden)
    _weight_gradient(top, gradient, out[-3])
    _weight_gradient(top, log_rate_gradient, out[-1])
    gradient = gradient @ weights[-3][0].T
    gradient += log_rate_gradient @ weights[-1][0].T
    for index in range(len(weights) - 4, -1, -1):
        gradient = _through_tanh(gradient, activations.trunk[index + 1])
        _weight_gradient(activations.trunk[index], gradient, out[index])
        if index:  # the gradient of the features is not needed
            gradient = gradient @ weights[index][0].T


def _through_tanh(gradient: Array, y: Array) -> Array:
    """Return the gradient before a tanh from that after it: times ``1 - y^2``."""
    derivative: Array = y * y
    np.subtract(1.0, derivative, out=derivative)
    derivative *= gradient
    return derivative


def _weight_gradient(x: Array, gradient: Array, out: tuple[Array, Array]) -> None:
    """Write the gradient of a layer's weights from its input and the gradient of its output."""
    np.matmul(x.T, gradient, out=out[0])
    np.sum(gradient, axis=0, out=out[1])
