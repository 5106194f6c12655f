"""A network for all films as it is used: folded to the plain network of one film."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from isocharge.common.activations import TANH, Activation
from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.perceptron import Layer, Perceptron, evaluate_hidden_layers
from isocharge.simulate import Domain, FilmPrior, ForwardMap, NoiseModel
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.training.correlation import with_correlation
from isocharge.train.training.features import logarithmic_features
from isocharge.train.training.fitted import Fitted, Provenance
from isocharge.train.training.folded_network import FoldedNetwork
from isocharge.train.training.folding import answer_units, fold
from isocharge.train.training.output_regression import adapt_to_charges, add_variance

TAUGHT, COPIES = 750, 4
"""Presses by which layers are changed, each with noise drawn so often; twice as many change errors by 0.5 %."""

CORRELATED = 1500
"""Presses from which correlations are learned, those among them."""

PRESSES, SEED = 1000, 11
"""Fresh presses on which a film's network is judged, and their seed."""


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
        """Compute the perceptron of one film from its context, shape (n_context,)."""
        context_layers = [self._linear(f"context.{name}") for name in CONTEXT_LAYERS]
        psi = evaluate_hidden_layers(context_layers, self.activation, context)
        n_layer = sum(name.startswith("constant.") for name in self.arrays)
        phi = self._apply_linear("phi", psi).reshape(n_layer + 1, -1)
        layers = []
        for number in range(n_layer):
            weight = self._mix(f"constant.{number}", f"bases.{number}", phi[number])
            layers.append(Layer(weight, self._apply_linear(f"bias.{number}", psi)))
        *hidden, last = layers
        return Perceptron(tuple(hidden), last, self._mix("skip", "skip_bases", phi[n_layer]), self.activation)

    def _linear(self, name: str) -> Layer[Array]:
        """Return a linear layer; the file holds its weight with shape (n_output, n_input)."""
        return Layer(self.arrays[f"{name}.weight"].T, self.arrays[f"{name}.bias"])

    def _apply_linear(self, name: str, value: Array) -> Array:
        """Apply a linear layer to a vector."""
        layer = self._linear(name)
        return np.asarray(value @ layer.weight + layer.bias)

    def _mix(self, constant: str, bases: str, phi: Array) -> Array:
        """Compute the weights of a layer from phi, shape (n_basis,)."""
        return np.asarray(self.arrays[constant] + np.tensordot(phi, self.arrays[bases], axes=1))


@dataclass(frozen=True)
class FilmsModel:
    """What is needed for the network of any film of a prior.

    Attributes:
        family: Forward maps of the films.
        scaling: Exact scales and context of films; holds prior and domain.
        mean: Of the logarithms of the charges (pC) with the exact scales divided out, shape (n_electrode,).
        whitening: Shape (n_electrode, n_electrode).
        contact: Weights of the contact network.
        misfit: Weights of the misfit network.
        noise: Noise of the training.
        sha256: Checksum of the file that it was read from, or "".
        made_with: Of a fit, for the metadata; not in the file.
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
        """The films: the sensor as described, the probe, and how far films spread."""
        return self.scaling.prior

    @property
    def domain(self) -> Domain:
        """The contacts that the network knows."""
        return self.scaling.domain

    def forward_map(self, parameters: Array) -> ForwardMap:
        """The charges of one film, parameters as in `FilmPrior`, shape (n_parameter,).

        Raises:
            SceneError: If the film is outside the family.
        """
        return self.family.forward_map(*self.prior.film(parameters))

    def film(
        self,
        parameters: Array,
        *,
        left: tuple[Array, Array] | None = None,
        provenance: Provenance | None = None,
        factor: Callable[[Array], Array] | None = None,
        correlation: bool = True,
        fresh: int = PRESSES,
    ) -> Fitted:
        """The network of one film, as `fit` gives it for one: to predict, to evaluate on fresh presses, to release.

        Args:
            parameters: Of the film, as in `FilmPrior`, shape (n_parameter,).
            left: Contacts (x, y, F), shape (n, 3), mm and N, and the variances of (x, y, ln F) there by what is not
                known of the film, shape (n, 3): the deviations are larger by them.
            provenance: For the release, if there is something to say.
            factor: Contacts (x, y, F), shape (n, 3), mm and N, to factors on the charges, shape (n, n_electrode), if
                they differ from those of the parameters: the network's first and last layers are changed accordingly,
                and its deviations are those of the errors that this leaves.
            correlation: Whether it learns how errors go together; that takes a second or two.
            fresh: How many presses it has to be judged on.

        Raises:
            InputError: If there are not as many finite parameters as the prior names.
            SceneError: If the film is outside the family.
        """
        network, (sensor, probe) = self.fold(parameters), self.prior.film(parameters)
        rng, (known, variance) = np.random.default_rng(SEED), left or (np.empty((0, 3)), np.empty((0, 3)))
        drawn, learned = draw_contacts(rng, self.domain, PRESSES + CORRELATED), CORRELATED if correlation else TAUGHT
        contact = np.concatenate([drawn[PRESSES - fresh : PRESSES + learned], known])
        ratio = np.ones((len(contact), self.mean.size)) if factor is None else factor(contact)
        charge = self.forward_map(parameters).charges(contact)
        presses = LabelledPresses(contact[:fresh], (charge * ratio)[:fresh])
        if factor is not None:
            taught = np.arange(fresh, fresh + TAUGHT).repeat(COPIES)
            noisy = self.noise.add((charge * ratio)[taught], rng)
            network = adapt_to_charges(network, noisy, noisy / ratio[taught], contact[taught])
        if correlation:
            of = slice(fresh, fresh + learned)
            examples = LabelledPresses(contact[of], (charge * ratio)[of])
            network = with_correlation(network, examples, self.noise, SEED)
        if left is not None:
            taught = np.arange(fresh + learned, len(contact)).repeat(COPIES)
            noisy = self.noise.add((charge * ratio)[taught], rng)
            network = add_variance(network, noisy, variance.repeat(COPIES, axis=0))
        return Fitted(
            network=network,
            sensor=sensor,
            probes=(probe.notation,),
            domain=self.domain,
            noise=self.noise,
            test=presses,
            good=presses,
            sha256=self.sha256,
            provenance=provenance or Provenance(),
            requested_domain=self.domain,
        )

    def fold(self, parameters: Array) -> FoldedNetwork:
        """The plain network of one film, parameters as in `FilmPrior`, shape (n_parameter,); some milliseconds.

        Raises:
            InputError: If there are not as many finite parameters as the prior names.
        """
        parameters = np.asarray(parameters, dtype=float)
        if parameters.shape != (len(self.prior.names),) or not np.isfinite(parameters).all():
            raise InputError(
                f"film: expected {len(self.prior.names)} finite parameters ({', '.join(self.prior.names)}), got "
                f"{parameters.tolist()}"
            )
        context = self.scaling.context(parameters)
        perceptrons = [weights.perceptron(context) for weights in (self.contact, self.misfit)]
        logarithms_mean = self.mean + self.scaling.log_charge_scale(parameters)
        features = logarithmic_features(logarithms_mean)
        features_mean = logarithms_mean - np.log(features.typical_pC)
        units = answer_units(
            self.domain, self.scaling.rotation(parameters), self.scaling.offset(parameters), features.n_electrode
        )
        return FoldedNetwork(features, fold(perceptrons, features_mean, self.whitening, units))
