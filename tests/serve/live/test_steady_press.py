"""Tests of the press watch: a steady press is taken with its true charge, and other presses are refused."""

import math
import re
from itertools import groupby, islice

import numpy as np
import pytest

from isocharge.serve import Frame
from isocharge.serve.flags import NEGATIVE, RECONNECTED, RESTART, SATURATED, TARE
from isocharge.serve.live.steady_press import Phase, PressWatch

RATE_HZ = 200.0
"""Number of frames per second, Hz."""

PRESS = np.array([800.0, 400.0, 300.0, 500.0])
"""Touch charges of a press, shape (4,), pC."""

NAMES = ("A", "B", "C", "D")


def noise_std(charge_pC):
    """Return the standard deviations of noisy charges, shape (4,), pC."""
    return np.hypot(1.0, 0.002 * charge_pC)


def readings(charge_pC, flags):
    """Yield noisy readings. Something touches if the first charge is above 20 pC.

    Args:
        charge_pC: Charges without noise, shape (n, 4), pC.
        flags: Flags of some frames by their numbers.
    """
    noisy_pC = np.random.default_rng(1).normal(charge_pC, noise_std(charge_pC))
    for number, reading_pC in enumerate(noisy_pC):
        frame = Frame(number, round(1e6 * number / RATE_HZ), (), clock_s=number / RATE_HZ)
        frame.flags = list(flags.get(number, ()))
        if TARE not in frame.flags:
            frame.charge_pC = reading_pC
            frame.is_contact = charge_pC[number, 0] > 20.0
        frame.noise_pC = np.ones(4)
        yield frame


def watch_presses(*parts, flags=None, armed_frame=None, every=1):
    """Return the results of a press watch for the readings of successive parts; see `rest` and `held`.

    The watch is armed before the frame with the number `armed_frame`, and gets only every frame of a number `every`.
    """
    watch = PressWatch(NAMES)
    results = []
    for reading in islice(readings(np.concatenate(parts), flags or {}), 0, None, every):
        if reading.seq == armed_frame:
            watch.arm()
        results.append(watch.feed(reading))
    return results


def rest(seconds, level=0.0):
    """Return the charges of a film at rest, shape (n, 4), pC."""
    return np.full((round(seconds * RATE_HZ), 4), level)


def held(seconds, change=lambda _: 1.0, press=PRESS):
    """Return the charges of a press, shape (n, 4), pC, multiplied by a function of the time since the touch, s."""
    return np.array([press * change(number / RATE_HZ) for number in range(round(seconds * RATE_HZ))])


def taken_presses(results):
    """Return the presses that were taken."""
    return [result.press for result in results if result.press]


def phases_of(results):
    """Return the phases in their order, without repetitions, as one text."""
    return " ".join(phase.value for phase, _ in groupby(result.phase for result in results))


def test_press_is_taken_once_and_the_next_press_after_a_lift():
    results = watch_presses(rest(1), held(2), rest(1), held(2, press=PRESS / 2), rest(1), flags={250: (NEGATIVE,)})
    assert phases_of(results) == "waiting settling taken lift waiting settling taken lift waiting"
    for press, clean_pC in zip(taken_presses(results), (PRESS, PRESS / 2), strict=True):
        standard_error_pC = noise_std(clean_pC) * math.sqrt(1 / 100 + 1 / 50)  # of 100 frames, and of 50 frames at rest
        assert (np.abs(press.charge_pC - clean_pC) < 4 * standard_error_pC).all()
        assert press.held_s < 0.8
    assert [press.flags for press in taken_presses(results)] == [(NEGATIVE,), ()]


@pytest.mark.parametrize("every", [1, 10])
def test_drift_before_the_touch_is_subtracted(every):
    """The amplifier has drifted by 9 pC since the tare, which is below the touch threshold.

    The board sends 200 or 20 frames per second.
    """
    (press,) = taken_presses(watch_presses(rest(1, 9.0), held(2) + 9.0, rest(1, 9.0), every=every))
    np.testing.assert_allclose(press.charge_pC, PRESS, atol=2.0)


def test_press_whose_force_rises_slowly_is_taken_later():
    """The force rises with a time constant of 0.4 s. The mean may be wrong by the largest allowed drift, 0.5 %."""
    rising_press = held(6, lambda t: 1 - math.exp(-t / 0.4))
    (press,) = taken_presses(watch_presses(rest(1), rising_press))
    assert press.held_s > 1.5
    np.testing.assert_allclose(press.charge_pC, PRESS, rtol=0.01)


LOST_PORT = dict.fromkeys((*range(50), *range(220, 320)), (TARE,)) | {220: (RECONNECTED, TARE)}
"""Flags of the frames if the port is lost during a press. The film is then tared again."""


def leaking(t):
    """Return the share of a charge that has not leaked after some time, s, with a time constant of 10 s."""
    return math.exp(-t / 10.0)


def moving(t):
    return np.array([1.0, 1 + 0.05 * t, 1.0, 1.0])


def shaking(t):
    return 1.0 + 0.1 * math.sin(40.0 * t)


def leaking_and_released(t):
    """The force falls to 0 in the last tenth of 5 s, which is not the reason of the refusal."""
    return min(1.0, 10.0 * (5.0 - t)) * leaking(2.0 * t)


@pytest.mark.parametrize(
    ("parts", "flags", "phases", "reason"),
    [
        *(
            (
                [rest(1), held(9, change), rest(1)],
                {},
                "waiting settling refused lift waiting",
                f"not steady within 8 s: {reason}",
            )
            for change, reason in (
                (leaking, r"the charge of . changes by -\d+ pC per second .* isocharge serve doctor"),
                (moving, r"the charge of B changes by (1[89]|2[0-2]) pC per second"),
                (shaking, "the charge of A shakes by"),
            )
        ),
        (
            [rest(1), held(5, leaking_and_released), rest(1)],
            {},
            "waiting settling refused waiting",
            r"released after .* the charge of . changes by -\d+ pC per second",
        ),
        # The charge at rest before the second touch is unknown, so its touch charge could have any error.
        (
            [rest(1), held(2), rest(0.05), held(2), rest(1)],
            {},
            "waiting settling taken lift waiting settling refused lift waiting",
            "pressed too soon",
        ),
        # The second touch is very short and is ignored.
        (
            [rest(1), held(0.3), rest(1), held(0.05), rest(1)],
            {},
            "waiting settling refused waiting settling waiting",
            "released after 0.3 s, before it was steady: hold it longer",
        ),
        (
            [rest(1), held(2), rest(1), held(2)],
            {220: (SATURATED,)},
            "waiting settling refused lift waiting settling taken lift",
            "an amplifier is at its limit: press less hard",
        ),
        (
            [rest(1), held(0.5), rest(1), held(2)],
            LOST_PORT,
            "taring waiting settling refused taring waiting settling taken lift",
            "the port was lost",
        ),
    ],
)
def test_press_is_refused_with_a_reason_and_the_other_press_is_not(parts, flags, phases, reason):
    results = watch_presses(*parts, flags=flags)
    assert phases_of(results) == phases
    (refusal,) = [result.reason for result in results if result.phase is Phase.refused]
    assert re.match(reason, refusal), refusal


def test_press_after_a_restart_of_the_board_is_taken():
    """The clock of the board begins again at 0, far before the latest touch."""
    watch = PressWatch(NAMES)
    charge_pC = np.concatenate([rest(1), held(2), rest(1), rest(1), held(2)])
    results = []
    for number, reading in enumerate(readings(charge_pC, {800: (RESTART, TARE)})):
        reading.clock_s += 100.0 if number < 800 else -4.0
        results.append(watch.feed(reading))
    assert len(taken_presses(results)) == 2


def test_an_armed_watch_takes_no_press_that_has_begun():
    results = watch_presses(rest(1), held(2), rest(1), held(2), armed_frame=240)  # in the first press
    assert phases_of(results) == "waiting settling lift waiting settling taken lift"
