"""Methods of a report: triangulation, least squares on a charge map, and models.

Every function in `METHOD_BUILDERS` adds a method to all reports. Models are added by their folders.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.contact import Contact
from isocharge.serve.model.predictor import Predictor
from isocharge.simulate import ChargeMap, NoiseModel, Triangulation
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.train.data.presses import LabelledPresses

N_CANDIDATES = 512
"""Number of contacts among which least squares chooses the starting points of its descents."""


@dataclass(frozen=True)
class FittingTask:
    """Presses and conditions to which a method is fitted.

    Attributes:
        presses: Presses of the dataset. Simulated presses have no noise.
        charge_map: Map from contacts to charges that is fitted to the presses. Its domain contains the contacts that
            can occur.
        noise: Noise of the charges when the method is used.
    """

    presses: LabelledPresses
    charge_map: ChargeMap
    noise: NoiseModel


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


def triangulation(task: FittingTask) -> Method:
    """Return the triangulation of the paper, which intersects the contours of the charges."""
    contours = Triangulation(task.charge_map)
    return Method("triangulation", "NumPy", lambda charge: contours.locate(charge).contact)


def least_squares(task: FittingTask) -> Method:
    """Return the search for the contact with the smallest squared residuals of the charges.

    The residuals are divided by the standard deviation of the noise. The contact is restricted to the domain.
    """

    def estimate(charge: Array) -> Array:
        """Estimate contacts (x, y, F), shape (n, 3), mm and N."""
        contact, _ = search(task.charge_map, charge, task.noise.sigma(charge), candidates=N_CANDIDATES)
        return contact

    return Method("least squares, Gauss-Newton", "NumPy", estimate)


METHOD_BUILDERS: tuple[Callable[[FittingTask], Method], ...] = (triangulation, least_squares)
"""Functions that fit the methods of all reports. A function raises TrainingError if there are too few presses."""


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
