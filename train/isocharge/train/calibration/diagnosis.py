"""Search for mistakes in the records of presses that no film explains.

The search considers swapped charge columns, wrong gains, rotated or mirrored axes of the rig, and wrong units. For each
mistake, a corrected copy of the presses is compared with the charges of a few films. If the correction of a mistake
makes the presses agree with a film, an error message names the mistake. The presses themselves are never changed.
Before the search, separate checks find positions outside the film, dead channels, and channels with the wrong sign.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from isocharge.common.arrays import Array
from isocharge.common.contact_domain import with_log_force
from isocharge.common.errors import PressError
from isocharge.serve.presses.measured_presses import MeasuredPresses
from isocharge.simulate.sensor.film import Film
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.press_data import in_domain

MAX_DEAD_RATIO = 0.1
"""A channel counts as dead if its typical charge, divided by that of all channels, is below this ratio.

Even a dead channel may show small charges, because of crosstalk or an offset. The limit is lower for a channel that has
smaller charges than the other channels on some possible film. The limit is also lower for presses of unknown places and
forces."""

UNPLACED_RATIO = 0.2
"""Factor of `MAX_DEAD_RATIO` for presses of unknown places and forces, which may all be near one electrode."""

UNIT_CORRECTIONS = {
    "the forces are in g, not N": (1.0, 9.80665e-3, 1.0),
    "the forces are in mN, not N": (1.0, 1e-3, 1.0),
    "the forces are in kg, not N": (1.0, 9.80665, 1.0),
    "the forces are in lbf, not N": (1.0, 4.4482216, 1.0),
    "the positions are in m, not mm": (1e3, 1.0, 1.0),
    "the positions are in cm, not mm": (10.0, 1.0, 1.0),
    "the positions are in inch, not mm": (25.4, 1.0, 1.0),
    "the charges are in nC, not pC": (1.0, 1.0, 1e3),
    "the charges are in uC, not pC": (1.0, 1.0, 1e6),
    "the charges are in C, not pC": (1.0, 1.0, 1e12),
    "the charges are in fC, not pC": (1.0, 1.0, 1e-3),
}
"""Wrong units that the search for mistakes considers.

Each entry maps a sentence about the mistake to the factors that correct the positions, the forces and the charges.
"""

PRETENSIONS_MPa = (0.3, 1.5, 3.0)
"""Pretensions of the films with which presses are compared, MPa."""

SCATTER_STD = 0.1
"""Usual standard deviation of ln(measured charge / expected charge) over the electrodes and presses.

The gains of the electrodes and a shift of the electrodes cause such a scatter."""

OFFSET_STD = 0.6
"""Usual standard deviation of the offset that all logarithms ln(measured charge / expected charge) share.

The piezoelectric coefficients cause such an offset."""

MAX_SQUARED_DEVIATION = 4.0
"""Upper limit of a squared deviation of logarithms of charges. This limit bounds the effect of outliers."""

SUSPICIOUS_MISFIT = 8.0
"""Presses whose misfit, as returned by `misfit`, exceeds this number probably contain a mistake."""

BETTER_MISFIT_RATIO = 0.25
"""Ratio of two misfits below which one explanation of the presses counts as clearly better than another."""

AXIS_CORRECTIONS = {
    "they are turned by 90 degrees": ("-y", "x"),
    "they are turned by 180 degrees": ("-x", "-y"),
    "they are turned by -90 degrees": ("y", "-x"),
    "x is mirrored": ("-x", "y"),
    "y is mirrored": ("x", "-y"),
    "x and y are exchanged": ("y", "x"),
    "x and y are exchanged and mirrored": ("-y", "-x"),
}
"""Rotations and reflections of the axes that the search for mistakes considers.

Each entry maps a description to the correct coordinates x and y, expressed by the written coordinates.
"""


def check_places(presses: MeasuredPresses, film: Film) -> None:
    """Raise an error if a press lies outside the film.

    Args:
        presses: The presses. Positions that were not measured are NaN.
        film: The film, which may be oval.

    Raises:
        PressError: If a position is outside the film.
    """
    x, y, _ = presses.contact.T
    rim_distance = film.rim_distance(np.arctan2(y, x))
    outside_rows = np.flatnonzero(np.hypot(x, y) >= rim_distance)  # an unknown position, NaN, is not outside
    if outside_rows.size:
        row = outside_rows[0]
        raise PressError(
            f"line {presses.lines[row]}: a press at ({x[row]:g}, {y[row]:g}) mm is off the film, "
            f"whose radius there is {rim_distance[row]:.4g} mm; positions are in mm from the film's centre"
        )


def check_channels(presses: MeasuredPresses, charges: FilmCharges) -> None:
    """Raise an error if a channel has no charges, is dead or has the wrong sign.

    Args:
        presses: The measured presses. Only presses with a known place and force show a wrong sign.
        charges: Charges of a film and of similar films. A channel with small charges does not count as dead if it has
            similarly small charges on one of a few examined films.

    Raises:
        PressError: If a channel has no charges, is dead or has the wrong sign.
    """
    for name, channel_charge in zip(presses.electrodes, presses.charge_pC.T, strict=True):
        if np.isnan(channel_charge).all():
            raise PressError(f"electrode {name!r}: no press has a charge of it; a calibration needs all electrodes")

    placed = presses[presses.placed]  # presses with a known place and force
    film_charges = expected_charges(charges, placed.contact)  # shape (n_film, n, n_electrode), pC
    # The charge ratio of a channel is its typical charge, divided by that of all channels. Find the smallest charge
    # ratio that a working channel usually has. Without known places, one ratio holds for all channels. It is small,
    # because all presses may be far from an electrode.
    smallest_usual_ratio = np.array(UNPLACED_RATIO)
    if len(placed):
        # Use the smallest charge ratio of each channel on a few films, shape (n_electrode,). A ratio above 1 counts as
        # 1, so that large expected charges of a channel do not raise its limit.
        film_ratios = [_charge_ratios(film_charge) for film_charge in film_charges]
        smallest_usual_ratio = np.min(film_ratios, axis=0, initial=1.0)
    charge_ratio = _charge_ratios(presses.charge_pC)
    for channel in np.flatnonzero(charge_ratio < MAX_DEAD_RATIO * smallest_usual_ratio):  # the first one is reported
        typical_charge = np.nanmedian(np.abs(presses.charge_pC[:, channel]))
        raise PressError(
            f"electrode {presses.electrodes[channel]!r} is dead: half of its charges are below "
            f"{typical_charge:.3g} pC, {100.0 * charge_ratio[channel]:.2g} % of those of the others; check "
            "the channel, its unit, its cable and its amplifier"
        )
    _check_signs(placed, film_charges)


def _check_signs(presses: MeasuredPresses, film_charges: Array) -> None:
    """Raise an error if most charges of a channel have the opposite sign to the charges of every film.

    Args:
        presses: The measured presses with a known place and force.
        film_charges: Charges of these presses on a few films, shape (n_film, n, n_electrode), pC.
    """
    is_opposite = (presses.charge_pC * film_charges < 0.0).all(axis=0)  # False for NaN
    opposite_counts = is_opposite.sum(axis=0)
    measured_counts = np.isfinite(presses.charge_pC).sum(axis=0)
    reversed_channels = np.flatnonzero(opposite_counts > 0.5 * measured_counts)
    if reversed_channels.size == len(presses.electrodes):
        raise PressError(
            "the charges of all electrodes have the opposite sign to those of the film; exchange the wires, change the "
            "sign of the charges, or change the signs of d31 and d32 in the sensor file"
        )
    for channel in reversed_channels:  # the first one is reported
        raise PressError(
            f"electrode {presses.electrodes[channel]!r}: {opposite_counts[channel]} of its {measured_counts[channel]} "
            "charges have the opposite sign to those of the film; exchange its wires or its sign, or check the order "
            "of the columns"
        )


def _charge_ratios(charge: Array) -> Array:
    """Return the typical charge of each channel, divided by that of all channels, shape (n_electrode,).

    The typical charge of a channel is the median magnitude of its charges. The typical charge of all channels is the
    median over the channels. If this median is zero, all ratios are 1.

    Args:
        charge: Charges, shape (n, n_electrode), pC; NaN where a charge was not measured.
    """
    typical_charge = np.nanmedian(np.abs(charge), axis=0)
    middle = np.median(typical_charge)
    return np.asarray(np.divide(typical_charge, middle, out=np.ones_like(typical_charge), where=middle > 0.0))


def expected_charges(charges: FilmCharges, contact: Array) -> Array:
    """Compute the charges of presses on the mean film of the prior, for each pretension in `PRETENSIONS_MPa`.

    Args:
        charges: Charges of a film and of similar films, with their prior.
        contact: Contacts (x, y, F), shape (n, 3), mm and N. A contact outside the domain of the films is moved into the
            domain.

    Returns:
        Charges, shape (n_pretension, n, n_electrode), pC.
    """
    prior = charges.prior
    films = np.tile(prior.mean, (len(PRETENSIONS_MPa), 1))
    films[:, prior.index("pretension")] = PRETENSIONS_MPa
    contact_in_domain = in_domain(with_log_force(contact), charges.domain)
    # The object `charges` computes the charges of any film from its properties.
    return np.array([charges.charges(values, contact_in_domain) for values in films])


def find_mistakes(presses: MeasuredPresses, charges: FilmCharges) -> list[str]:
    """Find the mistakes whose correction makes the presses agree far better with a film.

    The misfit of the corrected presses must be small, and clearly smaller than before. A mistake is left out if the
    misfit after its correction is clearly larger than the misfit after the best correction.

    Args:
        presses: The measured presses. A press whose place or force is unknown is not used.
        charges: Charges of a film and of similar films.

    Returns:
        One sentence for each mistake, with the best explanation first. The list is empty if no mistake explains the
        presses.
    """
    placed_presses = presses[presses.placed]
    if not len(placed_presses):
        return []
    corrected_misfits = {  # by the sentence about the mistake
        sentence: misfit(replace(placed_presses, contact=contact, charge_pC=charge), charges)
        for sentence, contact, charge in _possible_corrections(placed_presses, charges)
    }
    # A misfit is clearly smaller than another misfit if it is less than `BETTER_MISFIT_RATIO` of the other. A corrected
    # misfit must be clearly smaller than that of the uncorrected presses, and it must not be suspicious itself.
    largest_accepted = min(BETTER_MISFIT_RATIO * misfit(placed_presses, charges), SUSPICIOUS_MISFIT)
    smallest = min(corrected_misfits.values())
    probable = [
        sentence
        for sentence, corrected_misfit in corrected_misfits.items()
        if corrected_misfit < largest_accepted and BETTER_MISFIT_RATIO * corrected_misfit <= smallest
    ]
    return sorted(probable, key=corrected_misfits.__getitem__)  # the smallest misfit first


def misfit(presses: MeasuredPresses, charges: FilmCharges) -> float:
    """Compute the misfit between the charges of presses and the charges of the film that agrees best with them.

    The compared films are those of `expected_charges`, which differ in their pretension. The misfit of one film is
    computed from the logarithms of the ratios of measured charges to the charges of the film. The median of these
    logarithms is the offset. The misfit is the mean squared deviation from the offset, divided by `SCATTER_STD`
    squared, plus the squared offset, divided by `OFFSET_STD` squared. Each squared deviation is limited to
    `MAX_SQUARED_DEVIATION`. The function returns the smallest misfit of all films. Correctly recorded presses usually
    have a misfit of about 1, and a misfit of 20 indicates a mistake in the records.

    Args:
        presses: The measured presses. Only presses with a known place and force are used. Without such presses, the
            misfit is 0. If most of the used presses lie outside the domain of the films, the misfit is infinite.
        charges: Solved film, from which the charges of the films with other pretensions follow.
    """
    placed = presses[presses.placed]
    if not len(placed):
        return 0.0
    if charges.domain.is_outside(placed.contact).mean() > 0.5:
        return np.inf
    # The offset of a film is the median over all charges, shape (n_film,).
    log_ratio = _log_ratio(placed.charge_pC, expected_charges(charges, placed.contact))  # (n_film, n, n_electrode)
    offset = np.nanmedian(log_ratio, axis=(1, 2))
    squared_deviation = np.minimum((log_ratio - offset[:, None, None]) ** 2, MAX_SQUARED_DEVIATION)
    mean_square = np.nanmean(squared_deviation, axis=(1, 2))
    misfit_of_film = mean_square / SCATTER_STD**2 + (offset / OFFSET_STD) ** 2  # shape (n_film,)
    return float(np.min(misfit_of_film))


def _log_ratio(measured: Array, expected: Array) -> Array:
    """Return the logarithms of the ratios of measured to expected charges.

    The logarithm is a large negative number if the two charges have opposite signs or the expected charge is zero. The
    logarithm is NaN if the measured charge is NaN.

    Args:
        measured: Measured charges, pC.
        expected: Charges of films, pC. Their shape must be compatible with that of the measured charges for
            broadcasting.

    Returns:
        Logarithms, with the broadcast shape of the two arrays.
    """
    tiny = np.finfo(float).tiny  # avoids a division by zero and the logarithm of zero
    ratio = measured * expected / np.maximum(expected**2, tiny)
    return np.log(np.maximum(ratio, tiny))


def _possible_corrections(presses: MeasuredPresses, charges: FilmCharges) -> Iterator[tuple[str, Array, Array]]:
    """Yield a corrected copy of the presses for each possible mistake.

    The mistakes are wrong units, swapped charge columns, a channel with a wrong gain, and rotated or mirrored axes of
    the rig. For presses at one place, only wrong units are considered, because another order of the columns may fit
    their charges by chance.

    Args:
        presses: The measured presses, all with a known place and force.
        charges: Charges of a film and of similar films, which are used to find plausible orders of the columns.

    Yields:
        A sentence that describes the mistake; the corrected contacts (x, y, F), shape (n, 3), mm and N; and the
        corrected charges, shape (n, n_electrode), pC.
    """
    contact = presses.contact
    charge = presses.charge_pC
    for sentence, (position_factor, force_factor, charge_factor) in UNIT_CORRECTIONS.items():
        yield sentence, contact * [position_factor, position_factor, force_factor], charge * charge_factor
    if is_one_place(presses):
        return

    electrodes = presses.electrodes
    for electrode_of_column in _plausible_electrode_orders(presses, charges):
        held_names = ", ".join(electrodes[electrode] for electrode in electrode_of_column)
        sentence = f"the charge columns are swapped: those named {', '.join(electrodes)} hold {held_names}"
        column_of_electrode = np.argsort(electrode_of_column)  # the inverse permutation
        yield sentence, contact, charge[:, column_of_electrode]

    # The gain of a channel is the median ratio of measured to expected charges over the similar films (axis 0) and the
    # presses (axis 1), relative to the median over all channels. If the charges of a channel have the wrong sign, the
    # logarithm of their ratio is a very large negative number. The limits keep the gain and its inverse finite.
    log_ratios = np.nanmedian(_log_ratio(charge, expected_charges(charges, contact)), axis=(0, 1))
    log_gains = np.clip(log_ratios - np.median(log_ratios), -3.0, 3.0)
    for column, gain in enumerate(np.exp(log_gains)):
        corrected_charge = charge.copy()
        corrected_charge[:, column] /= gain
        sentence = f"the gain of {electrodes[column]} is about {gain:.2g} times that of the sensor file"
        yield sentence, contact, corrected_charge

    x, y, force = contact.T
    coordinates = {"x": x, "-x": -x, "y": y, "-y": -y}
    for description, (correct_x, correct_y) in AXIS_CORRECTIONS.items():
        rotated_contact = np.column_stack([coordinates[correct_x], coordinates[correct_y], force])
        yield f"the rig's axes are not the film's: {description}", rotated_contact, charge


def _plausible_electrode_orders(presses: MeasuredPresses, charges: FilmCharges) -> set[tuple[int, ...]]:
    """Find the assignments of charge columns to electrodes that agree best with a few films.

    For each pretension in `PRETENSIONS_MPa`, the columns are assigned to the electrodes of a film with this pretension.
    The best assignment minimises the sum of squared differences between the logarithms of measured and expected
    charges. Before the logarithms are compared, a common factor of all charges is removed.

    Args:
        presses: The measured presses, all with a known place and force.
        charges: Charges of a film and of similar films.

    Returns:
        Set of assignments. Each assignment contains, for each column, the index of the electrode to which its charges
        belong. The assignment in which each column belongs to the electrode of its name is left out.
    """
    electrode_orders = set()
    for expected in expected_charges(charges, presses.contact):
        log_ratio = _log_ratio(presses.charge_pC[:, :, None], expected[:, None])  # shape (n, n_column, n_electrode)
        # The median is subtracted, because a common factor of all charges does not matter here. The upper limit of the
        # squared deviations reduces the effect of outliers.
        squared_deviation = np.minimum((log_ratio - np.nanmedian(log_ratio)) ** 2, MAX_SQUARED_DEVIATION)
        # The best assignment has the smallest sum of costs, and assigns each column to a different electrode.
        cost = np.nansum(squared_deviation, axis=0)  # shape (n_column, n_electrode)
        _, electrode_of_column = linear_sum_assignment(cost)
        electrode_orders.add(tuple(electrode_of_column.tolist()))
    written_order = tuple(range(len(presses.electrodes)))
    return electrode_orders - {written_order}


def unexplained_error(presses: MeasuredPresses, charges: FilmCharges, reason: str) -> PressError:
    """Create the error for presses that no film of the sensor explains.

    The message names up to three mistakes that would explain the presses. If no mistake is found, the message asks the
    user to check the setup.

    Args:
        presses: The presses as they are written in the file.
        charges: Charges of a film and of similar films.
        reason: Reason why the presses are refused, as a part of a sentence.
    """
    prior = charges.prior  # with the described sensor and probe
    statement = f"no film of {prior.sensor.name!r} explains these {len(presses)} presses: {reason}"
    alternatives = "; or ".join(find_mistakes(presses, charges)[:3])
    advice = (
        f"; is it this layout and this probe ({prior.probe.notation}), do the places and forces belong to these rows, "
        "and are the charges touch charges (reading under load minus reading without load)?"
    )
    if alternatives:
        advice = f". A film would explain them if {alternatives}. Nothing was changed: correct the file or the options"
    return PressError(statement + advice)


def is_one_place(presses: MeasuredPresses) -> bool:
    """Return whether at least one position is known, and all known positions are equal within their errors."""
    is_known = np.isfinite(presses.contact[:, 0])  # x and y are either both known or both unknown
    if not is_known.any():
        return False
    largest_range_mm = np.ptp(presses.contact[is_known, :2], axis=0).max()  # the larger of the ranges of x and y
    # Nearly all normally distributed errors are within three standard deviations, a range of six. One press may be much
    # less accurate than the others, so the median of the standard deviations counts.
    return bool(largest_range_mm <= 6.0 * np.median(presses.position_std_mm))
