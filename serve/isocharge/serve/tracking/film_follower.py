"""The pretension of a film, followed by ordinary touches of unknown place and force.

Four charges have one degree of freedom more than a contact (x, y, force): the misfit. If a film has become tauter or
slacker, for instance because the room is a degree warmer, the misfits of all touches grow, and the pretension at which
they are smallest is that of the film. `isocharge.serve.tracking.film_filter` estimates the pretension from the hardest
frame of each touch, together with the gains, a common offset, and the directions in which the calibration left the film
uncertain (`FilmDirections`). Contacts are corrected for the estimated pretension and directions.

Touches that no pretension explains hardly change the estimate. The film counts as lost, which means that it is no
longer followed, if the last touches are of that kind (two contacts, for instance), if a wrong gain explains them far
better, or if their charges have a common offset (the warmth of a hand) that is larger than the settings allow. Contacts
are then computed with the estimate before these touches.
"""

import math
from collections import deque
from functools import partial
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import ModelError
from isocharge.serve.flags import BEYOND, GAP, MISFIT, OUTSIDE, REPEAT, STRESS
from isocharge.serve.model.film_directions import read_film_directions
from isocharge.serve.model.pretensions import Pretensions, read_pretensions
from isocharge.serve.prediction.contact import Contact, Sensitivity, is_close
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.record.record import FollowedFilm
from isocharge.serve.signal_chain.rule import Rule, Setting
from isocharge.serve.tracking.film_filter import FilmFilter, TouchResiduals

HARMLESS_FLAGS = frozenset({STRESS, GAP, REPEAT})
"""Flags of frames that do not exclude a touch. GAP and REPEAT only mean that frames were lost."""

HARMLESS_FLAGS_OUTSIDE = HARMLESS_FLAGS | {OUTSIDE, BEYOND, MISFIT}
"""Flags that do not exclude a touch if a frame has the flag OUTSIDE, which the first frames of every touch have."""

RECENT_TOUCHES = 40
"""Number of the latest touches from which the follower decides whether the film is lost."""

FEWEST_TOUCHES = 12
"""Number of touches after which contacts are corrected for the first time."""

LARGEST_SQUARE = 9.0
"""Upper bound of the squared misfit of a touch in this decision, in units of the mean square of good touches."""

EXPLAINED_SQUARE = 1.25
"""Largest mean of the squared misfits of very many touches for which the touches count as explained."""

EXPLAINED_SCATTER = 5.0
"""Amount, times the square root of n, by which the sum for n touches may exceed n times `EXPLAINED_SQUARE`."""

WRONG_GAINS = np.outer([-1.0, 1.0], [0.03, 0.04, 0.06, 0.09]).ravel()
"""Gain errors of a single electrode that are compared with a change of the pretension."""

WRONG_GAIN_MARGIN = 9.0
"""Amount by which the sum of the squared misfits with a wrong gain must be smaller than the sum for any pretension, so
that the gain counts as the cause."""

OFFSET_CORRECTION_ERROR = 0.5
"""Standard deviation of the correction of the pretension for offsets, in units of the correction."""

SENSITIVITY_STEP_MPa = 0.05
"""Step of the finite differences with respect to the pretension."""

SMALLEST_CHANGE_MPa = 0.01
"""Smallest change of the pretension after which the weights of the model are computed again."""


class FollowRule(Rule, frozen=True, kw_only=True):
    """How a film is followed; the section `[follow]` of a device file.

    Attributes:
        drift_MPa_per_root_hour: Standard deviation of the pretension's change in an hour; it grows with the root of
            the time. A degree is 0.3 to 0.44 MPa on a ring of aluminium.
        largest_offset_pC: Standard deviation of the largest charges that warmth may add to all electrodes during a
            touch. The film is not followed while the charges are more than twice as large. 0 assumes that there are
            none.
    """

    drift_MPa_per_root_hour: Setting = 0.35
    largest_offset_pC: Setting = 30.0


class FilmStateEstimate(NamedTuple):
    """Estimate of the film.

    Attributes:
        pretension_MPa: Estimate of the pretension.
        std_MPa: Standard deviation of the pretension.
        directions: Estimate of the directions at this pretension, shape (n_direction,), in standard deviations.
        directions_per_MPa: Change of this estimate with the pretension, shape (n_direction,), 1/MPa.
    """

    pretension_MPa: float
    std_MPa: float
    directions: Array
    directions_per_MPa: Array

    def charge_factor(self, log_changes: Array, step_MPa: float = 0.0) -> Array:
        """Compute the charges of this film over those of the calibrated film, both at the same pretension.

        Args:
            log_changes: Changes of ln Q by one unit of each direction, shape (n_direction, n_electrode).
            step_MPa: Distance of that pretension from the estimated one.

        Returns:
            Shape (n_electrode,), dimensionless.
        """
        directions = self.directions + step_MPa * self.directions_per_MPa
        return np.asarray(np.exp(directions @ log_changes))


class FollowedContact(NamedTuple):
    """A contact on the followed film.

    Attributes:
        contact: The contact.
        charge_pC: Charges for which the model of the followed pretension gives this contact, shape (n_electrode,), pC.
    """

    contact: Contact
    charge_pC: Array


class HardestFrame(NamedTuple):
    """The contact of the frame of a touch with the largest force, and its touch charges, shape (n_electrode,), pC."""

    contact: Contact
    charge_pC: Array


class TouchSquares(NamedTuple):
    """Squared misfits of one touch, each at most LARGEST_SQUARE, in units of the mean square of good touches.

    Attributes:
        filtered: With the estimated gains and offset, at each pretension, shape (n_pretension,).
        filtered_then: The same at the pretension that was estimated then.
        without_gains: With the estimated offset only, at each pretension, shape (n_pretension,).
        wrong_gain: With each of the wrong gains, for the calibrated film and for the followed film, shape (n_case,).
    """

    filtered: Array
    filtered_then: float
    without_gains: Array
    wrong_gain: Array


class FilmFollower:
    """Follows one film; belongs to one thread. The same frames give the same answers, bit for bit.

    Attributes:
        predictor: The model of the film as it is now.
        is_lost: Whether the film is not followed, because no pretension explains the last touches.
    """

    def __init__(self, predictor: Predictor, rule: FollowRule | None = None, offset_ratio: Array | float = 1.0) -> None:
        """Begin with the film as it was calibrated.

        Args:
            predictor: The calibrated model.
            rule: By default the settings of an empty section.
            offset_ratio: Charge that warmth gives each electrode over the common offset, shape (n_electrode,), or one
                number for all.

        Raises:
            ModelError: If the model has three electrodes, or no file of pretensions, or one of another model.
        """
        self._calibrated = predictor
        self._pretensions = followable_pretensions(predictor)
        self._directions = read_film_directions(predictor.folder, self._pretensions.typical_pC.size)
        rule = rule or FollowRule()
        self._filter = FilmFilter(
            self._pretensions,
            self._directions,
            rule.drift_MPa_per_root_hour,
            rule.largest_offset_pC,
            np.broadcast_to(np.asarray(offset_ratio, dtype=float), self._pretensions.typical_pC.shape),
        )
        self._calibrated_estimate = FilmStateEstimate(
            self._pretensions.calibrated_MPa,
            self._pretensions.std_MPa,
            np.zeros(self._directions.count),
            np.zeros(self._directions.count),
        )
        self._wrong_gains = 1.0 + np.kron(np.eye(self._pretensions.typical_pC.size), WRONG_GAINS[:, None])
        self.reset()

    def reset(self) -> None:
        """Return to the film as it was calibrated, and begin to follow it again."""
        self._filter.reset()
        self.predictor = self._calibrated
        self.is_lost = False
        self._applied_estimate = self._calibrated_estimate
        self._neighbour: Predictor | None = None
        self._neighbour_step_MPa = SENSITIVITY_STEP_MPa
        self._factors: tuple[Array, Array] | None = None
        self._factors_contact: Contact | None = None
        self._sensitivity = Sensitivity(SENSITIVITY_STEP_MPa)
        self._touches = 0
        self._recent: deque[TouchSquares] = deque(maxlen=RECENT_TOUCHES)
        self._earlier: deque[FilmStateEstimate] = deque(maxlen=RECENT_TOUCHES)
        self.discard_touch()

    def discard_touch(self) -> None:
        """Discard the touch that is under way, as after an outage or a new tare."""
        self._hardest: HardestFrame | None = None
        self._is_spoiled = False

    @property
    def film(self) -> FollowedFilm:
        """The film as it is now."""
        return FollowedFilm(self._applied_estimate.pretension_MPa, self._applied_estimate.std_MPa, self._touches)

    def observe_frame(
        self, charge_pC: Array | None, contact: Contact | None, flags: tuple[str, ...], clock_s: float
    ) -> None:
        """Process a frame. The film is estimated again when a touch has ended.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            contact: The model's answer to them; None where nothing touches.
            flags: Flags of the frame.
            clock_s: Time of the frame on a clock that does not jump, s.
        """
        if contact is None:
            self._end_touch(clock_s)
            return
        if flags:
            harmless = HARMLESS_FLAGS_OUTSIDE if OUTSIDE in flags else HARMLESS_FLAGS
            if not harmless.issuperset(flags):
                self._is_spoiled = True
            return
        if self._hardest is None or contact.force_N > self._hardest.contact.force_N:
            assert charge_pC is not None
            self._hardest = HardestFrame(contact, charge_pC)

    def _end_touch(self, clock_s: float) -> None:
        """Use the touch that has just ended, unless one of its frames had a flag that makes the touch unusable."""
        if self._hardest is not None and not self._is_spoiled:
            self.observe_touch(self._hardest, clock_s)
        self.discard_touch()

    def follow_contact(self, contact: Contact, charge_pC: Array) -> FollowedContact:
        """Correct a contact for the present estimate of the film, and add the uncertainty of the pretension.

        Before the first estimate, the contact is returned unchanged.

        Args:
            contact: Answer of `predictor` to the charges.
            charge_pC: Touch charges, shape (n_electrode,), pC.
        """
        if self._neighbour is None:
            return FollowedContact(contact, charge_pC)
        estimate = self._applied_estimate
        if self._directions.count == 0:
            neighbour = partial(self._neighbour.predict, charge_pC)
            return FollowedContact(
                contact.widened(self._sensitivity.shift(contact, estimate.std_MPa, neighbour)), charge_pC
            )
        factor, neighbour_factor = self._charge_factors(contact)
        corrected_pC = charge_pC / factor
        corrected = self.predictor.predict(corrected_pC)
        neighbour = partial(self._neighbour.predict, charge_pC / neighbour_factor)
        shift = self._sensitivity.shift(corrected, estimate.std_MPa, neighbour)
        return FollowedContact(corrected.widened(shift), corrected_pC)

    def _charge_factors(self, contact: Contact) -> tuple[Array, Array]:
        """Return the factors by which the charges are divided before they are passed to the models.

        The factors are computed again only if the contact has moved.

        Args:
            contact: Contact near which the factors are needed.

        Returns:
            Factors for the model of the estimated pretension and for the model of the neighbouring pretension, each of
            shape (n_electrode,).
        """
        if self._factors is None or not is_close(contact, self._factors_contact):
            (log_changes,) = self._directions.log_changes(np.array([contact[:3]]))
            factor = self._applied_estimate.charge_factor(log_changes)
            neighbour_factor = self._applied_estimate.charge_factor(log_changes, self._neighbour_step_MPa)
            self._factors = factor, neighbour_factor
            self._factors_contact = contact
        return self._factors

    def observe_touch(self, touch: HardestFrame, clock_s: float) -> None:
        """Update the estimate of the film with a touch, and decide whether the film is lost.

        Args:
            touch: The hardest frame of the touch.
            clock_s: Time of the touch on a clock that does not jump, s.
        """
        (log_changes,) = self._directions.log_changes(np.array([touch.contact[:3]]))
        self._filter.predict(clock_s)
        residuals = self._filter.update(touch.charge_pC, log_changes)
        self._touches += 1
        self._recent.append(self._touch_squares(touch.charge_pC, log_changes, residuals))
        if len(self._recent) < FEWEST_TOUCHES:
            return
        was_lost = self.is_lost
        self.is_lost = self._is_unexplained() or self._is_gain_wrong() or self._filter.is_offset_too_large
        if not self.is_lost:
            self._earlier.append(self._estimate())
            self._apply_estimate(self._earlier[-1])
        elif not was_lost:
            before_recent = len(self._earlier) == RECENT_TOUCHES
            self._apply_estimate(self._earlier[0] if before_recent else self._calibrated_estimate)
            self._earlier.clear()

    def _touch_squares(self, charge_pC: Array, log_changes: Array, residuals: TouchResiduals) -> TouchSquares:
        """Return the squared misfits of a touch that decide whether the film is lost."""
        directions = self._filter.direction_means(self._filter.mean_MPa)
        corrected_pC = (charge_pC - self._filter.offset_pC) * np.exp(-directions @ log_changes)
        candidates = corrected_pC * self._wrong_gains
        misfits = [model.predict_batch(candidates).misfit for model in (self._calibrated, self.predictor)]
        scale = self._pretensions.misfit_rms**2 * (1.0 + residuals.offset_variance)
        wrong_gain = np.concatenate(misfits).astype(float) ** 2 / scale
        filtered = np.minimum(residuals.filtered, LARGEST_SQUARE)
        return TouchSquares(
            filtered=filtered,
            filtered_then=float(filtered[self._filter.nearest]),
            without_gains=np.minimum(residuals.without_gains, LARGEST_SQUARE),
            wrong_gain=np.minimum(wrong_gain, LARGEST_SQUARE),
        )

    def _is_unexplained(self) -> bool:
        """Return whether no pretension explains the latest touches.

        The squared misfits of the touches are added up for the pretension that is estimated now, and for the
        pretensions that were estimated at each touch. The smaller sum is compared with a limit.
        """
        count = len(self._recent)
        nearest = self._filter.nearest
        sum_at_present_estimate = sum(float(touch.filtered[nearest]) for touch in self._recent)
        sum_at_earlier_estimates = sum(touch.filtered_then for touch in self._recent)
        limit = EXPLAINED_SQUARE * count + EXPLAINED_SCATTER * math.sqrt(count)
        return min(sum_at_present_estimate, sum_at_earlier_estimates) > limit

    def _is_gain_wrong(self) -> bool:
        """Return whether a wrong gain of one electrode explains the latest touches far better than any pretension."""
        sum_by_pretension = np.sum([touch.without_gains for touch in self._recent], axis=0)
        sum_by_wrong_gain = np.sum([touch.wrong_gain for touch in self._recent], axis=0)
        return bool(sum_by_wrong_gain.min() < sum_by_pretension.min() - WRONG_GAIN_MARGIN)

    def _estimate(self) -> FilmStateEstimate:
        """Return the estimate of the film.

        The estimate is the mean over two hypotheses, which have the same prior probability: the pretension has changed
        since the calibration, or it has not.
        """
        pretensions = self._pretensions
        mean_MPa = self._filter.mean_MPa
        change = mean_MPa - pretensions.calibrated_MPa
        variance = float(self._filter.probability @ (self._filter.grid_MPa - mean_MPa) ** 2)
        variance += (OFFSET_CORRECTION_ERROR * self._filter.offset_correction_MPa) ** 2
        unchanged_variance = variance + pretensions.floor_MPa**2
        changed_variance = unchanged_variance + pretensions.std_MPa**2
        exponent = -0.5 * change**2 * (1.0 / unchanged_variance - 1.0 / changed_variance)
        odds_of_unchanged = math.sqrt(changed_variance / unchanged_variance) * math.exp(exponent)
        share = 1.0 / (1.0 + odds_of_unchanged)
        std = math.sqrt(unchanged_variance + share * (1.0 - share) * change**2)
        pretension_MPa = pretensions.calibrated_MPa + share * change
        directions = self._filter.direction_means(pretension_MPa)
        neighbouring = self._filter.direction_means(pretension_MPa + SENSITIVITY_STEP_MPa)
        return FilmStateEstimate(pretension_MPa, std, directions, (neighbouring - directions) / SENSITIVITY_STEP_MPa)

    def _apply_estimate(self, estimate: FilmStateEstimate) -> None:
        """Set the models with which contacts are computed to those of a new estimate of the film.

        If the pretension has changed by less than `SMALLEST_CHANGE_MPa`, the present models are kept.
        """
        is_same_film = abs(estimate.pretension_MPa - self._applied_estimate.pretension_MPa) < SMALLEST_CHANGE_MPa
        if is_same_film:
            estimate = estimate._replace(pretension_MPa=self._applied_estimate.pretension_MPa)
        self._applied_estimate = estimate
        self._factors = None
        if is_same_film and self._neighbour is not None:
            return
        if not is_same_film:
            self.predictor = self._model_at(estimate.pretension_MPa)
        largest_MPa = self._pretensions.range_MPa[1]
        step = SENSITIVITY_STEP_MPa
        if estimate.pretension_MPa + step > largest_MPa:
            step = -step
        self._neighbour_step_MPa = step
        self._neighbour = self._model_at(estimate.pretension_MPa + step)
        self._sensitivity = Sensitivity(SENSITIVITY_STEP_MPa)

    def _model_at(self, pretension_MPa: float) -> Predictor:
        """Return the model of the film at another pretension."""
        return self._calibrated.with_constants(self._pretensions.constants(pretension_MPa))


def followable_pretensions(predictor: Predictor) -> Pretensions:
    """Read the file of pretensions beside a model, and check that the film can be followed with it.

    Raises:
        ModelError: If the model has three electrodes, or no file of pretensions, or one of another model.
    """
    electrodes = predictor.metadata.electrodes
    if len(electrodes) <= 3:
        raise ModelError(
            f"model {predictor.metadata.label}: its film cannot be followed: {len(electrodes)} charges "
            f"{electrodes} only determine x, y and force; expected a model with four electrodes or more, whose misfit "
            "shows a change of the film"
        )
    pretensions = read_pretensions(predictor.folder)
    _check_same_model(predictor, pretensions)
    return pretensions


def _check_same_model(predictor: Predictor, pretensions: Pretensions) -> None:
    """Refuse weights of another model.

    With the weights of the calibrated pretension, the graph must compute the same contacts as with its own weights.
    With the weights of another pretension, it must compute other contacts.
    """
    lowest_MPa, highest_MPa = pretensions.range_MPa
    other_MPa = highest_MPa if pretensions.calibrated_MPa == lowest_MPa else lowest_MPa
    charges = np.outer([0.5, 1.0, 2.0], pretensions.typical_pC)
    own = np.asarray(predictor.predict_batch(charges))
    calibrated = predictor.with_constants(pretensions.constants(pretensions.calibrated_MPa))
    other = predictor.with_constants(pretensions.constants(other_MPa))
    is_same = np.allclose(np.asarray(calibrated.predict_batch(charges)), own, rtol=1e-5, atol=1e-5, equal_nan=True)
    if not is_same or np.array_equal(np.asarray(other.predict_batch(charges)), own):
        raise ModelError(
            f"{predictor.folder}: pretensions.npz is not of this model.onnx; copy the model's folder again, or "
            "calibrate again"
        )
