"""Evaluation of input features and perceptrons with PyTorch, as the training requires."""

from collections.abc import Sequence

import torch
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.train.training.activations import Activation
from isocharge.train.training.charge_features import ChargeFeatures
from isocharge.train.training.perceptron import Layer, Perceptron


def evaluate_features(features: ChargeFeatures, charge: Tensor) -> Tensor:
    """Compute the input features of charges. Finite charges give finite features, because the charges are clipped.

    Args:
        features: Definition of the features: limits, typical charges and means.
        charge: Charges, shape (..., n_electrode), pC.

    Returns:
        Features, same shape, dimensionless.
    """

    def to_tensor(values: Array) -> Tensor:
        """Convert an array to a tensor with the data type of the charges."""
        return torch.as_tensor(values, dtype=charge.dtype)

    clipped_charge = charge.clamp(to_tensor(features.low_pC), to_tensor(features.high_pC))
    ratio = clipped_charge / to_tensor(features.typical_pC)
    if features.mean is None:  # all charges of the presses are positive
        return torch.log(ratio)
    return torch.asinh(ratio) - to_tensor(features.mean)


def evaluate_hidden_layers(layers: Sequence[Layer[Tensor]], activation: Activation, inputs: Tensor) -> Tensor:
    """Apply hidden layers to inputs, one layer after the other.

    Args:
        layers: Weights and biases of the hidden layers.
        activation: Activation that is applied after each layer.
        inputs: Inputs, shape (n, n_input) or (n_batch, n, n_input).

    Returns:
        Outputs of the last layer, shape (n, width) or (n_batch, n, width).
    """
    activation_function = getattr(torch.nn.functional, activation.torch_name)
    outputs = inputs
    for layer in layers:
        outputs = activation_function(_evaluate_layer(layer, outputs))
    return outputs


def evaluate(perceptron: Perceptron[Tensor], inputs: Tensor) -> Tensor:
    """Evaluate a perceptron: the hidden layers, the last layer, and the skip layer from the inputs to the outputs.

    Args:
        perceptron: One perceptron, or n_batch perceptrons with weights of shape (n_batch, n_input, n_output) and biases
            of shape (n_batch, 1, n_output).
        inputs: Inputs, shape (n, n_input) for one perceptron, or (n_batch, n, n_input) for several perceptrons.

    Returns:
        Outputs, shape (n, n_output) or (n_batch, n, n_output).
    """
    hidden_output = evaluate_hidden_layers(perceptron.hidden, perceptron.activation, inputs)
    return _evaluate_layer(perceptron.last, hidden_output) + inputs @ perceptron.skip


def _evaluate_layer(layer: Layer[Tensor], inputs: Tensor) -> Tensor:
    """Compute inputs @ weight + bias in one operation, for one layer or a batch of layers."""
    if inputs.ndim == 2:
        return torch.addmm(layer.bias, inputs, layer.weight)
    return torch.baddbmm(layer.bias, inputs, layer.weight)
