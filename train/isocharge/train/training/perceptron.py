"""Definition of a multilayer perceptron with a skip layer, and its evaluation with NumPy.

For inputs x, the hidden layer l computes h_l = f(h_(l-1) W_l + b_l), where h_0 = x and f is the activation function.
The output layer computes y = h_L V + c + x S from the result h_L of the last hidden layer. The skip layer S maps the
inputs linearly to the outputs. The hidden layers therefore only need to learn the nonlinear part of the function.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.train.training.activations import Activation

LARGEST_INT8 = 127
"""Largest absolute value of the integers by which weights are represented in 8 bits, in units of their scale."""


class Layer(NamedTuple):
    """Weights of a linear layer, which computes inputs @ weight + bias.

    Attributes:
        weight: Matrix of the layer, shape (n_input, n_output).
        bias: Bias of the layer, shape (n_output,).
    """

    weight: Array
    bias: Array


@dataclass(frozen=True)
class Perceptron:
    """A multilayer perceptron with a skip layer.

    Attributes:
        hidden: Hidden layers, from the first to the last layer. The activation function follows each hidden layer.
        last: Output layer.
        skip: Weights of the skip layer from the inputs directly to the outputs, shape (n_input, n_output).
        activation: Activation function of the hidden layers.
    """

    hidden: tuple[Layer, ...]
    last: Layer
    skip: Array
    activation: Activation

    def evaluate(self, inputs: Array) -> Array:
        """Compute the outputs, shape (n, n_output), of inputs of shape (n, n_input)."""
        value = inputs
        for layer in self.hidden:
            value = self.activation.numpy_function(value @ layer.weight + layer.bias)
        return np.asarray(value @ self.last.weight + self.last.bias + inputs @ self.skip)
