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
"""Ratio of the squared residual of a press to the median squared residual, above which the press is left out.

The residual of such a press is ten times as large as a typical residual."""

MAX_ROUNDS = 3
"""Largest number of fits without presses with gross errors.

A gross error distorts the fit, so that good presses can seem to have gross errors in the first round."""

SCATTER_PROBABILITY = 1e-3
"""Probability of a scatter as large as the measured one, below which the scatter is reported."""

SCATTER_RATIO = 1.3
"""Ratio of the scatter to the expected scatter, above which the scatter is reported."""


@dataclass(frozen=True)
class CorrectedFilm:
    """Film whose charges are those of a described sensor, corrected by measured presses.

    Attributes:
        forward_map: Forward map of the sensor as described.
        correction: Correction by the presses.
        domain: Contacts for which the film is needed.
        scatter: Root-mean-square residual of the presses after the correction, relative to the expected residual.
        is_scattered: Whether the scatter is larger than noise and errors of the contacts explain.
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
        """Return the root mean square of the correction at contacts (n, 3), percent of the charges."""
        return 100.0 * rms(self.correction.log_factor(contact))


def correct_film(presses: MeasuredPresses, forward_map: ForwardMap, domain: Domain, noise: NoiseModel) -> CorrectedFilm:
    """Correct a forward map by presses. Presses with gross errors are left out, with a warning.

    Args:
        presses: Presses whose places, forces and charges are known.
        forward_map: Forward map, which is solved a little beyond the presses.
        domain: Contacts for which the film is needed.
        noise: Noise of the charges.

    Returns:
        The forward map with a smooth correction, and the scatter of the presses about it.
    """
    residuals = Residuals.of(presses, forward_map, noise)
    correction, is_gross = _robust_correction(residuals)
    if is_gross.any():
        left_out = presses[is_gross]
        left_out_rows = row_words(left_out.lines, left_out.row_noun)
        _log.warning("%s: left out, since these presses differ from all others; look at them again", left_out_rows)

    # The scatter is the root of chi-squared over its degrees of freedom. The degrees of freedom are the number of
    # residuals minus the effective number of fitted coefficients.
    good_residuals = residuals[~is_gross]
    total_chi2 = good_residuals.chi2(correction.log_factor(good_residuals.contact)).sum()
    degrees_of_freedom = max(good_residuals.log_ratio.size - correction.freedom, 1.0)
    scatter = float(np.sqrt(total_chi2 / degrees_of_freedom))
    is_improbable = scipy.stats.chi2.sf(total_chi2, degrees_of_freedom) < SCATTER_PROBABILITY
    is_scattered = bool(scatter > SCATTER_RATIO and is_improbable)
    return CorrectedFilm(forward_map, correction, domain, scatter, is_scattered)


def _robust_correction(residuals: Residuals) -> tuple[Correction, Booleans]:
    """Fit a correction to the presses without gross errors.

    A press has a gross error if its squared residual is much larger than the median. The correction and the selection
    of presses are computed in turn until the selection no longer changes.

    Args:
        residuals: Differences between measured presses and a forward map.

    Returns:
        The correction, and whether each press has a gross error, shape (n,).
    """
    correction = fit_correction(residuals)
    is_gross = np.zeros(len(residuals), dtype=bool)
    for _ in range(MAX_ROUNDS):
        chi2 = residuals.chi2(correction.log_factor(residuals.contact))
        was_gross = is_gross
        is_gross = chi2 > GROSS_ERROR_RATIO * np.median(chi2)
        if np.array_equal(is_gross, was_gross):
            break
        correction = fit_correction(residuals[~is_gross])
    return correction, is_gross
