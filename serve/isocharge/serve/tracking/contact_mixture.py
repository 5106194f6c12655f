"""Gaussian mixture that follows a contact if the map from contacts to charges has a fold.

Near a fold of the map from contacts to charges, two different contacts produce the same charges. A single frame cannot
distinguish these two contacts. A sequence of frames can distinguish the two contacts, because one contact crosses the
fold while the other contact turns back at the fold.

The state of a component consists of x, y and the logarithm of the force, the rates of change of these three values, and
the logarithms of the electrode gains. The probability distribution of the state is a weighted sum of Gaussian
distributions (Alspach and Sorenson 1972). Each Gaussian component is updated with the measured charges by an iterated
extended Kalman filter (Bell and Cathey 1993).

Components are added in four cases.

- When a touch begins, components are placed all over the film. Components that do not explain the charges are removed.
- If the most probable component extends across a fold, one component is added on each side of the fold.
- If the innovation of the most probable component exceeds the gate, a component with an uncertain velocity is added.
- If the most probable component is fast, a component with zero velocity is added, because the contact may have stopped.

The charges are averaged over intervals of `STEP_s` before an update. Shorter intervals would hardly improve the
accuracy.
"""

import math
from collections.abc import Sequence

import numpy as np

from isocharge.common.arrays import Array, Booleans, Integers
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.tracking.contact_filter import MAX_GAP_s
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
    film_charges,
    limit_iteration_steps,
    linearise_update,
    updated_covariance,
)
from isocharge.serve.tracking.two_mode_filter import FORCE_RATE_STD, SPEED_STD

STEP_s = 0.005
"""Length of the time interval over which charges are averaged, s."""

CLOCK_TOLERANCE_s = 1e-5
"""Amount by which a step may be shorter than `STEP_s`, s, because the times of the frames are not exact."""

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
"""Shortest time between two searches over the whole film, s. Each search takes milliseconds."""

MAX_SQUARED_DISTANCE = 60.0
"""Largest squared distance of a component that explains the charges, dimensionless.

The squared distance is the sum of the squared misfit of the charges and the squared change of the state.
"""

MAX_RELATIVE_RADIUS = 1.1
"""Distance from the centre, relative to the radius of the film, beyond which components are removed."""

FOLD_DISTANCE = 4.0
"""Distance of a fold from the most probable component, in standard deviations, below which two components are added.

The distance is large, because an error of a gain displaces the fold. The contact then seems to stop before the fold.
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
    """Gaussian mixture that estimates the position and the force of one contact from the charges of each frame.

    The methods must be called from one thread. The same sequence of frames always gives bitwise equal results.

    Attributes:
        charges: Charges of every contact on the film.
    """

    def __init__(self, charges: ChargeSeries, noise: ModelNoise) -> None:
        """Start without a contact.

        Args:
            charges: Charges of every contact on the film.
            noise: Noise of the charges of a frame, with which the model was trained.
        """
        self.charges = charges
        self._noise = noise
        self._initial_contacts = _evenly_distributed_contacts(charges)
        self.reset()

    def reset(self) -> None:
        """Discard the contact and all received frames."""
        self._components: Components | None = None
        self._hypotheses: list[ContactHypothesis] = []
        self._latest_frame_s = -math.inf
        self._step_frames: list[tuple[Array, float]] = []  # charges and time of each frame of the present step
        self._step_begin_s = -math.inf
        self._mixture_time_s = -math.inf  # time of the latest update, which is the mean time of its frames
        self._next_search_s = -math.inf  # earliest time of the next search over the whole film

    def update(self, charge_pC: Array, t_s: float) -> list[ContactHypothesis]:
        """Process the next frame, and return the contacts that explain the charges.

        The mixture is updated only once in each step, which is a time interval of length `STEP_s`. Between two updates,
        the contacts are extrapolated with constant velocities to the time of the frame.

        If the clock was set back, the contact and all earlier frames are discarded, because the time since these frames
        is unknown. The whole film is then searched at once.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            t_s: Time of the frame on any clock, s.

        Returns:
            The contacts that explain the charges, in descending order of their probability. The list is empty if no
            contact explains the charges.
        """
        was_clock_set_back = t_s < self._latest_frame_s
        if was_clock_set_back:
            self.reset()
        self._latest_frame_s = t_s
        self._step_frames.append((charge_pC, t_s))
        is_within_step = t_s - self._step_begin_s < STEP_s - CLOCK_TOLERANCE_s
        if not is_within_step:
            self._process_step(t_s)
        return [hypothesis.extrapolated(t_s - self._mixture_time_s) for hypothesis in self._hypotheses]

    def _process_step(self, t_s: float) -> None:
        """Update the mixture with the mean charges of the frames in a step, and begin the next step.

        Args:
            t_s: Time of the latest frame in the step, s.
        """
        charges_of_frames, times_s = zip(*self._step_frames, strict=True)
        mean_time_s = sum(times_s) / len(times_s)
        dt_s = mean_time_s - self._mixture_time_s  # time since the previous update
        self._step_frames = []
        self._step_begin_s = t_s
        self._mixture_time_s = mean_time_s

        # Follow the contact of the previous step. If there was no contact, or the charges no longer fit it, search the
        # whole film. The search takes milliseconds, so it is not repeated in every step.
        measurement = self._mean_measurement(charges_of_frames)
        components = None
        if self._components is not None and dt_s < MAX_GAP_s:
            components = self._advance(self._components, measurement, dt_s)
        if components is None and t_s >= self._next_search_s:
            self._next_search_s = t_s + SEARCH_INTERVAL_s
            components = self._search(measurement)
        self._components = components
        self._hypotheses = [] if components is None else self._combine_by_contact(components)

    def _mean_measurement(self, charges_of_frames: Sequence[Array]) -> Measurement:
        """Average the charges over the frames in a step, and compute the variances of the mean charges.

        Averaging over n frames divides the variance of the frame noise by n. The slow noise is the same in all frames
        of a step, so averaging does not reduce it.

        Args:
            charges_of_frames: Touch charges of each frame in the step, each of shape (n_electrode,), pC.
        """
        charge_pC = np.mean(charges_of_frames, axis=0)
        frame_noise_pC2 = self._noise.variance(charge_pC) / len(charges_of_frames)
        slow_noise_pC2 = (SLOW_NOISE_STD * charge_pC) ** 2
        return Measurement(charge_pC, frame_noise_pC2 + slow_noise_pC2)

    def _search(self, measurement: Measurement) -> Components | None:
        """Search the whole film for contacts that explain the charges.

        Components with large variances are placed on a spiral that covers the film, and are then updated with the
        charges. The state of a component consists of x, y and the logarithm of the force, the rates of change of these
        three values, and the logarithm of the gain of each electrode.

        Args:
            measurement: Charges of this step.

        Returns:
            The updated components; None if the most probable component does not explain the charges.
        """
        n_electrode = measurement.charge_pC.size
        mean = np.zeros((N_INITIAL_COMPONENTS, N_MOTION + n_electrode))  # rates and logarithms of gains remain 0
        mean[:, CONTACT] = self._initial_contacts

        # Standard deviation of each entry of the state. Each component covers an equal part of the film.
        std = np.empty(N_MOTION + n_electrode)
        std[POSITION] = self.charges.domain.radius / math.sqrt(N_INITIAL_COMPONENTS)
        std[LOG_FORCE] = INITIAL_LOG_FORCE_STD
        std[VELOCITY] = SPEED_STD
        std[LOG_FORCE_RATE] = FORCE_RATE_STD
        std[GAINS] = GAIN_STD
        covariance = np.tile(np.diag(std**2.0), (N_INITIAL_COMPONENTS, 1, 1))

        equal_log_weights = np.zeros(N_INITIAL_COMPONENTS)
        components = Components(mean, covariance, equal_log_weights)
        return self._update(components, measurement, INITIAL_ITERATIONS)

    def _advance(self, components: Components, measurement: Measurement, dt_s: float) -> Components | None:
        """Predict the components at the time of this step, and update the components with the measured charges.

        A component with another velocity is added before the update if the most probable component is fast, or if the
        innovation of this component is large. The innovation is the difference between the measured and the predicted
        charges. The update increases the weights of components that explain the charges well, relative to the weights
        of other components.

        Args:
            components: Components after the previous step.
            measurement: Charges of this step.
            dt_s: Time since the previous step, s.

        Returns:
            The updated components; None if the most probable component does not explain the charges.
        """
        predicted = predict_components(components, dt_s)

        # The added component starts as a copy of the most probable component. Its weight is the weight of the most
        # probable component multiplied by the probability of a sudden change of the velocity since the previous step.
        most_probable = predicted.best
        added_mean = predicted.mean[most_probable].copy()
        added_covariance = predicted.covariance[most_probable].copy()
        added_log_weight = predicted.log_weight[most_probable] + math.log(SUDDEN_CHANGE_RATE * dt_s)

        has_large_innovation = self._squared_innovation(predicted, measurement) > SQUARED_GATE
        is_fast = np.hypot(added_mean[X_RATE], added_mean[Y_RATE]) > SPEED_STD
        if has_large_innovation:
            # The rates may have changed to unknown values at any time since the previous step. The position and the
            # force may therefore have changed, too.
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

        The innovation v is the difference between the measured and the predicted charges. The covariance of the
        innovation is S = J P J^T + R. Here P is the covariance of the state, J is the Jacobian of the charges with
        respect to the state, and R is the covariance of the noise. The result is v^T S^-1 v.

        Args:
            components: Predicted components.
            measurement: Charges of this step.
        """
        most_probable = components.best
        charges_pC, jacobians = charges_and_jacobian(self.charges, components.mean)  # of all components
        jacobian = jacobians[most_probable]  # shape (n_electrode, n_state)
        charge_covariance = jacobian @ components.covariance[most_probable] @ jacobian.T
        innovation_covariance = charge_covariance + np.diag(measurement.variance)
        innovation = measurement.charge_pC - charges_pC[most_probable]
        return float(innovation @ np.linalg.solve(innovation_covariance, innovation))

    def _most_probable_states(
        self, prior: Components, measurement: Measurement, iterations: int
    ) -> tuple[Array, LinearisedUpdate]:
        """For each component, find the most probable state for the measured charges.

        Each iteration linearises the charges about the present state, computes the Kalman update of the prior mean with
        the linearised charges, and moves the state towards the updated mean. The change of the state in one iteration
        is limited, because the linearisation is only accurate near the present state.

        Args:
            prior: Predicted components.
            measurement: Charges of this step.
            iterations: Number of iterations of the search.

        Returns:
            The states, shape (n_component, n_state), and the update that is linearised at these states.
        """
        states = prior.mean
        linearised = linearise_update(self.charges, states, prior, measurement)
        for _ in range(iterations):
            state_charge_covariance = linearised.cross_covariance.swapaxes(1, 2)  # (n_component, n_state, n_electrode)
            change_from_prior = (state_charge_covariance @ linearised.weighted_innovation)[:, :, 0]
            updated_mean = prior.mean + change_from_prior
            states = states + limit_iteration_steps(updated_mean - states)
            linearised = linearise_update(self.charges, states, prior, measurement)
        return states, linearised

    def _update(self, prior: Components, measurement: Measurement, iterations: int) -> Components | None:
        """Update the components with the charges, remove improbable components, and split a component at a fold.

        The weight of each component is multiplied by the likelihood of the component. Components that are clearly
        outside the film, beyond `MAX_RELATIVE_RADIUS`, are removed.

        Args:
            prior: Predicted components.
            measurement: Charges of this step.
            iterations: Number of iterations of the search for the most probable state of each component.

        Returns:
            The updated components; None if the most probable component does not explain the charges.
        """
        states, linearised = self._most_probable_states(prior, measurement, iterations)

        # The likelihood p of a component is given by -2 ln p = squared misfit + squared change of the state + ln det S,
        # where S is the covariance of the innovation. All terms have the shape (n_component,).
        squared_misfit, squared_state_change = _squared_distances(measurement, linearised)
        squared_distance = squared_misfit + squared_state_change
        _sign, log_determinant = np.linalg.slogdet(linearised.innovation_covariance)
        log_weight = prior.log_weight - 0.5 * (squared_distance + log_determinant)

        is_outside_film = np.hypot(states[:, X], states[:, Y]) > MAX_RELATIVE_RADIUS * self.charges.domain.radius
        log_weight[is_outside_film] = -np.inf
        best = int(log_weight.argmax())  # the most probable component
        is_any_inside = np.isfinite(log_weight[best])
        is_explained = is_any_inside and squared_distance[best] < MAX_SQUARED_DISTANCE
        if not is_explained:
            return None

        covariance = updated_covariance(prior, linearised)
        misfit = math.sqrt(squared_misfit[best])
        relative_log_weight = log_weight - log_weight[best]  # the largest logarithm becomes 0
        updated_components = Components(states, covariance, relative_log_weight, misfit)
        return self._split_at_fold(prune_components(updated_components))

    def _split_at_fold(self, components: Components) -> Components:
        """Add one component on each side of a fold if the most probable component extends across the fold.

        Near a fold of the map from contacts to charges, a contact on one side of the fold has the same charges as a
        contact on the other side. A single Gaussian component describes only the contacts on one side of the fold
        accurately.

        Args:
            components: Components after the update with the charges of this step.

        Returns:
            The components, and two additional components if the most probable component extends across a fold.
        """
        best = components.best
        mean = components.mean[best]
        covariance = components.covariance[best]

        # Standard deviation of the position along the longest axis of the covariance ellipse.
        variances, axes = np.linalg.eigh(covariance[POSITION, POSITION])
        longest = variances.size - 1  # `eigh` returns the variances in ascending order
        std_mm = math.sqrt(max(variances[longest], 0.0))  # rounding errors may make the variance negative
        is_wide = std_mm >= MIN_SPLIT_STD_mm
        has_space_for_two = len(components.mean) <= MAX_COMPONENTS - 2
        if not (is_wide and has_space_for_two):
            return components

        # Expected change of the whole state if the position changes by one standard deviation along the longest axis.
        change_per_std = covariance[:, POSITION] @ axes[:, longest] / std_mm  # shape (n_state,)

        # Search for a fold up to `FOLD_DISTANCE` standard deviations from the mean on both sides.
        sides = np.array([1.0, -1.0])
        states_on_both_sides = mean + FOLD_DISTANCE * np.outer(sides, change_per_std)  # shape (2, n_state)
        if not self._is_across_fold(mean, states_on_both_sides).any():
            return components

        # Each added component is narrower along the longest axis than the most probable component. The ratio of the
        # variances is the square of the ratio of the standard deviations.
        removed_share = 1.0 - SPLIT_STD_RATIO**2
        narrow_covariance = covariance - removed_share * np.outer(change_per_std, change_per_std)

        # The weight of each added component is the weight of the most probable component, multiplied by the relative
        # density of the most probable component at a distance of `SPLIT_DISTANCE` standard deviations.
        log_weight = components.log_weight[best] - 0.5 * SPLIT_DISTANCE**2
        added_means = mean + SPLIT_DISTANCE * np.outer(sides, change_per_std)
        for added_mean in added_means:
            components = components.with_component(added_mean, narrow_covariance, log_weight)
        return components

    def _is_across_fold(self, state: Array, other_states: Array) -> Booleans:
        """Determine between which pairs of states a fold of the map from contacts to charges lies.

        Each pair consists of the reference state and one of the other states.

        At a fold, the orientation of the map changes, and the determinant of the Jacobian of the map changes its sign.
        If two folds lie between the states of a pair, the method finds no fold.

        Args:
            state: The reference state, shape (6 + n_electrode,).
            other_states: The states that are compared with `state`, shape (n, 6 + n_electrode).

        Returns:
            Whether the number of folds between `state` and each other state is odd, shape (n,).
        """
        states = np.vstack([state, other_states])
        _charges, jacobians = film_charges(self.charges, states)
        state_jacobian = jacobians[0]  # shape (n_electrode, 3)
        other_jacobians = jacobians[1:]

        # For three electrodes, det(J^T K) = det(J) det(K), which is negative if the two determinants differ in sign.
        # With more electrodes, the Jacobians J and K are not square, but the product J^T K is square.
        relative_orientation = np.linalg.det(state_jacobian.T @ other_jacobians)
        return np.asarray(relative_orientation < 0.0)

    def _combine_by_contact(self, components: Components) -> list[ContactHypothesis]:
        """For each contact, combine all components that describe the contact into one hypothesis.

        The most probable component and all components that describe the same contact form the first group. The
        remaining components are grouped in the same way, until no component remains.

        Args:
            components: Components after the update with the charges of this step.

        Returns:
            One hypothesis for each contact, in descending order of their probability.
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

        # A later group may have a larger total probability than an earlier group.
        return sorted(hypotheses, key=lambda hypothesis: -hypothesis.probability)

    def _is_same_contact(self, components: Components, rows: Integers) -> Booleans:
        """Determine which of the selected components describe the same contact as the first selected component.

        Two components describe the same contact if they are near each other, and no fold of the map from contacts to
        charges lies between them. Two components are near each other if x and y both differ by less than
        `SEPARATE_DISTANCE` standard deviations of the difference.

        Args:
            components: All components.
            rows: Indices of the selected components, shape (n,). The first selected component is the reference.

        Returns:
            Whether each selected component describes the same contact as the reference, shape (n,).
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


def _squared_distances(measurement: Measurement, linearised: LinearisedUpdate) -> tuple[Array, Array]:
    """Compute how far the updated state of each component is from the measured charges and from the prior state.

    Let J be the Jacobian of the charges, P the prior covariance of the state, and S^-1 v the weighted innovation. The
    update changes the state by P J^T S^-1 v. The square of this change, relative to P, is (S^-1 v)^T J P J^T (S^-1 v).

    Args:
        measurement: Charges of this step.
        linearised: Quantities of the update, linearised about the updated states.

    Returns:
        Squared misfit of the charges relative to the variance of the noise, shape (n_component,), and squared change of
        the state relative to the prior covariance, shape (n_component,).
    """
    residual_pC = measurement.charge_pC - linearised.charge_pC
    squared_misfit = (residual_pC**2 / measurement.variance).sum(axis=1)
    weighted_innovation = linearised.weighted_innovation  # S^-1 v, shape (n_component, n_electrode, 1)
    weighted_row = weighted_innovation.swapaxes(1, 2)  # shape (n_component, 1, n_electrode)
    # The charge covariance is J P J^T, shape (n_component, n_electrode, n_electrode).
    squared_state_change = (weighted_row @ linearised.charge_covariance @ weighted_innovation)[:, 0, 0]
    return squared_misfit, squared_state_change


def _evenly_distributed_contacts(charges: ChargeSeries) -> Array:
    """Return contacts (x, y, ln F) that are evenly distributed over the film on a spiral (Vogel 1979).

    The squared distances of the contacts from the centre are evenly spaced, and the angle between successive contacts
    is the golden angle. Every contact therefore represents the same area of the film. All contacts have the same medium
    force.

    Args:
        charges: Charges of every contact on the film, with the radius of the film and its range of forces.

    Returns:
        Contacts, shape (`N_INITIAL_COMPONENTS`, 3), mm and the logarithm of N.
    """
    contact_number = np.arange(N_INITIAL_COMPONENTS)
    angle = GOLDEN_ANGLE * contact_number
    radius_mm = charges.domain.radius * np.sqrt((contact_number + 0.5) / N_INITIAL_COMPONENTS)
    x_mm = radius_mm * np.cos(angle)
    y_mm = radius_mm * np.sin(angle)
    medium_log_force = np.log(charges.domain.force_range).mean()  # of the smallest and the largest force
    log_force = np.full(N_INITIAL_COMPONENTS, medium_log_force)
    return np.column_stack([x_mm, y_mm, log_force])
