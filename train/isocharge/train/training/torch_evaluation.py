"""Evaluation of a network's definition with PyTorch, for training."""

from collections.abc import Sequence

import torch
from torch import Tensor

from isocharge.common.activations import Activation
from isocharge.common.arrays import Array
from isocharge.common.charge_features import ChargeFeatures
from isocharge.common.perceptron import Layer, Perceptron


def evaluate_features(features: ChargeFeatures, charge: Tensor) -> Tensor:
    """Compute the input features of charges, shape (..., n_electrode), pC. Finite charges give finite features."""

    def like_charge(values: Array) -> Tensor:
        return torch.as_tensor(values, dtype=charge.dtype)

    clipped = charge.clamp(like_charge(features.low_pC), like_charge(features.high_pC))
    ratio = clipped / like_charge(features.typical_pC)
    if features.mean is None:
        return torch.log(ratio)
    return torch.asinh(ratio) - like_charge(features.mean)


def evaluate_hidden_layers(layers: Sequence[Layer[Tensor]], activation: Activation, inputs: Tensor) -> Tensor:
    """Apply hidden layers to inputs of shape (n, n_input) or (n_batch, n, n_input)."""
    function = getattr(torch.nn.functional, activation.torch_name)
    value = inputs
    for layer in layers:
        value = function(_evaluate_layer(layer, value))
    return value


def evaluate(perceptron: Perceptron[Tensor], inputs: Tensor) -> Tensor:
    """Evaluate a perceptron.

    Args:
        perceptron: A perceptron, or n_batch perceptrons with weights of shape (n_batch, n_input, n_output) and biases
            of shape (n_batch, 1, n_output).
        inputs: Shape (n, n_input), or (n_batch, n, n_input).

    Returns:
        Shape (n, n_output), or (n_batch, n, n_output).
    """
    hidden_output = evaluate_hidden_layers(perceptron.hidden, perceptron.activation, inputs)
    return _evaluate_layer(perceptron.last, hidden_output) + inputs @ perceptron.skip


def _evaluate_layer(layer: Layer[Tensor], inputs: Tensor) -> Tensor:
    """Compute inputs @ weight + bias in one operation."""
    if inputs.ndim == 2:
        return torch.addmm(layer.bias, inputs, layer.weight)
    return torch.baddbmm(layer.bias, inputs, layer.weight)
