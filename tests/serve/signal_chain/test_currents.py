"""Boards that send currents: integral, leak, and detection of touches.

The charges are stated first, and the currents are their differences. The integral must return the charges.
"""

import math

import numpy as np
import pytest

from isocharge.common.errors import DeviceError
from isocharge.serve import Chunk, Frame, TouchStream, device_from_table, encode_frame
from isocharge.train.export_c.folder import device_header
from stage_runner import StageRunner, charges_and_contacts

RATE_HZ = 500.0
T_S = np.arange(0.0, 15.0, 1.0 / RATE_HZ)
RATIOS = np.linspace(0.9, -1.0, 8)
"""Charges of a press relative to its force. Their sum is negative."""

FORCE = np.interp(T_S, [0.0, 3.0, 3.4, 6.0, 8.0, 8.2, 11.0, 11.1, 14.0, 14.2], [0, 0, 1, 1, 0.6, 0, 0, 0.4, 0.4, 0])
"""Force of two presses, shape (n,), relative to the largest force."""


def currents(charge_pC, tau_s=math.inf):
    """Return the currents of charges, pC in a sampling interval, with an offset, noise and the leak of the film."""
    leak_pC = charge_pC / (tau_s * RATE_HZ)
    noise = 0.2 * np.random.default_rng(7).standard_normal(charge_pC.shape)
    return np.diff(charge_pC, axis=0, prepend=0.0) + leak_pC + noise - 300.0


def run(values, together=0, **sections):
    """Return the frames of a board that sends currents."""
    return StageRunner(8, front_end="current", **sections).run(values, RATE_HZ, together)


@pytest.mark.parametrize(("tau_s", "force"), [(math.inf, FORCE), (5.0, FORCE), (5.0, np.zeros_like(FORCE))])
def test_integral_of_currents_is_the_charge_and_detects_touches(tau_s, force):
    charge_pC = 1000.0 * force[:, None] * RATIOS
    sections = {} if math.isinf(tau_s) else {"leak": {"tau_s": tau_s}}
    frames = run(currents(charge_pC, tau_s), **sections)
    integral_pC, is_contact = charges_and_contacts(frames)
    assert not any("drift" in frame.flags for frame in frames)
    is_held = force > 0.3  # a contact of currents ends at 0.3 of its peak
    assert is_contact[is_held].sum() >= 0.98 * is_held.sum()
    assert not is_contact[(T_S < 3.0) | (np.abs(T_S - 9.5) < 1.0)].any()
    assert is_contact.any() == force.any()
    np.testing.assert_allclose(integral_pC[is_held], charge_pC[is_held], atol=60.0)


ORDERS = {
    "lost": [*range(52), *range(54, 85)],
    "repeated": [*range(54), *range(53, 85)],
    "late": [*range(53), 54, 53, *range(55, 85)],
    "counter stands still": range(85),
    "invalid": range(85),
}
"""Numbers of the frames in the order in which they arrive, by the damage of the transmission."""


@pytest.mark.parametrize("damage", ORDERS)
def test_charge_survives_a_damaged_frame_in_a_rise(damage, predictor):
    # 45 frames at rest, a rise of 20 frames with a current that grows and decreases, and a hold
    share = np.arange(20) / 19
    rise = 5.0 * share * (1.0 - share) ** 2
    current_pC = np.concatenate([np.zeros(45), rise, np.zeros(20)])[:, None] * [40.0, 30.0, 20.0]
    step = damage != "counter stands still"
    frames = [Frame(step * i, 1000 * i, tuple(row)) for i, row in enumerate(current_pC.tolist())]
    if damage == "invalid":
        frames[53].values = (math.nan,) * 3
    device = device_from_table({"front_end": "current", "tare": {"frames": 40}}, "b")
    stream = TouchStream(predictor, device)
    data = b"".join(encode_frame(frames[number]) for number in ORDERS[damage])
    *_, last = stream.frames(Chunk(data, 5.0, 0))
    # A lost current is assumed to be the mean of its neighbours, and each current is at most 1/9 of the charge.
    np.testing.assert_allclose(last.charge_pC, current_pC.sum(axis=0), rtol=0.01)


def test_noise_of_the_charges_grows_during_a_touch():
    """Error of the charge, relative to its stated standard deviation, 1 and 8 s after the beginning of a touch."""
    charge_pC = np.outer(np.arange(1300) >= 400, 1000.0 * RATIOS)
    errors = []
    for seed in range(6):
        noise_pC = np.random.default_rng(seed).normal(0.0, 0.3, charge_pC.shape)
        frames = StageRunner(8, front_end="current").run(np.diff(charge_pC, axis=0, prepend=0.0) + noise_pC, 100.0)
        errors.append([(frame.charge_pC - charge_pC[-1]) / frame.noise_pC for frame in (frames[500], frames[1200])])
    rms_errors = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert np.all((rms_errors > 0.7) & (rms_errors < 1.6))


def test_many_missing_currents_cause_no_touch_and_give_a_touch_the_flag_gap():
    values = currents(100.0 * FORCE[:, None] * RATIOS)
    values[750:1250] = values[2000:2500] = math.nan  # at rest, and during the first press
    frames = run(values, together=200)  # the frames of the tare have the same time
    assert not any(frame.is_contact for frame in frames[:1450])
    assert "gap" in frames[2900].flags


def test_currents_are_refused_in_c():
    with pytest.raises(DeviceError, match="b: front_end: the C code does not add up currents"):
        device_header(device_from_table({"front_end": "current"}, "b"), ("A", "B", "C"))
