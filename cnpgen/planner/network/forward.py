"""The network as functions of its weights: forwards, and backwards from the gradient of what it gave."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.planner.network.architecture import Weights

Array = NDArray[Any]


@dataclass(frozen=True)
class Activations:
    """What every layer gave for N inputs; the backward pass needs all of it.

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
        weights: What ``Architecture.split`` gives, float32 or float64.
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
        weights: What the activations were computed with.
        activations: What ``forward`` gave.
        path_gradient: Gradient of the scalar with respect to ``activations.path``, shape (N, path_outputs).
        log_rate_gradient: Likewise to ``activations.log_rate``, shape (N, rate_outputs).
        out: Where to, as ``weights``.
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
        if index:  # nobody asks for the gradient of the features
            gradient = gradient @ weights[index][0].T


def _through_tanh(gradient: Array, y: Array) -> Array:
    """Gradient before a tanh from that behind it: times ``1 - y^2``."""
    slope: Array = y * y
    np.subtract(1.0, slope, out=slope)
    slope *= gradient
    return slope


def _weight_gradient(x: Array, gradient: Array, out: tuple[Array, Array]) -> None:
    """Write the gradient of a layer's weights from its input and the gradient behind it."""
    np.matmul(x.T, gradient, out=out[0])
    np.sum(gradient, axis=0, out=out[1])
