"""A network for all films as it is used: fold it for one film, and predict."""

from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array
from isocharge.errors import InputError
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.data.domain import ContactDomain
from isocharge.train.films.conditional_weights import ConditionalWeights
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.fit import FilmsFit
from isocharge.train.release.folding import FoldedLayers, FoldedNetwork, answer_units


@dataclass(frozen=True)
class FilmsModel:
    """What is needed for a model of any film of a prior; no torch in it.

    Attributes:
        family: Forward maps of the films.
        scaling: Exact scales and context of films; holds prior and domain.
        mean: Of the logarithms of the charges (pC) with the exact scales divided out, shape (n_electrode,).
        whitening: Shape (n_electrode, n_electrode).
        contact: Weights of the contact network.
        misfit: Weights of the misfit network.
        noise: Noise of the training.
        sha256: Checksum of the file that it was read from, or "".
    """

    family: FilmFamily
    scaling: FilmScaling
    mean: Array
    whitening: Array
    contact: ConditionalWeights
    misfit: ConditionalWeights
    noise: NoiseModel
    sha256: str = ""

    @classmethod
    def of(cls, fit: FilmsFit, noise: NoiseModel) -> "FilmsModel":
        """What a training gave, in full precision."""
        inputs = fit.inputs
        weights = (ConditionalWeights(part) for part in (fit.contact, fit.misfit))
        return cls(fit.family, inputs.scaling, inputs.mean, inputs.whitening, *weights, noise)

    @property
    def prior(self) -> FilmPrior:
        """The films: the sensor as described, the probe, and how far films spread."""
        return self.scaling.prior

    @property
    def domain(self) -> ContactDomain:
        """The contacts that the network knows."""
        return self.scaling.domain

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
        perceptrons = [weights.plain(context) for weights in (self.contact, self.misfit)]
        logs_mean = self.mean + self.scaling.log_charge_scale(parameters)
        typical = 2.0 ** np.round(logs_mean / np.log(2.0))
        turn, offset = self.scaling.turn(parameters), self.scaling.offset(parameters)
        units = answer_units(self.domain, turn, offset, self.mean.size)
        return FoldedNetwork(
            FoldedLayers.of(perceptrons, self.whitening, logs_mean - np.log(typical), units), typical
        )

