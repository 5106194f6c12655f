"""Forward map of a described sensor, corrected by measured presses."""

import logging
from dataclasses import dataclass

import numpy as np
import scipy  # loads a part when it is used

from isocharge.common.arrays import Array, Booleans
from isocharge.common.measured_presses import MeasuredPresses, row_words
from isocharge.common.statistics import rms
from isocharge.simulate import Domain, ForwardMap, NoiseModel
from isocharge.train.rig.correction import Correction, Residuals, fit_correction

_log = logging.getLogger(__name__)

GROSS_ERROR_RATIO = 100.0
"""Ratio of the chi-squared of a press to the median chi-squared of all presses above which the press is left out.

The residual of such a press is more than ten times as large as a typical residual."""

MAX_ROUNDS = 3
"""Largest number of times that the presses with gross errors are left out and the correction is fitted again.

A gross error distorts the fit, so that good presses can seem to have gross errors in the first round."""

SCATTER_PROBABILITY = 1e-3
"""Largest probability of a scatter by chance at which the scatter is reported."""

SCATTER_RATIO = 1.3
"""Smallest ratio of the scatter to the expected scatter at which the scatter is reported."""


@dataclass(frozen=True)
class CorrectedFilm:
    """Film whose charges are computed by a forward map and corrected by measured presses.

    Attributes:
        forward_map: Forward map of the sensor as described.
        correction: Correction by the presses.
        domain: Contacts for which the film is needed.
        scatter: Root-mean-square residual of the presses after the correction, divided by its expected value.
        is_scattered: Whether the scatter is larger than the noise and the errors of the measured contacts explain.
    """

    forward_map: ForwardMap
    correction: Correction
    domain: Domain
    scatter: float
    is_scattered: bool

    def charges(self, contact: Array) -> Array:
        """Return the charges, shape (n, n_electrode), pC, of contacts (x, y, F), shape (n, 3), mm and N."""
        factor = np.exp(self.correction.log_factor(contact))
        return np.asarray(self.forward_map.charges(contact) * factor)

    def correction_percent(self, contact: Array) -> float:
        """Return the root mean square of the correction at contacts, shape (n, 3), in percent of the charges."""
        return 100.0 * rms(self.correction.log_factor(contact))


def correct_film(presses: MeasuredPresses, forward_map: ForwardMap, domain: Domain, noise: NoiseModel) -> CorrectedFilm:
    """Correct a forward map with measured presses.

    Presses with gross errors are left out, and a warning about these presses is logged.

    Args:
        presses: Presses whose places, forces and charges are known.
        forward_map: Forward map, which must reach a little beyond the presses.
        domain: Contacts for which the film is needed.
        noise: Noise of the charges.

    Returns:
        The forward map with a smooth correction, and the scatter of the presses about the corrected map.
    """
    residuals = Residuals.of(presses, forward_map, noise)
    correction, is_gross = _robust_correction(residuals)
    if is_gross.any():
        excluded_presses = presses[is_gross]
        excluded_rows = row_words(excluded_presses.lines, excluded_presses.row_noun)
        _log.warning("%s: left out, since these presses differ from all others; look at them again", excluded_rows)

    # The scatter is the root of chi-squared over its degrees of freedom. The degrees of freedom are the number of
    # residuals minus the effective number of fitted coefficients, and at least one.
    good_residuals = residuals[~is_gross]
    total_chi2 = good_residuals.chi2(correction.log_factor(good_residuals.contact)).sum()
    degrees_of_freedom = max(good_residuals.log_ratio.size - correction.effective_count, 1.0)
    scatter = float(np.sqrt(total_chi2 / degrees_of_freedom))

    # The scatter is reported if it is both large and unlikely to be due to chance.
    probability = scipy.stats.chi2.sf(total_chi2, degrees_of_freedom)  # of a chi-squared that is as large or larger
    is_scattered = bool(scatter > SCATTER_RATIO and probability < SCATTER_PROBABILITY)
    return CorrectedFilm(forward_map, correction, domain, scatter, is_scattered)


def _robust_correction(residuals: Residuals) -> tuple[Correction, Booleans]:
    """Fit a correction to the presses without gross errors.

    A press has a gross error if its chi-squared after the correction is more than `GROSS_ERROR_RATIO` times the median.
    Every fit of the correction changes chi-squared. The presses with gross errors are therefore determined again after
    every fit, until they no longer change. The correction is refitted at most `MAX_ROUNDS` times.

    Args:
        residuals: Differences between measured presses and a forward map.

    Returns:
        The correction, and whether each press has a gross error, shape (n,).
    """
    correction = fit_correction(residuals)
    is_gross = np.zeros(len(residuals), dtype=bool)  # the first fit uses all presses
    for _ in range(MAX_ROUNDS):
        chi2 = residuals.chi2(correction.log_factor(residuals.contact))
        was_gross_before = is_gross
        is_gross = chi2 > GROSS_ERROR_RATIO * np.median(chi2)
        if np.array_equal(is_gross, was_gross_before):
            break  # another fit would use the same presses
        correction = fit_correction(residuals[~is_gross])
    return correction, is_gross
