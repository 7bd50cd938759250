"""The architecture of the network (paper, section on the neural network), with all parameters in one vector."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cnpgen.errors import UsageError

Array = NDArray[Any]
Weights = tuple[tuple[Array, Array], ...]  # (W, b) of every layer


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
        return self.start + (self.inputs + 1) * self.outputs

    def weight(self, parameters: Array) -> Array:
        """Return a view of W, shape (inputs, outputs), of a vector of all parameters."""
        return parameters[self.start : self.stop - self.outputs].reshape(self.inputs, self.outputs)

    def bias(self, parameters: Array) -> Array:
        """Return a view of b, shape (outputs,), of a vector of all parameters."""
        return parameters[self.stop - self.outputs : self.stop]


@dataclass(frozen=True, kw_only=True)
class Architecture:
    """A trunk of tanh layers, a configuration head of two tanh layers, and a time head of one layer and exp.

    Attributes:
        inputs: Number of features.
        hidden: Width of the trunk and of the configuration head.
        layers: Depth of the trunk.
        path_outputs: Outputs of the configuration head (the paper's phi): interior points times joints.
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
            inputs, start = (layers[-1].outputs, layers[-1].stop) if layers else (self.inputs, 0)
            layers.append(Layer(f"trunk_{index}", inputs, self.hidden, start))
        return tuple(layers)

    @cached_property
    def heads(self) -> tuple[Layer, Layer, Layer]:
        """Hidden and output layer of the configuration head, and the layer of the time head."""
        hidden = Layer("path_hidden", self.hidden, self.hidden, self.trunk[-1].stop)
        path = Layer("path_output", self.hidden, self.path_outputs, hidden.stop)
        return hidden, path, Layer("rate_output", self.hidden, self.rate_outputs, path.stop)

    @property
    def all_layers(self) -> tuple[Layer, ...]:
        """All layers, in the order of the parameter vector."""
        return (*self.trunk, *self.heads)

    def split(self, parameters: Array) -> Weights:
        """Return views of W and b of every layer, of a vector of all parameters, shape (n_parameters,)."""
        return tuple((layer.weight(parameters), layer.bias(parameters)) for layer in self.all_layers)

    @property
    def n_parameters(self) -> int:
        """Length of the vector of all parameters."""
        return self.heads[-1].stop


def initial_parameters(architecture: Architecture, *, seed: int, head_scale: float, rate_bias: float) -> Array:
    """Draw parameters by Glorot's uniform distribution; biases are zero except that of the time head.

    With small last layers an untrained network plans the straight line at a constant rate.

    Args:
        architecture: The architecture.
        seed: Seed.
        head_scale: Factor of both heads' last weights.
        rate_bias: Bias of the time head: logarithm of the initial (expected time / duration).

    Returns:
        float32, shape (n_parameters,).
    """
    random = np.random.Generator(np.random.Philox(key=seed))
    parameters = np.zeros(architecture.n_parameters, np.float32)
    _, path, rate = architecture.heads
    for layer in architecture.all_layers:
        bound = np.sqrt(6 / (layer.inputs + layer.outputs)) * (head_scale if layer in {path, rate} else 1.0)
        layer.weight(parameters)[:] = random.uniform(-bound, bound, (layer.inputs, layer.outputs))
    rate.bias(parameters)[:] = rate_bias
    return parameters
