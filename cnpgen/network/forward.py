"""The network as functions of its parameters: forwards, and backwards from the gradient of what it gave."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.network.architecture import Architecture, Layer

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


def forward(architecture: Architecture, parameters: Array, features: Array) -> Activations:
    """Evaluate the network.

    Args:
        architecture: The architecture.
        parameters: All parameters, shape (n_parameters,), float32 or float64.
        features: Inputs, shape (N, inputs), of the same type.
    """
    trunk = [features]
    for layer in architecture.trunk:
        trunk.append(_tanh_layer(layer, parameters, trunk[-1]))
    hidden_layer, path_layer, rate_layer = architecture.heads
    hidden = _tanh_layer(hidden_layer, parameters, trunk[-1])
    path = _tanh_layer(path_layer, parameters, hidden)
    log_rate = trunk[-1] @ rate_layer.weight(parameters)
    log_rate += rate_layer.bias(parameters)
    return Activations(tuple(trunk), hidden, path, log_rate)


def _tanh_layer(layer: Layer, parameters: Array, x: Array) -> Array:
    y: Array = x @ layer.weight(parameters)
    y += layer.bias(parameters)
    np.tanh(y, out=y)
    return y


def backward(
    architecture: Architecture,
    parameters: Array,
    activations: Activations,
    *,
    path_gradient: Array,
    log_rate_gradient: Array,
    out: Array,
) -> None:
    """Write the gradient of a scalar with respect to all parameters.

    Args:
        architecture: The architecture.
        parameters: What the activations were computed with.
        activations: What ``forward`` gave.
        path_gradient: Gradient of the scalar with respect to ``activations.path``, shape (N, path_outputs).
        log_rate_gradient: Likewise to ``activations.log_rate``, shape (N, rate_outputs).
        out: Where to, shape (n_parameters,).
    """
    hidden_layer, path_layer, rate_layer = architecture.heads
    top = activations.trunk[-1]
    gradient = _through_tanh(path_gradient, activations.path)
    gradient = _layer_gradient(path_layer, parameters, activations.path_hidden, gradient, out)
    gradient = _through_tanh(gradient, activations.path_hidden)
    gradient = _layer_gradient(hidden_layer, parameters, top, gradient, out)
    gradient += _layer_gradient(rate_layer, parameters, top, log_rate_gradient, out)
    for layer, x, y in zip(architecture.trunk[::-1], activations.trunk[-2::-1], activations.trunk[:0:-1], strict=True):
        gradient = _through_tanh(gradient, y)
        if layer.start:
            gradient = _layer_gradient(layer, parameters, x, gradient, out)
        else:  # nobody asks for the gradient of the features
            _parameter_gradient(layer, x, gradient, out)


def _through_tanh(gradient: Array, y: Array) -> Array:
    """Gradient before a tanh from that behind it: times ``1 - y^2``."""
    slope = y * y
    np.subtract(1.0, slope, out=slope)
    slope *= gradient
    return slope


def _layer_gradient(layer: Layer, parameters: Array, x: Array, gradient: Array, out: Array) -> Array:
    """Write a layer's part of the gradient; return the gradient of its input, shape (N, inputs)."""
    _parameter_gradient(layer, x, gradient, out)
    before: Array = gradient @ layer.weight(parameters).T
    return before


def _parameter_gradient(layer: Layer, x: Array, gradient: Array, out: Array) -> None:
    np.matmul(x.T, gradient, out=layer.weight(out))
    np.sum(gradient, axis=0, out=layer.bias(out))
