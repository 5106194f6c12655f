"""Trainable form of the network for all films: a perceptron whose weights depend on the film.

Each charge is divided by its charge scale, which depends on the film (see `film_scaling`). The inputs of the perceptron
are the whitened logarithms of the quotients. The context of a film consists of a few numbers that describe the film. A
small network, the context network, converts the context into a feature vector psi.

The weight matrix of layer l is W_l = W_l0 + sum over k of phi_lk W_lk. The matrices W_l0 and W_lk are the same for all
films, whereas the factors phi_lk depend on the film. The factors phi_lk and the biases of the layers are linear
functions of psi. The weight matrix of the skip layer is also a constant matrix plus a weighted sum of basis matrices.
From the context of a single film, `ConditionalWeights.perceptron` computes an ordinary perceptron with fixed weights.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.common.activations import TANH, Activation
from isocharge.common.arrays import Array
from isocharge.common.charge_features import ChargeFeatures
from isocharge.common.perceptron import Layer, Perceptron
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.films_data import FilmPresses
from isocharge.train.films.films_model import CONTEXT_LAYERS
from isocharge.train.training.features import whitening
from isocharge.train.training.network import as_tensor
from isocharge.train.training.torch_evaluation import evaluate, evaluate_features, evaluate_hidden_layers

N_BASES = 6
"""Number of matrices W_lk of a layer, whose weighted sum is added to the constant matrix W_l0."""

CONTEXT_WIDTH = 64
"""Width of each layer of the context network, and length of the feature vector psi."""

N_WHITENING_FILMS = 512
"""Number of films from whose charges the whitening is computed."""

INITIAL_BASIS_SIZE = 0.3
"""Initial size of the matrices W_lk, relative to the initial size of the constant matrix W_l0."""

INITIAL_PHI_STD = 0.3
"""Initial standard deviation of the factors phi_lk for a feature vector psi whose elements have the magnitude 1."""


@dataclass(frozen=True)
class FilmInputs:
    """Conversion of charges into the inputs of the network for all films.

    The inputs are (ln(clip(Q)) - ln(S) - mean) @ whitening. Q are the charges in pC, and S are the charge scales of the
    film. `FilmScaling.log_charge_scale` computes ln(S).

    Attributes:
        scaling: Charge scales and contexts of films.
        mean: Mean of the logarithms of the scaled charges Q / S, with Q in pC, shape (n_electrode,).
        whitening: Whitening matrix, shape (n_electrode, n_electrode).
    """

    scaling: FilmScaling
    mean: Array
    whitening: Array

    @classmethod
    def fit(cls, scaling: FilmScaling, presses: FilmPresses) -> "FilmInputs":
        """Compute the mean and the whitening matrix from noise-free charges of many films.

        Args:
            scaling: Charge scales and contexts of films.
            presses: Presses on films. Only the presses on the first `N_WHITENING_FILMS` films are used.
        """
        charge = presses.charge()[:N_WHITENING_FILMS]
        log_charge = np.log(np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE))
        log_scale = scaling.log_charge_scale(presses.parameters[:N_WHITENING_FILMS])  # shape (n_film, n_electrode)
        scaled_log_charge = log_charge - log_scale[:, None]  # shape (n_film, n_press, n_electrode)
        n_electrode = charge.shape[-1]
        mean, whitening_matrix = whitening(scaled_log_charge.reshape(-1, n_electrode))
        return cls(scaling, mean, whitening_matrix)

    @property
    def charge_features(self) -> ChargeFeatures:
        """Features ln(Q / 1 pC), for which each charge Q is first clipped to the limits of the network."""
        return ChargeFeatures(np.ones(self.mean.size), np.array(LOWEST_CHARGE), np.array(HIGHEST_CHARGE))

    def values(self, charge: Tensor, parameters: Array) -> Tensor:
        """Convert charges of presses on several films into the inputs of the network.

        Args:
            charge: Charges, shape (n_film, n, n_electrode), pC.
            parameters: Parameters of the films, shape (n_film, n_parameter).

        Returns:
            Inputs, shape (n_film, n, n_electrode).
        """
        mean_log_charge = as_tensor(self.scaling.log_charge_scale(parameters) + self.mean)  # (n_film, n_electrode)
        log_charge = evaluate_features(self.charge_features, charge)
        return (log_charge - mean_log_charge[:, None]) @ as_tensor(self.whitening)

    def context(self, parameters: Array) -> Tensor:
        """Compute the contexts of films from their parameters.

        Args:
            parameters: Parameters of the films, shape (n_film, n_parameter).

        Returns:
            Contexts, shape (n_film, n_context).
        """
        return as_tensor(self.scaling.context(parameters))


class ConditionalPerceptron(nn.Module):
    """Perceptron with a skip layer, in which all weights and biases depend on the film.

    One call evaluates the perceptron for presses on many films.

    Args:
        n_input: Number of electrodes.
        hidden: Widths of the hidden layers.
        n_output: Number of outputs.
        n_context: Number of values in the context of a film.
        activation: Activation of the hidden layers and of the context network.
    """

    def __init__(
        self,
        n_input: int,
        hidden: tuple[int, ...],
        n_output: int,
        n_context: int,
        activation: Activation = TANH,
    ) -> None:
        """Create the layers with random weights.

        The weight matrix of each layer is a constant matrix plus a weighted sum of `N_BASES` basis matrices. The
        weights of this sum, called the factors phi, and the biases depend on the film. A small context network computes
        features of the film from its context, and the factors and biases are linear functions of these features. The
        skip layer connects the inputs directly with the outputs. Before the training, the weights of the skip layer are
        zero, and the biases are the same for all films.

        Args:
            n_input: Number of inputs.
            hidden: Widths of the hidden layers.
            n_output: Number of outputs.
            n_context: Number of values in the context of a film.
            activation: Activation of the hidden layers and of the context network.
        """
        super().__init__()
        self.activation = activation

        # Context network: two layers that compute the features of a film
        context_shapes = [(n_context, CONTEXT_WIDTH), (CONTEXT_WIDTH, CONTEXT_WIDTH)]
        self.context = nn.ModuleDict(
            {name: nn.Linear(*shape) for name, shape in zip(CONTEXT_LAYERS, context_shapes, strict=True)}
        )

        # Constant matrix, basis matrices and bias of each layer, and the matrices of the skip layer
        layer_shapes = list(pairwise((n_input, *hidden, n_output)))  # numbers of inputs and outputs of each layer
        self.constant = nn.ParameterList([_uniform_weights(1.0, shape) for shape in layer_shapes])
        self.bases = nn.ParameterList(
            [_uniform_weights(INITIAL_BASIS_SIZE, shape, (N_BASES,)) for shape in layer_shapes]
        )
        self.bias = nn.ModuleList([nn.Linear(CONTEXT_WIDTH, width) for _, width in layer_shapes])
        self.skip = nn.Parameter(torch.zeros(n_input, n_output))
        self.skip_bases = nn.Parameter(torch.zeros(N_BASES, n_input, n_output))

        # Linear layer that computes all factors phi: `N_BASES` factors for each layer and for the skip layer
        n_mixed_matrix = len(layer_shapes) + 1
        self.phi = nn.Linear(CONTEXT_WIDTH, N_BASES * n_mixed_matrix)

        for bias_layer in self.bias:  # with weights of zero, the biases are the same for all films
            nn.init.zeros_(bias_layer.weight)  # type: ignore[arg-type]
        # A factor is a sum over `CONTEXT_WIDTH` features, so the division makes its size independent of their number.
        nn.init.normal_(self.phi.weight, std=INITIAL_PHI_STD / np.sqrt(CONTEXT_WIDTH))
        nn.init.zeros_(self.phi.bias)

    def forward(self, inputs: Tensor, context: Tensor) -> Tensor:
        """Compute the outputs of the network for presses on several films.

        Args:
            inputs: Inputs for each film, shape (n_film, n, n_input).
            context: Contexts of the films, shape (n_film, n_context).

        Returns:
            Outputs, shape (n_film, n, n_output).
        """
        return evaluate(self.film_perceptrons(context), inputs)

    def film_perceptrons(self, context: Tensor) -> Perceptron[Tensor]:
        """Return the perceptrons of several films as a single `Perceptron`.

        The first axis of its weight arrays is the index of the film. The context network computes the features psi of
        each film. The weight matrix of each layer is the sum of a constant matrix and basis matrices, each multiplied
        by a factor phi of the film. The factors phi and the biases are linear functions of the features psi.

        Args:
            context: Contexts of the films, shape (n_film, n_context).
        """
        n_layer = len(self.constant)
        context_layers = [Layer(linear.weight.T, linear.bias) for linear in self._context_linears()]
        film_features = evaluate_hidden_layers(context_layers, self.activation, context)
        # One row for each layer and for the skip layer
        basis_factors = self.phi(film_features).view(len(context), n_layer + 1, N_BASES)

        layers = []
        for layer_index, (constant, bases, bias) in enumerate(zip(self.constant, self.bases, self.bias, strict=True)):
            weight = _mix_weights(constant, bases, basis_factors[:, layer_index])
            film_bias = bias(film_features)[:, None]  # shape (n_film, 1, n_output), the same for all presses on a film
            layers.append(Layer(weight, film_bias))
        skip = _mix_weights(self.skip, self.skip_bases, basis_factors[:, n_layer])
        *hidden, output_layer = layers
        return Perceptron(tuple(hidden), output_layer, skip, self.activation)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the weights as a dictionary of arrays by name, as `ConditionalWeights` expects them."""
        return {name: values.detach().double().numpy() for name, values in self.state_dict().items()}

    def _context_linears(self) -> list[nn.Linear]:
        """Return the layers of the context network."""
        return [module for module in self.context.values() if isinstance(module, nn.Linear)]


def _mix_weights(constant: Tensor, bases: Tensor, phi: Tensor) -> Tensor:
    """Compute the weights of one layer for several films: a constant matrix plus a weighted sum of basis matrices.

    Args:
        constant: Constant matrix, shape (n_input, n_output).
        bases: Basis matrices, shape (n_basis, n_input, n_output).
        phi: Factors of the basis matrices for each film, shape (n_film, n_basis).

    Returns:
        Weights, shape (n_film, n_input, n_output).
    """
    # Sum over the bases k, for each film f, input i and output o
    return constant + torch.einsum("fk,kio->fio", phi, bases)


def _uniform_weights(scale: float, shape: tuple[int, int], leading_shape: tuple[int, ...] = ()) -> nn.Parameter:
    """Draw weights that are uniformly distributed between -scale / sqrt(n_input) and scale / sqrt(n_input).

    Args:
        scale: Largest magnitude of a weight, multiplied by sqrt(n_input).
        shape: Shape of one weight matrix, (n_input, n_output).
        leading_shape: Leading dimensions of the result if several matrices are drawn; empty for one matrix.

    Returns:
        Weights, shape (*leading_shape, n_input, n_output).
    """
    n_input, _ = shape
    from_minus_one_to_one = 2.0 * torch.rand((*leading_shape, *shape)) - 1.0
    return nn.Parameter(scale * from_minus_one_to_one / np.sqrt(n_input))
