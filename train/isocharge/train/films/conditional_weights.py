"""The weights of a conditional perceptron in NumPy, and the plain perceptron that they are for one film."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from isocharge.arrays import Array
from isocharge.train.release.folding import PlainPerceptron


@dataclass(frozen=True)
class ConditionalWeights:
    """Weights by name, as `ConditionalPerceptron.to_arrays` gives them.

    Attributes:
        arrays: By name.
    """

    arrays: Mapping[str, Array]

    @property
    def layers(self) -> int:
        """Number of layers, the one that skips the others left out."""
        return sum(name.startswith("constant.") for name in self.arrays)

    def plain(self, context: Array) -> PlainPerceptron:
        """The perceptron for one context, shape (n_context,)."""
        psi = context
        for number in (0, 2):
            psi = np.tanh(self._linear(f"context.{number}", psi))
        phi = self._linear("phi", psi).reshape(self.layers + 1, -1)
        weights = [self._mixed(f"constant.{k}", f"bases.{k}", phi[k]) for k in range(self.layers)]
        biases = [self._linear(f"bias.{k}", psi) for k in range(self.layers)]
        return PlainPerceptron(
            tuple(zip(weights, biases, strict=True)), self._mixed("skip", "skip_bases", phi[self.layers])
        )

    def _linear(self, name: str, value: Array) -> Array:
        moved: Array = self.arrays[f"{name}.weight"] @ value + self.arrays[f"{name}.bias"]
        return moved

    def _mixed(self, constant: str, bases: str, shares: Array) -> Array:
        mixed: Array = self.arrays[constant] + np.tensordot(shares, self.arrays[bases], axes=1)
        return mixed
