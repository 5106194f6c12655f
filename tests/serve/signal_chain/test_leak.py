"""Tests of the leak correction with the output of a leaky integrator in closed form."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from stage_runner import StageRunner, charges_and_contacts

RATE_HZ = 200.0
"""Number of frames per second, Hz."""

TAU_S = 2.0
"""Time constant of the amplifiers, s."""


def amplifier_output(charge_pC):
    """Compute the output of an amplifier, shape (n,), pC, if the charge is linear between two frames.

    With a constant current i between the frames, dv/dt = i - v / tau has the solution v[n] = a v[n-1] + i tau (1 - a).
    """
    interval = 1.0 / (RATE_HZ * TAU_S)  # relative to the time constant
    gain = -math.expm1(-interval) / interval
    return lfilter([gain, -gain], [1.0, -math.exp(-interval)], charge_pC)


def touch_charge(begin_s=3.0, duration_s=8.0, height_pC=400.0, seconds=20.0):
    """Compute the touch charge of a press whose charge rises and falls within 50 ms, shape (n,), pC.

    Args:
        begin_s: Begin of the press, s.
        duration_s: Duration of the press, s.
        height_pC: Charge of the press, pC.
        seconds: Length of the simulation, s.
    """
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return height_pC * np.clip(np.minimum(t - begin_s, begin_s + duration_s - t) / 0.05, 0.0, 1.0)


def correct_leak(output_pC, every=1, tau_s=TAU_S, noise_pC=0.0, **settings):
    """Correct the leak of three electrodes with the same output, except for the noise.

    Args:
        output_pC: Output of the amplifiers, shape (n,), pC.
        every: Only every such frame arrives.
        tau_s: Time constant that the correction assumes, s.
        noise_pC: Standard deviation of the noise, pC.
        settings: Further settings of the section `[leak]`.

    Returns:
        Touch charges, shape (m, 3), pC, NaN before the tare; and whether something touches, shape (m,).
    """
    chain = StageRunner(tare={"frames": 20}, leak={"tau_s": tau_s} | settings)
    noise = np.random.default_rng(0).normal(0.0, noise_pC, (len(output_pC), 3))
    return charges_and_contacts(chain.run((output_pC[:, None] + noise)[::every], RATE_HZ / every))


def test_held_press_keeps_its_charge_despite_the_leak():
    output_pC = amplifier_output(touch_charge())
    assert output_pC[2150] < 20.0  # the output of the amplifier at the end of the press
    charge_pC, contact = correct_leak(output_pC)
    held = slice(700, 2180)
    np.testing.assert_allclose(charge_pC[held, 0], 400.0, atol=0.5)
    assert contact[held].all()
    assert not contact[2250:].any()
    np.testing.assert_allclose(charge_pC[2900:], 0.0, atol=0.05)
    # Every second frame is lost. The correction uses the time since the previous frame that has arrived.
    charge_pC, _ = correct_leak(output_pC, every=2)
    np.testing.assert_allclose(charge_pC[1000, 0], 400.0, atol=3.0)


@pytest.mark.parametrize("is_invalid", [False, True])
@pytest.mark.parametrize(
    ("gap_s", "is_falsified", "touch_end_s"),
    [
        ((2.9, 3.5), True, 11.0),  # contains the beginning of the touch
        ((10.95, 11.5), False, 11.5),  # contains its end
        ((5.0, 6.0), False, 11.0),  # the charge is constant
        ((3.02, 3.03), False, 11.0),  # short
    ],
)
def test_touch_has_the_flag_gap_to_its_end_if_missing_frames_falsify_its_charge(
    gap_s, is_falsified, touch_end_s, is_invalid
):
    """The touch of 400 pC begins after 3 s and ends after 11 s. The inflow is 4 pC/s, so that 8 pC remain at rest."""
    inflow_pC = 0.02 * np.arange(2600)
    output_pC = amplifier_output(touch_charge(seconds=13.0) + inflow_pC)[:, None]
    output_pC = output_pC + np.random.default_rng(0).normal(0.0, 0.3, (2600, 3))
    chain = StageRunner(tare={"frames": 20}, leak={"tau_s": TAU_S})
    previous_s = 0.0
    for index, values in enumerate(output_pC):
        t_s = index / RATE_HZ
        if gap_s[0] <= t_s < gap_s[1]:
            if not is_invalid:
                continue
            values = np.full(3, np.nan)
        reading = chain.advance(values, t_s, t_s - previous_s)
        previous_s = t_s
        if reading.is_contact:
            assert ("gap" in reading.flags) == is_falsified
            assert t_s < touch_end_s + 0.06
            if 3.1 < t_s < 10.9 and not is_falsified:
                assert np.abs(reading.charge_pC - 400.0).max() < 12.0
        elif t_s > touch_end_s + 0.1:
            assert "gap" not in reading.flags
            assert is_falsified or np.abs(reading.charge_pC).max() < 20.0


@pytest.mark.parametrize("rate_Hz", [10.0, 30.0, 200.0, 1000.0])
@pytest.mark.parametrize("tau_s", [1.0, 10.0])
def test_press_has_its_charge_at_any_rate(rate_Hz, tau_s):
    """A current of 400 pC / 30 ms flows for 30 ms. The equation dv/dt = i - v / tau is solved in closed form.

    Presses at random times between two frames have the correct charge on average. The charge that arrives in the first
    frame of the touch must not decay like the charge at rest, and has decayed in the amplifier for half a frame.
    """
    rise_s = 0.03
    charges = []
    for delay in range(5):
        since_touch_s = (np.arange(-15.0, rate_Hz) - 0.2 * delay) / rate_Hz
        charging_s = np.clip(since_touch_s, 0.0, rise_s)
        decay = np.exp(-np.maximum(since_touch_s - rise_s, 0.0) / tau_s)
        output_pC = 400.0 / rise_s * tau_s * -np.expm1(-charging_s / tau_s) * decay
        chain = StageRunner(tare={"frames": 10}, leak={"tau_s": tau_s})
        charges.append(chain.run(np.tile(output_pC[:, None], 3), rate_Hz)[-1].charge_pC[0])
    assert np.mean(charges) == pytest.approx(400.0, rel=3e-3 if rate_Hz * tau_s < 50.0 else 5e-4)


def test_charge_that_was_subtracted_as_warming_does_not_leak_from_the_integral_of_currents():
    """Without a current, the charge that remains decays with the time constant of the integral."""
    chain = StageRunner(front_end="current", tare={"frames": 10}, leak={"tau_s": 1.0})
    currents_pC = np.zeros((30, 3))
    currents_pC[20:23] = 100.0
    *_, frame = chain.run(currents_pC, 100.0)
    assert frame.is_contact
    frame.warming_pC = 20.0
    next_frame = chain.advance(np.zeros(3), 0.4, 0.1)
    np.testing.assert_allclose(next_frame.charge_pC, (frame.charge_pC - 20.0) * math.exp(-0.1), rtol=1e-3)


def test_inflow_is_learned_out_of_contact():
    """The inflow is 5 pC/s. Without its estimate, it adds 50 pC to each electrode in a press of 10 s.

    The noise of 2 pC hardly changes the estimate.
    """
    press_pC = touch_charge(12.0, 10.0, 300.0, seconds=24.0)
    inflow_pC = 0.025 * np.arange(4800)
    output_pC = amplifier_output(press_pC + inflow_pC)
    end_of_press = slice(4300, 4350)
    with_estimate, _ = correct_leak(output_pC, noise_pC=2.0)
    without_estimate, _ = correct_leak(output_pC, learn=False)
    np.testing.assert_allclose(with_estimate[end_of_press].mean(axis=0), 300.0, atol=2.5)
    assert without_estimate[end_of_press].min() > 340.0


def test_error_of_tau_has_the_theoretical_effect():
    """The expected charge is q' = q (1 + (tau / tau' - 1)(1 - exp(-t / tau))) at a time t after the touch.

    Here tau' is the assumed time constant. The formula holds in the limit of short steps.
    """
    charge_pC, _ = correct_leak(amplifier_output(touch_charge()), tau_s=1.05 * TAU_S)
    lost_share = 0.05 / 1.05 * (1 - math.exp(-7.0 / TAU_S))
    assert charge_pC[2000, 0] == pytest.approx(400.0 * (1 - lost_share), abs=1.0)
