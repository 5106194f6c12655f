"""Gaussian mixture that follows a contact on a film whose map from contacts to charges has a fold.

Where the map folds, several contacts have the same charges, and a single frame cannot distinguish them. A sequence of
frames can distinguish them, because one contact crosses the fold while the other contact turns back at the fold.

The state of a component is the position, the logarithm of the force, the rates of these three, and the logarithms of
the electrode gains. The distribution of the state is a sum of Gaussians (Alspach and Sorenson 1972). Each component is
updated with the measured charges by an iterated extended Kalman filter (Bell and Cathey 1993).

Components are added in four cases.

- When a touch begins, components are placed all over the film. Components that do not explain the charges are removed.
- If the most probable component extends across a fold, two components are added, one towards each side.
- If the innovation of the most probable component exceeds the gate, a component with an uncertain velocity is added.
- If the most probable component is fast, a component with zero velocity is added, because the contact may have stopped.

Charges are averaged over `STEP_s` before an update. Shorter steps are hardly more accurate.
"""

import math
from collections.abc import Sequence

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.serve.model.charge_series import ChargeSeries, read_charges
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.tracking.mixture_components import (
    CONTACT,
    GAINS,
    LOG_FORCE,
    LOG_FORCE_RATE,
    MAX_COMPONENTS,
    N_MOTION,
    POSITION,
    RATES,
    VELOCITY,
    X_RATE,
    Y_RATE,
    Components,
    ContactHypothesis,
    X,
    Y,
    combine_components,
    predict_components,
    prune_components,
)
from isocharge.serve.tracking.mixture_update import (
    LinearisedUpdate,
    Measurement,
    charges_and_jacobian,
    limit_iteration_step,
    linearise_update,
    updated_covariance,
)
from isocharge.serve.tracking.motion import FORCE_RATE_STD, SPEED_STD, MAX_GAP_s

STEP_s = 0.005
"""Time over which charges are averaged, s."""

CLOCK_TOLERANCE_s = 1e-5
"""Amount by which a step may be shorter than `STEP_s`, s. The times of frames are not exact."""

GAIN_STD = 0.01
"""Standard deviation of an electrode gain about its calibrated value, dimensionless."""

SLOW_NOISE_STD = 0.003
"""Standard deviation of slow noise, relative to the charge. Slow noise lasts for several frames."""

INITIAL_LOG_FORCE_STD = 2.0
"""Standard deviation of ln F when a touch begins, dimensionless."""

NEW_SPEED_STD = 80.0
"""Standard deviation of the change of the velocity when a contact starts, stops or turns, mm/s."""

SUDDEN_CHANGE_RATE = 2.0
"""Mean number of movements that start or stop in a second, 1/s."""

SQUARED_GATE = 8.0
"""Squared Mahalanobis distance of the innovation above which the velocity has probably changed, dimensionless."""

SEARCH_INTERVAL_s = 0.05
"""Shortest time between two searches over the whole film, each of which takes milliseconds, s."""

MAX_SQUARE = 60.0
"""Largest squared distance of a component that explains the charges, dimensionless.

The squared distance is the sum of the squared misfit of the charges and the squared change of the state.
"""

MAX_RELATIVE_RADIUS = 1.1
"""Distance from the centre, relative to the radius of the film, beyond which components are removed."""

FOLD_DISTANCE = 4.0
"""Distance of a fold from the most probable component, in standard deviations, below which two components are added.

The distance is large, because an error of a gain displaces the fold. The contact then seems to stop in front of it.
"""

SPLIT_DISTANCE = 2.5
"""Distance of an added component from the component that extends across a fold, in standard deviations."""

SPLIT_STD_RATIO = 0.5
"""Standard deviation of a component added at a fold along the axis of the split, relative to the original component."""

MIN_SPLIT_STD_mm = 0.05
"""Standard deviation of the position below which a component is not split, mm."""

SEPARATE_DISTANCE = 3.0
"""Distance, in standard deviations, above which components on the same side of a fold are different contacts."""

N_INITIAL_COMPONENTS = 121
"""Number of components all over the film when a touch begins."""

UPDATE_ITERATIONS = 3
"""Number of iterations of the Kalman filter in each update."""

INITIAL_ITERATIONS = 20
"""Number of iterations of the Kalman filter when a touch begins."""

GOLDEN_ANGLE = 2.399963
"""Angle between successive points of a spiral that covers a disk evenly, rad (Vogel 1979)."""


class ContactMixture:
    """Follows one contact by its charges.

    An object belongs to one thread. The same frames give the same results, bit for bit.
    """

    def __init__(self, charges: ChargeSeries, noise: ModelNoise) -> None:
        """Begin without a contact.

        Args:
            charges: Charges of every contact.
            noise: Noise of a frame, as in the training of the model.
        """
        self.charges = charges
        self._noise = noise
        self._initial_contacts = _evenly_distributed_contacts(charges)
        self.reset()

    def reset(self) -> None:
        """Discard the contact."""
        self._components: Components | None = None
        self._hypotheses: list[ContactHypothesis] = []
        self._step_frames: list[tuple[Array, float]] = []  # charges and time of each frame of the present step
        self._step_begin_s = -math.inf
        self._t_s = -math.inf  # mean time of the frames of the previous step
        self._next_search_s = -math.inf  # time before which the whole film is not searched again

    def update(self, charge_pC: Array, t_s: float) -> list[ContactHypothesis]:
        """Process the next frame.

        The mixture is updated once for all frames of a step, which is a period of `STEP_s`. Between the updates, the
        contacts are extrapolated to the time of the frame with their velocities.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            t_s: Time of the frame on any clock, s.

        Returns:
            The contacts that explain the charges, in descending order of their probability; empty if there is none.
        """
        self._step_frames.append((charge_pC, t_s))
        is_within_step = 0.0 <= t_s - self._step_begin_s < STEP_s - CLOCK_TOLERANCE_s
        if not is_within_step:
            self._process_step(t_s)
        return [hypothesis.extrapolated(t_s - self._t_s) for hypothesis in self._hypotheses]

    def _process_step(self, t_s: float) -> None:
        """Update the mixture with the mean charges of the frames of a step. The next step begins.

        Args:
            t_s: Time of the latest frame of the step, s.
        """
        charges, times_s = zip(*self._step_frames, strict=True)  # charges and time of each frame
        mean_time_s = sum(times_s) / len(times_s)
        dt_s = mean_time_s - self._t_s  # since the mean time of the previous step
        self._step_frames = []
        self._step_begin_s = t_s
        self._t_s = mean_time_s

        # Follow the contact of the previous step. If there is none, search the whole film, but not in every step.
        measurement = self._mean_measurement(charges)
        components = None
        if self._components is not None and 0.0 < dt_s < MAX_GAP_s:
            components = self._advance(self._components, measurement, dt_s)
        if components is None and t_s >= self._next_search_s:
            self._next_search_s = t_s + SEARCH_INTERVAL_s
            components = self._search(measurement)
        self._components = components
        self._hypotheses = [] if components is None else self._group(components)

    def _mean_measurement(self, charges: Sequence[Array]) -> Measurement:
        """Return the mean charges of a step, and their variances.

        The average over the frames reduces the noise of single frames, but not the slow noise.

        Args:
            charges: Touch charges of each frame of the step, each of shape (n_electrode,), pC.
        """
        charge_pC = np.mean(charges, axis=0)
        frame_noise_pC2 = self._noise.variance(charge_pC) / len(charges)
        slow_noise_pC2 = (SLOW_NOISE_STD * charge_pC) ** 2
        return Measurement(charge_pC, frame_noise_pC2 + slow_noise_pC2)

    def _search(self, measurement: Measurement) -> Components | None:
        """Search the whole film for contacts that explain the charges.

        Components with large variances are placed on a spiral that covers the film, and are then updated with the
        charges. A state contains the position, the logarithm of the force, the rates of these three, and the logarithm
        of the gain of each electrode.

        Args:
            measurement: Charges of this step.

        Returns:
            The components that explain the charges; None if there are none.
        """
        n_electrode = measurement.charge_pC.size
        mean = np.zeros((N_INITIAL_COMPONENTS, N_MOTION + n_electrode))  # rates and logarithms of gains are 0
        mean[:, CONTACT] = self._initial_contacts

        # Standard deviation of each entry of the state. Each component covers an equal part of the film.
        std = np.empty(N_MOTION + n_electrode)
        std[POSITION] = self.charges.radius_mm / math.sqrt(N_INITIAL_COMPONENTS)
        std[LOG_FORCE] = INITIAL_LOG_FORCE_STD
        std[VELOCITY] = SPEED_STD
        std[LOG_FORCE_RATE] = FORCE_RATE_STD
        std[GAINS] = GAIN_STD
        covariance = np.tile(np.diag(std**2.0), (N_INITIAL_COMPONENTS, 1, 1))

        equal_log_weights = np.zeros(N_INITIAL_COMPONENTS)
        components = Components(mean, covariance, equal_log_weights)
        return self._update(components, measurement, INITIAL_ITERATIONS)

    def _advance(self, components: Components, measurement: Measurement, dt_s: float) -> Components | None:
        """Predict the components, and update them with the charges of a step.

        A component with another velocity is added if the innovation of the most probable component (measured minus
        predicted charges) is large, or if the most probable component is fast. The update then determines which of the
        components is right.

        Args:
            components: Components after the previous step.
            measurement: Charges of this step.
            dt_s: Time since the previous step, s.

        Returns:
            The updated components; None if no component explains the charges.
        """
        predicted = predict_components(components, dt_s)

        # The added component begins as a copy of the most probable component. Its weight is multiplied by the
        # probability that the velocity has changed suddenly since the previous step.
        most_probable = predicted.best
        added_mean = predicted.mean[most_probable].copy()
        added_covariance = predicted.covariance[most_probable].copy()
        added_log_weight = predicted.log_weight[most_probable] + math.log(SUDDEN_CHANGE_RATE * dt_s)

        has_large_innovation = self._squared_innovation(predicted, measurement) > SQUARED_GATE
        is_fast = np.hypot(added_mean[X_RATE], added_mean[Y_RATE]) > SPEED_STD
        if has_large_innovation:  # the velocity may have changed
            rate_variance = np.array([NEW_SPEED_STD, NEW_SPEED_STD, FORCE_RATE_STD]) ** 2
            added_covariance[RATES, RATES] += np.diag(rate_variance)
            added_covariance[CONTACT, CONTACT] += np.diag(rate_variance * dt_s**2)
            predicted = predicted.with_component(added_mean, added_covariance, added_log_weight)
        elif is_fast:  # the contact may have stopped at its previous position
            added_mean[CONTACT] -= dt_s * added_mean[RATES]
            added_mean[RATES] = 0.0
            predicted = predicted.with_component(added_mean, added_covariance, added_log_weight)
        return self._update(predicted, measurement, UPDATE_ITERATIONS)

    def _squared_innovation(self, components: Components, measurement: Measurement) -> float:
        """Compute the squared Mahalanobis distance of the innovation of the most probable component.

        The innovation v is the difference of the measured and the predicted charges. Its covariance is S = J P J^T + R,
        where P is the covariance of the state, J the derivative of the charges with respect to the state, and R the
        covariance of the noise. The result is v^T S^-1 v.

        Args:
            components: Predicted components.
            measurement: Charges of this step.
        """
        most_probable = components.best
        charge_pC, jacobian = charges_and_jacobian(self.charges, components.mean)
        charge_covariance = jacobian @ components.covariance @ jacobian.swapaxes(1, 2)
        innovation_covariance = charge_covariance[most_probable] + np.diag(measurement.variance)
        innovation = measurement.charge_pC - charge_pC[most_probable]
        return float(innovation @ np.linalg.solve(innovation_covariance, innovation))

    def _most_probable_states(
        self, prior: Components, measurement: Measurement, iterations: int
    ) -> tuple[Array, LinearisedUpdate]:
        """Search for the state of each component that is most probable after the measured charges.

        Each iteration linearises the charges about the present state and computes the Kalman update of the prior mean
        with them. The state moves towards the updated mean, but not beyond the range of the linearisation.

        Args:
            prior: Predicted components.
            measurement: Charges of this step.
            iterations: Number of iterations of the search.

        Returns:
            The states, shape (n_component, n_state), and the update that is linearised at these states.
        """
        state = prior.mean
        linearised = linearise_update(self.charges, state, prior, measurement)
        for _ in range(iterations):
            state_charge_covariance = linearised.cross_covariance.swapaxes(1, 2)  # (n_component, n_state, n_electrode)
            change_from_prior = (state_charge_covariance @ linearised.weighted_innovation)[:, :, 0]
            step = prior.mean + change_from_prior - state
            state = state + limit_iteration_step(step)
            linearised = linearise_update(self.charges, state, prior, measurement)
        return state, linearised

    def _update(self, prior: Components, measurement: Measurement, iterations: int) -> Components | None:
        """Update the components with the charges, and then prune and split them.

        The weight of each component is multiplied by its likelihood. Components outside of the film are removed. If the
        most probable component does not explain the charges, there is no contact.

        Args:
            prior: Predicted components.
            measurement: Charges of this step.
            iterations: Number of iterations of the search for the most probable state of each component.

        Returns:
            The components, or None if no component explains the charges.
        """
        state, linearised = self._most_probable_states(prior, measurement, iterations)

        # Likelihood p of each component: -2 ln p = squared misfit + squared change of the state + ln det(covariance of
        # the innovation). The change of the state is relative to its covariance before the update. All terms have the
        # shape (n_component,).
        residual_pC = measurement.charge_pC - linearised.charge_pC
        squared_misfit = (residual_pC**2 / measurement.variance).sum(axis=1)
        column = linearised.weighted_innovation  # S^-1 v of the innovation v with the covariance S
        row = column.swapaxes(1, 2)
        squared_state_change = (row @ linearised.charge_covariance @ column)[:, 0, 0]
        square = squared_misfit + squared_state_change
        _sign, log_determinant = np.linalg.slogdet(linearised.innovation_covariance)
        log_weight = prior.log_weight - 0.5 * (square + log_determinant)

        is_outside_film = np.hypot(state[:, X], state[:, Y]) > MAX_RELATIVE_RADIUS * self.charges.radius_mm
        log_weight[is_outside_film] = -np.inf
        best = int(log_weight.argmax())
        is_explained = square[best] < MAX_SQUARE and np.isfinite(log_weight[best])
        if not is_explained:
            return None

        covariance = updated_covariance(prior, linearised)
        misfit = math.sqrt(squared_misfit[best])
        updated = Components(state, covariance, log_weight - log_weight[best], misfit)
        return self._split_at_fold(prune_components(updated))

    def _split_at_fold(self, components: Components) -> Components:
        """Add a component towards each side of a fold if the most probable component extends across the fold.

        At a fold of the map from contacts to charges, two contacts with equal charges meet. The contact may be on
        either side, but a single Gaussian component describes only one side well.

        Args:
            components: Components after the update with the charges of this step.

        Returns:
            The components, with two additional components if there is a fold.
        """
        best = components.best
        mean = components.mean[best]
        covariance = components.covariance[best]
        has_space_for_two = len(components.mean) <= MAX_COMPONENTS - 2

        # Standard deviation of the position along the longest axis of its covariance
        variances, axes = np.linalg.eigh(covariance[POSITION, POSITION])
        longest = variances.size - 1  # `eigh` returns the variances in ascending order
        std_mm = math.sqrt(max(variances[longest], 0.0))  # rounding errors may make the variance negative
        if std_mm < MIN_SPLIT_STD_mm or not has_space_for_two:
            return components

        # Expected change of the whole state if the position changes by one standard deviation along the longest axis.
        direction = covariance[:, POSITION] @ axes[:, longest] / std_mm
        sides = np.array([1.0, -1.0])
        states_on_both_sides = mean + FOLD_DISTANCE * np.outer(sides, direction)
        if not self._is_across_fold(mean, states_on_both_sides).any():
            return components

        # The added components are narrower along this direction, and have a smaller weight than the component between.
        removed_share = 1.0 - SPLIT_STD_RATIO**2
        narrow_covariance = covariance - removed_share * np.outer(direction, direction)
        log_weight = components.log_weight[best] - 0.5 * SPLIT_DISTANCE**2
        added_means = mean + SPLIT_DISTANCE * np.outer(sides, direction)
        for added_mean in added_means:
            components = components.with_component(added_mean, narrow_covariance, log_weight)
        return components

    def _is_across_fold(self, state: Array, other_states: Array) -> Booleans:
        """Return whether a fold of the map from contacts to charges lies between a state and each of other states.

        At a fold, the orientation of the map changes, and the determinant of its Jacobian changes its sign.

        Args:
            state: A state, shape (6 + n_electrode,).
            other_states: The states to compare it with, shape (n, 6 + n_electrode).

        Returns:
            Whether an odd number of folds lies in between, shape (n,).
        """
        states = np.vstack([state, other_states])
        _charges, jacobians = self.charges.linearised(states[:, CONTACT])
        state_jacobian = jacobians[0]  # shape (n_electrode, 3)
        other_jacobians = jacobians[1:]

        # For three electrodes, det(J^T K) = det(J) det(K), which is negative if the two determinants differ in sign.
        # With more electrodes, the Jacobians J and K are not square, but the product is.
        relative_orientation = np.linalg.det(state_jacobian.T @ other_jacobians)
        return np.asarray(relative_orientation < 0.0)

    def _group(self, components: Components) -> list[ContactHypothesis]:
        """Combine the components that describe the same contact.

        The most probable component and all components of the same contact form a group. The components that remain are
        grouped in the same way, until no component remains.

        Args:
            components: Components after the update with the charges of this step.

        Returns:
            The contacts, in descending order of their probability.
        """
        probability = np.exp(components.log_weight - components.log_weight.max())
        probability /= probability.sum()
        remaining = np.argsort(-probability, kind="stable")  # rows of the components, the most probable first
        hypotheses = []
        while remaining.size > 0:
            is_same = self._is_same_contact(components, remaining)
            group = remaining[is_same]
            hypothesis = combine_components(components.select(group), probability[group])
            hypotheses.append(hypothesis)
            remaining = remaining[~is_same]
        return sorted(hypotheses, key=lambda hypothesis: -hypothesis.probability)

    def _is_same_contact(self, components: Components, rows: Integers) -> Booleans:
        """Return which components describe the same contact as the component of the first row.

        Components of the same contact are near each other, and no fold of the map from contacts to charges lies between
        them. They are near if x and y differ by less than a few standard deviations of the difference.

        Args:
            components: All components.
            rows: Indices of the components to compare, shape (n,). The first one is the reference.

        Returns:
            Whether each component of `rows` describes the same contact, shape (n,).
        """
        first = rows[0]
        mean = components.mean[rows]
        position_variance = components.covariance[:, [X, Y], [X, Y]]  # of x and of y, shape (n_component, 2)
        difference_std_mm = np.sqrt(position_variance[first] + position_variance[rows])
        difference_mm = np.abs(mean[:, POSITION] - components.mean[first, POSITION])
        is_near = (difference_mm < SEPARATE_DISTANCE * difference_std_mm).all(axis=1)
        is_same = is_near & ~self._is_across_fold(components.mean[first], mean)
        is_same[0] = True  # even if rounding errors make the first component appear to be across a fold
        return np.asarray(is_same)


def _evenly_distributed_contacts(charges: ChargeSeries) -> Array:
    """Return contacts (x, y, ln F) of medium force on a spiral that covers the film, shape (n, 3).

    On this spiral (Vogel 1979), the contacts cover equal areas of the film: the radius grows with the square root of
    the number of the contact, and successive contacts differ by the golden angle.
    """
    number = np.arange(N_INITIAL_COMPONENTS)
    angle = GOLDEN_ANGLE * number
    radius_mm = charges.radius_mm * np.sqrt((number + 0.5) / N_INITIAL_COMPONENTS)
    x_mm = radius_mm * np.cos(angle)
    y_mm = radius_mm * np.sin(angle)
    medium_log_force = np.log(charges.force_N).mean()
    log_force = np.full(N_INITIAL_COMPONENTS, medium_log_force)
    return np.column_stack([x_mm, y_mm, log_force])


def contact_mixture(predictor: Predictor) -> ContactMixture | None:
    """Return the mixture for the film of a model; None if the model has no file `charges.npz`.

    Raises:
        ModelError: If the file is damaged.
    """
    charges = read_charges(predictor.folder, len(predictor.metadata.electrodes))
    if charges is None:
        return None
    return ContactMixture(charges, predictor.metadata.noise)
