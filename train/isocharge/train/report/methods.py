"""Methods of a report: triangulation, least squares on a charge map, and models.

Every function in `METHOD_BUILDERS` adds a method to all reports. Models are added by their folders.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, TrainingError
from isocharge.serve.model.contact import Contact
from isocharge.serve.model.predictor import Predictor
from isocharge.simulate import ChargeMap, Domain, NoiseModel, Triangulation
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.train.data.charge_fit import fit_charge_series
from isocharge.train.data.presses import LabelledPresses, split_by_position

VALIDATION_FRACTION = 0.1
"""Fraction of the positions whose presses are used to choose the degree of a charge series."""

N_CANDIDATES = 512
"""Number of contacts among which least squares chooses the starting points of its descents."""


@dataclass(frozen=True)
class FittingTask:
    """Presses and conditions to which a method is fitted.

    Attributes:
        presses: Presses of the dataset. Simulated presses have no noise.
        domain: Contacts that can occur. Their positions are uniformly distributed over a disk, and their forces are
            log-uniform.
        noise: Noise of the charges when the method is used.
        charge_map: Simulated map from contacts to charges; None if the presses were measured.
        seed: Seed of random choices.
    """

    presses: LabelledPresses
    domain: Domain
    noise: NoiseModel
    charge_map: ChargeMap | None = None
    seed: int = 0


@dataclass(frozen=True)
class Method:
    """A fitted method.

    Attributes:
        name: Name in the table and in the picture.
        library: Library that computes the estimates.
        estimate: Function from charges, shape (n, n_electrode), pC, to contacts (x, y, F), shape (n, 3), mm and N. A
            contact without an estimate is NaN.
        single_call: Function from the charges of one press, shape (n_electrode,), pC, to a function without arguments
            that estimates the contact of this press. None if `estimate` is the fastest way to estimate one contact.
    """

    name: str
    library: str
    estimate: Callable[[Array], Array]
    single_call: Callable[[Array], Callable[[], object]] | None = None

    def call_for(self, charge: Array) -> Callable[[], object]:
        """Return a function without arguments that estimates the contact of one press, to measure its duration.

        Args:
            charge: Charges of the press, shape (n_electrode,), pC.
        """
        if self.single_call is None:
            return partial(self.estimate, charge[None])
        return self.single_call(charge)


def triangulation(task: FittingTask) -> Method | None:
    """Return the triangulation of the paper, which intersects the contours of the charges.

    Args:
        task: Conditions. Without a charge map, there are no contours, and None is returned.
    """
    if task.charge_map is None:
        return None
    contours = Triangulation(task.charge_map)
    return Method("triangulation", "NumPy", lambda charge: contours.locate(charge).contact)


def least_squares(task: FittingTask) -> Method:
    """Return the search for the contact with the smallest squared residuals of the charges.

    The residuals are divided by the standard deviation of the noise. The contact is restricted to the domain.

    Args:
        task: Presses and conditions. Without a charge map, a series is fitted to the presses.

    Raises:
        TrainingError: If there are too few presses.
    """
    charge_map = task.charge_map
    if charge_map is None:
        train, validation = split_by_position(task.presses, VALIDATION_FRACTION, task.seed)
        names = tuple(map(str, range(train.charge.shape[1])))
        charge_map = fit_charge_series(task.domain, names, train, validation)

    def estimate(charge: Array) -> Array:
        """Estimate contacts (x, y, F), shape (n, 3), mm and N."""
        contact, _ = search(charge_map, charge, task.noise.sigma(charge), candidates=N_CANDIDATES)
        return contact

    return Method("least squares, Gauss-Newton", "NumPy", estimate)


METHOD_BUILDERS: tuple[Callable[[FittingTask], Method | None], ...] = (triangulation, least_squares)
"""Functions that fit the methods of all reports. A function returns None if its method needs a missing charge map."""


def fit_methods(task: FittingTask) -> tuple[list[Method], list[str]]:
    """Fit all methods of `METHOD_BUILDERS`.

    Args:
        task: Presses and conditions of the fits.

    Returns:
        The fitted methods; and the reasons why other methods could not be fitted to measured presses.

    Raises:
        DatasetError: If a method cannot be fitted to simulated presses.
        TrainingError: If there are too few simulated presses for a method.
    """
    methods = []
    failure_reasons = []
    for build_method in METHOD_BUILDERS:
        try:
            method = build_method(task)
        except (DatasetError, TrainingError) as error:
            if not task.presses.measured:
                raise
            failure_reasons.append(f"{build_method.__name__}: {error}")
            continue
        if method is not None:
            methods.append(method)
    return methods, failure_reasons


def model_method(folder: Path) -> Method:
    """Return the model in a version folder as a method.

    Args:
        folder: Version folder of the model.
    """
    predictor = Predictor(folder)

    def estimate(charge: Array) -> Array:
        """Estimate contacts (x, y, F), shape (n, 3), mm and N."""
        answers = predictor.predict_batch(charge)
        return np.stack([answers.x_mm, answers.y_mm, answers.force_N], axis=1).astype(float)

    def single_call(charge: Array) -> Callable[[], object]:
        """Return a function that computes the complete answer to one press."""
        answer = np.zeros(len(Contact._fields), np.float32)  # overwritten by every call
        return partial(predictor.predict_into, charge.astype(np.float32), answer)

    return Method(f"network `{predictor.metadata.label}`", "Predictor", estimate, single_call)
