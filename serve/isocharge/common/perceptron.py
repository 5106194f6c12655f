"""Multilayer perceptron with a skip layer: its definition, and its evaluation with NumPy.

For inputs x, the hidden layers compute h_l = f(h_(l-1) W_l + b_l) with h_0 = x. The output layer computes
y = h_L V + c + x S. The activation f follows each hidden layer. The skip layer S maps the inputs linearly to the
outputs, so that the hidden layers only need to learn the nonlinear part. Leading dimensions of the arrays are batch
dimensions, so that the weights of several perceptrons can be evaluated in one call.

The definition is generic in the type of its arrays. Training evaluates the perceptron with PyTorch tensors
(`isocharge.train.training.torch_evaluation`), and the ONNX and C exports write it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from isocharge.common.activations import Activation
from isocharge.common.arrays import Array, Singles

Weights = TypeVar("Weights")
"""Type of the arrays of a perceptron: NumPy arrays or PyTorch tensors."""

Values = TypeVar("Values", Array, Singles)
"""Type of NumPy arrays in an evaluation: double or single precision."""


class Layer(NamedTuple, Generic[Weights]):
    """A linear layer: inputs @ weight + bias.

    Attributes:
        weight: Shape (..., n_input, n_output).
        bias: Shape (n_output,); (..., 1, n_output) if there are batch dimensions.
    """

    weight: Weights
    bias: Weights


@dataclass(frozen=True)
class Perceptron(Generic[Weights]):
    """A multilayer perceptron with a skip layer.

    Attributes:
        hidden: Hidden layers, each followed by the activation, from first to last.
        last: Output layer.
        skip: Weights from the inputs straight to the outputs, shape (..., n_input, n_output).
        activation: Activation of the hidden layers.
    """

    hidden: tuple[Layer[Weights], ...]
    last: Layer[Weights]
    skip: Weights
    activation: Activation


def evaluate_hidden_layers(layers: Sequence[Layer[Any]], activation: Activation, inputs: Values) -> Values:
    """Apply hidden layers with NumPy, in the float type of the arrays.

    Args:
        layers: Hidden layers, from first to last.
        activation: Activation of each layer.
        inputs: Shape (..., n_input).

    Returns:
        Output of the last of these layers, shape (..., n_output).
    """
    value = inputs
    for layer in layers:
        value = activation.numpy_function(value @ layer.weight + layer.bias)
    return np.asarray(value)


def evaluate_output_layer(perceptron: Perceptron[Any], hidden_output: Values, inputs: Values) -> Values:
    """Apply the output layer and the skip layer with NumPy.

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
        inputs: Shape (..., n_input).

    Returns:
        Outputs, shape (..., n_output).
    """
    hidden_output = evaluate_hidden_layers(perceptron.hidden, perceptron.activation, inputs)
    return evaluate_output_layer(perceptron, hidden_output, inputs)
