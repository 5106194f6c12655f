"""One interface for every method: a regressor as scikit-learn has them, charges in and contacts out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Protocol, Self

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.model_selection import ParameterGrid

from isocharge.common.arrays import Array
from isocharge.simulate.forward.charge_map import Domain
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.presses import LabelledPresses, position_error

Kind = Literal["paper", "learnt", "fitted map", "network"]

FIRST_COPY, VALIDATION_COPY = 1000, 999
"""Seeds of the noise, relative to the task's, on training and validation presses."""


class GivenMethod(BaseEstimator, RegressorMixin):  # type: ignore[misc]
    """A method that learns nothing from presses."""

    def fit(self, charge: Array, contact: Array) -> Self:
        """It is as it was given."""
        del charge, contact
        return self


class Regressor(Protocol):
    """What is compared; with scikit-learn's `BaseEstimator`, which copies it and sets its parameters."""

    def fit(self, charge: Array, contact: Array) -> Any:
        """Learn from charges, shape (n, n_electrode), pC, and contacts (x, y, F), shape (n, 3), mm and N.

        Raises:
            DatasetError: If the presses cannot teach this method.
        """

    def predict(self, charge: Array) -> Array:
        """Contacts, shape (n, 3); NaN where the method has no answer."""


@dataclass(frozen=True)
class FittingTask:
    """What methods are fitted for.

    Attributes:
        train: Presses to learn from, clean or measured.
        validation: Presses at other positions, to choose parameters by.
        domain: The contacts that can occur: uniform over a disk, log-uniform in force.
        noise: What will be on the charges.
        seed: Of noise and subsets.
        quick: Take the first candidate and one noisy copy, to try things out.
    """

    train: LabelledPresses
    validation: LabelledPresses
    domain: Domain
    noise: NoiseModel
    seed: int = 0
    quick: bool = False

    def presses(self, copies: int) -> LabelledPresses:
        """Copies of the training presses with fresh noise; measured ones, or those of no copies, as they are."""
        if self.train.measured or not copies:
            return self.train
        count = 1 if self.quick else copies
        charge = [self.train.noisy(self.noise, self.seed + FIRST_COPY + copy) for copy in range(count)]
        return LabelledPresses(np.tile(self.train.contact, (count, 1)), np.concatenate(charge))

    @cached_property
    def validation_charge(self) -> Array:
        """Charges of the validation presses, with noise."""
        if self.validation.measured:
            return self.validation.charge
        return self.validation.noisy(self.noise, self.seed + VALIDATION_COPY)


@dataclass(frozen=True)
class Rival:
    """A method, and how it is fitted at its best.

    Attributes:
        name: In tables and pictures.
        kind: In pictures.
        computed_by: What computes it.
        regressor: Before it is fitted.
        copies: Noisy copies of the presses that it learns from; 0 for clean presses.
        candidates: Values of its parameters, of which validation chooses.
        given_force: Whether it is given the true force behind the charges, which no sensor knows.
        choice: Parameters and how they were chosen; once it is fitted.
    """

    name: str
    kind: Kind
    computed_by: str
    regressor: Regressor
    copies: int = 0
    candidates: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    given_force: bool = False
    choice: str = ""

    def inputs(self, charge: Array, force: Array) -> Array:
        """What it is given of presses, shape (n, n_electrode) or one column more."""
        return np.column_stack([charge, force]) if self.given_force else charge

    def fit(self, task: FittingTask) -> "Rival":
        """Fitted with each of the candidates; the one with the least error on noisy validation presses.

        Raises:
            DatasetError: If the presses cannot teach this method.
        """
        presses = task.presses(self.copies)
        tried = list(ParameterGrid(dict(self.candidates)))[: 1 if task.quick else None]
        fitted = [clone(self.regressor).set_params(**parameters) for parameters in tried]
        errors = []
        for regressor in fitted:
            regressor.fit(presses.charge, presses.contact)
            answers = regressor.predict(self.inputs(task.validation_charge, task.validation.contact[:, 2]))
            errors.append(rms(position_error(answers, task.validation.contact)))
        best = int(np.argmin(errors))
        chosen = [*map(described, tried[best].items()), f"{len(presses)} {'noisy' if self.copies else 'clean'} presses"]
        if len(tried) > 1:
            chosen.append(f"best of {len(tried)} by validation ({errors[best]:.3f} mm rms)")
        return replace(self, regressor=fitted[best], choice=self.choice or ", ".join(chosen))


def described(parameter: tuple[str, object]) -> str:
    """A parameter, name and value, for people; factors of axes by the names of the axes."""
    name, value = parameter
    if isinstance(value, Mapping):
        return ", ".join(f"{axis} axis x {factor:g}" for axis, factor in value.items())
    return f"{name.rpartition('__')[2]} {value:g}" if isinstance(value, int | float) else f"{name} {value}"
