"""Contacts followed through time: against a textbook's Kalman filter, planted paths and taps, and honest deviations."""

import json
import math

import numpy as np
import pytest
from msgspec import structs
from scipy.signal import lfilter

from isocharge.serve import Chunk, Contact, Device, Frame, TouchStream, encode_frame
from isocharge.serve.flags import INVALID
from isocharge.serve.live.device import device_from_table, with_settings
from isocharge.serve.tracking.modes import CALMEST, Modes, Movement
from isocharge.serve.tracking.noise import LINE, Scatter, Shape
from isocharge.serve.tracking.tracker import PLACE, Tracker, TrackRule

STD, TRACK = 0.06, {"track": {}}
RNG = np.random.default_rng(0)


def contacts(path, std=STD, correlation=0.6, force=1.0):
    """Noisy answers about true places, complex numbers of shape (n,), mm."""
    noise = np.linalg.cholesky([[1.0, correlation], [correlation, 1.0]]) @ RNG.standard_normal((2, len(path))) * std
    forces = force * np.exp(0.003 * RNG.standard_normal(len(path)))
    for place, (dx, dy), newtons in zip(path, noise.T, forces, strict=True):
        values = (place.real + dx, place.imag + dy, newtons, std, std, 0.003 * newtons, 0.5, correlation, 0.0, 0.0)
        yield Contact(*map(float, values))


def followed(path, rate_Hz=1000.0, **options):
    """What a tracker says of a path, and the events with their frames."""
    return followed_all(contacts(path, **options), rate_Hz)


def followed_all(answers, rate_Hz=1000.0):
    """The same of answers."""
    tracker = Tracker(TrackRule(lasting=0.0))
    answers = [tracker.update(one, k / rate_Hz) for k, one in enumerate(answers)]
    contacts = np.array([structs.astuple(tracked) for tracked, _ in answers])
    return contacts, [(k, event) for k, (_, event) in enumerate(answers) if event]


def slide(speed, rate_Hz=1000.0, turn=0.7):
    """At rest for 0.3 s, then as long at a speed, mm/s, then at rest."""
    t = np.arange(0.0, 0.9, 1.0 / rate_Hz)
    return np.exp(1j * turn) * speed * np.clip(t - 0.3, 0.0, 0.3), t


def test_the_moving_mode_alone_is_the_kalman_filter_of_the_textbook():
    """Constant velocity with white acceleration (Bar-Shalom, Li, Kirubarajan 2001, 6.2.2), in matrices."""
    dt, speed, std, movement = 0.01, 400.0, 0.1, Movement(0.0, 400.0, 50.0)
    measured = RNG.standard_normal(30) * std + np.linspace(0.0, 1.0, 30)
    modes = Modes.start(measured[0], std**2, movement)
    transition, noise = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    mean, cov = np.array([measured[0], 0.0]), np.diag([std**2, speed])
    for value in measured[1:]:
        change = movement.change * max(mean[1] ** 2 / speed, CALMEST)
        mean, cov = transition @ mean, transition @ cov @ transition.T + change * noise
        gain = cov[:, 0] / (cov[0, 0] + std**2)
        mean, cov = mean + gain * (value - mean[0]), cov - np.outer(gain, cov[0])
        modes.moving, modes.scatter = 1.0 - 1e-9, Scatter.start(0j)
        modes.step(value, dt, LINE, std**2)
        assert (modes.place.real, modes.velocity.real) == pytest.approx(tuple(mean), rel=1e-6, abs=1e-6)
        got = [modes.variance, modes.covariance, modes.velocity_variance]
        assert got == pytest.approx([cov[0, 0], cov[0, 1], cov[1, 1]], rel=1e-6)


@pytest.mark.parametrize(("louder", "left"), [(0.2, 0.0), (1.0, 0.0), (3.0, 0.0), (1.0, 0.5)])
def test_the_scatter_of_frames_is_learned_while_the_contact_slides(louder, left):
    """Noise of known size, of which `left` is left after 1 ms, on a slide of 50 mm/s, at uneven times."""
    (shape, variance), learned = Shape.of_place(STD, STD, 0.6), []
    for _ in range(10):
        white = [complex(one.x_mm, one.y_mm) for one in contacts(np.zeros(1500), std=louder * STD)]
        places = lfilter([math.sqrt(1.0 - left**2)], [1.0, -left], white) + 0.05 * np.arange(1500)
        at_ms = np.cumsum(RNG.choice([1, 2, 5], 500))
        modes, at = Modes.start(places[at_ms[0]], variance, PLACE), at_ms[0]
        for ms in at_ms[at_ms < 1500]:
            if ms > at and modes.step(places[ms], 1e-3 * (ms - at), shape, variance):
                at = ms
        learned.append(modes.scatter.variance)
    assert np.mean(learned) == pytest.approx(louder**2, rel=0.15, abs=0.02)


def test_a_board_quieter_or_louder_than_the_model_says_is_followed_accordingly():
    """A slide of 10 mm/s: errors and deviations go with the noise."""
    path, _ = slide(10.0)
    for louder in (0.2, 4.0):
        errors, said = [], []
        for _ in range(10):
            noisy = contacts(path, std=louder * STD)
            found, _ = followed_all(one._replace(x_std_mm=STD, y_std_mm=STD) for one in noisy)
            errors.append(abs(found[100:, 0] + 1j * found[100:, 1] - path[100:]) ** 2)
            said.append(found[100:, 3] ** 2 + found[100:, 4] ** 2)
        assert 0.33 < np.mean(errors) / np.mean(said) < 2.0  # variances; as stated it would be 0.04, 16


def test_a_held_contact_is_quiet_and_its_deviations_hold():
    errors = []
    for _ in range(20):
        found, _ = followed(np.zeros(400))
        errors.append(found[50:])
    errors = np.concatenate(errors)
    assert np.sqrt(np.mean(errors[:, :2] ** 2)) < 0.2 * STD
    assert np.mean(np.abs(errors[:, 0]) < 1.96 * errors[:, 3]) > 0.93
    np.testing.assert_array_equal(errors[:, 4], errors[:, 3])  # of y as of x, as those of the frames


@pytest.mark.parametrize("speed", [5.0, 20.0, 50.0, 200.0])
def test_a_slide_is_followed_without_lag_and_better_than_any_moving_average(speed):
    path, t = slide(speed)
    moves, along, errors, raw = (t > 0.3) & (t < 0.6), np.exp(0.7j), [], []
    for _ in range(20):
        found, _ = followed(path)
        errors.append(found[:, 0] + 1j * found[:, 1] - path)
        raw.append([complex(*one[:2]) for one in contacts(path)])
    lag_ms = -1e3 * np.mean((np.array(errors)[:, moves] / along).real) / speed
    assert abs(lag_ms) < (5.0 if speed >= 20.0 else 10.0)
    averages = [
        np.sqrt(np.mean([np.abs(np.convolve(one, np.ones(n) / n)[: len(t)] - path)[50:] ** 2 for one in raw]))
        for n in range(1, 50)
    ]
    assert np.sqrt(np.mean(np.abs(np.array(errors)[:, 50:]) ** 2)) < min(averages)


def test_lifted_and_pressed_elsewhere_it_follows_within_three_frames():
    found, _ = followed(np.where(np.arange(200) < 100, 0.0, 4.0 - 3.0j))
    assert np.abs(found[102:, 0] + 1j * found[102:, 1] - (4.0 - 3.0j)).max() < 4.0 * STD


def test_a_slide_of_a_millimetre_in_a_frame_is_followed_at_once():
    """200 mm/s at 200 Hz: what begins to move is no frame far off."""
    path, _ = slide(200.0, rate_Hz=200.0)
    found, _ = followed(path, rate_Hz=200.0)
    assert np.abs(found[:, 0] + 1j * found[:, 1] - path).max() < 5.0 * STD


def test_one_frame_far_off_does_not_count():
    found, _ = followed(np.where(np.arange(200) == 100, 3.0, 0.0))
    assert np.abs(found[50:, :2]).max() < 2.0 * STD


def test_what_the_touch_does():
    """A tap; then a press that holds, slides at 50 mm/s along 40 degrees, holds and is released."""
    path, _ = slide(50.0, turn=math.radians(40.0))
    _, events = followed(path)
    assert [event for _, event in events] == ["press", "hold", "slide", "hold"]
    assert [frame / 1000.0 for frame, _ in events] == pytest.approx([0.0, 0.2, 0.31, 0.8], abs=0.03)
    tracker = Tracker()
    said = [tracker.update(one, k / 1000.0) for k, one in enumerate(contacts(path))]
    moving = np.mean([(one.vx_mm_s, one.vy_mm_s) for one, _ in said[400:590]], axis=0)
    assert (np.hypot(*moving), np.degrees(np.arctan2(*moving[::-1]))) == pytest.approx((50.0, 40.0), rel=0.03)
    assert tracker.update(None, 0.85, (INVALID,)) == (said[-1][0], None)
    assert tracker.update(None, 0.9) == (None, "release")
    assert tracker.update(None, 0.95) == (None, None)
    tap = [tracker.update(one, 1.0 + k / 1000.0)[1] for k, one in enumerate(contacts(np.zeros(100)))]
    assert [*filter(None, tap), tracker.update(None, 1.1)[1]] == ["press", "tap"]
    swipe = [tracker.update(one, 2.0 + k / 1000.0)[1] for k, one in enumerate(contacts(0.1 * np.arange(100)))]
    assert [*filter(None, swipe), tracker.update(None, 2.1)[1]] == ["press", "slide", "release"]


def test_a_saturated_frame_counts_for_less():
    tracker = Tracker()
    for k, one in enumerate(contacts(np.zeros(100))):
        tracker.update(one, k / 1000.0)
    moved = [tracker.update(one, 0.1 + k / 1000.0, ("saturated",))[0].x_mm for k, one in enumerate(contacts([0.5] * 5))]
    assert max(moved) < 0.1


def test_records_carry_it_beside_the_answer_of_the_frame_and_repeat_bit_for_bit(film, predictor):
    """The record without tracking is the beginning of the record with it."""
    rest, rng = np.zeros((10, 3)), np.random.default_rng(0)
    pressed = film.charge_pC(np.full(30, 2.0), np.full(30, -3.0), np.full(30, 0.5)) + rng.standard_normal((30, 3))
    frames = [
        Frame(k, 1000 * k, tuple(row)) for k, row in enumerate([*rest.tolist(), *pressed.tolist(), *rest.tolist()])
    ]
    chunks = [Chunk(encode_frame(frame), 5.0 + 1e-3 * k, 0) for k, frame in enumerate(frames)]
    table = {"tare": {"frames": 10}}

    def lines(device):
        touch = TouchStream(predictor, device, now_ns=lambda: 0)
        return [record.to_json() for chunk in chunks for record in touch.feed(chunk)]

    plain, first, again = map(lines, (device_from_table(table, "b"), *[device_from_table(table | TRACK, "b")] * 2))
    assert first == again
    assert [json.loads(line)["event"] for line in first].count("press") == 1
    assert json.loads(first[40])["event"] == "tap"
    for mine, theirs in zip(map(json.loads, first), map(json.loads, plain), strict=True):
        tracked, *none = (mine.pop(name) for name in ("tracked", "other", "event"))
        assert mine == theirs
        assert (tracked is None) == (not mine["contact"])
        assert none[0] is None
    assert abs(json.loads(first[39])["tracked"]["x_mm"] - 2.0) < 0.05


def test_the_device_file_switches_it_on_and_a_recording_keeps_it():
    assert Device().track is None
    assert device_from_table({"track": {"lasting": 0.9}}, "b").track == TrackRule(lasting=0.9)
    assert with_settings(device_from_table({}, "b"), "track", on=True).table == {"track": {"on": True}}
