"""Trainable network in PyTorch that estimates contacts, standard deviations and misfits from charges.

The inputs are whitened logarithms of the charges. A larger force increases all charges by nearly the same factor.
Therefore, the common factor of the charges depends mostly on the force, and the ratios of the charges depend mostly on
the position. A first perceptron estimates the means of x, y and ln F and the logarithms of their standard deviations.

A second perceptron estimates the misfit vector (Q - Q(c)) / sigma. Here, Q are the measured charges, sigma are the
standard deviations of their noise, and Q(c) are the charges of a contact c. The contact c is chosen so that the vector
is as short as possible. The length of the misfit vector is the misfit. If the measured charges agree exactly with the
charges of a contact, the vector is zero. Near such charges, the vector is a smooth function of the charges, but its
length is not smooth. Therefore, the perceptron learns the vector instead of the length. The length may be a tenth or
several thousand. The length is therefore compressed by the function asinh.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.common.arrays import Array, Reals
from isocharge.common.contact_domain import Domain
from isocharge.serve.model.contact import MISFIT_LIMIT
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.training.config import NetworkConfig
from isocharge.train.training.folded_network import (
    LARGEST_INT8,
    LOG_FORCE,
    LOG_FORCE_STD,
    TURN,
    ChargeFeatures,
    FoldedNetwork,
    Layer,
    Perceptron,
    fold,
    linear_answer_map,
)


def logarithmic_features(charge: Array, white_noise_pC: float = LOWEST_CHARGE) -> ChargeFeatures:
    """Return features for positive charges: the logarithms of charge / typical charge.

    The typical charge of an electrode is the power of two nearest to the geometric mean of its charges. A division by a
    power of two is exact in float32. The logarithms of the quotients are near 0, where float32 has the smallest errors.

    Args:
        charge: Charges of presses without noise, shape (n, n_electrode), pC.
        white_noise_pC: Standard deviation of the white noise, pC. Charges below `LOWEST_CHARGE` are distinguished down
            to this noise or to the smallest charge.
    """
    lowest_pC = min(LOWEST_CHARGE, max(white_noise_pC, float(charge.min())))
    clipped_charge = np.clip(charge, lowest_pC, HIGHEST_CHARGE)
    return ChargeFeatures(
        typical_pC=2.0 ** np.round(np.log2(clipped_charge).mean(axis=0)),
        low_pC=np.array(lowest_pC),
        high_pC=np.array(HIGHEST_CHARGE),
    )


def signed_features(charge: Array, typical: Array) -> ChargeFeatures:
    """Define features for charges of both signs: asinh(charge / typical charge) minus its mean over the given charges.

    The given charges determine the mean and the limits of the features. No feature is computed here. When features are
    computed, each charge is first limited to a range that is wider than the range of the given charges. On the
    scale of the inverse hyperbolic sine, the limits are the smallest given value minus the width of the given range,
    and the largest given value plus this width.

    Args:
        charge: Charges of presses, shape (n, n_electrode), pC.
        typical: Charge of each electrode above which the noise is proportional to the charge, shape (n_electrode,), pC.
    """
    asinh_charge = np.arcsinh(charge / typical)
    lowest = asinh_charge.min(axis=0)
    highest = asinh_charge.max(axis=0)
    margin = highest - lowest  # the limits lie outside the range by the width of the range
    return ChargeFeatures(
        typical_pC=typical,
        low_pC=np.sinh(lowest - margin) * typical,
        high_pC=np.sinh(highest + margin) * typical,
        mean=asinh_charge.mean(axis=0),
    )


FIRST_LAYER_SLOPES = (0.5, 3.5)
"""Smallest and largest norm of the initial weights of a unit in a sharpened first layer.

The inputs of the layer have unit variance.
"""

FORCE_OUTPUTS = [LOG_FORCE.start, LOG_FORCE_STD.start, TURN.start + 1, TURN.start + 2]
"""Columns of the contact perceptron's outputs for ln F, for its log standard deviation and for its correlations."""


class Posterior(NamedTuple):
    """Normal distributions of the unit coordinates of n contacts, as the contact perceptron estimates them.

    Attributes:
        mean: Means, shape (n, 3).
        log_std: Logarithms of the standard deviations, shape (n, 3).
        turn: Angles of the correlations minus a right angle, shape (n, 3), rad. Three zeros mean no correlations.
    """

    mean: Tensor
    log_std: Tensor
    turn: Tensor


class TrainablePerceptron(nn.Module):
    """A perceptron with a skip layer (`isocharge.train.training.folded_network`).

    The logarithm of the force is nearly a linear function of the logarithms of the charges. The network must estimate
    the logarithm of the force with an error of about a thousandth of its range. The skip layer learns the linear part
    of this function, so that the hidden layers only need to learn the nonlinear part.

    Args:
        n_input: Number of inputs.
        hidden: Widths of the hidden layers.
        n_output: Number of outputs.
    """

    def __init__(self, n_input: int, hidden: tuple[int, ...], n_output: int) -> None:
        """Create the layers with random weights. The weights of the skip layer are zero.

        Args:
            n_input: Number of inputs.
            hidden: Widths of the hidden layers.
            n_output: Number of outputs.
        """
        super().__init__()
        widths = (n_input, *hidden, n_output)
        self.linear_layers = [nn.Linear(n_in, n_out) for n_in, n_out in pairwise(widths)]  # from first to last
        self.layers = nn.ModuleList(self.linear_layers)  # the same layers, so that PyTorch finds their parameters
        self.skip = nn.Linear(n_input, n_output, bias=False)
        nn.init.zeros_(self.skip.weight)

    def sharpen_first_layer(self) -> None:
        """Replace the weights of the first layer by larger random weights, so that the units are clearly nonlinear.

        Near the rim of the working area, the posterior mean of the contact is a strongly nonlinear function of the
        charges. Units that are nearly linear for all inputs learn such a function slowly. Therefore, each unit gets a
        random direction in the space of the inputs, a random slope along this direction, and a random centre. The
        centre is the point of this space at which the argument of the hyperbolic tangent is zero.
        """
        first, *_ = self.linear_layers
        n_unit = first.out_features
        direction = nn.functional.normalize(torch.randn(n_unit, first.in_features), dim=1)
        smallest, largest = FIRST_LAYER_SLOPES
        slope = smallest + (largest - smallest) * torch.rand(n_unit, 1)
        centre = torch.randn(n_unit, first.in_features)
        with torch.no_grad():
            first.weight.copy_(slope * direction)
            first.bias.copy_(-(first.weight * centre).sum(dim=1))  # weight @ centre + bias = 0

    def last_hidden(self, inputs: Tensor) -> Tensor:
        """Compute the last hidden layer, shape (n, n_unit), from the inputs, shape (n, n_input)."""
        value = inputs
        for layer in self.linear_layers[:-1]:
            value = torch.tanh(layer(value))
        return value

    def forward(self, inputs: Tensor) -> Tensor:
        """Compute the outputs, shape (n, n_output), from the inputs, shape (n, n_input)."""
        outputs: Tensor = self.linear_layers[-1](self.last_hidden(inputs)) + self.skip(inputs)
        return outputs

    def to_numpy(self) -> Perceptron:
        """Return a copy of the perceptron as NumPy arrays in double precision."""
        *hidden, last = (Layer(_to_numpy(layer.weight.T), _to_numpy(layer.bias)) for layer in self.linear_layers)
        return Perceptron(tuple(hidden), last, _to_numpy(self.skip.weight.T))

    def round_hidden_matrices(self) -> None:
        """Round the weights between hidden layers to 8 bits, and exclude these weights from further training.

        Each rounded weight is the product of a scale and an integer from -127 to 127. All weights that lead to the same
        unit have the same scale.
        """
        _, *between, _ = self.linear_layers  # all layers except the first and the last
        for matrix in (layer.weight for layer in between):
            weights = matrix.detach()  # shares its memory with the matrix, so that `copy_` below changes the matrix
            scale = weights.abs().amax(dim=1, keepdim=True) / LARGEST_INT8  # shape (n_output, 1)
            # The smallest divisor `tiny` prevents a division by the scale 0 of a row of zeros.
            integers = torch.round(weights / scale.clamp(min=torch.finfo(weights.dtype).tiny))
            weights.copy_(integers * scale)
            matrix.requires_grad_(False)


class InverseNetwork(nn.Module):
    """Network that consists of the contact perceptron and the misfit perceptron.

    The contact perceptron estimates unit coordinates. Unit coordinates are x, y and ln F after a shift and a scaling,
    so that each of them ranges from -1 to 1 in the domain.

    Args:
        domain: Contacts for which the network is trained.
        features: Features of the charges, before they are whitened.
        charge: Charges of the presses for training, shape (n, n_electrode), pC. Their features determine the whitening.
        config: Widths of the hidden layers.
        force_std: Relative standard deviation of the force if all presses have the same force. The network then always
            returns the force in the middle of the domain, with this standard deviation. If None, the network learns the
            force.
    """

    def __init__(
        self,
        domain: Domain,
        features: ChargeFeatures,
        charge: Array,
        config: NetworkConfig,
        force_std: float | None = None,
    ) -> None:
        """Create the perceptrons with random weights, and compute the whitening by a principal component analysis.

        The inputs (features - mean) @ matrix of the presses for training have zero mean and unit covariance. The mean
        and the matrix are stored as buffers, because they are not trained.

        Args:
            domain: Contacts for which the network is trained.
            features: Features of the charges, before they are whitened.
            charge: Charges of the presses for training, shape (n, n_electrode), pC.
            config: Widths of the hidden layers.
            force_std: Relative standard deviation of a constant force; None to learn the force.
        """
        super().__init__()
        self.domain = domain
        self.features = features
        n_electrode = features.n_electrode
        n_output = TURN.stop  # three means, three logarithms of standard deviations, and three turns
        widths, misfit_widths = config.widths(n_electrode)
        self.contact = TrainablePerceptron(n_electrode, widths, n_output)
        self.contact.sharpen_first_layer()  # replaces the weights by larger ones
        self.misfit_vector = TrainablePerceptron(n_electrode, misfit_widths, n_electrode)

        # The final outputs are outputs * factor + offset. Without a force to learn, the factor 0 lets constants replace
        # the outputs for the force: the middle of the range of forces (0), its given standard deviation in unit
        # coordinates, and no correlations (0). `domain.scale[2]` is the scale of ln F.
        self.output_factor = nn.Buffer(torch.ones(n_output))
        self.output_offset = nn.Buffer(torch.zeros(n_output))
        if force_std is not None:
            self.output_factor[FORCE_OUTPUTS] = 0.0
            self.output_offset[LOG_FORCE_STD] = np.log(force_std / domain.scale[2])

        # Whitening. The rows of `principal_axes` are orthonormal. The standard deviation of the features along an axis
        # is the singular value divided by the square root of the number of presses. `eps` prevents a division by zero.
        press_features = feature_values(features, torch.tensor(charge, dtype=torch.float64))
        mean = press_features.mean(dim=0)
        _, singular_values, principal_axes = torch.linalg.svd(press_features - mean, full_matrices=False)
        inverse_std = len(press_features) ** 0.5 / singular_values.clamp(min=torch.finfo(press_features.dtype).eps)
        self.features_mean = nn.Buffer(mean.float())
        self.whitening = nn.Buffer((principal_axes.T * inverse_std).float())

    def inputs(self, charge: Tensor) -> Tensor:
        """Compute the whitened features, which are the inputs of both perceptrons. Finite charges give finite inputs.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Inputs, shape (n, n_electrode).
        """
        return (feature_values(self.features, charge) - self.features_mean) @ self.whitening

    def posterior(self, charge: Tensor) -> Posterior:
        """Estimate the contacts of n presses from their charges, shape (n, n_electrode), pC."""
        outputs = self.contact(self.inputs(charge)) * self.output_factor + self.output_offset
        return Posterior(*outputs.split(3, dim=1))


def feature_values(features: ChargeFeatures, charge: Tensor) -> Tensor:
    """Compute the features of charges, pC. Charges and features have the shape (n, n_electrode).

    The features are ln(Q / typical charge) for positive charges, or asinh(Q / typical charge) - mean for charges of
    both signs. The charges Q are first limited to a range.
    """

    def constant(values: Array) -> Tensor:
        """Return an array as a tensor with the number type of the charges."""
        return torch.tensor(values, dtype=charge.dtype)

    ratio = charge.clamp(constant(features.low_pC), constant(features.high_pC)) / constant(features.typical_pC)
    if features.mean is None:  # all charges are positive
        return torch.log(ratio)
    return torch.asinh(ratio) - constant(features.mean)


def compress_length(residual: Tensor) -> Tensor:
    """Compress the lengths of residuals. The compressed residuals are the targets of the misfit perceptron.

    The length of a residual becomes asinh(length / MISFIT_LIMIT).

    Args:
        residual: Residuals (Q - Q(c)) / sigma at the nearest contact c, shape (..., n_electrode).

    Returns:
        Vectors with the directions of the residuals and the compressed lengths, shape (..., n_electrode).
    """
    length = torch.linalg.vector_norm(residual, dim=-1, keepdim=True)
    return nn.functional.normalize(residual, dim=-1) * torch.asinh(length / MISFIT_LIMIT)


def as_tensor(values: Reals) -> Tensor:
    """Return a copy of an array as a tensor in single precision."""
    return torch.tensor(values).float()


def fold_network(network: InverseNetwork) -> FoldedNetwork:
    """Return a trained network whose perceptrons include the whitening of the inputs and the units of the answers.

    The perceptrons of the result compute the answers directly from the features. The function `fold` includes maps
    before and after a perceptron in its layers.
    """
    features_mean = _to_numpy(network.features_mean)
    whitening = _to_numpy(network.whitening)
    output_factor = _to_numpy(network.output_factor)
    answer_map = linear_answer_map(network.domain)
    # The answers are (outputs * factor + offset) @ weight + bias, which is one linear map of the outputs. If the force
    # is not learned, the factor and the offset make the outputs for the force constant.
    answers_of_zero_outputs = _to_numpy(network.output_offset) @ answer_map.weight + answer_map.bias
    outputs_to_answers = Layer(output_factor[:, None] * answer_map.weight, answers_of_zero_outputs)
    n_electrode = network.features.n_electrode
    identity = Layer(np.eye(n_electrode), np.zeros(n_electrode))  # the misfit vector is already an answer
    return FoldedNetwork(
        features=network.features,
        contact=fold(network.contact.to_numpy(), features_mean, whitening, outputs_to_answers),
        misfit=fold(network.misfit_vector.to_numpy(), features_mean, whitening, identity),
    )


def _to_numpy(tensor: Tensor) -> Array:
    """Return a copy of a tensor as a NumPy array in double precision."""
    return tensor.detach().double().numpy()
