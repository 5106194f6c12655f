"""The network for all films: a perceptron whose weights depend on a context, and what a film's parameters do exactly.

With E h the stretching stiffness, d the geometric mean of d31 and d32, and g the gain of an electrode,

    Q / (g d E)  =  function of F / (E h), of the place in the frame of the electrodes, and of the context:

the softened pretension over E, ln d31/d32, h, where the film's centre lies in that frame, its rotation, and the
probe's radius. The noise and the ends of the domain do not scale along, so the context also has the scales that were
divided out: of all charges, of the force, and each gain about their mean.

The network's inputs are the charges with the exact scales of the film divided out. A small network turns the context
into psi. Layer l then has the weights W_l0 + sum_k phi_lk W_lk, with phi linear in psi, and a bias that is linear in
psi; so has the layer that skips the others. Computed once per film, it is a plain perceptron.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.forward.film_grid import SOFTENING
from isocharge.simulate.sensor.film_prior import SHARED, FilmPrior
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE
from isocharge.train.films.films_data import FilmPresses
from isocharge.train.training.folding import PlainPerceptron
from isocharge.train.training.network import Trainable, as_tensor, whitening

DRAWS = 4096
"""Films drawn to standardise the context."""


@dataclass(frozen=True)
class FilmScaling:
    """The exact scales of films, and their context, for parameters of any leading shape.

    Attributes:
        prior: The films.
        domain: The contacts; unit coordinates refer to it.
    """

    prior: FilmPrior
    domain: Domain

    def log_charge_scale(self, parameters: Array) -> Array:
        """ln of the charges' exact factors, 1 for the described film: (..., n_parameter) to (..., n_electrode)."""
        common = _of(parameters, "young") + 0.5 * (_of(parameters, "d31") + _of(parameters, "d32"))
        return np.asarray(parameters[..., len(SHARED) :] + common[..., None])

    def rotation(self, parameters: Array) -> Array:
        """Matrix T of `to_film`, (..., n_parameter) to (..., 3, 3): the rotation of the electrodes."""
        rotation = np.zeros((*parameters.shape[:-1], 3, 3))
        rotation[..., :2, :2] = _rotation(_of(parameters, "rotation"))
        rotation[..., 2, 2] = 1.0
        return rotation

    def offset(self, parameters: Array) -> Array:
        """Offset o of `to_film`, (..., n_parameter) to (..., 3)."""
        described = np.array(self.prior.sensor.calibration.shift)
        moved = described + _shift(parameters) - _rotation(_of(parameters, "rotation")) @ described
        stiffness = _of(parameters, "young") + _of(parameters, "thickness")
        return np.asarray(np.concatenate([moved, stiffness[..., None]], axis=-1) / self.domain.scale)

    def to_film(self, parameters: Array, unit: Array) -> Array:
        """Unit coordinates on the described film with the scales divided out, (..., 3), to those on the film: T u + o.

        The place is carried along by the electrodes; the force grows with the stiffness.
        """
        return np.asarray((self.rotation(parameters) @ unit[..., None])[..., 0] + self.offset(parameters))

    def context(self, parameters: Array) -> Array:
        """What a network knows of a film, standardised over the films: (..., n_parameter) to (..., 9 + n_electrode)."""
        centre, spread = self.standard
        return np.asarray((self._raw_context(parameters) - centre) / spread)

    @cached_property
    def standard(self) -> tuple[Array, Array]:
        """Means and standard deviations of the context over the films, each of shape (9 + n_electrode,)."""
        raw = self._raw_context(self.prior.draw(np.random.default_rng(0), DRAWS))
        return raw.mean(axis=0), raw.std(axis=0)

    def _raw_context(self, parameters: Array) -> Array:
        film, described = self.prior.sensor.film, np.array(self.prior.sensor.calibration.shift)
        strain = _of(parameters, "pretension") / (film.young * np.exp(_of(parameters, "young")))
        back = _rotation(-_of(parameters, "rotation"))
        centre = described - (back @ (described + _shift(parameters))[..., None])[..., 0]
        gains = parameters[..., len(SHARED) :]
        columns = [
            np.log(strain + SOFTENING),
            _of(parameters, "d31") - _of(parameters, "d32"),
            _of(parameters, "thickness"),
            centre[..., 0],
            centre[..., 1],
            _of(parameters, "rotation"),
            _of(parameters, "probe_radius"),
            self.log_charge_scale(parameters).mean(axis=-1),
            _of(parameters, "young") + _of(parameters, "thickness"),
        ]
        return np.concatenate([np.stack(columns, axis=-1), gains - gains.mean(axis=-1, keepdims=True)], axis=-1)


def _of(parameters: Array, name: str) -> Array:
    """One of the parameters that all films share, shape (...)."""
    return np.asarray(parameters[..., SHARED.index(name)])


def _shift(parameters: Array) -> Array:
    return np.stack([_of(parameters, "shift_x"), _of(parameters, "shift_y")], axis=-1)


def _rotation(angle: Array) -> Array:
    """Matrices of shape (..., 2, 2) for rotations by angles (...), rad, anticlockwise."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


BASES = 6
"""Matrices that a layer's weights are made of, besides the constant one."""

PSI = 64
"""Width of the context's network."""

FITTED = 512
"""Films that the whitening is taken from."""

FIRST_BASIS, FIRST_SHARE = 0.3, 0.3
"""Sizes at the start: of the bases, over the constant matrix; of phi."""


@dataclass(frozen=True)
class FilmInputs:
    """x = (ln clip(Q) - ln scale(film) - mean) @ whitening.

    Attributes:
        scaling: Exact scales and context of films.
        mean: Of the logarithms (Q in pC), shape (n_electrode,).
        whitening: Shape (n_electrode, n_electrode).
    """

    scaling: FilmScaling
    mean: Array
    whitening: Array

    @classmethod
    def fit(cls, scaling: FilmScaling, presses: FilmPresses) -> "FilmInputs":
        """Zero mean and unit covariance along the principal axes, over clean charges of many films."""
        logs = np.log(np.clip(presses.charge()[:FITTED], LOWEST_CHARGE, HIGHEST_CHARGE))
        logs = (logs - scaling.log_charge_scale(presses.parameters[:FITTED])[:, None]).reshape(-1, logs.shape[-1])
        return cls(scaling, *whitening(logs))

    def values(self, charge: Tensor, parameters: Array) -> Tensor:
        """Charges (n_film, n, n_electrode) of films (n_film, n_parameter) to inputs of the same shape."""
        shift = as_tensor(self.scaling.log_charge_scale(parameters) + self.mean)
        logs = torch.log(charge.clamp(LOWEST_CHARGE, HIGHEST_CHARGE)) - shift[:, None]
        return logs @ as_tensor(self.whitening)

    def context(self, parameters: Array) -> Tensor:
        """Contexts of films, (n_film, n_parameter) to (n_film, n_context)."""
        return as_tensor(self.scaling.context(parameters))


class ConditionalPerceptron(Trainable):
    """Perceptrons of many films at once.

    Args:
        inputs: Number of electrodes.
        hidden: Widths of the hidden layers.
        outputs: Number of outputs.
        context: Number of context values.
        bases: Matrices that a layer's weights are made of, besides the constant one.
        psi: Width of the context's network.
    """

    def __init__(
        self, inputs: int, hidden: tuple[int, ...], outputs: int, context: int, bases: int = BASES, psi: int = PSI
    ) -> None:
        super().__init__()
        sizes = list(pairwise((inputs, *hidden, outputs)))
        self.context = nn.Sequential(nn.Linear(context, psi), nn.Tanh(), nn.Linear(psi, psi), nn.Tanh())
        self.constant = nn.ParameterList([_uniform(1.0, *size) for size in sizes])
        self.bases = nn.ParameterList([_uniform(FIRST_BASIS, *size, count=bases) for size in sizes])
        self.bias = nn.ModuleList([nn.Linear(psi, size[1]) for size in sizes])
        self.skip = nn.Parameter(torch.zeros(inputs, outputs))
        self.skip_bases = nn.Parameter(torch.zeros(bases, inputs, outputs))
        self.phi = nn.Linear(psi, bases * (len(sizes) + 1))
        for linear in self.bias:
            nn.init.zeros_(linear.weight)  # type: ignore[arg-type]
        nn.init.normal_(self.phi.weight, std=FIRST_SHARE / np.sqrt(psi))
        nn.init.zeros_(self.phi.bias)

    def forward(self, inputs: Tensor, context: Tensor) -> Tensor:
        """Inputs (n_film, n, inputs) and contexts (n_film, n_context) to (n_film, n, outputs)."""
        psi = self.context(context)
        phi = self.phi(psi).view(len(context), len(self.constant) + 1, -1)
        value, last = inputs, len(self.constant) - 1
        for number, (constant, bases, bias) in enumerate(zip(self.constant, self.bases, self.bias, strict=True)):
            weight = constant + torch.einsum("fk,kio->fio", phi[:, number], bases)
            value = torch.baddbmm(bias(psi)[:, None], value, weight)
            value = value if number == last else torch.tanh(value)
        skip = self.skip + torch.einsum("fk,kio->fio", phi[:, -1], self.skip_bases)
        return value + torch.bmm(inputs, skip)

    def hidden_matrices(self) -> list[Tensor]:
        """Constant weights from one hidden layer to the next."""
        return list(self.constant)[1:-1]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Weights by name, as `ConditionalWeights` takes them."""
        return {name: values.detach().double().numpy() for name, values in self.state_dict().items()}


def _uniform(share: float, inputs: int, outputs: int, count: int = 0) -> nn.Parameter:
    """Weights of shape (inputs, outputs), or `count` of them, uniform in +-share / sqrt(inputs)."""
    shape = (count, inputs, outputs) if count else (inputs, outputs)
    return nn.Parameter(share * (2.0 * torch.rand(shape) - 1.0) / np.sqrt(inputs))


@dataclass(frozen=True)
class ConditionalWeights:
    """The same weights in NumPy, and the plain perceptron that they are for one film.

    Attributes:
        arrays: By name, as `ConditionalPerceptron.to_arrays` gives them.
    """

    arrays: Mapping[str, Array]

    def plain(self, context: Array) -> PlainPerceptron:
        """The perceptron for one context, shape (n_context,)."""
        psi = context
        for number in (0, 2):
            psi = np.tanh(self._linear(f"context.{number}", psi))
        count = sum(name.startswith("constant.") for name in self.arrays)
        phi = self._linear("phi", psi).reshape(count + 1, -1)
        layers = tuple(
            (self._mixed(f"constant.{k}", f"bases.{k}", phi[k]), self._linear(f"bias.{k}", psi)) for k in range(count)
        )
        return PlainPerceptron(layers, self._mixed("skip", "skip_bases", phi[count]))

    def _linear(self, name: str, value: Array) -> Array:
        return np.asarray(self.arrays[f"{name}.weight"] @ value + self.arrays[f"{name}.bias"])

    def _mixed(self, constant: str, bases: str, shares: Array) -> Array:
        return np.asarray(self.arrays[constant] + np.tensordot(shares, self.arrays[bases], axes=1))
