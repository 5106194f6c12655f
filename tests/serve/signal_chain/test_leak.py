"""The leak undone, against the closed form of a leaky integrator: v decays, q stays."""

import numpy as np
import pytest

from isocharge.serve import Chain
from isocharge.serve.signal_chain.chain import SignalChain
from isocharge.serve.signal_chain.leak import Leak, LeakRule, undo_leak
from isocharge.serve.signal_chain.tare import TareRule

RATE_HZ, TAU_S = 200.0, 2.0


def integrator(charge_pC):
    """v[n] = a v[n-1] + q[n] - q[n-1] by its impulse response, from rest, for charges (n,)."""
    n = np.arange(len(charge_pC))
    return np.convolve(np.diff(charge_pC, prepend=0.0), np.exp(-n / (RATE_HZ * TAU_S)))[: len(n)]


def pressed(*presses, seconds=20.0):
    """Charge (n,) of presses (start s, seconds, pC) with edges of 50 ms."""
    t, charge = np.arange(round(seconds * RATE_HZ)) / RATE_HZ, np.zeros(round(seconds * RATE_HZ))
    for start, length, height in presses:
        charge += height * np.clip(np.minimum(t - start, start + length - t) / 0.05, 0.0, 1.0)
    return charge


def undo(output_pC, rule=None, every=1, tau_s=TAU_S):
    """Touch charges (n, 3) and contact (n,) of one output (n,) on three electrodes; only every so many frames come."""
    settings = Chain(tare=TareRule(frames=20), tau_s=np.full(3, tau_s), leak=rule or LeakRule())
    chain = SignalChain(settings, 3)
    charges, contact, last = [], [], 0.0
    for k, v in enumerate(output_pC):
        if k % every:
            continue
        reading = chain.advance(np.full(3, v), k / RATE_HZ, k / RATE_HZ - last)
        last = k / RATE_HZ
        charges.append(np.full(3, np.nan) if reading.charge_pC is None else reading.charge_pC)
        contact.append(reading.contact)
    return np.array(charges), np.array(contact)


def test_held_press_keeps_its_charge_despite_the_leak():
    output = integrator(pressed((3.0, 8.0, 400.0)))
    assert output[2150] < 20.0  # what the amplifier still shows at the end of the press
    got, contact = undo(output)
    held = slice(700, 2180)
    np.testing.assert_allclose(got[held, 0], 400.0, atol=0.5)
    assert contact[held].all()
    assert not contact[2250:].any()
    np.testing.assert_allclose(got[2900:], 0.0, atol=0.05)


def test_inflow_is_learned_out_of_contact():
    """5 pC/s from the tare on; unlearned, they add 50 pC to each electrode in a press of 10 s."""
    charge = pressed((8.0, 10.0, 300.0), seconds=22.0)
    since_s = np.maximum(0.0, np.arange(charge.size) / RATE_HZ - 0.5)
    output = integrator(charge) + 5.0 * TAU_S * (1.0 - np.exp(-since_s / TAU_S))
    np.testing.assert_allclose(undo(output)[0][3550, 0], 300.0, atol=8.0)
    assert undo(output, LeakRule(learn=False))[0][3550, 0] > 340.0


def test_two_presses_in_a_row_do_not_spoil_each_other():
    got, contact = undo(integrator(pressed((3.0, 4.0, 400.0), (7.3, 4.0, 200.0))))
    np.testing.assert_allclose(got[1300, 0], 400.0, atol=0.5)
    np.testing.assert_allclose(got[2200, 0], 200.0, atol=4.0)  # the foot of the second is lost to the relaxing base
    assert np.count_nonzero(np.diff(contact.astype(int)) == 1) == 2


def test_lost_frames_hardly_change_the_charge():
    """Every second frame lost while pressed: the step is twice as long, and a is taken for it."""
    got, _ = undo(integrator(pressed((3.0, 8.0, 400.0))), every=2)
    np.testing.assert_allclose(got[1000, 0], 400.0, atol=3.0)


@pytest.mark.parametrize("error", [0.005, 0.05])
def test_error_of_tau_has_the_theoretical_effect(error):
    """q' = q (1 + (tau / tau' - 1)(1 - exp(-t / tau))) in the limit of small steps, for a step held for t."""
    got, _ = undo(integrator(pressed((3.0, 8.0, 400.0))), tau_s=TAU_S * (1 + error))
    expected = 400.0 * (1 + (1 / (1 + error) - 1) * (1 - np.exp(-7.0 / TAU_S)))
    assert got[2000, 0] == pytest.approx(expected, abs=1.0)


def test_slow_common_warming_is_no_touch():
    output = integrator(3.0 * np.arange(4000) / RATE_HZ)  # 3 pC/s on each electrode
    got, contact = undo(output)
    assert not contact.any()
    assert np.abs(got[1000:]).max() < 4.0


def leak_after(surplus_pC, noise_pC=1.0, **state):
    """What is known after one frame of 5 ms in which so much came, nothing touching."""
    rule = LeakRule()
    leak = Leak.start(np.zeros(3))._replace(learned_s=10.0, **state)
    return undo_leak(rule, np.full(3, TAU_S), leak, np.full(3, surplus_pC), np.full(3, noise_pC), 0.005, contact=False)


def test_spike_is_clipped_in_learning():
    """Four standard deviations of an innovation, sqrt(2) pC each, over 3 s of settling."""
    assert leak_after(1.0).inflow_pC_per_s == pytest.approx(np.full(3, 1.0 / 3.0))
    assert leak_after(1000.0).inflow_pC_per_s == pytest.approx(np.full(3, 4.0 * np.sqrt(2.0) / 3.0))
    assert leak_after(-1000.0, noise_pC=0.0).inflow_pC_per_s == pytest.approx(np.full(3, -0.1 / 3.0))


def test_learning_pauses_after_a_release():
    """A finger that leaves takes the last twentieth of its charge after the release."""
    rule = LeakRule()
    leak = Leak.start(np.zeros(3))._replace(learned_s=10.0)
    leak = undo_leak(rule, np.full(3, TAU_S), leak, np.full(3, 40.0), np.ones(3), 0.005, contact=True)
    for k in range(99):
        leak = undo_leak(rule, np.full(3, TAU_S), leak, np.full(3, 40.0 - 0.4 * k), np.ones(3), 0.005, contact=False)
    assert not leak.inflow_pC_per_s.any()
    for k in range(20):
        leak = undo_leak(rule, np.full(3, TAU_S), leak, np.full(3, -0.4 * k), np.ones(3), 0.005, contact=False)
    assert leak.inflow_pC_per_s.any()
