"""A press is taken with its true charge as soon as it is steady, and otherwise refused with a reason."""

import math
import re
from itertools import pairwise

import numpy as np
import pytest

from isocharge.serve.flags import RECONNECTED, SATURATED, TARE
from isocharge.serve.live import steady_press
from isocharge.serve.live.reading_stream import TimedReading
from isocharge.serve.live.steady_press import Phase, PressWatch
from isocharge.serve.port.device_clock import ReadingTime
from isocharge.serve.signal_chain.chain import Reading
from isocharge.serve.signal_chain.tare import Tare

RATE_HZ = 200.0
PRESS = np.array([800.0, 400.0, 300.0, 500.0])
NAMES = ("A", "B", "C", "D")


def readings(charge_pC, *, noise_pC=1.0, flags=None):
    """Yield readings of charges with noise, shape (n, 4), pC, in contact where the first charge is above 20 pC."""
    tare = Tare(np.zeros(4), np.full(4, noise_pC), 100)
    rng = np.random.default_rng(1)
    for k, clean in enumerate(charge_pC):
        noisy = clean + np.hypot(noise_pC, 0.002 * clean) * rng.standard_normal(4)
        contact = clean[0] > 20.0
        frame_flags = flags(k) if flags else ()
        has_tare = TARE not in frame_flags
        charge_pC = noisy if has_tare else None
        reading = Reading(noisy, charge_pC, tare, contact=contact and has_tare, flags=frame_flags)
        yield TimedReading(reading, ReadingTime(1e9 + k / RATE_HZ, round(1e6 * k / RATE_HZ), 1.0 / RATE_HZ))


def watched(*parts, **options):
    watch = PressWatch(NAMES)
    return [watch.feed(reading) for reading in readings(np.concatenate(parts), **options)]


def rest(seconds, level=0.0):
    return np.full((round(seconds * RATE_HZ), 4), level)


def held(seconds, change=lambda _: 1.0, press=PRESS):
    return np.array([press * change(k / RATE_HZ) for k in range(round(seconds * RATE_HZ))])


def taken_presses(results):
    """Return the presses that were taken."""
    return [result.press for result in results if result.press]


def events(seen):
    """Return the phases in their order, without repetitions."""
    phases = [result.phase.value for result in seen]
    return [phases[0], *(after for before, after in pairwise(phases) if after != before)]


def test_press_is_taken_once_and_the_next_press_after_a_lift():
    seen = watched(rest(1), held(2), rest(1), held(2, press=PRESS / 2), rest(1))
    assert events(seen) == ["waiting", "settling", "taken", "lift"] * 2 + ["waiting"]
    for press, clean in zip(taken_presses(seen), (PRESS, PRESS / 2), strict=True):
        standard_error = np.hypot(1.0, 0.002 * clean) * math.sqrt(1 / press.frames + 1 / 50)
        assert (np.abs(press.charge_pC - clean) < 4 * standard_error).all()
        np.testing.assert_allclose(press.scatter_pC, np.hypot(1.0, 0.002 * clean), rtol=0.35)
        assert press.held_s < 0.8
        assert press.frames == pytest.approx(100, abs=2)


def test_drift_before_the_touch_is_subtracted():
    """The amplifier has drifted by 9 pC since the tare, which is below the touch threshold."""
    (press,) = taken_presses(watched(rest(1, 9.0), held(2) + 9.0, rest(1, 9.0)))
    np.testing.assert_allclose(press.charge_pC, PRESS, atol=1.5)


def test_press_whose_force_rises_slowly_is_taken_later():
    """The force rises with a time constant of 0.4 s. The mean may be wrong by the largest allowed drift, 0.5 %."""
    (seen,) = [result for result in watched(rest(1), held(6, lambda t: 1 - math.exp(-t / 0.4))) if result.press]
    assert seen.held_s > 1.5
    np.testing.assert_allclose(seen.press.charge_pC, PRESS, rtol=0.01)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: math.exp(-t / 10.0), r"fall by (9\.\d|10) % per second on all .* \[leak\] tau_s = 10 "),
        (
            lambda t: 1.0 - 0.3 * math.log10(t + 0.01),
            r"fall by .* creeps, by (2[5-9]|3\d) % in each decade .* set no \[leak\]",
        ),
        (lambda t: 0.5 + 0.05 * t, r"rise by 5\.[67] % per second: hold the force"),
        (lambda t: np.array([1 + 0.03 * t, 1 - 0.03 * t, 1.0, 1.0]), "the press moves"),
        (lambda t: 1.0 + 0.1 * math.sin(40.0 * t), "the charge of A shakes by"),
    ],
)
def test_press_that_creeps_moves_or_shakes_is_refused_with_a_reason(change, reason):
    seen = watched(rest(1), held(9, change), rest(1))
    assert events(seen) == ["waiting", "settling", "refused", "lift", "waiting"]
    (refused,) = [result for result in seen if result.phase is Phase.refused]
    assert refused.reason.startswith("not steady within 8 s: ")
    assert re.search(reason, refused.reason), refused.reason


def test_reason_of_each_press_is_its_own_leak_or_creep_and_not_the_release():
    release = lambda t: min(1.0, 10.0 * (5.0 - t))  # noqa: E731
    leak = held(5, lambda t: release(t) * math.exp(-t / 5.0))
    creep = held(5, lambda t: release(t) * (1.0 - 0.3 * math.log10(t + 0.01)))
    seen = watched(rest(1), leak, rest(1), creep, rest(1), leak, rest(1))
    reasons = [result.reason for result in seen if result.phase is Phase.refused]
    for expected, reason in zip(("tau_s = 5 ", "the film creeps", "tau_s = 5 "), reasons, strict=True):
        assert expected in reason


def test_press_of_a_trembling_hand_is_taken():
    """The charge varies by 1 % at 9 Hz, and its mean is nevertheless correct."""
    (press,) = taken_presses(watched(rest(1), held(4, lambda t: 1 + 0.014 * math.sin(56.0 * t))))
    np.testing.assert_allclose(press.charge_pC, PRESS, rtol=0.005)


def test_press_without_a_rest_before_it_is_refused():
    """The charge at rest before the touch is unknown, so the touch charge could have any error."""
    seen = watched(rest(1), held(2), rest(0.05), held(2), rest(1))
    assert events(seen) == ["waiting", "settling", "taken", "lift", "waiting", "settling", "refused", "lift", "waiting"]
    assert "too soon" in next(result.reason for result in seen if result.phase is Phase.refused)


def test_short_press_is_refused_and_a_very_short_touch_is_ignored():
    seen = watched(rest(1), held(0.3), rest(1), held(0.05), rest(1))
    assert [result.reason for result in seen if result.phase is Phase.refused] == [
        "released after 0.3 s, before it was steady: hold it longer"
    ]
    assert not [result for result in seen if result.press]


def test_saturated_press_is_refused_and_the_next_press_is_taken():
    seen = watched(rest(1), held(2), rest(1), held(2), flags=lambda k: (SATURATED,) if k == 220 else ())
    assert events(seen) == ["waiting", "settling", "refused", "lift", "waiting", "settling", "taken", "lift"]
    assert [result.reason for result in seen if result.phase is Phase.refused] == [
        "an amplifier is at its limit: press less hard"
    ]


def test_press_is_refused_after_the_port_was_lost():
    """The film is tared again. Neither the press that was under way nor its continuation is taken."""
    words = lambda k: ((RECONNECTED,) if k == 220 else ()) + ((TARE,) if k < 50 or 220 <= k < 320 else ())  # noqa: E731
    seen = watched(rest(1), held(0.5), rest(1), held(2), flags=words)
    assert events(seen) == [
        "taring",
        "waiting",
        "settling",
        "refused",
        "taring",
        "waiting",
        "settling",
        "taken",
        "lift",
    ]
    assert "the port was away" in next(result.reason for result in seen if result.phase is Phase.refused)


def test_an_armed_watch_takes_no_press_that_has_begun():
    watch, seen = PressWatch(NAMES), []
    for k, reading in enumerate(readings(np.concatenate([rest(1), held(2), rest(1), held(2)]))):
        if k == 240:
            watch.arm()
        seen.append(watch.feed(reading))
    assert events(seen) == ["waiting", "settling", "lift", "waiting", "settling", "taken", "lift"]


def test_window_is_checked_ten_times_in_its_length_at_any_frame_rate(monkeypatch):
    calls = []
    monkeypatch.setattr(steady_press, "unsteadiness", lambda *_: calls.append(1) or "no")
    watched(rest(1), held(2.0))
    assert len(calls) == pytest.approx(10 * 1.5 / 0.5, abs=2)
