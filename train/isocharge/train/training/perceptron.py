"""Definition of a multilayer perceptron with a skip layer, and its evaluation with NumPy.

For inputs x, the hidden layer l computes h_l = f(h_(l-1) W_l + b_l), where h_0 = x and f is the activation function.
The output layer computes y = h_L V + c + x S from the result h_L of the last hidden layer. The skip layer S maps the
inputs linearly to the outputs. The hidden layers therefore only need to learn the nonlinear part of the function.
Leading dimensions of the arrays are batch dimensions. One call can therefore evaluate several perceptrons with
different weights.

The definition is generic with respect to the type of the arrays. Training evaluates a perceptron with PyTorch tensors
(`isocharge.train.training.torch_evaluation`). The ONNX export and the C export write a perceptron to a file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from isocharge.common.arrays import Array, Singles
from isocharge.train.training.activations import Activation

Weights = TypeVar("Weights")
"""Type of the arrays of a perceptron: NumPy arrays or PyTorch tensors."""

Values = TypeVar("Values", Array, Singles)
"""Type of NumPy arrays in an evaluation: double or single precision."""


class Layer(NamedTuple, Generic[Weights]):
    """Weights of a linear layer, which computes inputs @ weight + bias.

    Attributes:
        weight: Matrix of the layer, shape (..., n_input, n_output).
        bias: Bias of the layer, shape (n_output,), or shape (..., 1, n_output) if there are batch dimensions.
    """

    weight: Weights
    bias: Weights


@dataclass(frozen=True)
class Perceptron(Generic[Weights]):
    """A multilayer perceptron with a skip layer.

    Attributes:
        hidden: Hidden layers, from the first to the last layer. The activation function follows each hidden layer.
        last: Output layer.
        skip: Weights of the skip layer from the inputs directly to the outputs, shape (..., n_input, n_output).
        activation: Activation function of the hidden layers.
    """

    hidden: tuple[Layer[Weights], ...]
    last: Layer[Weights]
    skip: Weights
    activation: Activation


def evaluate_hidden_layers(layers: Sequence[Layer[Any]], activation: Activation, inputs: Values) -> Values:
    """Evaluate hidden layers with NumPy, in the floating-point type of the arrays.

    Args:
        layers: Hidden layers, from the first to the last layer.
        activation: Activation function, which is applied after each layer.
        inputs: Inputs of the first layer, shape (..., n_input).

    Returns:
        Output of the last layer, shape (..., n_output).
    """
    value = inputs
    for layer in layers:
        value = activation.numpy_function(value @ layer.weight + layer.bias)
    return np.asarray(value)


def evaluate_output_layer(perceptron: Perceptron[Any], hidden_output: Values, inputs: Values) -> Values:
    """Evaluate the output layer and the skip layer of a perceptron with NumPy.

    Args:
        perceptron: The perceptron.
        hidden_output: Result of `evaluate_hidden_layers`, shape (..., n_hidden).
        inputs: Inputs of the perceptron, shape (..., n_input).

    Returns:
        Outputs, shape (..., n_output).
    """
    last = perceptron.last
    return np.asarray(hidden_output @ last.weight + last.bias + inputs @ perceptron.skip)


def evaluate(perceptron: Perceptron[Any], inputs: Values) -> Values:
    """Evaluate a perceptron with NumPy.

    Args:
        perceptron: The perceptron.
        inputs: Inputs of the perceptron, shape (..., n_input).

    Returns:
        Outputs, shape (..., n_output).
    """
    hidden_output = evaluate_hidden_layers(perceptron.hidden, perceptron.activation, inputs)
    return evaluate_output_layer(perceptron, hidden_output, inputs)
