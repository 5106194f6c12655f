"""Contacts followed in time, by isocharge and by other filters: tables and picture of serve/docs/tracking_results.md.

    python tests/benchmarks/bench_track.py [--model NAME|PATH] [--paths 40] [--rate-hz 1000] [--noise reference]
        [--force 1] [--plot FILE] [--json]

A contact is at rest, then moves at a constant speed for 0.3 s or 8 mm, and is at rest again. The paths lie at random
positions of the inner working area. The charges are simulated with noise, and the filters smooth the contacts of the
model. The filters are:

- the moving average;
- the 1 euro filter (Casiez et al. 2012), adjusted by the rule of its authors: first the cutoff frequency at rest, then
  beta;
- a Kalman filter for a constant velocity with white acceleration;
- the tracker of isocharge.

The first three filters have the best setting for each speed. The tracker of isocharge has the same setting for all.
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter
from shared import model_film, options, print_results

from isocharge.common.arrays import Array, Booleans
from isocharge.serve import Contact, Predictor
from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.contact import Contacts
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.tracking.tracker import Tracker
from isocharge.simulate import ForwardMap, noise_model
from isocharge.simulate.plots.figure import new_figure

SPEEDS_mm_per_s = (0.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
"""Speeds of the moving contacts, mm/s."""

REST_s = 0.3
"""Time at rest before and after the movement, s."""

MAX_MOVEMENT_s = 0.3
"""Longest duration of a movement, s."""

MAX_MOVEMENT_mm = 8.0
"""Longest movement, mm."""

SETTLING_TIME_s = 0.05
"""Time after the press from which errors count, s."""

MAX_SQUARED_DISTANCE_95 = 5.991
"""95th percentile of the chi-squared distribution with two degrees of freedom."""

NO_FILTER = "none"
OURS = "ours"

Smooth = Callable[[np.ndarray], np.ndarray]
"""Function from positions x + iy, shape (n_path, n_frame), mm, to smoothed positions of the same shape."""


def moving_average(count: int) -> Smooth:
    """Return the moving average over a number of frames."""

    def smooth(position: np.ndarray) -> np.ndarray:
        frames_so_far = np.arange(1, position.shape[1] + 1)
        return lfilter(np.ones(count), 1.0, position) / np.minimum(frames_so_far, count)

    return smooth


def one_euro(cutoff_Hz: float, beta: float, dt_s: float) -> Smooth:
    """Return the 1 euro filter (Casiez, Roussel and Vogel 2012, algorithms 1 and 2).

    Args:
        cutoff_Hz: Cutoff frequency at rest, Hz.
        beta: Increase of the cutoff frequency with the speed, 1/mm.
        dt_s: Time between frames, s.
    """

    def smoothing_factor(cutoff_Hz: np.ndarray | float) -> np.ndarray | float:
        return 1.0 / (1.0 + 1.0 / (2.0 * np.pi * cutoff_Hz * dt_s))

    def smooth(position: np.ndarray) -> np.ndarray:
        smoothed = position.copy()
        velocity = np.zeros(len(position), complex)
        for frame in range(1, position.shape[1]):
            innovation = position[:, frame] - smoothed[:, frame - 1]
            velocity += smoothing_factor(1.0) * (innovation / dt_s - velocity)
            factor = smoothing_factor(cutoff_Hz + beta * np.abs(velocity))
            smoothed[:, frame] = smoothed[:, frame - 1] + factor * innovation
        return smoothed

    return smooth


def kalman(density: float, std_mm: float, dt_s: float) -> Smooth:
    """Return a Kalman filter for a constant velocity with white acceleration.

    Args:
        density: Power spectral density of the acceleration, mm^2/s^3.
        std_mm: Standard deviation of the measured positions, mm.
        dt_s: Time between frames, s.
    """
    initial_velocity_variance = 1600.0  # mm^2/s^2
    transition = np.array([[1.0, dt_s], [0.0, 1.0]])
    process_noise = density * np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])

    def smooth(position: np.ndarray) -> np.ndarray:
        smoothed = position.copy()
        velocity = np.zeros(len(position), complex)
        covariance = np.diag([std_mm**2, initial_velocity_variance])  # of position and velocity
        for frame in range(1, position.shape[1]):
            covariance = transition @ covariance @ transition.T + process_noise
            predicted = smoothed[:, frame - 1] + velocity * dt_s
            innovation = position[:, frame] - predicted
            gain = covariance[:, 0] / (covariance[0, 0] + std_mm**2)
            smoothed[:, frame] = predicted + gain[0] * innovation
            velocity = velocity + gain[1] * innovation
            covariance = covariance - np.outer(gain, covariance[0])
        return smoothed

    return smooth


class Paths(NamedTuple):
    """True paths of contacts.

    Attributes:
        position: Positions x + iy, shape (n_path, n_frame), mm.
        is_moving: Whether the contacts move in each frame, shape (n_frame,).
    """

    position: np.ndarray
    is_moving: Booleans


def draw_paths(speed: float, count: int, dt_s: float, rng: np.random.Generator) -> Paths:
    """Draw paths with random centres within 2 mm of the centre of the film, and with random directions.

    Args:
        speed: Speed of the movement, mm/s.
        count: Number of paths.
        dt_s: Time between frames, s.
        rng: Random number generator.
    """
    duration_s = min(MAX_MOVEMENT_s, MAX_MOVEMENT_mm / speed) if speed else MAX_MOVEMENT_s
    t_s = np.arange(0.0, 2.0 * REST_s + duration_s, dt_s)
    distance_from_centre = 2.0 * np.sqrt(rng.random(count))
    bearing, direction = np.exp(2j * np.pi * rng.random((2, count)))
    centre = distance_from_centre * bearing
    distance = speed * (np.clip(t_s - REST_s, 0.0, duration_s) - 0.5 * duration_s)
    is_moving = (t_s > REST_s) & (t_s < REST_s + duration_s)
    return Paths(centre[:, None] + direction[:, None] * distance, is_moving)


class TrackedPaths(NamedTuple):
    """Paths that the tracker of isocharge estimates.

    Attributes:
        position: Positions x + iy, shape (n_path, n_frame), mm.
        std: Standard deviations of x and y, shape (n_path, n_frame, 2), mm.
        step_us: CPU time for each frame, us.
    """

    position: np.ndarray
    std: Array
    step_us: float


def track(contacts: list[list[Contact]], dt_s: float) -> TrackedPaths:
    """Follow the measured contacts of several paths.

    Args:
        contacts: Contact of each frame of each path.
        dt_s: Time between frames, s.
    """
    position = []
    std = []
    begin_s = time.thread_time()
    for path in contacts:
        tracker = Tracker(Setup(()))
        frames = [Frame(None, None, (), clock_s=number * dt_s, contact=contact) for number, contact in enumerate(path)]
        for frame in frames:
            tracker.step(frame)
        tracked = [frame.tracking.tracked for frame in frames]
        position.append([complex(contact.x_mm, contact.y_mm) for contact in tracked])
        std.append([(contact.x_std_mm, contact.y_std_mm) for contact in tracked])
    duration_s = time.thread_time() - begin_s
    positions = np.array(position)
    return TrackedPaths(positions, np.array(std), 1e6 * duration_s / positions.size)


def candidate_filters(at_rest: np.ndarray, is_settled: Booleans, std_mm: float, dt_s: float) -> dict[str, list[Smooth]]:
    """Return each of the other filters with several settings.

    Args:
        at_rest: Measured positions of contacts at rest, shape (n_path, n_frame), mm.
        is_settled: Whether the errors of each frame count, shape (n_frame,).
        std_mm: Typical standard deviation of the measured positions, mm.
        dt_s: Time between frames, s.
    """

    def jitter_mm(cutoff_Hz: float) -> float:
        """Return the standard deviation of the smoothed positions at rest."""
        return float(np.std(one_euro(cutoff_Hz, 0.0, dt_s)(at_rest)[:, is_settled]))

    # The cutoff frequency at rest is that which reduces the noise to a third.
    cutoffs_Hz = np.geomspace(0.5, 50.0, 8).tolist()
    rest_cutoff_Hz = min(cutoffs_Hz, key=lambda cutoff_Hz: abs(jitter_mm(cutoff_Hz) - std_mm / 3.0))
    return {
        "moving average": [moving_average(count) for count in range(1, 60, 2)],
        "1 euro": [one_euro(rest_cutoff_Hz, beta, dt_s) for beta in np.geomspace(0.01, 10.0, 10)],
        "plain Kalman": [kalman(density, std_mm, dt_s) for density in np.geomspace(10.0, 1e6, 11)],
    }


def measure_speed(asked: argparse.Namespace, predictor: Predictor, film: ForwardMap, speed: float) -> dict[str, float]:
    """Measure errors (rms of the distance, mm), lags (ms) and coverages of all filters at one speed, mm/s."""
    dt_s = 1.0 / asked.rate_hz
    rng = np.random.default_rng([asked.seed, int(speed)])
    paths = draw_paths(speed, asked.paths, dt_s, rng)
    true_position = paths.position
    force_N = np.full(true_position.shape, asked.force)
    true_contact = np.stack([true_position.real, true_position.imag, force_N], axis=-1).reshape(-1, 3)
    charge = noise_model(asked.noise).add(film.charges(true_contact), rng)
    columns = np.stack(predictor.predict_batch(charge)).astype(float).reshape(-1, *true_position.shape)
    contacts = [[Contact(*row) for row in path] for path in np.moveaxis(columns, 0, -1).tolist()]
    measured = Contacts(*columns)
    position = measured.x_mm + 1j * measured.y_mm
    typical_std_mm = float(np.median([measured.x_std_mm, measured.y_std_mm]))

    t_s = np.arange(true_position.shape[1]) * dt_s
    is_settled = t_s > SETTLING_TIME_s

    def error_mm(estimated: np.ndarray) -> float:
        """Return the root mean square of the distance from the true positions."""
        return float(np.sqrt(np.mean(np.abs(estimated - true_position)[:, is_settled] ** 2)))

    measured_at_rest = true_position[:, :1] + position - true_position
    estimates = {NO_FILTER: position}
    for name, filters in candidate_filters(measured_at_rest, is_settled, typical_std_mm, dt_s).items():
        estimates[name] = min((smooth(position) for smooth in filters), key=error_mm)
    tracked = track(contacts, dt_s)
    estimates[OURS] = tracked.position

    row: dict[str, float] = {"speed_mm_s": speed, "force_N": asked.force, "ours_step_us": tracked.step_us}
    for name, estimated in estimates.items():
        row[f"{name}_mm"] = error_mm(estimated)
        if speed:
            path_vector = true_position[:, -1] - true_position[:, 0]
            direction = path_vector / np.abs(path_vector)
            error_along_path = ((estimated - true_position) / direction[:, None]).real
            row[f"{name}_lag_ms"] = float(-1e3 * np.mean(error_along_path[:, paths.is_moving]) / speed)

    # Jitter before the movement, and the share of positions within the 95 % ellipses
    is_before = is_settled & (t_s < REST_s)
    row["ours_jitter_mm"] = float(np.sqrt(np.mean(np.var(tracked.position[:, is_before], axis=1)) / 2.0))
    error = tracked.position - true_position
    x_deviation, y_deviation = np.moveaxis(np.stack([error.real, error.imag], axis=-1) / tracked.std, -1, 0)
    correlation = measured.xy_correlation
    mixed_term = 2.0 * correlation * x_deviation * y_deviation
    squared_distance = (x_deviation**2 + y_deviation**2 - mixed_term) / (1.0 - correlation**2)
    row["ours_95"] = float(np.mean(squared_distance[:, is_settled] < MAX_SQUARED_DISTANCE_95))
    return row


def main() -> None:
    asked = options(__doc__, paths=40, rate_hz=1000.0, force=1.0, noise="reference", plot=None)
    predictor = Predictor(asked.model)
    film = model_film(predictor, 8.0)
    rows = [measure_speed(asked, predictor, film, speed) for speed in SPEEDS_mm_per_s]
    if asked.plot:
        moving = [row for row in rows if row["speed_mm_s"]]
        names = (NO_FILTER, "moving average", "1 euro", "plain Kalman", OURS)
        axes = new_figure(7.0, 4.5).subplots()
        for name in names:
            lag_ms = [row[f"{name}_lag_ms"] for row in moving]
            axes.plot(lag_ms, [row[f"{name}_mm"] for row in moving], "o-", label=name, ms=4)
        axes.set(xlabel="mean lag of a slide, ms", ylabel="error, rms, mm", title="slides of 5 to 200 mm/s")
        axes.legend(fontsize=8)
        axes.figure.savefig(asked.plot, dpi=120)
    print_results("track", asked, {"slides": rows})


if __name__ == "__main__":
    main()
