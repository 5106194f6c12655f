"""The signal chain applied to the readings of the simulated amplifier, which shares no code with the chain."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.simulate import load_amplifier
from stage_runner import StageRunner, charges_and_contacts

RATE_HZ = 200.0


def held(*presses, seconds):
    """Charge (n, 3) of presses (start s, seconds, pC) with edges of 0.1 s."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    charge = sum(h * np.clip(np.minimum(t - start, start + length - t) / 0.1, 0, 1) for start, length, h in presses)
    return np.repeat(charge[:, None], 3, axis=1)


def undo(measurement, charge_pC, seed):
    """Touch charges and contact, with tau known to 0.5 % and gains to 0.2 %."""
    rng = np.random.default_rng(seed + 1000)
    output = measurement(charge_pC)
    gain = measurement.gain * (1 + 0.002 * rng.uniform(-1, 1, 3))
    tau = measurement.leak_time * (1 + 0.005 * rng.uniform(-1, 1, 3))
    sections = {
        "gain": {"pC_per_unit": dict(zip("ABC", (1 / gain).tolist(), strict=True))},
        "saturation": {"limit_pC": 1499.9},
        "hum": {"on": True},
        "leak": {"tau_s": dict(zip("ABC", tau.tolist(), strict=True))},
    }
    return charges_and_contacts(StageRunner(**sections).run(output, RATE_HZ))


@pytest.mark.first_cases(2)
@pytest.mark.parametrize("tau", [10.0, 1.0])
@pytest.mark.parametrize(("warming_K", "limit_pC"), [(0.0, 5.0), (0.05, 15.0)])
def test_two_held_presses(tau, warming_K, limit_pC):
    """Two presses of 400 pC for 8 s and 300 pC for 10 s have small errors at their ends, and zero afterwards.

    The amplifier is `bench`.
    """
    part = replace(load_amplifier("bench"), tau=tau, temperature_rms=warming_K)
    charge = held((6.0, 8.0, 400.0), (20.0, 10.0, 300.0), seconds=36.0)
    got, contact = undo(part.start(3, RATE_HZ, np.random.default_rng(0)), charge, 0)
    for end_s, height in ((13.8, 400.0), (29.8, 300.0)):
        at = round(end_s * RATE_HZ)
        assert np.abs(got[at - 20 : at].mean(axis=0) - height).max() < limit_pC
    touches = np.flatnonzero(np.diff(contact.astype(int)))
    assert len(touches) == 4
    assert np.abs(touches / RATE_HZ - [6.0, 14.0, 20.0, 30.0]).max() < 0.15
    assert np.abs(got[round(34.0 * RATE_HZ) :].mean(axis=0)).max() < 1.0


def test_a_minute_of_rest_gives_no_touch():
    """The amplifier is `bench`, whose film temperature changes."""
    part = load_amplifier("bench").start(3, RATE_HZ, np.random.default_rng(0))
    _, contact = undo(part, np.zeros((12_000, 3)), 0)
    assert not contact.any()
