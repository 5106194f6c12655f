"""The network during training, in PyTorch: from charges to contact, standard deviations and misfit.

The inputs are whitened logarithms of the charges (`isocharge.train.training.features`). The force scales all charges by
nearly the same factor. The common factor therefore depends mostly on the force, and the ratios depend mostly on the
position. One perceptron gives the mean and the logarithm of the standard deviation of (x, y, ln F). A second perceptron
gives the vector (Q - Q(c)) / sigma at the contact c of the domain where this vector is shortest. The length of the
vector is the misfit. If a contact explains the charges exactly, the vector is zero. The vector is a smooth function of
the charges there, but its length is not. The length of the vector ranges from a tenth to thousands, and is compressed
by asinh.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.common.activations import ACTIVATIONS, TANH, Activation
from isocharge.common.arrays import Array
from isocharge.common.perceptron import Layer, Perceptron
from isocharge.simulate.forward.charge_map import Domain
from isocharge.train.training.config import NetworkConfig
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.folded_network import LOG_STD, MEAN, MISFIT_UNIT, N_CONTACT_ANSWERS, FoldedNetwork
from isocharge.train.training.folding import answer_units, fold
from isocharge.train.training.torch_evaluation import evaluate, evaluate_features

LARGEST_INT8 = 127
"""Largest absolute value of a weight that is rounded to 8 bits, in units of the scale of its output."""

FIRST_LAYER_SLOPES = (0.5, 3.5)
"""Smallest and largest norm of the initial weights of a unit of a sharpened first layer. The inputs have unit
variance."""

N_TRAINING_ANGLES = 3
"""Number of outputs of the contact perceptron for the angles of the correlations, which are not released."""

TRAINING_ANGLES = slice(N_CONTACT_ANSWERS, N_CONTACT_ANSWERS + N_TRAINING_ANGLES)
"""Outputs of the contact perceptron with these angles, relative to a right angle."""

INITIAL_NONLINEAR_SIZE = 0.2
"""Factor on the initial weights of outputs whose linear part was fitted."""

MIN_LENGTH = 1e-9
"""Length below which a misfit vector counts as having this length, so that no division by zero occurs."""


class TrainablePerceptron(nn.Module):
    """A perceptron with a skip layer (`isocharge.common.perceptron`).

    The logarithm of the force is nearly a linear function of the logarithms of the charges. It is needed with an error
    of about a thousandth of its range. With the skip layer, the hidden layers only need to learn the nonlinear part.

    Args:
        n_input: Number of inputs.
        hidden: Widths of the hidden layers.
        n_output: Number of outputs.
        activation: Activation of the hidden layers.
    """

    def __init__(self, n_input: int, hidden: tuple[int, ...], n_output: int, activation: Activation = TANH) -> None:
        """Create the layers with random weights. The weights of the skip layer are zero.

        Args:
            n_input: Number of inputs.
            hidden: Widths of the hidden layers.
            n_output: Number of outputs.
            activation: Activation of the hidden layers.
        """
        super().__init__()
        self.activation = activation
        widths = (n_input, *hidden, n_output)
        self.layers = nn.ModuleList([nn.Linear(n_in, n_out) for n_in, n_out in pairwise(widths)])
        self.skip = nn.Linear(n_input, n_output, bias=False)
        nn.init.zeros_(self.skip.weight)

    def sharpen_first_layer(self) -> None:
        """Draw the first layer again with larger weights, so that the units bend at random places among the inputs.

        The posterior mean of contacts at the rim of the working area bends within a small distance. Units that are
        nearly linear over all inputs learn this slowly. Each unit gets a random direction in the space of the inputs
        and a random slope along this direction. The output of the unit is zero at a random centre.
        """
        first, *_ = self.linear_layers()
        n_unit = first.out_features
        direction = nn.functional.normalize(torch.randn(n_unit, first.in_features), dim=1)
        smallest, largest = FIRST_LAYER_SLOPES
        slope = smallest + (largest - smallest) * torch.rand(n_unit, 1)
        centre = torch.randn(n_unit, first.in_features)
        with torch.no_grad():
            first.weight.copy_(slope * direction)
            first.bias.copy_(-(first.weight * centre).sum(dim=1))  # weight @ centre + bias = 0

    def fit_linear_part(self, inputs: Tensor, targets: Tensor) -> None:
        """Set the skip layer to the linear least-squares fit of the first outputs.

        The hidden layers then start with a small contribution to these outputs, and learn what is not linear.

        Args:
            inputs: Inputs, shape (n, n_input).
            targets: Targets of the first n_target outputs, shape (n, n_target).
        """
        n_input = inputs.shape[1]
        n_target = targets.shape[1]
        *_, last = self.linear_layers()
        design = torch.cat([inputs, torch.ones(len(inputs), 1)], dim=1)  # the column of ones is for the offset
        coefficients = torch.linalg.lstsq(design.double(), targets.double()).solution.float()
        slopes, offset = torch.split(coefficients, [n_input, 1])
        with torch.no_grad():
            self.skip.weight[:n_target] = slopes.T
            last.weight[:n_target] *= INITIAL_NONLINEAR_SIZE
            last.bias[:n_target] = offset[0]

    def forward(self, inputs: Tensor) -> Tensor:
        """Compute the outputs, shape (n, n_output), of inputs of shape (n, n_input)."""
        return evaluate(self.definition(), inputs)

    def definition(self) -> Perceptron[Tensor]:
        """Return the perceptron with the tensors that are trained."""
        *hidden, last = (Layer(layer.weight.T, layer.bias) for layer in self.linear_layers())
        return Perceptron(tuple(hidden), last, self.skip.weight.T, self.activation)

    def to_numpy(self) -> Perceptron[Array]:
        """Return a copy of the perceptron as NumPy arrays in double precision."""
        return perceptron_to_numpy(self.definition())

    def linear_layers(self) -> list[nn.Linear]:
        """Return the hidden layers and the output layer, from first to last."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def hidden_matrices(self) -> list[Tensor]:
        """Return the weights between hidden layers, shape (n_output, n_input) each."""
        _, *between, _ = self.linear_layers()
        return [layer.weight for layer in between]

    def round_hidden_matrices(self) -> None:
        """Round the weights between hidden layers to 8 bits, one scale for each output, and stop their training.

        A rounded weight is an integer from -127 to 127 times the scale of its output.
        """
        for matrix in self.hidden_matrices():
            weights = matrix.detach()  # shares its memory with the matrix
            scale = weights.abs().amax(dim=1, keepdim=True) / LARGEST_INT8
            integers = torch.round(weights / scale.clamp(min=1e-30))  # the limit avoids a division by zero
            weights.copy_(integers * scale)
            matrix.requires_grad_(False)


class InverseNetwork(nn.Module):
    """The whole network.

    Args:
        domain: Contacts for which the network is trained.
        features: Whitened input features.
        config: Widths and activation of the hidden layers.
    """

    def __init__(self, domain: Domain, features: WhitenedFeatures, config: NetworkConfig) -> None:
        """Create the perceptrons with random weights.

        The scales of the contacts and the whitening of the features are buffers, which are not trained.

        Args:
            domain: Contacts that the network estimates.
            features: Features of the charges.
            config: Widths and activation of the hidden layers.
        """
        super().__init__()
        self.domain = domain
        self.features = features
        n_electrode = self.n_electrode
        activation = ACTIVATIONS[config.activation]
        n_output = N_CONTACT_ANSWERS + N_TRAINING_ANGLES
        self.contact = TrainablePerceptron(n_electrode, config.contact_widths(n_electrode), n_output, activation)
        self.contact.sharpen_first_layer()
        self.misfit_vector = TrainablePerceptron(
            n_electrode, config.misfit_widths(n_electrode), n_electrode, activation
        )
        self.centre = nn.Buffer(as_tensor(domain.centre))
        self.scale = nn.Buffer(as_tensor(domain.scale))
        self.features_mean = nn.Buffer(as_tensor(features.mean))
        self.whitening = nn.Buffer(as_tensor(features.matrix))

    @property
    def n_electrode(self) -> int:
        """Number of electrodes."""
        return self.features.charge_features.n_electrode

    def inputs(self, charge: Tensor) -> Tensor:
        """Compute the inputs of both perceptrons from charges of shape (n, n_electrode), pC.

        Finite charges give finite inputs.
        """
        return (evaluate_features(self.features.charge_features, charge) - self.features_mean) @ self.whitening

    def posterior(self, charge: Tensor) -> tuple[Tensor, Tensor]:
        """Compute mean and log standard deviation of the unit coordinates.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Mean and logarithm of the standard deviation, shape (n, 3) each.
        """
        mean, log_std, _ = self.posterior_with_angles(charge)
        return mean, log_std

    def posterior_with_angles(self, charge: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute the posterior with the angles of its correlations (`isocharge.train.training.correlation`).

        The angles are trained together with the network, so that the hidden layers contain the information about the
        correlations. The angles of a released model are fitted to the hidden layers after the training.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Mean and logarithm of the standard deviation of the unit coordinates, and the angles, shape (n, 3) each.
        """
        outputs = self.contact(self.inputs(charge))
        return outputs[:, MEAN], outputs[:, LOG_STD], outputs[:, TRAINING_ANGLES]

    def forward(self, charge: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Estimate contacts.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Standard deviations of the contacts, shape (n, 3). Misfits,
            shape (n, 1).
        """
        # (x, y, ln F) and the standard deviations of these values
        unit_mean, unit_log_std = self.posterior(charge)
        log_contact = unit_mean * self.scale + self.centre
        log_contact_std = torch.exp(unit_log_std) * self.scale

        # The standard deviation of ln F is that of F relative to F.
        force = torch.exp(log_contact[:, 2:])  # shape (n, 1)
        contact = torch.cat([log_contact[:, :2], force], dim=1)
        contact_std = torch.cat([log_contact_std[:, :2], log_contact_std[:, 2:] * force], dim=1)

        misfit_vector = self.misfit_vector(self.inputs(charge))
        compressed_misfit = torch.linalg.vector_norm(misfit_vector, dim=1, keepdim=True)
        return contact, contact_std, MISFIT_UNIT * torch.sinh(compressed_misfit)


def compress_length(residual: Tensor) -> Tensor:
    """Return the targets of the misfit perceptron: residuals with the length asinh(length / MISFIT_UNIT).

    Args:
        residual: (Q - Q(c)) / sigma at the nearest contact c, shape (..., n_electrode).
    """
    length: Tensor = torch.linalg.vector_norm(residual, dim=-1, keepdim=True)
    return residual * (torch.asinh(length / MISFIT_UNIT) / length.clamp(min=MIN_LENGTH))


def as_tensor(values: Array) -> Tensor:
    """Return a copy of an array as a tensor in single precision."""
    return torch.tensor(values).float()


def perceptron_to_numpy(perceptron: Perceptron[Tensor]) -> Perceptron[Array]:
    """Return a copy of a perceptron as NumPy arrays in double precision."""
    hidden = tuple(Layer(_to_numpy(layer.weight), _to_numpy(layer.bias)) for layer in perceptron.hidden)
    last = Layer(_to_numpy(perceptron.last.weight), _to_numpy(perceptron.last.bias))
    return Perceptron(hidden, last, _to_numpy(perceptron.skip), perceptron.activation)


def fold_network(network: InverseNetwork) -> FoldedNetwork:
    """Fold both perceptrons of a trained network into one."""
    charge_features = network.features.charge_features
    units = answer_units(network.domain, np.eye(3), np.zeros(3), charge_features.n_electrode)
    perceptrons = [_contact_to_numpy(network), network.misfit_vector.to_numpy()]
    return _fold(network, perceptrons, units)


def fold_contact_mean(network: InverseNetwork) -> FoldedNetwork:
    """Fold the contact perceptron of a trained network without its standard deviations.

    The answers of the folded network are x and y in mm, and ln F.
    """
    weights_of_means = np.diag(network.domain.scale)
    weights_of_log_stds = np.zeros((3, 3))
    units = Layer(np.vstack([weights_of_means, weights_of_log_stds]), network.domain.centre)
    return _fold(network, [_contact_to_numpy(network)], units)


def _fold(network: InverseNetwork, perceptrons: Sequence[Perceptron[Array]], units: Layer[Array]) -> FoldedNetwork:
    """Fold perceptrons of a network into one.

    Args:
        network: The network, whose features and whitening are used.
        perceptrons: Perceptrons that run side by side.
        units: Linear layer from the outputs of all perceptrons to the answers.
    """
    mean = _to_numpy(network.features_mean)
    matrix = _to_numpy(network.whitening)
    return FoldedNetwork(network.features.charge_features, fold(perceptrons, mean, matrix, units))


def _contact_to_numpy(network: InverseNetwork) -> Perceptron[Array]:
    """Return the contact perceptron as NumPy arrays, without the outputs for the angles of the correlations."""
    perceptron = network.contact.to_numpy()
    weight, bias = perceptron.last
    last = Layer(weight[:, :N_CONTACT_ANSWERS], bias[:N_CONTACT_ANSWERS])
    return replace(perceptron, last=last, skip=perceptron.skip[:, :N_CONTACT_ANSWERS])


def _to_numpy(tensor: Tensor) -> Array:
    return np.asarray(tensor.detach().double().numpy())
