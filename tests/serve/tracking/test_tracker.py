"""The tracker: compared with the Kalman filter of a textbook, and on simulated slides, holds and taps."""

import json
import math

import numpy as np
import pytest
from msgspec import structs

from isocharge.serve import Contact, Predictor
from isocharge.serve.flags import INVALID
from isocharge.serve.model.model_folder import find_model, load_model
from isocharge.serve.record.record import TrackedContact
from isocharge.serve.tracking.motion_filter import (
    ACCELERATION_DENSITY,
    HELD_DRIFT_DENSITY,
    INITIAL_RATE_STD,
    LARGEST_STD,
    SPEED_CHANGE_RATE,
    MotionFilter,
)
from isocharge.serve.tracking.tracker import TouchEvents
from stage_runner import new_tracker, recorded_lines, track

STD = 0.06
"""Standard deviation of a simulated position, mm."""

LOG_FORCE_STD = 0.003
"""Standard deviation of the logarithm of a simulated force."""

RNG = np.random.default_rng(0)

X, Y, FORCE, X_STD, Y_STD = range(5)
"""Columns of an array of tracked contacts."""


def noisy_contacts(path, std=STD, correlation=0.6, force_N=1.0):
    """Yield noisy contacts along a path of positions x + iy, shape (n,), mm."""
    root = np.linalg.cholesky([[1.0, correlation], [correlation, 1.0]])
    noise = root @ RNG.standard_normal((2, len(path))) * std
    forces = force_N * np.exp(LOG_FORCE_STD * RNG.standard_normal(len(path)))
    for position, (x_error, y_error), force_N in zip(path, noise.T, forces, strict=True):
        yield Contact(
            x_mm=float(position.real + x_error),
            y_mm=float(position.imag + y_error),
            force_N=float(force_N),
            x_std_mm=std,
            y_std_mm=std,
            force_std_N=float(LOG_FORCE_STD * force_N),
            misfit=0.5,
            xy_correlation=correlation,
            xF_correlation=0.0,
            yF_correlation=0.0,
        )


def track_contacts(contacts):
    """Track contacts at 1 kHz, and return the tracked contacts, shape (n, 9)."""
    results = update_all(new_tracker(lasting=0.0), contacts, begin_s=0.0)
    return np.array([structs.astuple(tracked) for tracked, _ in results])


def update_all(tracker, contacts, begin_s, flags=()):
    """Track contacts at 1 kHz from a time on, s; return the results of all updates."""
    return [track(tracker, contact, begin_s + number / 1000.0, flags) for number, contact in enumerate(contacts)]


def events_of(results):
    """Return the events among the results of updates, each after the number of its frame."""
    return [(number, event) for number, (_, event) in enumerate(results) if event is not None]


def position_errors(tracked, path):
    """Return the errors of tracked positions as complex numbers, shape (n,), mm."""
    return tracked[:, X] + 1j * tracked[:, Y] - path


def slide(speed, rate_Hz=1000.0, direction=0.7):
    """Return the positions x + iy and times of a contact that rests, slides and rests, for 0.3 s each."""
    t = np.arange(0.0, 0.9, 1.0 / rate_Hz)
    return np.exp(1j * direction) * speed * np.clip(t - 0.3, 0.0, 0.3), t


def test_moving_mode_equals_the_kalman_filter_with_constant_velocity():
    """The reference has white acceleration (Bar-Shalom, Li and Kirubarajan 2001, 6.2.2), and is written in matrices."""
    dt = 0.01
    std = 0.1
    measured = RNG.standard_normal(30) * std + np.linspace(0.0, 1.0, 30)
    noise = np.diag([std**2, std**2, 1e-4])
    modes = MotionFilter(np.array([measured[0], 0.0, 0.0]), noise)
    only_moving = np.array([0.0, 0.0, 1e-9, 1.0])

    transition = np.array([[1.0, dt], [0.0, 1.0]])
    process_noise = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    drift = np.diag([HELD_DRIFT_DENSITY[0, 0] * dt, 0.0])
    mean = np.array([measured[0], 0.0])
    covariance = np.diag([std**2, INITIAL_RATE_STD[0] ** 2])
    for value in measured[1:]:
        density = ACCELERATION_DENSITY[0] + SPEED_CHANGE_RATE[0] * mean[1] ** 2
        mean = transition @ mean
        covariance = transition @ covariance @ transition.T + density * process_noise + drift
        gain = covariance[:, 0] / (covariance[0, 0] + std**2)
        mean = mean + gain * (value - mean[0])
        covariance = covariance - np.outer(gain, covariance[0])

        modes.probability = only_moving
        modes.step(dt, np.array([value, 0.0, 0.0]), noise)
        assert modes.mean[3, [0, 3]] == pytest.approx(mean, rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(modes.covariance[3][np.ix_([0, 3], [0, 3])], covariance, rtol=1e-6)


@pytest.mark.parametrize("noise_ratio", [0.2, 8.0])
def test_reported_std_adapts_to_a_board_whose_noise_differs_from_the_training(noise_ratio):
    """A slide of 10 mm/s. Without the estimate of the noise, the ratio of the variances would be 0.04 or 16."""
    path, _ = slide(10.0)
    squared_errors = []
    reported_variances = []
    for _ in range(2):
        contacts = noisy_contacts(path, std=noise_ratio * STD)
        settled = track_contacts(contact._replace(x_std_mm=STD, y_std_mm=STD) for contact in contacts)[100:]
        squared_errors.append(np.abs(position_errors(settled, path[100:])) ** 2)
        reported_variances.append(settled[:, X_STD] ** 2 + settled[:, Y_STD] ** 2)
    assert 0.33 < np.mean(squared_errors) / np.mean(reported_variances) < 2.0


@pytest.mark.parametrize(("rate_Hz", "lost_share"), [(200.0, 0.3), (100.0, 0.5), (30.0, 0.0)])
def test_irregular_times_and_the_beginning_of_a_slide_are_not_taken_for_noise(rate_Hz, lost_share):
    """A slide of 200 mm/s. With second differences for regular times, the ratio of squares would be 0.02 to 0.17."""
    normalised = []
    for _ in range(10):
        path, t = slide(200.0, rate_Hz)
        is_received = RNG.random(t.size) >= lost_share
        path, t = path[is_received], t[is_received]
        tracker = new_tracker(lasting=0.0)
        for contact, position, t_s in zip(noisy_contacts(path, correlation=0.0), path, t, strict=True):
            tracked, _ = track(tracker, contact, t_s)
            if 0.4 < t_s < 0.6:
                normalised.append((tracked.x_mm - position.real) / tracked.x_std_mm)
    assert 0.4 < np.mean(np.square(normalised)) < 1.5


@pytest.mark.parametrize("speed", [5.0, 200.0])
def test_slide_is_tracked_without_lag_and_better_than_by_any_moving_average(speed):
    path, t = slide(speed)
    is_moving = (t > 0.3) & (t < 0.6)
    measured = [[complex(contact.x_mm, contact.y_mm) for contact in noisy_contacts(path)] for _ in range(3)]
    errors = np.array([position_errors(track_contacts(noisy_contacts(path)), path) for _ in range(3)])
    lag_ms = -1e3 * np.mean((errors[:, is_moving] / np.exp(0.7j)).real) / speed
    assert abs(lag_ms) < (5.0 if speed >= 20.0 else 10.0)

    average_rms = []
    for count in range(1, 50):
        averages = [np.convolve(row, np.ones(count) / count)[: len(t)] for row in measured]
        average_rms.append(np.sqrt(np.mean(np.abs(averages - path)[:, 50:] ** 2)))
    assert np.sqrt(np.mean(np.abs(errors[:, 50:]) ** 2)) < min(average_rms)


def test_contact_that_is_lifted_and_pressed_elsewhere_is_tracked_within_three_frames():
    second = 4.0 - 3.0j
    tracked = track_contacts(noisy_contacts(np.where(np.arange(200) < 100, 0.0, second)))
    assert np.abs(position_errors(tracked[102:], second)).max() < 4.0 * STD


def test_single_outlier_is_ignored():
    tracked = track_contacts(noisy_contacts(np.where(np.arange(200) == 100, 3.0, 0.0)))
    assert np.abs(tracked[50:, [X, Y]]).max() < 2.0 * STD


def test_velocity_and_events_of_a_slide():
    path, _ = slide(50.0, direction=math.radians(40.0))
    tracker = new_tracker()
    results = update_all(tracker, noisy_contacts(path), begin_s=0.0)
    numbers, events = zip(*events_of(results), strict=True)
    assert events == ("press", "hold", "slide", "hold")
    assert np.array(numbers) / 1000.0 == pytest.approx([0.0, 0.2, 0.31, 0.8], abs=0.03)
    vx, vy = np.mean([(tracked.vx_mm_s, tracked.vy_mm_s) for tracked, _ in results[400:590]], axis=0)
    assert math.hypot(vx, vy) == pytest.approx(50.0, rel=0.03)
    assert math.degrees(math.atan2(vy, vx)) == pytest.approx(40.0, rel=0.03)

    last_tracked, _ = results[-1]
    assert track(tracker, None, 0.95, (INVALID,)) == (last_tracked, None)
    assert track(tracker, None, 1.0) == (None, "release")
    assert track(tracker, None, 1.05) == (None, None)


def test_event_release_of_a_short_slide():
    tracker = new_tracker()
    swipe = update_all(tracker, noisy_contacts(0.1 * np.arange(100)), begin_s=2.0)
    assert [event for _, event in events_of(swipe)] == ["press", "slide"]
    assert track(tracker, None, 2.1) == (None, "release")


def test_long_touch_without_hold_or_slide_is_no_tap():
    """It is uncertain whether the contact moves or rests."""
    tracked = TrackedContact(0.0, 0.0, 1.0, STD, STD, 0.003, 0.0, 0.0, moving=0.7)
    events = TouchEvents(tracked, 10.0)
    assert events.step(tracked, 10.5) is None
    assert events.end(10.5) == "release"


def test_touch_during_a_tare_has_one_press_and_one_end(film, predictor):
    force_N = np.repeat([0.0, 0.5, 0.0], [50, 500, 50])
    charge = film.charge_pC(np.full(600, 2.0), np.full(600, -3.0), force_N)
    noisy_charge = charge + np.random.default_rng(0).standard_normal(charge.shape)
    lines = recorded_lines(predictor, noisy_charge, {"track": {}}, {300: lambda touch: touch.tare()})
    events = [json.loads(line)["event"] for line in lines]
    assert [event for event in events if event in ("press", "tap", "release")] == ["press", "release"]


def test_frames_with_the_same_time_are_smoothed():
    """A board at 1 kHz states its time in units of 10 ms."""
    tracker = new_tracker(lasting=0.0)
    tracked = [
        track(tracker, contact, 1e-2 * (number // 10))[0]
        for number, contact in enumerate(noisy_contacts(np.zeros(600)))
    ]
    assert np.std([contact.x_mm for contact in tracked[300:]]) < 0.2 * STD
    assert np.mean([contact.moving for contact in tracked[300:]]) < 0.1


@pytest.mark.parametrize("name", ["eight-25um-biaxial", "three-25um-biaxial"])
def test_slow_press_of_a_released_model_is_tracked_from_its_first_frame(name):
    """The first frames state up to 1e5 mm, with correlations that rounding makes indefinite."""
    predictor = Predictor(find_model(name))
    charges = load_model(predictor.folder).golden.charge_pC.astype(float)
    presses = [charge for charge in charges if not predictor.flags(predictor.predict(charge))][:8]
    size = np.minimum(np.arange(1, 101) / 60.0, 1.0)[:, None] ** 2
    for charge in presses:
        frames = charge * size + RNG.standard_normal((100, len(charge)))
        tracker = new_tracker()
        tracked = [track(tracker, predictor.predict(frame), 0.005 * k)[0] for k, frame in enumerate(frames)]
        truth = predictor.predict(charge)
        assert np.isfinite([structs.astuple(contact) for contact in tracked]).all()
        assert abs(tracked[-1].x_mm - truth.x_mm) < 4.0 * tracked[-1].x_std_mm


def test_filter_whose_covariance_has_a_negative_eigenvalue_takes_no_frame():
    motion = MotionFilter(np.zeros(3), -np.eye(3))
    assert not motion.step(0.0, np.ones(3), 0.1 * np.eye(3))
    np.testing.assert_array_equal(motion.mean, 0.0)


def test_saturated_frames_have_a_small_weight():
    tracker = new_tracker()
    update_all(tracker, noisy_contacts(np.zeros(100)), begin_s=0.0)
    moved = update_all(tracker, noisy_contacts([0.5] * 5), begin_s=0.1, flags=("saturated",))
    assert max(tracked.x_mm for tracked, _ in moved) < 0.1


def test_frames_after_those_with_a_flag_have_the_std_of_their_noise():
    squared_ratios = []
    for _ in range(8):
        tracker = new_tracker(lasting=0.0)
        update_all(tracker, noisy_contacts(np.zeros(500)), 0.0, ("misfit",))
        results = update_all(tracker, noisy_contacts(np.zeros(100)), 0.5)
        squared_ratios += [(tracked.x_mm / tracked.x_std_mm) ** 2 for tracked, _ in results]
    assert np.mean(squared_ratios) < 2.0


def test_records_with_track_only_add_fields(film, predictor):
    rest = np.zeros((10, 3))
    noise = np.random.default_rng(0).standard_normal((30, 3))
    rows = np.concatenate([rest, film.charges(np.array([[2.0, -3.0, 0.5]])) + noise, rest])

    plain, tracked = ([*map(json.loads, recorded_lines(predictor, rows, table))] for table in ({}, {"track": {}}))
    assert (abs(tracked[39]["tracked"]["x_mm"] - 2.0) < 0.05, tracked[40]["event"]) == (True, "tap")
    for record, plain_record in zip(tracked, plain, strict=True):
        assert (record["tracked"] is None) == (not record["contact"])
        assert record == plain_record | {name: record[name] for name in ("tracked", "event", "other")}


def test_contact_with_very_small_and_very_large_standard_deviations_is_tracked():
    contacts = noisy_contacts(np.zeros(100), correlation=0.99999)
    assert np.isfinite(track_contacts(contact._replace(x_std_mm=1e-9, y_std_mm=1e9) for contact in contacts)).all()


def test_rounding_errors_make_no_variance_negative():
    """The errors are correlated and of very different sizes. The short form of the Kalman update fails for them."""
    rng = np.random.default_rng(0)

    def covariance():
        root = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-2.5, 0.0, (3, 1))
        scaled_root = root * LARGEST_STD * 10.0 ** rng.uniform(-5.0, 0.0, 3)
        return scaled_root.T @ scaled_root

    for _ in range(50):
        motion = MotionFilter(np.zeros(3), covariance())
        for dt_s in rng.choice([0.0, 0.5], 8):
            motion.step(dt_s, np.zeros(3), covariance())
        assert np.diagonal(motion.covariance, axis1=1, axis2=2).min() > 0.0


def test_rapidly_rising_force_is_followed():
    forces_N = np.linspace(0.05, 0.45, 20)
    tracked = track_contacts(noisy_contacts(np.zeros(20), force_N=forces_N))
    np.testing.assert_allclose(tracked[:, FORCE], forces_N, rtol=0.05)
