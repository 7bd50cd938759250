"""The architecture of the network (paper, section on the neural network), its forward and its backward pass.

All parameters are in one vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cnpgen.arrays import AnyArray
from cnpgen.errors import UsageError

Weights = tuple[tuple[AnyArray, AnyArray], ...]  # (W, b) of every layer


@dataclass(frozen=True)
class Layer:
    """One affine layer ``y = x W + b``.

    Attributes:
        name: Its name in model files.
        inputs: Width of x.
        outputs: Width of y.
        start: Offset of W in the vector of all parameters; b follows.
    """

    name: str
    inputs: int
    outputs: int
    start: int

    @property
    def stop(self) -> int:
        """Offset of the next layer."""
        # The bias follows the weights as one more row.
        return self.start + (self.inputs + 1) * self.outputs

    def weight(self, parameters: AnyArray) -> AnyArray:
        """Return a view of W, shape (inputs, outputs), of a vector of all parameters."""
        return parameters[self.start : self.stop - self.outputs].reshape(
            self.inputs, self.outputs
        )

    def bias(self, parameters: AnyArray) -> AnyArray:
        """Return a view of b, shape (outputs,), of a vector of all parameters."""
        return parameters[self.stop - self.outputs : self.stop]


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """A trunk of tanh layers, a configuration head of two tanh layers, and a time head of one layer and exp.

    Attributes:
        inputs: Number of features.
        hidden: Width of the trunk and of the configuration head.
        layers: Depth of the trunk.
        path_outputs: Outputs of the configuration head (the paper's phi): interior
            points times joints.
        rate_outputs: Outputs of the time head: logarithms of the control points of r.
    """

    inputs: int
    hidden: int
    layers: int
    path_outputs: int
    rate_outputs: int

    def __str__(self) -> str:
        return f"{self.layers} x {self.hidden}"

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1:
                raise UsageError(f"{name} of a network must be at least 1, got {value}")

    @cached_property
    def trunk(self) -> tuple[Layer, ...]:
        """The tanh layers shared by both heads."""
        layers: list[Layer] = []
        for index in range(self.layers):
            inputs, start = (
                (layers[-1].outputs, layers[-1].stop) if layers else (self.inputs, 0)
            )
            layers.append(Layer(f"trunk_{index}", inputs, self.hidden, start))
        return tuple(layers)

    @cached_property
    def heads(self) -> tuple[Layer, Layer, Layer]:
        """Hidden and output layer of the configuration head, and the layer of the time head."""
        hidden = Layer("path_hidden", self.hidden, self.hidden, self.trunk[-1].stop)
        path = Layer("path_output", self.hidden, self.path_outputs, hidden.stop)
        return (
            hidden,
            path,
            Layer("rate_output", self.hidden, self.rate_outputs, path.stop),
        )

    @property
    def all_layers(self) -> tuple[Layer, ...]:
        """All layers, in the order of the parameter vector."""
        return (*self.trunk, *self.heads)

    def split(self, parameters: AnyArray) -> Weights:
        """Return views of W and b of every layer, of a vector of all parameters, shape (n_parameters,)."""
        return tuple(
            (layer.weight(parameters), layer.bias(parameters))
            for layer in self.all_layers
        )

    @property
    def n_parameters(self) -> int:
        """Length of the vector of all parameters."""
        return self.heads[-1].stop


def initial_parameters(
    architecture: Architecture, *, seed: int, head_scale: float, rate_bias: float
) -> AnyArray:
    """Draw parameters by Glorot's uniform distribution; biases are zero except that of the time head.

    With small last layers, by the factor ``head_scale`` of both heads' last weights, an
    untrained network plans the straight line at a constant rate. The bias of the time
    head is the logarithm of (expected time / duration).
    """
    random = np.random.Generator(np.random.Philox(key=seed))
    parameters = np.zeros(architecture.n_parameters, np.float32)
    _, path, rate = architecture.heads
    for layer in architecture.all_layers:
        # Glorot: variance 2 / (inputs + outputs) keeps the size of activations from
        # layer to layer.
        bound = np.sqrt(6 / (layer.inputs + layer.outputs)) * (
            head_scale if layer in {path, rate} else 1.0
        )
        layer.weight(parameters)[:] = random.uniform(
            -bound, bound, (layer.inputs, layer.outputs)
        )
    rate.bias(parameters)[:] = rate_bias
    return parameters


@dataclass(frozen=True)
class Activations:
    """Outputs of every layer for N inputs, as needed by the backward pass.

    Attributes:
        trunk: The input and every trunk layer's output, shape (N, inputs) and (N,
            hidden).
        path_hidden: The configuration head's hidden layer, shape (N, hidden).
        path: The configuration head, in (-1, 1), shape (N, path_outputs): the paper's
            phi.
        log_rate: The time head before its exponential, shape (N, rate_outputs).
    """

    trunk: tuple[AnyArray, ...]
    path_hidden: AnyArray
    path: AnyArray
    log_rate: AnyArray


def forward(weights: Weights, features: AnyArray) -> Activations:
    """Evaluate the network for inputs of shape (N, inputs), float32 or float64 as the weights."""
    *trunk_weights, hidden_weights, path_weights, (rate_weight, rate_bias) = weights
    trunk = [features]
    for layer in trunk_weights:
        trunk.append(_tanh_layer(layer, trunk[-1]))
    hidden = _tanh_layer(hidden_weights, trunk[-1])
    # The time head has no tanh: logarithms of rates are unbounded.
    log_rate = trunk[-1].dot(rate_weight)
    log_rate += rate_bias
    return Activations(
        tuple(trunk), hidden, _tanh_layer(path_weights, hidden), log_rate
    )


def _tanh_layer(layer: tuple[AnyArray, AnyArray], x: AnyArray) -> AnyArray:
    weight, bias = layer
    # The product of ``@``, in two thirds of its time for one row.
    y: AnyArray = x.dot(weight)
    y += bias
    np.tanh(y, y)
    return y


def backward(
    weights: Weights,
    activations: Activations,
    *,
    path_gradient: AnyArray,
    log_rate_gradient: AnyArray,
    out: Weights,
) -> None:
    """Write the gradient of a scalar with respect to all weights to ``out``.

    The gradients are those with respect to ``path`` and ``log_rate`` of the
    activations, and have their shapes.
    """
    # Reverse order of ``forward``: y = tanh(x W + b), dW = x^T g, dx = g W^T with g
    # before tanh.
    top, hidden = activations.trunk[-1], activations.path_hidden
    gradient = _through_tanh(path_gradient, activations.path)
    _weight_gradient(hidden, gradient, out[-2])
    gradient = _through_tanh(gradient @ weights[-2][0].T, hidden)
    _weight_gradient(top, gradient, out[-3])
    _weight_gradient(top, log_rate_gradient, out[-1])
    # Both heads read the top of the trunk, so their gradients add up.
    gradient = gradient @ weights[-3][0].T
    gradient += log_rate_gradient @ weights[-1][0].T
    for index in range(len(weights) - 4, -1, -1):
        gradient = _through_tanh(gradient, activations.trunk[index + 1])
        _weight_gradient(activations.trunk[index], gradient, out[index])
        if index:
            # The gradient of the features is not needed.
            gradient = gradient @ weights[index][0].T


def _through_tanh(gradient: AnyArray, y: AnyArray) -> AnyArray:
    """Return the gradient before a tanh from that after it: times ``1 - y^2``."""
    derivative: AnyArray = y * y
    np.subtract(1.0, derivative, out=derivative)
    derivative *= gradient
    return derivative


def _weight_gradient(
    x: AnyArray, gradient: AnyArray, out: tuple[AnyArray, AnyArray]
) -> None:
    """Write the gradient of a layer's weights from its input and the gradient of its output."""
    np.matmul(x.T, gradient, out=out[0])
    np.sum(gradient, axis=0, out=out[1])
