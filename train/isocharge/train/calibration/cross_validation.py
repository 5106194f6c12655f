"""Cross-validation of a calibration, which measures errors on presses that were not used in the fit.

The pressed places are divided into folds. For each fold, the film is fitted again to the presses of all other folds.
The network of the fitted film then estimates the contacts of the presses in the fold from their charges. The estimated
contacts differ from the measured contacts for three reasons: effects that no parameter describes, noise of the charges,
and errors of the rig.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from isocharge.common.arrays import Booleans
from isocharge.common.measured_presses import MeasuredPresses
from isocharge.train.calibration.film_fit import FilmPosterior, refit_film
from isocharge.train.calibration.press_data import PressData
from isocharge.train.calibration.problem import CalibrationProblem
from isocharge.train.data.presses import FEWEST_MEASURED, LabelledPresses, complete, folds_by_place
from isocharge.train.model_release.evaluate import ONLY_SIMULATED, contact_errors
from isocharge.train.training.fitted import Answers, Fitted

FOLD_COUNT = 5
"""Number of folds into which the presses are divided."""

MAX_FITTED_PRESSES = 250
"""Largest number of presses to which a film is fitted again. More presses take longer and hardly change the film."""


@dataclass(frozen=True)
class HeldOutAnswers:
    """Presses, with contacts that were estimated without using these presses in the fit of the film.

    Attributes:
        presses: The measured presses.
        answers: Contacts and misfits that the networks computed from the charges of the presses. The standard
            deviations are those of the differences from the measured contacts, so they include the errors of the rig.
    """

    presses: LabelledPresses
    answers: Answers

    @property
    def errors(self) -> dict[str, float]:
        """Errors of the position (mm) and of the force (%), by the names that `model_release.evaluate` uses.

        Errors that are defined only for simulated presses are left out.
        """
        contact, std, _ = self.answers
        all_errors = contact_errors(contact, std, self.presses.contact)
        return {name: error for name, error in all_errors.items() if name not in ONLY_SIMULATED}


def cross_validate(
    problem: CalibrationProblem,
    presses: MeasuredPresses,
    data: PressData,
    posterior: FilmPosterior,
    network_of_film: Callable[[FilmPosterior], Fitted],
    at_C: float | None = None,
) -> HeldOutAnswers | None:
    """Estimate the contact of each press with the network of a film that was fitted without this press.

    The presses are divided into `FOLD_COUNT` folds by their places. For each fold, the film is fitted to the presses of
    all other folds. The network of this film then estimates the contacts of the presses in the fold.

    Args:
        problem: The calibration problem, which defines the possible films.
        presses: The presses to which the film was fitted.
        data: The same presses in the form for a fit, with the effect of friction on their charges.
        posterior: Estimate of the film from these presses. Presses that were left out as bad are not used here either.
        network_of_film: Function that returns the network that belongs to the estimate of a film.
        at_C: Mean temperature of the presses, degrees Celsius; None if their temperatures are unknown.

    Returns:
        The presses that can be judged, and the answers of the networks for them. None if fewer than `FEWEST_MEASURED`
        presses can be judged. A press can be judged if its place, force and charges are known, if it was not left out
        as bad, and if it lies in the domain of the networks.
    """
    is_judged = complete(presses) & ~posterior.bad & ~problem.domain.is_outside(presses.contact)
    if is_judged.sum() < FEWEST_MEASURED:
        return None

    # Presses that cannot be judged belong to no fold. Unless they were left out as bad, they are used in all fits.
    no_fold = -1
    fold_of_press = np.full(len(presses), no_fold)
    fold_of_press[is_judged] = folds_by_place(presses.contact[is_judged], FOLD_COUNT)

    # Answers of the networks, which are filled in fold by fold. The rows of presses without a fold are never read.
    contact = np.empty((len(presses), 3))
    network_std = np.empty((len(presses), 3))
    misfit = np.empty((len(presses), 1))
    for fold in range(FOLD_COUNT):
        is_held_out = fold_of_press == fold
        is_fitted = _thinned(~is_held_out & ~posterior.bad)  # at most `MAX_FITTED_PRESSES` presses
        with threadpool_limits(1):  # the matrices are small, so a second thread would only wait
            film = refit_film(
                problem.charges, data[is_fitted], problem.before, posterior, at_C, friction=problem.friction
            )
        fold_contact, fold_std, fold_misfit = network_of_film(film).predict(presses.charge_pC[is_held_out])
        contact[is_held_out] = fold_contact
        network_std[is_held_out] = fold_std
        misfit[is_held_out] = fold_misfit

    # The estimated and the measured contact have independent errors, so the variances of both are added.
    force_N = presses.contact[:, 2]
    rig_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std * force_N])
    difference_std = np.hypot(network_std, rig_std)
    judged_presses = LabelledPresses(presses.contact[is_judged], presses.charge_pC[is_judged], measured=True)
    judged_answers = Answers(contact[is_judged], difference_std[is_judged], misfit[is_judged])
    return HeldOutAnswers(judged_presses, judged_answers)


def _thinned(is_chosen: Booleans) -> Booleans:
    """Select at most `MAX_FITTED_PRESSES` of the chosen presses, at equal distances in the list of presses.

    Args:
        is_chosen: Whether each press is one of the chosen presses, shape (n,).

    Returns:
        Whether each press is selected, shape (n,).
    """
    chosen_rows = np.flatnonzero(is_chosen)
    stride = max(1, math.ceil(len(chosen_rows) / MAX_FITTED_PRESSES))
    is_selected = np.zeros_like(is_chosen)
    is_selected[chosen_rows[::stride]] = True
    return is_selected
