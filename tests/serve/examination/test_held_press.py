"""Description of a held press whose charge follows a law in closed form: constant, leak, creep or drift."""

import re

import numpy as np
import pytest

from boards import encoded_frames, received
from isocharge.serve import device_from_table
from isocharge.serve.examination.held_press import HeldPress, find_held_press
from isocharge.serve.examination.port_check import examine_received
from isocharge.serve.signal_chain.leak import LeakRule

T_S = np.arange(0.0, 20.0, 0.005)


def board(law, drift=0.0, until_s=18.0, scale=1.0):
    """Return the values of three channels, one of them inverted, with an offset, noise and a press after 5 s.

    Args:
        law: Function that returns the relative charge of the press at some times since its beginning, s.
        drift: Slope of the channels, in 1/s.
        until_s: End of the press, s. The system is linear, so a release has the effect of an opposite press.
        scale: Factor of all values. Before it, the noise has the standard deviation 1.
    """
    press = drift * T_S / 500.0
    for begin_s, sign in ((5.0, 1.0), (max(until_s, 5.0), -1.0)):
        since_s = T_S - begin_s
        press = press + sign * np.where(since_s > 0.0, law(np.maximum(since_s, 0.005)), 0.0)
    charge = np.outer(press, (500.0, -400.0, 600.0))
    return scale * np.random.default_rng(0).normal(charge + 300.0, 1.0)


def constant(t):
    return np.ones_like(t)


def decays(tau_s):
    """Return the law of an amplifier that leaks."""
    return lambda t: np.exp(-t / tau_s)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 20.0])
@pytest.mark.parametrize(
    ("law", "drift", "tau_s", "message"),
    [
        (constant, 0.0, None, "keeps its charge for 13 s"),
        (decays(10.0), 0.0, 10.0, r"leaks: put \[leak\] tau_s"),
        (decays(40.0), 0.0, 40.0, r"leaks: put \[leak\] tau_s"),
        # 1 - 10^-0.03 is 6.7 %
        (lambda t: t**-0.03, 0.0, None, "creeps by 6.[5-9] % in each decade .* set no"),
        (lambda t: 1.0 - 0.05 * np.log10(t) + 0.06 * np.exp(-t / 2.5), 0.0, None, "changes by -[4-9]"),
        (constant, -8.0, None, "the rest level drifts by -1.6 % .* measure again"),
        (lambda t: 1.0 + 0.1 * np.sin(t), 0.0, None, "neither a leak .* nor creep"),
    ],
)
def test_held_press_finds_leak_creep_or_drift(law, drift, tau_s, message, scale):
    held = find_held_press(board(law, drift, scale=scale), T_S)
    assert held.rest_end_s == pytest.approx(4.9, abs=0.2)
    assert held.tau_s == (tau_s and pytest.approx(tau_s, rel=0.15))
    assert re.search(message, held.description)


def test_held_press_is_found_if_a_channel_sends_no_numbers():
    values = board(decays(10.0))
    values[:, 1] = np.nan
    assert find_held_press(values, T_S).tau_s == pytest.approx(10.0, rel=0.15)


@pytest.mark.parametrize("every", [20, 25, 50])
def test_leak_of_a_slow_board_has_its_time_constant(every):
    values = board(decays(10.0))[::every]  # 10, 8 and 4 frames per second
    held = find_held_press(values, T_S[::every])
    assert held.tau_s == pytest.approx(10.0, rel=0.05)
    assert 4.5 < held.rest_end_s <= 5.0


def test_leak_has_its_time_constant_although_frames_are_lost():
    has_arrived = (T_S < 6.0) | (T_S % 1.0 < 0.6)
    assert find_held_press(board(decays(10.0))[has_arrived], T_S[has_arrived]).tau_s == pytest.approx(10.0, rel=0.05)


@pytest.mark.parametrize("until_s", [0.0, 7.0])
def test_no_press_or_a_short_press_has_no_result(until_s):
    assert find_held_press(board(constant, until_s=until_s), T_S) == HeldPress()
    assert find_held_press(board(constant)[:300], T_S[:300]) == HeldPress()


def test_proposed_file_has_the_leak_and_the_offset_before_the_press():
    values = board(decays(10.0)) - 300.0
    report = examine_received(received(encoded_frames(values), 200.0))
    assert device_from_table(report.device, "board").rule(LeakRule).tau_s == pytest.approx(10.0, rel=0.05)
    assert max(abs(channel.offset_pC) for channel in report.channels) < 1.0
    assert report.missing == ()
    assert "put [leak] tau_s = 10 into a device file" in report.held
    assert report.missing_for_held_presses == ()
