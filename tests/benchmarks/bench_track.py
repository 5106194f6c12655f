"""Contacts followed in time, by isocharge and by other filters: the table of serve/docs/tracking_results.md.

    python tests/benchmarks/bench_track.py [--model NAME|PATH] [--paths 40] [--noise reference]

A contact of 1 N is at rest, then moves at a constant speed for 0.3 s or 8 mm, and is at rest again. The paths lie at
random positions of the inner working area. The charges of 1000 frames per second are simulated with noise, and the
filters smooth the contacts of the model. The filters are:

- the 1 euro filter (Casiez et al. 2012), adjusted by the rule of its authors: first the cutoff frequency at rest, then
  beta;
- a Kalman filter for a constant velocity with white acceleration;
- the tracker of isocharge.

The first two filters have the best setting for each speed. The tracker of isocharge has the same setting for all.
"""

import argparse
import time
from functools import partial

import msgspec
import numpy as np
from scipy.special import chdtri
from shared import model_film, options, print_results, track_contacts, whitened_errors

from isocharge.serve import Predictor
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.tracking.tracker import Tracker
from isocharge.simulate import ForwardMap, noise_model
from isocharge.train.data.contact_errors import rms

SPEEDS_mm_per_s = (0.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
"""Speeds of the moving contacts, mm/s."""

FORCE_N = 1.0
DT_s = 1e-3
"""Time between frames, s."""

REST_s = 0.3
"""Time at rest before and after the movement, s."""

MAX_MOVEMENT_s = 0.3
"""Longest duration of a movement, s."""

MAX_MOVEMENT_mm = 8.0
"""Longest movement, mm."""

SETTLING_TIME_s = 0.05
"""Time after the press from which errors count, s."""


def one_euro(position: np.ndarray, cutoff_Hz: float, beta: float) -> np.ndarray:
    """Smooth positions by the 1 euro filter (Casiez, Roussel and Vogel 2012, algorithms 1 and 2).

    Args:
        position: Positions x + iy, shape (n_path, n_frame), mm.
        cutoff_Hz: Cutoff frequency at rest, Hz.
        beta: Increase of the cutoff frequency with the speed, 1/mm.
    """

    def smoothing_factor(cutoff_Hz: np.ndarray | float) -> np.ndarray | float:
        return 1.0 / (1.0 + 1.0 / (2.0 * np.pi * cutoff_Hz * DT_s))

    smoothed = position.copy()
    velocity = np.zeros(len(position), complex)
    for frame in range(1, position.shape[1]):
        innovation = position[:, frame] - smoothed[:, frame - 1]
        velocity += smoothing_factor(1.0) * (innovation / DT_s - velocity)
        factor = smoothing_factor(cutoff_Hz + beta * np.abs(velocity))
        smoothed[:, frame] = smoothed[:, frame - 1] + factor * innovation
    return smoothed


def kalman(position: np.ndarray, density: float, std_mm: float) -> np.ndarray:
    """Smooth positions by a Kalman filter for a constant velocity with white acceleration.

    Args:
        position: Positions x + iy, shape (n_path, n_frame), mm.
        density: Power spectral density of the acceleration, mm^2/s^3.
        std_mm: Standard deviation of the measured positions, mm.
    """
    initial_velocity_variance = 1600.0  # mm^2/s^2
    transition = np.array([[1.0, DT_s], [0.0, 1.0]])
    process_noise = density * np.array([[DT_s**3 / 3.0, DT_s**2 / 2.0], [DT_s**2 / 2.0, DT_s]])
    smoothed = position.copy()
    velocity = np.zeros(len(position), complex)
    covariance = np.diag([std_mm**2, initial_velocity_variance])  # of position and velocity
    for frame in range(1, position.shape[1]):
        covariance = transition @ covariance @ transition.T + process_noise
        predicted = smoothed[:, frame - 1] + velocity * DT_s
        innovation = position[:, frame] - predicted
        gain = covariance[:, 0] / (covariance[0, 0] + std_mm**2)
        smoothed[:, frame] = predicted + gain[0] * innovation
        velocity = velocity + gain[1] * innovation
        covariance = covariance - np.outer(gain, covariance[0])
    return smoothed


def draw_paths(speed: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw paths with random centres within 2 mm of the centre of the film, and with random directions.

    Args:
        speed: Speed of the movement, mm/s.
        count: Number of paths.
        rng: Random number generator.

    Returns:
        Positions x + iy, shape (count, n_frame), mm.
    """
    duration_s = min(MAX_MOVEMENT_s, MAX_MOVEMENT_mm / speed) if speed else MAX_MOVEMENT_s
    t_s = np.arange(0.0, 2.0 * REST_s + duration_s, DT_s)
    distance_from_centre = 2.0 * np.sqrt(rng.random(count))
    bearing, direction = np.exp(2j * np.pi * rng.random((2, count)))
    distance = speed * (np.clip(t_s - REST_s, 0.0, duration_s) - 0.5 * duration_s)
    return (distance_from_centre * bearing)[:, None] + direction[:, None] * distance


def best_rivals(
    measured: np.ndarray, truth: np.ndarray, is_settled: np.ndarray, std_mm: float
) -> dict[str, np.ndarray]:
    """Return the positions of each of the other filters with its best setting.

    Args:
        measured: Measured positions x + iy, shape (n_path, n_frame), mm.
        truth: True positions, of the same shape.
        is_settled: Whether the errors of each frame count, shape (n_frame,).
        std_mm: Typical standard deviation of the measured positions, mm.
    """
    at_rest = truth[:, :1] + measured - truth

    def jitter_mm(cutoff_Hz: float) -> float:
        """Return the standard deviation of the smoothed positions at rest."""
        return float(np.std(one_euro(at_rest, cutoff_Hz, 0.0)[:, is_settled]))

    def error_mm(smoothed: np.ndarray) -> float:
        return rms(np.abs(smoothed - truth)[:, is_settled])

    # The cutoff frequency at rest is that which reduces the noise to a third.
    cutoffs_Hz = np.geomspace(0.5, 50.0, 8).tolist()
    rest_cutoff_Hz = min(cutoffs_Hz, key=lambda cutoff_Hz: abs(jitter_mm(cutoff_Hz) - std_mm / 3.0))
    one_euro_positions = (one_euro(measured, rest_cutoff_Hz, beta) for beta in np.geomspace(0.01, 10.0, 10))
    kalman_positions = (kalman(measured, density, std_mm) for density in np.geomspace(10.0, 1e6, 11))
    return {"1 euro": min(one_euro_positions, key=error_mm), "Kalman": min(kalman_positions, key=error_mm)}


def measure_speed(asked: argparse.Namespace, predictor: Predictor, film: ForwardMap, speed: float) -> dict[str, float]:
    """Measure errors (rms of the distance, mm), jitter, lag and coverage at one speed, mm/s."""
    rng = np.random.default_rng([asked.seed, int(speed)])
    position = draw_paths(speed, asked.paths, rng)
    truth = np.stack([position.real, position.imag, np.full(position.shape, FORCE_N)], axis=-1)
    charge = noise_model(asked.noise).add(film.charges(truth.reshape(-1, 3)), rng)
    outputs = np.stack(predictor.predict_batch(charge), axis=1).astype(float)
    paths = outputs.reshape(*position.shape, -1)
    measured = paths[:, :, 0] + 1j * paths[:, :, 1]

    t_s = np.arange(position.shape[1]) * DT_s
    is_settled = t_s > SETTLING_TIME_s
    estimates = {"none": measured}
    estimates |= best_rivals(measured, position, is_settled, float(np.median(outputs[:, 3:5])))

    tracker = Tracker(Setup(()))
    begin_s = time.thread_time()
    tracking = [
        frame
        for path, path_charge in zip(paths, np.split(charge, len(paths)), strict=True)
        for frame in track_contacts(tracker, t_s, path, path_charge)
    ]
    duration_s = time.thread_time() - begin_s
    tracked = np.array([msgspec.structs.astuple(frame.tracked)[:6] for frame in tracking])
    estimates["ours"] = (tracked[:, 0] + 1j * tracked[:, 1]).reshape(position.shape)

    row = {"speed_mm_s": speed, "ours_step_us": 1e6 * duration_s / len(tracked)}
    is_before = is_settled & (t_s < REST_s)
    for name, estimate in estimates.items():
        row[f"{name}_mm"] = rms(np.abs(estimate - position)[:, is_settled])
        row[f"{name}_jitter_mm"] = float(np.sqrt(np.mean(np.var(estimate[:, is_before], axis=1)) / 2.0))
    if speed:
        steps = np.diff(position)
        is_moving = np.abs(steps[0]) > 0.0
        direction = steps[:, is_moving] / np.abs(steps[:, is_moving])
        error_along_path = ((estimates["ours"] - position)[:, 1:][:, is_moving] / direction).real
        row["ours_lag_ms"] = -1e3 * float(np.mean(error_along_path)) / speed

    errors = whitened_errors(tracked[:, :3], truth.reshape(-1, 3), tracked[:, 3:6], outputs[:, 7:10])
    squared_distance = np.sum(errors[:, :2] ** 2, axis=1).reshape(position.shape)
    row["ours_95"] = float(np.mean(squared_distance[:, is_settled] < chdtri(2, 0.05)))
    return row


def main() -> None:
    asked = options(__doc__, paths=40, noise="reference")
    predictor = Predictor(asked.model)
    measure = partial(measure_speed, asked, predictor, model_film(predictor, 8.0))
    print_results("track", asked, {"slides": [measure(speed) for speed in SPEEDS_mm_per_s]})


if __name__ == "__main__":
    main()
