"""A trained network for all films, from which the network of each film is computed."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from isocharge.common.activations import TANH, Activation
from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.perceptron import Layer, Perceptron, evaluate_hidden_layers
from isocharge.simulate import Domain, FilmPrior, ForwardMap, NoiseModel
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.training.correlation import N_EXAMPLES, with_correlation
from isocharge.train.training.features import logarithmic_features
from isocharge.train.training.fitted import Fitted, Provenance
from isocharge.train.training.folded_network import FoldedNetwork
from isocharge.train.training.folding import fold, linear_answer_map, log_std_limits
from isocharge.train.training.output_regression import adapt_to_charges, add_variance

N_REGRESSION_PRESSES = 750
"""Number of presses to which a network is fitted if the charges differ from those of the simulated film.

More presses hardly reduce the errors.
"""

N_COPIES = 4
"""Number of copies of each press in the fits of the corrections. Each copy has its own noise."""

N_CORRELATION_PRESSES = 1500
"""Number of presses to which the correlations are fitted. They include the `N_REGRESSION_PRESSES` presses."""

N_TEST_PRESSES = 1000
"""Largest number of presses on which the errors of the network of a film are measured."""

SEED = 11
"""Seed of the presses and of their noise."""

CONTEXT_LAYERS = ("0", "2")
"""Names of the layers of the context network in the films file."""


@dataclass(frozen=True)
class ConditionalWeights:
    """The weights of a trained `ConditionalPerceptron` as NumPy arrays.

    Attributes:
        arrays: Weights by name, as `ConditionalPerceptron.to_arrays` returns them.
        activation: Activation of the hidden layers and of the context network.
    """

    arrays: Mapping[str, Array]
    activation: Activation = TANH

    def perceptron(self, context: Array) -> Perceptron[Array]:
        """Compute the perceptron of one film.

        Two context layers compute the features psi of the film from its context. The weight matrix of each layer is the
        sum of a constant matrix and basis matrices, each multiplied by a factor phi. The factors phi and the biases are
        linear functions of the features psi.

        Args:
            context: Numbers that describe the film, shape (n_context,).

        Returns:
            The perceptron with the weights and biases of this film.
        """
        context_layers = [self._linear(f"context.{name}") for name in CONTEXT_LAYERS]
        film_features = evaluate_hidden_layers(context_layers, self.activation, context)
        n_layer = sum(name.startswith("constant.") for name in self.arrays)  # each layer has one constant matrix
        # One row for each layer and for the skip layer
        basis_factors = self._apply_linear("phi", film_features).reshape(n_layer + 1, -1)
        layers = []
        for index in range(n_layer):
            weight = self._mix_weights(f"constant.{index}", f"bases.{index}", basis_factors[index])
            bias = self._apply_linear(f"bias.{index}", film_features)
            layers.append(Layer(weight, bias))
        skip_weight = self._mix_weights("skip", "skip_bases", basis_factors[n_layer])
        *hidden, output_layer = layers
        return Perceptron(tuple(hidden), output_layer, skip_weight, self.activation)

    def _linear(self, name: str) -> Layer[Array]:
        """Return the linear layer with this name."""
        # The weight is stored with the shape (n_output, n_input), as in PyTorch.
        return Layer(self.arrays[f"{name}.weight"].T, self.arrays[f"{name}.bias"])

    def _apply_linear(self, name: str, vector: Array) -> Array:
        """Apply the linear layer with this name to a vector of shape (n_input,)."""
        layer = self._linear(name)
        return np.asarray(vector @ layer.weight + layer.bias)

    def _mix_weights(self, constant: str, bases: str, phi: Array) -> Array:
        """Compute the weights of a layer: a constant matrix plus a weighted sum of basis matrices.

        Args:
            constant: Name of the constant matrix, shape (n_input, n_output).
            bases: Name of the array with the basis matrices, shape (n_basis, n_input, n_output).
            phi: Factors of the basis matrices, shape (n_basis,).
        """
        weighted_sum = np.tensordot(phi, self.arrays[bases], axes=1)
        return np.asarray(self.arrays[constant] + weighted_sum)


class AddedCovariance(NamedTuple):
    """Covariances of errors that a network makes in addition to the errors that noise causes.

    Attributes:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        covariance: Covariances of the additional errors of (x, y, ln F) at these contacts, shape (n, 3, 3).
    """

    contact: Array
    covariance: Array

    @property
    def variance(self) -> Array:
        """Variances of the additional errors of (x, y, ln F), shape (n, 3), mm^2, mm^2 and 1."""
        return np.diagonal(self.covariance, axis1=1, axis2=2)

    def displace(self, presses: LabelledPresses, rng: np.random.Generator) -> LabelledPresses:
        """Return copies of presses whose contacts are changed by random errors with the covariances.

        The charges of the copies are not changed. On the copies, a network therefore makes the additional errors.

        Args:
            presses: Presses at the contacts of the covariances.
            rng: Random number generator.

        Returns:
            The copies, at least `N_EXAMPLES` presses.
        """
        copies = presses.repeated(N_EXAMPLES)
        variances, directions = np.linalg.eigh(self.covariance)
        roots = directions * np.sqrt(np.maximum(variances, 0.0))[:, np.newaxis]  # rounding can give variances below 0
        copied_roots = roots[np.arange(len(copies)) % len(presses)]  # in the order of the copies
        error = np.einsum("nij,nj->ni", copied_roots, rng.standard_normal((len(copies), 3)))
        contact = copies.contact.copy()
        contact[:, :2] += error[:, :2]
        contact[:, 2] *= np.exp(error[:, 2])
        return replace(copies, contact=contact)


@dataclass(frozen=True)
class FilmsModel:
    """Network for all films of a prior.

    Attributes:
        family: Forward maps of the films.
        scaling: Charge scales and contexts of the films. It contains the prior and the domain.
        mean: Mean of the logarithms of the charges, pC, after division by the charge scales of the films, shape
            (n_electrode,).
        whitening: Matrix that whitens these logarithms, shape (n_electrode, n_electrode).
        contact: Weights of the contact network.
        misfit: Weights of the misfit network.
        noise: Noise for which the network was trained.
        sha256: Checksum of the file from which the model was read; empty for a model that was not read from a file.
        made_with: Settings of the training for the metadata of a model. The file does not contain them.
    """

    family: FilmFamily
    scaling: FilmScaling
    mean: Array
    whitening: Array
    contact: ConditionalWeights
    misfit: ConditionalWeights
    noise: NoiseModel
    sha256: str = ""
    made_with: Mapping[str, Any] = field(default_factory=dict)

    @property
    def prior(self) -> FilmPrior:
        """Distribution of the films."""
        return self.scaling.prior

    @property
    def domain(self) -> Domain:
        """Contacts for which the network was trained."""
        return self.scaling.domain

    def forward_map(self, parameters: Array) -> ForwardMap:
        """Return the forward map of one film, which computes charges from contacts.

        Args:
            parameters: Parameters of the film, as in `FilmPrior`, shape (n_parameter,).

        Raises:
            SceneError: If the forward maps of the family do not cover the film.
        """
        return self.family.forward_map(*self.prior.film(parameters))

    def film(
        self,
        parameters: Array,
        *,
        provenance: Provenance | None = None,
        charge_factor: Callable[[Array], Array] | None = None,
        added_covariance: AddedCovariance | None = None,
        correlation: bool = True,
        n_test: int = N_TEST_PRESSES,
    ) -> Fitted:
        """Compute the network of one film, with test presses and all other values that a release needs.

        The network is first computed from the parameters of the film. Up to three corrections follow, which use presses
        on the simulated film:

        1. With `charge_factor`, adapt the network to charges that differ from the simulated charges by known factors.
        2. With `added_covariance`, add variances to those that the network reports.
        3. With `correlation`, fit the correlations between the errors of x, y and force. These errors include the
           additional errors.

        Args:
            parameters: Parameters of the film, as in `FilmPrior`, shape (n_parameter,).
            provenance: Additional information for the release; None for no information.
            charge_factor: Function of contacts (x, y, F), shape (n, 3), mm and N, that returns the charges of the film
                divided by the charges of the simulated film, shape (n, n_electrode). None if the charges are equal.
                With this function, the first and the last layer of the network are changed, and its standard deviations
                are fitted to the remaining errors.
            added_covariance: Covariances of additional errors, for example because the parameters of the film are
                uncertain; None if there are no additional errors.
            correlation: Whether to fit the correlations, which takes one or two seconds.
            n_test: Number of test presses, at most `N_TEST_PRESSES`.

        Returns:
            The network with test presses on the simulated film.

        Raises:
            InputError: If there are not as many finite parameters as the prior names.
            SceneError: If the forward maps of the family do not cover the film.
        """
        network = self.fold(parameters)
        sensor, probe = self.prior.film(parameters)
        rng = np.random.default_rng(SEED)

        # Draw contacts for the test and for the corrections. The contacts of the additional errors are given.
        n_train = N_CORRELATION_PRESSES if correlation else N_REGRESSION_PRESSES
        test_contact, train_contact = self._draw_contacts(rng, n_test, n_train)
        uncertain_contact = np.empty((0, 3)) if added_covariance is None else added_covariance.contact

        # Compute the charges of all three groups of contacts together.
        contact = np.concatenate([test_contact, train_contact, uncertain_contact])
        test_rows, train_rows, uncertain_rows = np.split(np.arange(len(contact)), [n_test, n_test + n_train])

        simulated_charge = self.forward_map(parameters).charges(contact)
        factors = np.ones(simulated_charge.shape) if charge_factor is None else charge_factor(contact)
        presses = LabelledPresses(contact, simulated_charge * factors)

        # Apply the corrections.
        if charge_factor is not None:
            regression_rows = train_rows[:N_REGRESSION_PRESSES]
            network = self._adapt_to_factors(network, presses[regression_rows], factors[regression_rows], rng)
        correlation_presses = presses[train_rows]
        if added_covariance is not None:
            copied_rows = uncertain_rows.repeat(N_COPIES)  # each copy gets its own noise
            noisy_charge = self.noise.add(presses.charge[copied_rows], rng)
            repeated_variance = added_covariance.variance.repeat(N_COPIES, axis=0)
            network = add_variance(network, noisy_charge, repeated_variance)
            correlation_presses = added_covariance.displace(presses[uncertain_rows], rng)
        if correlation:
            network = with_correlation(network, correlation_presses, self.noise, SEED)
        test = presses[test_rows]
        return Fitted(
            network=network,
            sensor=sensor,
            probes=(probe.notation,),
            domain=self.domain,
            noise=self.noise,
            test=test,
            good=test,
            sha256=self.sha256,
            provenance=provenance or Provenance(),
            requested_domain=self.domain,
        )

    def _draw_contacts(self, rng: np.random.Generator, n_test: int, n_train: int) -> tuple[Array, Array]:
        """Draw contacts for the test and contacts for the corrections.

        The method always draws the largest possible number of contacts, and returns only as many contacts as are
        needed. Therefore, the contacts for the corrections do not depend on the number of contacts for the test.

        Args:
            rng: Random number generator.
            n_test: Number of contacts for the test, at most `N_TEST_PRESSES`.
            n_train: Number of contacts for the corrections, at most `N_CORRELATION_PRESSES`.

        Returns:
            Contacts for the test, shape (n_test, 3), and for the corrections, shape (n_train, 3), mm and N.
        """
        drawn_contact = draw_contacts(rng, self.domain, N_TEST_PRESSES + N_CORRELATION_PRESSES)
        test_candidates, train_candidates = np.split(drawn_contact, [N_TEST_PRESSES])
        return test_candidates[N_TEST_PRESSES - n_test :], train_candidates[:n_train]

    def _adapt_to_factors(
        self, network: FoldedNetwork, presses: LabelledPresses, factors: Array, rng: np.random.Generator
    ) -> FoldedNetwork:
        """Adapt the network of a simulated film to another film whose charges differ by known factors.

        Args:
            network: Network of the simulated film.
            presses: Presses whose charges are already multiplied by the factors.
            factors: Charges of the film divided by the charges of the simulated film, shape (n, n_electrode).
            rng: Random number generator for the noise.
        """
        copied_rows = np.arange(len(presses)).repeat(N_COPIES)  # each copy gets its own noise
        noisy_charge = self.noise.add(presses.charge[copied_rows], rng)
        simulated_charge = noisy_charge / factors[copied_rows]
        return adapt_to_charges(network, noisy_charge, simulated_charge, presses.contact[copied_rows])

    def fold(self, parameters: Array) -> FoldedNetwork:
        """Compute the network of one film from its parameters, without the corrections of the method `film`.

        One perceptron estimates the contact, and another the misfit. Both are merged into one perceptron, which reads
        the logarithms of the charges. Its first layer also divides the charges by the charge scales of the film, which
        are their expected ratios to the charges of the described film. Its last layer also converts the estimated
        contact from the described film to this film, whose electrodes are rotated and shifted.

        Args:
            parameters: Parameters of the film, as in `FilmPrior`, shape (n_parameter,).

        Returns:
            The network of the film.

        Raises:
            InputError: If there are not as many finite parameters as the prior names.
        """
        parameters = np.asarray(parameters, dtype=float)
        if parameters.shape != (len(self.prior.names),) or not np.isfinite(parameters).all():
            raise InputError(
                f"film: expected {len(self.prior.names)} finite parameters ({', '.join(self.prior.names)}), got "
                f"{parameters.tolist()}"
            )

        # The perceptrons with the weights of this film
        context = self.scaling.context(parameters)
        perceptrons = [weights.perceptron(context) for weights in (self.contact, self.misfit)]

        # The input features ln(Q / typical charge) and their mean. `self.mean` is the mean of ln(Q / charge scale).
        log_charge_mean = self.mean + self.scaling.log_charge_scale(parameters)
        features = logarithmic_features(log_charge_mean)
        features_mean = log_charge_mean - np.log(features.typical_pC)

        # The map from the answers of the perceptrons to contacts on this film
        rotation = self.scaling.rotation(parameters)
        offset = self.scaling.offset(parameters)
        answer_map = linear_answer_map(self.domain, rotation, offset, features.n_electrode)
        layers = fold(perceptrons, features_mean, self.whitening, answer_map)
        return FoldedNetwork(features, layers, log_std_limits(self.domain))
