"""Correction of contacts for changes of the film. The changes are estimated from ordinary touches.

The charges of four electrodes have one degree of freedom more than a contact (x, y, force). The misfit is the distance
between the measured charges and the nearest charges that a contact can produce. If the pretension of a film changes,
for example because the room becomes warmer by 1 K, the misfits of all touches increase. The estimated pretension is the
pretension for which the misfits of the touches are smallest.

The module `isocharge.serve.tracking.film_filter` estimates the pretension. The estimate uses one set of charges of each
touch, namely the average charges of the frames with about the largest force. The filter also estimates the gains, a
common offset, and the changes of the film along directions that remained uncertain after the calibration
(`FilmDirections`). Contacts are corrected for the estimated pretension and for the estimated changes along the
directions.

If no pretension explains a touch, for example a touch with two contacts, the touch hardly changes the estimate. The
film is considered lost in three cases.

- No pretension explains the latest touches.
- A wrong gain of one electrode explains the latest touches far better than any pretension.
- The charges have a common offset, for example from a warm hand, that is larger than the settings allow.

While the film is lost, contacts are computed with an earlier estimate that does not include the latest touches.
"""

import math
from collections import deque
from functools import partial
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.model.film_directions import read_film_directions
from isocharge.serve.prediction.contact import Contact, Sensitivity, is_close
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.record.record import FollowedFilm
from isocharge.serve.signal_chain.rule import Rule, Setting
from isocharge.serve.tracking.film_filter import FilmFilter
from isocharge.serve.tracking.film_state import FilmStateEstimate
from isocharge.serve.tracking.film_update import TouchResiduals
from isocharge.serve.tracking.followable_pretensions import followable_pretensions
from isocharge.serve.tracking.pretension_grid import odds_of_no_change
from isocharge.serve.tracking.touch_collector import ObservedTouch, TouchCollector
from isocharge.serve.tracking.touch_misfits import touch_misfits

RECENT_TOUCHES = 40
"""Number of the latest touches from which the follower decides whether the film is lost."""

FEWEST_TOUCHES = 12
"""Number of touches before the first correction of contacts."""

LARGEST_SQUARE = 9.0
"""Upper limit of the squared misfit of a touch, relative to the mean square of good touches.

The limit applies to the decision whether the film is lost. A single touch then has little influence.
"""

EXPLAINED_SQUARE = 1.25
"""Largest mean of the squared misfits of very many touches that are explained by a pretension."""

EXPLAINED_SCATTER = 5.0
"""Amount by which the sum of n squared misfits may exceed n * EXPLAINED_SQUARE, divided by the square root of n."""

WRONG_GAINS = np.outer([-1.0, 1.0], [0.03, 0.04, 0.06, 0.09]).ravel()
"""Gain errors of a single electrode that are compared with a change of the pretension."""

WRONG_GAIN_MARGIN = 9.0
"""Smallest reduction of the sum of squared misfits for which a gain is considered wrong.

The reduction is the smallest sum for any pretension minus the smallest sum for any wrong gain.
"""

OFFSET_CORRECTION_ERROR = 0.5
"""Standard deviation of the correction of the pretension for offsets, in units of the correction."""

UNCHANGED_PROBABILITY = 0.2
"""Probability before the first touch that the pretension has not changed since the calibration."""

SENSITIVITY_STEP_MPa = 0.05
"""Step of the finite differences with respect to the pretension, MPa."""

SMALLEST_CHANGE_MPa = 0.01
"""Smallest change of the pretension after which the weights of the model are computed again, MPa."""


class FollowRule(Rule, frozen=True, kw_only=True):
    """Settings of the correction for changes of the film, from the section `[follow]` of a device file.

    Attributes:
        drift_MPa_per_root_hour: Standard deviation of the change of the pretension in an hour, MPa. The standard
            deviation is proportional to the square root of the time. On a ring of aluminium, a change of the
            temperature by 1 K changes the pretension by 0.3 to 0.44 MPa.
        largest_offset_pC: Largest standard deviation of the charge that warmth may add to all electrodes during a
            touch, pC. The film is not followed while the mean added charge exceeds twice this value. 0 means that
            warmth adds no charge.
    """

    drift_MPa_per_root_hour: Setting = 0.35
    largest_offset_pC: Setting = 30.0


class FollowedContact(NamedTuple):
    """A contact after the correction for the estimated changes of the film.

    Attributes:
        contact: The corrected contact.
        charge_pC: Charges for which the model with the estimated pretension predicts this contact, shape
            (n_electrode,), pC.
    """

    contact: Contact
    charge_pC: Array


class SquaredMisfits(NamedTuple):
    """Squared misfits of one touch for different hypotheses about the film.

    The squared misfits are relative to the mean squared misfit of good touches. Each value is limited to
    `LARGEST_SQUARE`.

    Attributes:
        with_gains: Squared misfit at each pretension after a correction for the gains, the offset and the directions,
            shape (n_pretension,).
        at_touch_estimate: Element of `with_gains` at the pretension that was estimated at the time of the touch.
        without_gains: Squared misfit at each pretension after a correction for the offset and the directions, but not
            for the gains, shape (n_pretension,).
        wrong_gain: Squared misfit for each wrong gain of each electrode, first with the model of the calibrated film
            and then with the model of the estimated pretension, shape (2 * n_wrong_gain * n_electrode,).
    """

    with_gains: Array
    at_touch_estimate: float
    without_gains: Array
    wrong_gain: Array


class FilmFollower:
    """Estimator of the changes of one film, which corrects contacts for the estimated changes.

    The methods must be called from one thread. The same sequence of frames always gives bitwise equal contacts.

    Attributes:
        predictor: Model of the film with the estimated pretension.
        is_lost: Whether the film is lost. The estimate is not updated while the film is lost.
    """

    def __init__(self, predictor: Predictor, rule: FollowRule | None = None, offset_ratio: Array | float = 1.0) -> None:
        """Start with the assumption that the film has not changed since the calibration.

        Args:
            predictor: Model of the calibrated film.
            rule: Settings; None for the default value of every setting.
            offset_ratio: Charge that warmth adds to each electrode, relative to the common offset, shape
                (n_electrode,), or one number for all electrodes.

        Raises:
            ModelError: If the model has fewer than four electrodes, or has no file of pretensions, or the file of
                pretensions belongs to another model.
        """
        self._calibrated_predictor = predictor
        self._pretensions = followable_pretensions(predictor)
        electrodes = self._pretensions.typical_pC.size
        self._directions = read_film_directions(predictor.folder, electrodes)
        self._misfits = touch_misfits(predictor, self._pretensions)
        self._calibrated_misfits = self._misfits.at_pretension(self._pretensions.calibrated_MPa)
        rule = rule or FollowRule()
        self._filter = FilmFilter(
            self._pretensions,
            self._directions,
            self._misfits,
            rule.drift_MPa_per_root_hour,
            rule.largest_offset_pC,
            np.broadcast_to(np.asarray(offset_ratio, dtype=float), (electrodes,)),
        )
        self._calibrated_estimate = FilmStateEstimate(
            pretension_MPa=self._pretensions.calibrated_MPa,
            std_MPa=self._pretensions.std_MPa,
            directions=np.zeros(self._directions.count),
            directions_per_MPa=np.zeros(self._directions.count),
        )
        # Each row contains a wrong gain for one electrode, and the gain 1 for all other electrodes. The shape is
        # (n_wrong_gain * n_electrode, n_electrode).
        self._wrong_gains = 1.0 + np.kron(np.eye(electrodes), WRONG_GAINS[:, None])
        self._touch_collector = TouchCollector()
        self.reset()

    def reset(self) -> None:
        """Discard all touches, and assume again that the film has not changed since the calibration."""
        self._filter.reset()
        self.predictor = self._calibrated_predictor
        self._applied_misfits = self._calibrated_misfits
        self.is_lost = False
        self._applied_estimate = self._calibrated_estimate

        # Model at a neighbouring pretension, with which the sensitivity of contacts to the pretension is computed.
        self._neighbouring_model: Predictor | None = None
        self._neighbouring_step_MPa = SENSITIVITY_STEP_MPa

        # Charge ratios for both models, and the contact for which the ratios were computed; see `_charge_ratios`.
        self._stored_ratios: tuple[Array, Array] | None = None
        self._stored_ratios_contact: Contact | None = None
        self._sensitivity = Sensitivity(SENSITIVITY_STEP_MPa)
        self._touch_count = 0
        self._recent_misfits: deque[SquaredMisfits] = deque(maxlen=RECENT_TOUCHES)
        # Estimates after the latest touches. Before the first touches, the film was in the state of the calibration.
        self._recent_estimates = deque([self._calibrated_estimate] * RECENT_TOUCHES, maxlen=RECENT_TOUCHES)
        self._touch_collector.reset()

    def discard_touch(self) -> None:
        """Discard the frames of the present touch, for example after an outage or a new tare."""
        self._touch_collector.discard_touch()

    @property
    def film(self) -> FollowedFilm:
        """Present estimate of the film, in the format of a prediction record."""
        estimate = self._applied_estimate
        return FollowedFilm(estimate.pretension_MPa, estimate.std_MPa, self._touch_count)

    def observe_frame(
        self, charge_pC: Array | None, contact: Contact | None, flags: tuple[str, ...], clock_s: float
    ) -> None:
        """Process the next frame, and update the estimate of the film when a touch ends.

        The estimate is updated with the average charges of the frames with about the largest force, unless the touch is
        unusable; see `TouchCollector`.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC; None if nothing touches the film.
            contact: Contact that the model computed from the charges; None if nothing touches the film.
            flags: Flags of the frame.
            clock_s: Time of the frame on a clock that does not jump, s.
        """
        if contact is not None:
            assert charge_pC is not None  # a frame with a contact has charges
            self._touch_collector.add_frame(contact, charge_pC, flags)
            return
        touch = self._touch_collector.end_touch(self.predictor)
        if touch is not None:
            self.observe_touch(touch, clock_s)

    def follow_contact(self, contact: Contact, charge_pC: Array) -> FollowedContact:
        """Correct a contact for the estimated changes of the film.

        The charges of the present film differ from the charges of the film that `predictor` describes. The measured
        charges are therefore divided by the ratio of the charges of these two films, and the contact is computed again
        from the quotients. The uncertainty of the pretension is added to the standard deviations of the contact. The
        effect of this uncertainty on the contact is computed with the model of a neighbouring pretension. Before the
        first estimate of the film, the contact is returned unchanged.

        Args:
            contact: Contact that `predictor` computed from the charges.
            charge_pC: Touch charges, shape (n_electrode,), pC.
        """
        if self._neighbouring_model is None:  # there is no estimate yet
            return FollowedContact(contact, charge_pC)
        corrected_contact = contact
        corrected_pC = charge_pC
        neighbouring_pC = charge_pC  # charges for the model at the neighbouring pretension
        if self._directions.count > 0:  # without directions, all ratios are 1
            ratio, neighbouring_ratio = self._charge_ratios(contact)
            neighbouring_pC = charge_pC / neighbouring_ratio
            corrected_pC = charge_pC / ratio
            corrected_contact = self.predictor.predict(corrected_pC)
        predict_neighbouring = partial(self._neighbouring_model.predict, neighbouring_pC)
        shift = self._sensitivity.shift(corrected_contact, self._applied_estimate.std_MPa, predict_neighbouring)
        return FollowedContact(corrected_contact.widened(shift), corrected_pC)

    def _charge_ratios(self, contact: Contact) -> tuple[Array, Array]:
        """Return the ratios by which charges are divided before a model computes a contact from them.

        A ratio is a charge of the present film, divided by the charge of the film that the model describes. The ratios
        depend on the contact and on the estimate of the film. The ratios are therefore stored, and computed again only
        if the contact has moved or the estimate of the film has changed.

        Args:
            contact: Contact for which the ratios are needed.

        Returns:
            Ratios for the model with the estimated pretension, and ratios for the model with the neighbouring
            pretension, each of shape (n_electrode,).
        """
        if self._stored_ratios is None or not is_close(contact, self._stored_ratios_contact):
            contacts = np.array([contact[:3]])  # one contact (x, y, force), shape (1, 3)
            log_changes = self._directions.log_changes(contacts)[0]
            ratio = self._applied_estimate.charge_ratio(log_changes)
            neighbouring_ratio = self._applied_estimate.charge_ratio(log_changes, self._neighbouring_step_MPa)
            self._stored_ratios = ratio, neighbouring_ratio
            self._stored_ratios_contact = contact
        return self._stored_ratios

    def observe_touch(self, touch: ObservedTouch, clock_s: float) -> None:
        """Update the estimate of the film with a touch, and decide whether the film is lost.

        The film is lost if no pretension explains the latest touches, if the gain of an electrode seems to be wrong, or
        if the offsets are too large. When the film becomes lost, the estimate from the time before the latest touches
        is restored. No estimate is used before `FEWEST_TOUCHES` touches were observed.

        Args:
            touch: The touch.
            clock_s: Time of the touch on a clock that does not jump, s.
        """
        contacts = np.array([touch.contact[:3]])  # one contact (x, y, force), shape (1, 3)
        log_changes = self._directions.log_changes(contacts)[0]
        self._filter.predict(clock_s)
        residuals = self._filter.update(touch.charge_pC, contacts[0], log_changes, touch.misfit_std)
        self._touch_count += 1
        self._recent_misfits.append(self._squared_misfits(touch, log_changes, residuals))
        if len(self._recent_misfits) < FEWEST_TOUCHES:
            return

        was_lost = self.is_lost
        self.is_lost = self._is_unexplained() or self._is_gain_wrong() or self._filter.is_offset_too_large
        if not self.is_lost:
            estimate = self._estimate()
            self._recent_estimates.append(estimate)
            self._apply_estimate(estimate)
        elif not was_lost:  # the film became lost with this touch
            earlier_estimate = self._recent_estimates[0]  # before the latest `RECENT_TOUCHES` touches
            self._apply_estimate(earlier_estimate)
            # If the film is soon lost again, the same estimate is restored, because the later estimates are doubtful.
            self._recent_estimates.extend([earlier_estimate] * RECENT_TOUCHES)

    def _squared_misfits(self, touch: ObservedTouch, log_changes: Array, residuals: TouchResiduals) -> SquaredMisfits:
        """Compute the squared misfits of a touch, which are needed to decide whether the film is lost.

        Each squared misfit is limited to `LARGEST_SQUARE`, so that a single touch has little influence.

        Args:
            touch: The touch, with the charges Q.
            log_changes: Changes of ln Q by one unit of each direction, shape (n_direction, n_electrode). A direction is
                an uncertain combination of film parameters.
            residuals: Squared misfits that the filter computed for the touch.
        """
        squares_with_gains = np.minimum(residuals.with_gains, LARGEST_SQUARE)  # shape (n_pretension,)

        # Correct the charges for the estimated offset, and for the estimated changes of the film along the directions.
        direction_means = self._filter.direction_means(self._filter.mean_MPa)
        corrected_pC = (touch.charge_pC - self._filter.offset_pC) * np.exp(-direction_means @ log_changes)
        wrong_gain_squares = self._squared_misfits_of_wrong_gains(
            touch._replace(charge_pC=corrected_pC), residuals.offset_variance
        )
        return SquaredMisfits(
            with_gains=squares_with_gains,
            at_touch_estimate=float(squares_with_gains[self._filter.nearest_index]),
            without_gains=np.minimum(residuals.without_gains, LARGEST_SQUARE),
            wrong_gain=np.minimum(wrong_gain_squares, LARGEST_SQUARE),
        )

    def _squared_misfits_of_wrong_gains(self, corrected_touch: ObservedTouch, offset_variance: float) -> Array:
        """Compute the squared misfit of a touch for each hypothesis that the gain of one electrode is wrong.

        Args:
            corrected_touch: The touch, with charges that are corrected for the offset and the directions.
            offset_variance: Variance of the misfit that is caused by the deviation of the offset of this touch from
                the mean offset, relative to the mean squared misfit of good touches.

        Returns:
            Squared misfits, first at the calibrated pretension and then at the estimated pretension, shape
            (2 * n_wrong_gain * n_electrode,). They are relative to the mean squared misfit of good touches.
        """
        corrected_pC = corrected_touch.charge_pC
        charges_with_wrong_gain_pC = corrected_pC * self._wrong_gains  # shape (n_wrong_gain * n_electrode, n_electrode)
        start = np.array(corrected_touch.contact[:3])  # x, y and force
        no_changes = np.empty((0, corrected_pC.size))  # only the misfit vectors are needed, not their changes
        squares = []
        for misfits in (self._calibrated_misfits, self._applied_misfits):  # each has a single pretension
            linearised = misfits.linearise(charges_with_wrong_gain_pC, start, no_changes)
            # The shape of the misfit vectors is (n_wrong_gain * n_electrode, n_electrode).
            misfit_vectors = linearised.vectors[:, 0] / corrected_touch.misfit_std
            squares.append((misfit_vectors**2).sum(axis=1))

        # The random offset of this touch adds to the variance 1 of a good touch.
        return np.concatenate(squares) / (1.0 + offset_variance)

    def _is_unexplained(self) -> bool:
        """Return whether no pretension explains the latest touches.

        The squared misfits of the latest touches are added up in two ways. The first sum uses the present estimate of
        the pretension for all touches. The second sum uses the estimate at the time of each touch. If the smaller of
        the two sums exceeds a limit, no pretension explains the touches.
        """
        count = len(self._recent_misfits)
        nearest_index = self._filter.nearest_index
        sum_at_present_estimate = sum(float(touch.with_gains[nearest_index]) for touch in self._recent_misfits)
        sum_at_earlier_estimates = sum(touch.at_touch_estimate for touch in self._recent_misfits)
        largest_explained_sum = EXPLAINED_SQUARE * count + EXPLAINED_SCATTER * math.sqrt(count)
        return min(sum_at_present_estimate, sum_at_earlier_estimates) > largest_explained_sum

    def _is_gain_wrong(self) -> bool:
        """Return whether a wrong gain of one electrode explains the latest touches far better than any pretension."""
        sum_by_pretension = np.sum([touch.without_gains for touch in self._recent_misfits], axis=0)
        sum_by_wrong_gain = np.sum([touch.wrong_gain for touch in self._recent_misfits], axis=0)
        return bool(sum_by_wrong_gain.min() < sum_by_pretension.min() - WRONG_GAIN_MARGIN)

    def _estimate(self) -> FilmStateEstimate:
        """Compute the estimate of the film as an average over two hypotheses.

        The first hypothesis is that the pretension has changed since the calibration. The second hypothesis is that the
        pretension has not changed. Before the first touch, the second hypothesis has the probability
        `UNCHANGED_PROBABILITY`. The variance of the result includes the difference between the two hypotheses.
        """
        calibrated_MPa = self._pretensions.calibrated_MPa
        change_MPa = self._filter.mean_MPa - calibrated_MPa
        variance_MPa2 = self._filter_variance() + self._additional_variance()
        changed_probability = self._changed_probability()

        # Mean and standard deviation of the mixture of both hypotheses.
        pretension_MPa = calibrated_MPa + changed_probability * change_MPa
        variance_between_MPa2 = changed_probability * (1.0 - changed_probability) * change_MPa**2
        std_MPa = math.sqrt(variance_MPa2 + variance_between_MPa2)

        # Means of the directions at the estimated pretension, and the slopes of the means as finite differences.
        directions = self._filter.direction_means(pretension_MPa)
        neighbouring_directions = self._filter.direction_means(pretension_MPa + SENSITIVITY_STEP_MPa)
        directions_per_MPa = (neighbouring_directions - directions) / SENSITIVITY_STEP_MPa
        return FilmStateEstimate(pretension_MPa, std_MPa, directions, directions_per_MPa)

    def _filter_variance(self) -> float:
        """Return the variance of the pretension according to the filter, MPa^2."""
        deviations_MPa = self._filter.grid_MPa - self._filter.mean_MPa
        return float(self._filter.pretension_probability @ deviations_MPa**2)

    def _additional_variance(self) -> float:
        """Return the part of the pretension variance that is caused by errors outside the filter, MPa^2.

        These errors are the errors of the other parameters of the film, and the error of the correction for offsets.
        """
        offset_std_MPa = OFFSET_CORRECTION_ERROR * self._filter.offset_correction_MPa
        return self._pretensions.floor_MPa**2 + offset_std_MPa**2

    def _changed_probability(self) -> float:
        """Return the probability that the pretension has changed since the calibration."""
        pretensions = self._pretensions
        change_MPa = self._filter.grid_MPa - pretensions.calibrated_MPa
        odds_for_equal_priors = odds_of_no_change(
            change_MPa, self._filter.pretension_probability, pretensions.std_MPa, self._additional_variance()
        )
        # The odds are multiplied by the actual prior odds of the hypothesis that the pretension has not changed.
        unchanged_odds = odds_for_equal_priors * UNCHANGED_PROBABILITY / (1.0 - UNCHANGED_PROBABILITY)
        return 1.0 / (1.0 + unchanged_odds)

    def _apply_estimate(self, estimate: FilmStateEstimate) -> None:
        """Use a new estimate of the film for all later contacts.

        If the pretension has changed by less than `SMALLEST_CHANGE_MPa`, the present pretension and the present models
        are kept. The other values of the new estimate are used in any case.
        """
        self._stored_ratios = None  # the stored ratios of the charges belong to the previous estimate
        present_MPa = self._applied_estimate.pretension_MPa
        is_same_pretension = abs(estimate.pretension_MPa - present_MPa) < SMALLEST_CHANGE_MPa
        if is_same_pretension:
            self._applied_estimate = estimate._replace(pretension_MPa=present_MPa)
        else:
            self._applied_estimate = estimate
            self.predictor = self._model_with_pretension(estimate.pretension_MPa)
            self._applied_misfits = self._misfits.at_pretension(estimate.pretension_MPa)

        # The first estimate needs the neighbouring model even if the pretension has not changed.
        if not is_same_pretension or self._neighbouring_model is None:
            self._set_neighbouring_model(self._applied_estimate.pretension_MPa)

    def _set_neighbouring_model(self, pretension_MPa: float) -> None:
        """Create the model of a neighbouring pretension, in order to compute the sensitivity to the pretension.

        The neighbouring pretension is larger than the estimated pretension by `SENSITIVITY_STEP_MPa`. If no weights are
        available for the larger pretension, the neighbouring pretension is smaller by the same amount.

        Args:
            pretension_MPa: The estimated pretension, MPa.
        """
        step_MPa = SENSITIVITY_STEP_MPa
        _smallest_MPa, largest_MPa = self._pretensions.range_MPa
        if pretension_MPa + step_MPa > largest_MPa:
            step_MPa = -step_MPa
        self._neighbouring_step_MPa = step_MPa
        self._neighbouring_model = self._model_with_pretension(pretension_MPa + step_MPa)

        # The stored sensitivity belongs to the previous models. The sign of the step does not affect variances.
        self._sensitivity = Sensitivity(SENSITIVITY_STEP_MPa)

    def _model_with_pretension(self, pretension_MPa: float) -> Predictor:
        """Return the model of the calibrated film at the pretension `pretension_MPa`."""
        return self._calibrated_predictor.with_constants(self._pretensions.constants(pretension_MPa))
