"""The network for all films during training: a perceptron whose weights depend on the film.

The inputs are logarithms of the charges, from which the exact scales of the film are subtracted (`film_scaling`). The
context of a film consists of a few numbers that describe the film. A small context network converts the context into a
vector psi. The weights of layer l are then W_l = W_l0 + sum over k of phi_lk W_lk. The factors phi and the biases are
linear functions of psi. The skip layer has weights of the same form. For one film, the result is an ordinary perceptron
(`films_model.ConditionalWeights`).
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
"""Number of weight matrices W_lk that are mixed in a layer, besides the constant matrix W_l0."""

CONTEXT_WIDTH = 64
"""Width of the context network and length of psi."""

N_WHITENING_FILMS = 512
"""Number of films from whose charges the whitening is computed."""

INITIAL_BASIS_SIZE = 0.3
"""Initial size of the matrices W_lk, relative to the constant matrix."""

INITIAL_PHI_STD = 0.3
"""Initial standard deviation of phi."""


@dataclass(frozen=True)
class FilmInputs:
    """Inputs of the network for all films: (ln clip(Q) - log charge scale of the film - mean) @ whitening.

    Attributes:
        scaling: Exact scales and contexts of films.
        mean: Mean of the scaled logarithms (Q in pC), shape (n_electrode,).
        whitening: Whitening matrix, shape (n_electrode, n_electrode).
    """

    scaling: FilmScaling
    mean: Array
    whitening: Array

    @classmethod
    def fit(cls, scaling: FilmScaling, presses: FilmPresses) -> "FilmInputs":
        """Fit the mean and the whitening matrix to noise-free charges of many films.

        Args:
            scaling: Exact scales and contexts of films.
            presses: Presses on films. Only the first `N_WHITENING_FILMS` films are used.
        """
        charge = presses.charge()[:N_WHITENING_FILMS]
        log_charge = np.log(np.clip(charge, LOWEST_CHARGE, HIGHEST_CHARGE))
        log_scale = scaling.log_charge_scale(presses.parameters[:N_WHITENING_FILMS])  # shape (n_film, n_electrode)
        scaled_log_charge = log_charge - log_scale[:, None]  # shape (n_film, n_press, n_electrode)
        n_electrode = charge.shape[-1]
        mean, matrix = whitening(scaled_log_charge.reshape(-1, n_electrode))
        return cls(scaling, mean, matrix)

    @property
    def charge_features(self) -> ChargeFeatures:
        """Logarithms of the charges in pC."""
        return ChargeFeatures(np.ones(self.mean.size), np.array(LOWEST_CHARGE), np.array(HIGHEST_CHARGE))

    def values(self, charge: Tensor, parameters: Array) -> Tensor:
        """Compute the inputs of the network.

        Args:
            charge: Charges, shape (n_film, n, n_electrode), pC.
            parameters: Parameters of the films, shape (n_film, n_parameter).

        Returns:
            Inputs, shape (n_film, n, n_electrode).
        """
        shift = as_tensor(self.scaling.log_charge_scale(parameters) + self.mean)
        logarithms = evaluate_features(self.charge_features, charge)
        return (logarithms - shift[:, None]) @ as_tensor(self.whitening)

    def context(self, parameters: Array) -> Tensor:
        """Compute the contexts, shape (n_film, n_context), of films with parameters of shape (n_film, n_parameter)."""
        return as_tensor(self.scaling.context(parameters))


class ConditionalPerceptron(nn.Module):
    """A perceptron with a skip layer, in which all weights depend on the film.

    The perceptron is evaluated for many films at once.

    Args:
        n_input: Number of electrodes.
        hidden: Widths of the hidden layers.
        n_output: Number of outputs.
        n_context: Number of context values.
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

        The weights of each layer are a constant matrix plus `N_BASES` matrices, whose factors phi depend on the film. A
        small network computes these factors and the biases from the context. At the beginning, the biases do not depend
        on the film.

        Args:
            n_input: Number of inputs.
            hidden: Widths of the hidden layers.
            n_output: Number of outputs.
            n_context: Number of values that describe a film.
            activation: Activation of the hidden layers.
        """
        super().__init__()
        self.activation = activation
        sizes = list(pairwise((n_input, *hidden, n_output)))  # numbers of inputs and outputs of each layer
        context_sizes = [(n_context, CONTEXT_WIDTH), (CONTEXT_WIDTH, CONTEXT_WIDTH)]
        self.context = nn.ModuleDict(
            {name: nn.Linear(*size) for name, size in zip(CONTEXT_LAYERS, context_sizes, strict=True)}
        )
        self.constant = nn.ParameterList([_uniform_weights(1.0, size) for size in sizes])
        self.bases = nn.ParameterList([_uniform_weights(INITIAL_BASIS_SIZE, size, (N_BASES,)) for size in sizes])
        self.bias = nn.ModuleList([nn.Linear(CONTEXT_WIDTH, width) for _, width in sizes])
        self.skip = nn.Parameter(torch.zeros(n_input, n_output))
        self.skip_bases = nn.Parameter(torch.zeros(N_BASES, n_input, n_output))
        n_mixed_matrix = len(sizes) + 1  # the layers and the skip layer
        self.phi = nn.Linear(CONTEXT_WIDTH, N_BASES * n_mixed_matrix)

        for linear in self.bias:
            nn.init.zeros_(linear.weight)  # type: ignore[arg-type]
        nn.init.normal_(self.phi.weight, std=INITIAL_PHI_STD / np.sqrt(CONTEXT_WIDTH))
        nn.init.zeros_(self.phi.bias)

    def forward(self, inputs: Tensor, context: Tensor) -> Tensor:
        """Compute the outputs for films.

        Args:
            inputs: Inputs for each film, shape (n_film, n, n_input).
            context: Contexts of the films, shape (n_film, n_context).

        Returns:
            Outputs, shape (n_film, n, n_output).
        """
        return evaluate(self.definition(context), inputs)

    def definition(self, context: Tensor) -> Perceptron[Tensor]:
        """Return the perceptrons of films, as one perceptron whose weights have a first axis for the film.

        The context network computes features psi of each film. The weights of each layer are a sum of matrices with the
        factors phi. The factors phi and the biases are linear functions of psi.

        Args:
            context: Contexts of the films, shape (n_film, n_context).
        """
        n_layer = len(self.constant)
        context_layers = [Layer(linear.weight.T, linear.bias) for linear in self._context_linears()]
        psi = evaluate_hidden_layers(context_layers, self.activation, context)
        phi = self.phi(psi).view(len(context), n_layer + 1, N_BASES)  # one row for each layer and for the skip layer

        layers = []
        for layer_index, (constant, bases, bias) in enumerate(zip(self.constant, self.bases, self.bias, strict=True)):
            weight = _mix_weights(constant, bases, phi[:, layer_index])
            film_bias = bias(psi)[:, None]  # shape (n_film, 1, n_output), the same for all presses on a film
            layers.append(Layer(weight, film_bias))
        skip = _mix_weights(self.skip, self.skip_bases, phi[:, n_layer])
        *hidden, last = layers
        return Perceptron(tuple(hidden), last, skip, self.activation)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the weights by name, as `ConditionalWeights` takes them."""
        return {name: values.detach().double().numpy() for name, values in self.state_dict().items()}

    def _context_linears(self) -> list[nn.Linear]:
        """Return the layers of the context network."""
        return [module for module in self.context.values() if isinstance(module, nn.Linear)]


def _mix_weights(constant: Tensor, bases: Tensor, phi: Tensor) -> Tensor:
    """Compute the weights W_l of films: a constant matrix plus a weighted sum of basis matrices.

    Args:
        constant: Constant matrix, shape (n_input, n_output).
        bases: Basis matrices, shape (n_basis, n_input, n_output).
        phi: Factors of the basis matrices for each film, shape (n_film, n_basis).

    Returns:
        Weights, shape (n_film, n_input, n_output).
    """
    # Sum over the bases k, for each film f, input i and output o
    return constant + torch.einsum("fk,kio->fio", phi, bases)


def _uniform_weights(size: float, shape: tuple[int, int], batch: tuple[int, ...] = ()) -> nn.Parameter:
    """Draw weights that are uniformly distributed between -size / sqrt(n_input) and size / sqrt(n_input).

    Args:
        size: Size of the weights.
        shape: Shape of a matrix, (n_input, n_output).
        batch: Leading dimensions, if several matrices are drawn.
    """
    n_input, _ = shape
    from_minus_one_to_one = 2.0 * torch.rand((*batch, *shape)) - 1.0
    return nn.Parameter(size * from_minus_one_to_one / np.sqrt(n_input))
