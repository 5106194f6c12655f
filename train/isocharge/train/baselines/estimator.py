"""One interface for every method: fit on presses under noise, then charges in and contacts out.

A method's `fit` returns the fitted method in each form that runs: a library's own call, say, and plain NumPy. The forms
give the same answers at different speeds.
"""

import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Protocol, TypeVar

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import noisy_charges
from isocharge.train.data.presses import LabelledPresses, position_error

T = TypeVar("T")

FIRST_COPY, VALIDATION_COPY = 1000, 999
"""Seeds of the noise, relative to the task's, on training and validation presses."""


@dataclass(frozen=True)
class FittingTask:
    """What a method is fitted for.

    Attributes:
        train: Clean presses to learn from.
        validation: Clean presses at other positions, to choose hyperparameters by.
        domain: The contacts that can occur: uniform over a disk, log-uniform in force.
        noise: What will be on the charges.
        seed: Of noise and subsets.
        copies: Noisy copies of the training presses that noise-aware methods learn from.
        quick: Fewer candidates and smaller methods, to try things out.
        measured: Whether the charges were measured: they have their noise, and none is added.
    """

    train: LabelledPresses
    validation: LabelledPresses
    domain: ContactDomain
    noise: NoiseModel
    seed: int = 0
    copies: int = 5
    quick: bool = False
    measured: bool = False

    def noisy_train(self, copies: int) -> LabelledPresses:
        """`copies` of the training presses, each with fresh noise on the charges; measured ones once, as they are."""
        if self.measured:
            return self.train
        charge = [noisy_charges(self.train, self.noise, self.seed + FIRST_COPY + copy) for copy in range(copies)]
        return LabelledPresses(np.tile(self.train.contact, (copies, 1)), np.concatenate(charge))

    @cached_property
    def noisy_validation(self) -> LabelledPresses:
        """The validation presses with noise on the charges."""
        if self.measured:
            return self.validation
        charge = noisy_charges(self.validation, self.noise, self.seed + VALIDATION_COPY)
        return LabelledPresses(self.validation.contact, charge)

    def validation_error(self, predict: Callable[[Array], Array]) -> float:
        """Root-mean-square position error on noisy validation charges, mm: what hyperparameters are chosen by."""
        presses = self.noisy_validation
        return rms(position_error(predict(presses.charge_pC), presses.contact))


class Fitted(ABC):
    """A fitted method in one of its forms; every form is a dataclass.

    Attributes:
        name: The method.
        form: What computes it: a library's name or "NumPy".
        choice: The hyperparameters and how they were chosen, as a text.
        given_force: Whether it needs the true force, which no sensor knows.
    """

    name: str
    form: str
    choice: str
    given_force: bool = False

    @abstractmethod
    def predict(self, charge_pC: Array) -> Array:
        """Contacts of presses.

        Args:
            charge_pC: Charges, shape (n, n_electrode), pC.

        Returns:
            (x_mm, y_mm, force_N), shape (n, 3); NaN where the method has no answer.
        """

    def with_known_force(self, force_N: Array) -> "Fitted":
        """The same with the true forces of the next presses, shape (n,), N; itself if it does not need them."""
        del force_N
        return self

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """One press, charges of shape (n_electrode,), ready to be computed and timed, by the fastest call."""
        row = np.array(charge_pC, dtype=float)[np.newaxis]
        return lambda: self.predict(row)

    @property
    def memory(self) -> int:
        """Serialised size of what a prediction needs, bytes: the fields, without what follows from them."""
        values = [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]
        return len(pickle.dumps(values, protocol=pickle.HIGHEST_PROTOCOL))


class Estimator(Protocol):
    """A method that can be fitted."""

    @property
    def name(self) -> str:
        """The method's name, the same as its fitted forms carry."""

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Fit at its best for root-mean-square error under the task's noise; every form that runs.

        Raises:
            DatasetError: If the presses cannot teach this method.
        """


def best_of(task: FittingTask, candidates: Iterable[T], fit: Callable[[T], Callable[[Array], Array]]) -> tuple[T, str]:
    """Fit with every candidate and keep the one whose validation error is smallest.

    Args:
        task: Its validation presses decide.
        candidates: Hyperparameters.
        fit: From hyperparameters to a function like `Fitted.predict`.

    Returns:
        The candidate, and a text on what it was compared with.
    """
    tried = [(task.validation_error(fit(candidate)), number, candidate) for number, candidate in enumerate(candidates)]
    error, _, best = min(tried, key=lambda entry: entry[:2])
    others = "" if len(tried) == 1 else f", best of {len(tried)} by validation ({error:.3f} mm rms)"
    return best, others
